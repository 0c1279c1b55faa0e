#!/usr/bin/env bash
# DuckDB 2.0.0 finds no NaN in a Parquet file with statistics, and DuckDB, DataFusion 55.0.0 and pyarrow 26.0.1 drop
# NaN rows if a filter skips a row group.
#
# The statistics of a Parquet column omit NaN: the format requires it. pyarrow writes minimum and maximum of the
# numbers. DuckDB concludes from them that the column has no NaN: `isnan(v)` is false in every row, and `not isnan(v)`
# keeps the NaN. `isfinite(v)` is right. The usual filter for "missing or too slow", `not (v <= limit)`, loses the NaN
# if its row group contains no slow value, although all three readers keep it for the same table in memory. Polars
# 2.1.0 is right.
#
# Output seen (settling times 1, 2, NaN in the first row group and 3, 7, 8 in the second; rows from 0):
#   DuckDB, isnan(v): memory [2], file []
#   DuckDB, not isnan(v): memory [0, 1, 3, 4, 5], file [0, 1, 2, 3, 4, 5]
#   DuckDB, isfinite(v): memory [0, 1, 3, 4, 5], file [0, 1, 3, 4, 5]
#   DuckDB, not (v <= 5): memory [2, 4, 5], file [4, 5]
#   DataFusion, not (v <= 5): memory [2, 4, 5], file [4, 5]
#   pyarrow, not (v <= 5): memory [2, 4, 5], file [4, 5]
#   Polars, not (v <= 5): memory [2, 4, 5], file [2, 4, 5]
#
# What to do: write null instead of NaN, write without statistics, or filter in memory. In DuckDB use `not
# isfinite(v)`.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    duckdb==2.0.0 datafusion==55.0.0 pyarrow==26.0.1 polars==2.1.0
cd "$folder"
venv/bin/python - >output <<'PYTHON'
import datafusion
import duckdb
import polars
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

arrow = pa.table({"row": range(6), "v": [1.0, 2.0, float("nan"), 3.0, 7.0, 8.0]})
pq.write_table(arrow, "trials.parquet", row_group_size=3)

duck = duckdb.connect()
duck.execute("create table trials as select * from arrow")
for condition in ("isnan(v)", "not isnan(v)", "isfinite(v)", "not (v <= 5)"):
    rows = lambda source: [row for (row,) in duck.execute(f"select row from {source} where {condition}").fetchall()]
    print(f"DuckDB, {condition}: memory {rows('trials')}, file {rows(chr(39) + 'trials.parquet' + chr(39))}")

context = datafusion.SessionContext()
context.register_record_batches("memory", [arrow.to_batches()])
context.register_parquet("file", "trials.parquet")
rows = lambda source: sorted(context.sql(f"select row from {source} where not (v <= 5)").to_pydict()["row"])
print(f"DataFusion, not (v <= 5): memory {rows('memory')}, file {rows('file')}")

condition = ~(pc.field("v") <= 5)
memory, file = arrow.filter(condition), pq.read_table("trials.parquet", filters=condition)
print(f"pyarrow, not (v <= 5): memory {memory['row'].to_pylist()}, file {file['row'].to_pylist()}")

condition = ~(polars.col("v") <= 5)
memory = polars.from_arrow(arrow).filter(condition)
file = polars.scan_parquet("trials.parquet").filter(condition).collect()
print(f"Polars, not (v <= 5): memory {memory['row'].to_list()}, file {file['row'].to_list()}")
PYTHON
cat output
diff output - <<'EXPECTED'
DuckDB, isnan(v): memory [2], file []
DuckDB, not isnan(v): memory [0, 1, 3, 4, 5], file [0, 1, 2, 3, 4, 5]
DuckDB, isfinite(v): memory [0, 1, 3, 4, 5], file [0, 1, 3, 4, 5]
DuckDB, not (v <= 5): memory [2, 4, 5], file [4, 5]
DataFusion, not (v <= 5): memory [2, 4, 5], file [4, 5]
pyarrow, not (v <= 5): memory [2, 4, 5], file [4, 5]
Polars, not (v <= 5): memory [2, 4, 5], file [2, 4, 5]
EXPECTED
