#!/usr/bin/env bash
# DataFusion 55.0.0: reads a whole CSV column as null if its first 1,000 cells are empty.
#
# The type of a column is inferred from the first 1,000 rows. A column that is empty there gets the type null, and every
# later number becomes null without an error. One number among the first 1,000 rows gives a column of doubles.
#
# Output seen (three numbers after the empty cells):
#   999 empty cells: type double, 3 numbers
#   1000 empty cells: type null, 0 numbers
#
# What to do: pass a schema, or a larger `schema_infer_max_records`; Parquet needs neither.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check datafusion==55.0.0
cd "$folder"
venv/bin/python - >output <<'PYTHON'
from datafusion import SessionContext

for empty in (999, 1000):
    cells = [""] * empty + ["1.5"] * 3
    with open("trials.csv", "w") as file:
        file.write("trial,value\n" + "".join(f"{trial},{cell}\n" for trial, cell in enumerate(cells)))
    table = SessionContext().read_csv("trials.csv")
    numbers = sum(value is not None for value in table.to_pydict()["value"])
    print(f"{empty} empty cells: type {table.schema().field('value').type}, {numbers} numbers")
PYTHON
cat output
diff output - <<'EXPECTED'
999 empty cells: type double, 3 numbers
1000 empty cells: type null, 0 numbers
EXPECTED
