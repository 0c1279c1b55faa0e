#!/usr/bin/env bash
# tm_data_types 0.5.0 (Tektronix): reads a CSV file into 16 bits between its extremes; one NaN makes every sample NaN.
#
# `read_file` of a CSV file stores the column as int16 between its smallest and its largest value. One spike of 1e6
# moves a sample of 1 to 8.6. The file contains the exact numbers, and the .wfm file of the same waveform is read
# exactly.
#
# Output seen:
#   1, 2, 3: CSV [1.00002, 2.0, 2.99998], WFM [1.0, 2.0, 3.0]
#   1, 2, 1000000: CSV [8.6295, 8.6295, 999992.3705], WFM [1.0, 2.0, 1000000.0]
#   1, nan, 3: CSV [nan, nan, nan], WFM [1.0, nan, 3.0]
#
# What to do: read the CSV file with a CSV reader, or write and read .wfm.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check tm_data_types==0.5.0 numpy==1.26.4
cd "$folder"
venv/bin/python -W ignore - >output <<'PYTHON'
import numpy as np
from tm_data_types import AnalogWaveform, read_file, write_file


def read_back(path, values):
    waveform = AnalogWaveform()
    waveform.y_axis_values, waveform.x_axis_spacing, waveform.trigger_index = np.array(values, float), 1e-6, 0.0
    write_file(path, waveform)
    return np.round(read_file(path).normalized_vertical_values, 5).tolist()


for values in ((1, 2, 3), (1, 2, 1_000_000), (1, float("nan"), 3)):
    name = ", ".join(map(str, values))
    print(f"{name}: CSV {read_back('curve.csv', values)}, WFM {read_back('curve.wfm', values)}")
PYTHON
cat output
diff output - <<'EXPECTED'
1, 2, 3: CSV [1.00002, 2.0, 2.99998], WFM [1.0, 2.0, 3.0]
1, 2, 1000000: CSV [8.6295, 8.6295, 999992.3705], WFM [1.0, 2.0, 1000000.0]
1, nan, 3: CSV [nan, nan, nan], WFM [1.0, nan, 3.0]
EXPECTED
