#!/usr/bin/env bash
# DuckDB 2.0.0: of several rows at one instant, an ASOF join returns the first or the last, by the number of times.
#
# A trace of a step has two rows at one instant: the value before it and the value after it. `asof join … on q.t >=
# s.t` finds the last row at or before each time. If the left side has fewer than 64 rows, DuckDB uses a nested loop,
# which returns the first row of that instant for all times until the next one: the value before the step. From 64
# rows on it returns the last row. `merge_asof` of pandas and `join_asof` of Polars always return the last one.
#
# Output seen (drive 0 at 0 ms, 0 and then 10 at 1 ms, 10 at 100 ms; values between 2 and 3 ms):
#   63 times: DuckDB [0.0], pandas [10.0], Polars [10.0]
#   64 times: DuckDB [10.0], pandas [10.0], Polars [10.0]
#   63 times, asof_loop_join_threshold=0: DuckDB [10.0]
#
# What to do: `set asof_loop_join_threshold=0`, or keep one row of each instant before the join.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    duckdb==2.0.0 pandas==3.1.1 numpy==2.4.6 polars==2.1.0
cd "$folder"
venv/bin/python - >output <<'PYTHON'
import duckdb
import pandas as pd
import polars

step = {"t": [0, 1_000_000, 1_000_000, 100_000_000], "drive": [0.0, 0.0, 10.0, 10.0]}
duck = duckdb.connect()
duck.execute("create table s as select unnest($t::bigint[]) as t, unnest($drive::double[]) as drive", step)


def with_duckdb(times):
    duck.execute("create or replace table q as select unnest($t::bigint[]) as t", times)
    rows = duck.execute("select drive from q asof join s on q.t >= s.t").fetchall()
    return sorted({drive for (drive,) in rows})


for count in (63, 64):
    times = {"t": [2_000_000 + i for i in range(count)]}
    pandas = pd.merge_asof(pd.DataFrame(times), pd.DataFrame(step), on="t")["drive"].unique().tolist()
    both = polars.DataFrame(times).join_asof(polars.DataFrame(step), on="t")["drive"].unique().to_list()
    print(f"{count} times: DuckDB {with_duckdb(times)}, pandas {pandas}, Polars {both}")
duck.execute("set asof_loop_join_threshold=0")
print(f"63 times, asof_loop_join_threshold=0: DuckDB {with_duckdb({'t': times['t'][:63]})}")
PYTHON
cat output
diff output - <<'EXPECTED'
63 times: DuckDB [0.0], pandas [10.0], Polars [10.0]
64 times: DuckDB [10.0], pandas [10.0], Polars [10.0]
63 times, asof_loop_join_threshold=0: DuckDB [10.0]
EXPECTED
