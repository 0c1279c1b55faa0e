#!/usr/bin/env bash
# fastparquet 2026.9.0: reads booleans with RLE encoding in data pages of version 1 at the wrong rows, without an error.
#
# The Parquet format allows RLE for boolean values in data pages of version 1; the values then begin with a length of
# four bytes. pyarrow 26.0.1 writes such a file and reads it back rightly. fastparquet returns true values four rows
# late. With PLAIN encoding, or with data pages of version 2, it is right.
#
# Output seen (true rows 3, 17 and 30 of 40):
#   version 1.0, RLE: pyarrow [3, 17, 30], fastparquet [7, 21, 34]
#   version 1.0, PLAIN: pyarrow [3, 17, 30], fastparquet [3, 17, 30]
#   version 2.0, RLE: pyarrow [3, 17, 30], fastparquet [3, 17, 30]
#
# What to do: write booleans as PLAIN or with data pages of version 2 if fastparquet reads the file.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    fastparquet==2026.9.0 pyarrow==26.0.1 pandas==3.1.1 numpy==2.4.6 cramjam==2.14.0
cd "$folder"
venv/bin/python - >output <<'PYTHON'
import fastparquet
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

flags = np.zeros(40, bool)
flags[[3, 17, 30]] = True
for version, encoding in (("1.0", "RLE"), ("1.0", "PLAIN"), ("2.0", "RLE")):
    pq.write_table(
        pa.table({"saturated": flags}),
        "flags.parquet",
        use_dictionary=False,
        data_page_version=version,
        column_encoding={"saturated": encoding},
    )
    rows = lambda values: np.flatnonzero(values).tolist()
    arrow = rows(pq.read_table("flags.parquet")["saturated"].to_numpy())
    fast = rows(fastparquet.ParquetFile("flags.parquet").to_pandas()["saturated"].to_numpy())
    print(f"version {version}, {encoding}: pyarrow {arrow}, fastparquet {fast}")
PYTHON
cat output
diff output - <<'EXPECTED'
version 1.0, RLE: pyarrow [3, 17, 30], fastparquet [7, 21, 34]
version 1.0, PLAIN: pyarrow [3, 17, 30], fastparquet [3, 17, 30]
version 2.0, RLE: pyarrow [3, 17, 30], fastparquet [3, 17, 30]
EXPECTED
