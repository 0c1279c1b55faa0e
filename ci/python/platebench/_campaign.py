"""Plays campaigns and reads campaign folders."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from ._frames import Library, from_csv
from ._program import option_arguments, start_checked


class Campaign:
    """A campaign folder with results."""

    def __init__(self, folder: str | os.PathLike[str], frames: Library = "pandas") -> None:
        self.folder = Path(folder)
        self.frames: Library = frames

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The content of `summary.json`."""
        summary: dict[str, Any] = json.loads((self.folder / "summary.json").read_text(encoding="utf-8"))
        return summary

    @cached_property
    def results(self) -> Any:
        """A row per trial."""
        return from_csv(self.folder / "results.csv", self.frames)


def campaign(
    file: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    jobs: int | None = None,
    rig: str | None = None,
    options: Sequence[str] = (),
    frames: Library = "pandas",
) -> Campaign:
    """Plays a campaign, or resumes it; `options` are further options of `platebench campaign run`."""
    named = option_arguments({"out": Path(out), "jobs": jobs, "rig": rig})
    start_checked(["campaign", "run", file, *named, *options])
    return Campaign(out, frames)
