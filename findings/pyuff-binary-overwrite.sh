#!/usr/bin/env bash
# pyuff 2.5.8: `write_sets(set, "overwrite")` of a binary data set leaves an empty file, without an error.
#
# A data set 58 with `binary=1` has a text header and binary samples. To change from one to the other the writer
# closes the file and opens it again with the mode "overwrite", which deletes the header, and then the samples. The
# file has 7 bytes and `read_sets` returns an empty list. ASCII data sets, and "add" to a new file, are right. A NaN
# is written as 0 in any form.
#
# Output seen (samples 1, NaN, 3, 4):
#   ASCII, overwrite: read [1.0, 0.0, 3.0, 4.0]
#   binary, overwrite: 7 bytes, read nothing
#   binary, add: read [1.0, 0.0, 3.0, 4.0]
#
# What to do: delete the file and use "add"; cut out missing samples before.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pyuff==2.5.8 numpy==1.26.4
cd "$folder"
venv/bin/python - >output <<'PYTHON'
import os

import numpy as np
import pyuff

for name, binary, mode in (("ASCII", 0, "overwrite"), ("binary", 1, "overwrite"), ("binary", 1, "add")):
    if os.path.exists("response.uff"):
        os.remove("response.uff")
    response = {
        "type": 58, "binary": binary, "func_type": 1, "id1": "plate",
        "rsp_node": 1, "rsp_dir": 3, "ref_node": 1, "ref_dir": 3, "rsp_ent_name": "NONE", "ref_ent_name": "NONE",
        "abscissa_spacing": 1, "abscissa_spec_data_type": 17, "ordinate_spec_data_type": 8,
        "orddenom_spec_data_type": 0, "z_axis_spec_data_type": 0,
        "x": np.arange(4) * 1e-3, "data": np.array([1.0, np.nan, 3.0, 4.0]),
    }
    pyuff.UFF("response.uff").write_sets(response, mode)
    sets = pyuff.UFF("response.uff").read_sets()
    if sets:
        print(f"{name}, {mode}: read {sets['data'].tolist()}")
    else:
        print(f"{name}, {mode}: {os.path.getsize('response.uff')} bytes, read nothing")
PYTHON
cat output
diff output - <<'EXPECTED'
ASCII, overwrite: read [1.0, 0.0, 3.0, 4.0]
binary, overwrite: 7 bytes, read nothing
binary, add: read [1.0, 0.0, 3.0, 4.0]
EXPECTED
