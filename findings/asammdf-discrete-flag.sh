#!/usr/bin/env bash
# asammdf 8.8.28: interpolates a channel that has the flag "discrete value", and drops rows that share an instant.
#
# MDF 4 has a channel flag for values that hold until the next record (a drive, a setpoint). `Signal.interp` and
# `MDF.resample` interpolate such a channel linearly all the same. `MDF.configure(float_interpolation=0)` holds the
# values. `to_dataframe` keeps one of two records at one instant, so a step becomes a ramp in a plot.
#
# Output seen:
#   discrete flag read back: True
#   default, resampled at 0.5 s: 5.0
#   float_interpolation=0, resampled at 0.5 s: 0.0
#   records 4, rows of to_dataframe 3
#
# What to do: call `configure(float_interpolation=0)` first, and read signals with `get` instead of `to_dataframe`.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check asammdf==8.8.28
cd "$folder"
venv/bin/python - >output <<'PYTHON'
import numpy as np
from asammdf import MDF, Signal
from asammdf.blocks.v4_constants import FLAG_CN_DISCRETE


def resampled(configure):
    with MDF("held.mf4") as file:
        if configure:
            file.configure(float_interpolation=0)
        return file.resample(0.5).get("drive").samples[1]


with MDF(version="4.10") as file:
    file.append([Signal(np.array([0.0, 10.0, 10.0]), np.array([0.0, 1.0, 2.0]), name="drive", unit="V")])
    for channel in file.groups[0].channels:
        if channel.name == "drive":
            channel.flags |= FLAG_CN_DISCRETE
    file.save("held.mf4")
with MDF("held.mf4") as file:
    flags = [channel.flags for channel in file.groups[0].channels if channel.name == "drive"]
    print("discrete flag read back:", bool(flags[0] & FLAG_CN_DISCRETE))
print("default, resampled at 0.5 s:", resampled(False))
print("float_interpolation=0, resampled at 0.5 s:", resampled(True))
with MDF(version="4.10") as file:
    file.append([Signal(np.array([0.0, 1.0, 2.0, 3.0]), np.array([0.0, 1.0, 1.0, 2.0]), name="drive")])
    print(f"records {len(file.get('drive').samples)}, rows of to_dataframe {len(file.to_dataframe())}")
PYTHON
cat output
diff output - <<'EXPECTED'
discrete flag read back: True
default, resampled at 0.5 s: 5.0
float_interpolation=0, resampled at 0.5 s: 0.0
records 4, rows of to_dataframe 3
EXPECTED
