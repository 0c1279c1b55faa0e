#!/usr/bin/env bash
# npTDMS 1.13.0: writes big-endian arrays with their bytes unchanged under a little-endian header.
#
# Instruments send curves in big-endian order, and numpy keeps that order in the type ('>f8', '>i2').
# `TdmsWriter` stores the bytes as they are, and the file then contains other numbers. No error is raised.
#
# Output seen (1, 2, 3 written):
#   <f8: [1.0, 2.0, 3.0]
#   >f8: [3.03865e-319, 3.16e-322, 1.0435e-320]
#   >i2: [256, 512, 768]
#
# What to do: convert with `array.astype(array.dtype.newbyteorder("="))` before writing.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check npTDMS==1.13.0 numpy==2.4.6
cd "$folder"
venv/bin/python - >output <<'PYTHON'
import numpy as np
from nptdms import ChannelObject, TdmsFile, TdmsWriter

for order in ("<f8", ">f8", ">i2"):
    with TdmsWriter("curve.tdms") as file:
        file.write_segment([ChannelObject("scope", "channel 1", np.array([1, 2, 3], dtype=order))])
    print(f"{order}: {TdmsFile.read('curve.tdms')['scope']['channel 1'][:].tolist()}")
PYTHON
cat output
diff output - <<'EXPECTED'
<f8: [1.0, 2.0, 3.0]
>f8: [3.03865e-319, 3.16e-322, 1.0435e-320]
>i2: [256, 512, 768]
EXPECTED
