"""Makes data frames of pandas or polars."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

Library = Literal["pandas", "polars"]


def from_rows(rows: list[dict[str, Any]], library: Library) -> Any:
    """A frame with a column for every key; missing values are null."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    complete = [{column: row.get(column) for column in columns} for row in rows]
    if library == "polars":
        import polars

        return polars.from_dicts(complete, infer_schema_length=None) if complete else polars.DataFrame()
    import pandas

    return pandas.DataFrame(complete, columns=columns)


def from_csv(path: Path, library: Library) -> Any:
    """Every number is the double that was written."""
    if library == "polars":
        import polars

        return polars.read_csv(path, infer_schema_length=None)
    import pandas

    return pandas.read_csv(path, float_precision="round_trip")
