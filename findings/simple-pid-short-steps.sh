#!/usr/bin/env bash
# simple-pid 2.0.1: with `dt` given and shorter than 10 ms, the controller always returns its first output.
#
# `PID(...)` has `sample_time=0.01`, and a call that comes earlier returns the last output. The check also applies to
# the `dt` of a simulation in lockstep: with `pid(value, dt=0.001)` each call is "too early", no time is added, and
# the output never changes. The first output is computed, so a test of one step passes. No warning is given.
#
# Output seen (first-order plant, 30 steps of 1 ms):
#   sample_time default: outputs that differ 1, plant ends at 2.200 for a setpoint of 2
#   sample_time=None: outputs that differ 30, plant ends at 1.801 for a setpoint of 2
#
# What to do: `PID(..., sample_time=None)` if the caller gives `dt`.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check simple-pid==2.0.1
cd "$folder"
venv/bin/python - >output <<'PYTHON'
from simple_pid import PID


def played(name, **settings):
    pid = PID(1.0, 100.0, 0.0, setpoint=2.0, **settings)
    value, outputs = 0.0, []
    for _ in range(30):
        outputs.append(pid(value, dt=1e-3))
        value += 0.4 * (outputs[-1] - value)
    print(f"{name}: outputs that differ {len(set(outputs))}, plant ends at {value:.3f} for a setpoint of 2")


played("sample_time default")
played("sample_time=None", sample_time=None)
PYTHON
cat output
diff output - <<'EXPECTED'
sample_time default: outputs that differ 1, plant ends at 2.200 for a setpoint of 2
sample_time=None: outputs that differ 30, plant ends at 1.801 for a setpoint of 2
EXPECTED
