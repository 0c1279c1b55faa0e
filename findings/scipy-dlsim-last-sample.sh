#!/usr/bin/env bash
# SciPy 1.17.1: `dlsim` returns one sample less than `t` for one of eight durations.
#
# The number of output samples is floor(t[-1] / dt) + 1. With dt = 0.001 the quotient of 0.043 is 42.99…, so the last
# sample is missing from time, output and states. `t = linspace(0, (n - 1) / 1000, n)` and a recorded time column
# contain such ends; `arange(n) * dt` has none below 1,000 samples.
#
# Output seen (dt = 1 ms, n = 2 to 999 samples):
#   linspace: 126 of 998 lengths lose the last sample, first 44, 52, 60
#   arange(n) * dt: 0 of 998 lengths lose the last sample
#
# What to do: call `dlsim` without `t`, or with `arange(n) * dt`.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python - >output <<'PYTHON'
import numpy as np
from scipy.signal import StateSpace, dlsim

dt = 1e-3
delay = StateSpace([[0.0]], [[1.0]], [[1.0]], [[0.0]], dt=dt)
lost = lambda time: [n for n in range(2, 1000) if len(dlsim(delay, np.arange(float(n)), time(n))[0]) == n - 1]
shorter = lost(lambda n: np.linspace(0, (n - 1) / 1000, n))
print(f"linspace: {len(shorter)} of 998 lengths lose the last sample, first {', '.join(map(str, shorter[:3]))}")
print(f"arange(n) * dt: {len(lost(lambda n: np.arange(n) * dt))} of 998 lengths lose the last sample")
PYTHON
cat output
diff output - <<'EXPECTED'
linspace: 126 of 998 lengths lose the last sample, first 44, 52, 60
arange(n) * dt: 0 of 998 lengths lose the last sample
EXPECTED
