#!/usr/bin/env bash
# python-control 0.10.2: `step_info` measures a response from 0, so a step from 1 to 2 has half its overshoot.
#
# Rise, settling and overshoot refer to the final value, not to the size of the step, and there is no argument for the
# initial value. The settling band of 2 % is twice as wide for a step from 1 to 2 µm as for the same step from 0 to 1
# µm.
#
# Output seen (the same second-order step, 200 Hz, time constant 1.88 ms):
#   from 0 to 1: overshoot 26.5 %, rise 1.06 ms, settling 6.17 ms
#   from 1 to 2: overshoot 13.2 %, rise 1.28 ms, settling 5.82 ms
#
# What to do: subtract the initial value first: `step_info(y - y[0], t)`.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check control==0.10.2 numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python -W ignore - >output <<'PYTHON'
import control
import numpy as np

time = np.linspace(0, 60e-3, 6001)
decay, frequency = 1 / 1.88e-3, 2 * np.pi * 200
step = 1 - np.exp(-decay * time) * (np.cos(frequency * time) + decay / frequency * np.sin(frequency * time))
for name, response in (("from 0 to 1", step), ("from 1 to 2", 1 + step)):
    info = control.step_info(response, time)
    rise, settling = info["RiseTime"] * 1e3, info["SettlingTime"] * 1e3
    print(f"{name}: overshoot {info['Overshoot']:.1f} %, rise {rise:.2f} ms, settling {settling:.2f} ms")
PYTHON
cat output
diff output - <<'EXPECTED'
from 0 to 1: overshoot 26.5 %, rise 1.06 ms, settling 6.17 ms
from 1 to 2: overshoot 13.2 %, rise 1.28 ms, settling 5.82 ms
EXPECTED
