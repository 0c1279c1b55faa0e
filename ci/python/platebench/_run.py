"""Plays scenarios and reads run folders."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from ._frames import Library, from_csv, from_rows
from ._program import option_arguments, start_checked


class Run:
    """A run folder."""

    def __init__(self, folder: str | os.PathLike[str], frames: Library = "pandas") -> None:
        self.folder = Path(folder)
        self.frames: Library = frames

    @cached_property
    def record(self) -> dict[str, Any]:
        """The content of `run.json`."""
        record: dict[str, Any] = json.loads((self.folder / "run.json").read_text(encoding="utf-8"))
        if record.get("format") != 1:
            raise ValueError(f"{self.folder}: format {record.get('format')}, expected 1")
        return record

    @property
    def verdict(self) -> str:
        """`pass`, `fail` or `inconclusive`."""
        return str(self.record["verdict"])

    @cached_property
    def scenarios(self) -> Any:
        """A row per scenario."""
        nested = ("inputs", "expectations", "trials")
        rows = [{key: value for key, value in one.items() if key not in nested} for one in self.record["scenarios"]]
        return from_rows(rows, self.frames)

    @cached_property
    def expectations(self) -> Any:
        """A row per expectation; `limit` and other nested values as JSON."""
        rows = [
            {"scenario": one["file"], **{key: _flat(value) for key, value in expectation.items()}}
            for one in self.record["scenarios"]
            for expectation in one["expectations"]
        ]
        return from_rows(rows, self.frames)

    @cached_property
    def trials(self) -> Any:
        """A row per trial, with a column per metric."""
        rows = [
            {
                "scenario": one["file"],
                **{key: trial[key] for key in ("index", "seed", "trace", "cause", "reason")},
                **trial["metrics"],
            }
            for one in self.record["scenarios"]
            for trial in one["trials"]
        ]
        return from_rows(rows, self.frames)

    def trace(self, scenario: str | None = None, trial: int = 0) -> Any:
        """The rows of a trial. `scenario` with or without `.toml`; needless if the run has one."""
        scenarios = {one["file"].removesuffix(".toml"): one for one in self.record["scenarios"]}
        if scenario is None and len(scenarios) == 1:
            (found,) = scenarios.values()
        elif scenario is not None and scenario.removesuffix(".toml") in scenarios:
            found = scenarios[scenario.removesuffix(".toml")]
        else:
            raise KeyError(f"scenario {scenario!r}, expected one of {', '.join(scenarios)}")
        for one in found["trials"]:
            if one["index"] == trial:
                return from_csv(self.folder / one["trace"], self.frames)
        raise KeyError(f"{found['file']} has no trial {trial}")

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r}: {self.verdict})"


def _flat(value: Any) -> Any:
    return json.dumps(value) if isinstance(value, (dict, list)) else value


def run(
    *scenarios: str | os.PathLike[str],
    rig: str | None = None,
    law: str | None = None,
    trials: int | None = None,
    seed: int | None = None,
    jobs: int | None = None,
    out: str | os.PathLike[str] | None = None,
    options: Sequence[str] = (),
    frames: Library = "pandas",
) -> Run:
    """Plays scenarios; `options` are further options of `platebench run`. A failed run is a result, not an error.

    The run folder is `out`, or a new folder below `runs`.
    """
    if out is None:
        runs = Path("runs")
        runs.mkdir(exist_ok=True)
        out = Path(tempfile.mkdtemp(prefix="python-", dir=runs)) / "run"
    named = {"rig": rig, "law": law, "trials": trials, "seed": seed, "jobs": jobs, "out": Path(out)}
    start_checked(["run", *option_arguments(named), *options, *scenarios])
    return Run(out, frames)
