"""Finds and starts the program."""

from __future__ import annotations

import os
import shutil
import subprocess
import sysconfig
from collections.abc import Sequence
from pathlib import Path

#: Exit codes of a run that has a verdict.
VERDICTS = (0, 1, 3)


class PlatebenchError(RuntimeError):
    """The program ended without a verdict: invalid input, nothing to run, or no rig."""

    def __init__(self, exit_code: int, message: str) -> None:
        super().__init__(message or f"platebench ended with {exit_code}")
        self.exit_code = exit_code


def program() -> str:
    """The path of the program: `$PLATEBENCH`, the scripts of this environment, or `PATH`."""
    named = os.environ.get("PLATEBENCH")
    if named:
        return named
    found = shutil.which("platebench", path=sysconfig.get_path("scripts")) or shutil.which("platebench")
    if found is None:
        raise FileNotFoundError("platebench is neither in the scripts of this environment nor in PATH")
    return found


def start(arguments: Sequence[str | os.PathLike[str]]) -> subprocess.CompletedProcess[str]:
    """Runs the program to its end, whatever its exit code is."""
    command = [program(), *(os.fspath(argument) for argument in arguments)]
    return subprocess.run(command, text=True, stdin=subprocess.DEVNULL, capture_output=True, check=False)


def start_checked(arguments: Sequence[str | os.PathLike[str]]) -> subprocess.CompletedProcess[str]:
    """Like `start`; raises `PlatebenchError` without a verdict."""
    done = start(arguments)
    if done.returncode not in VERDICTS:
        raise PlatebenchError(done.returncode, done.stderr.strip())
    return done


def option_arguments(options: dict[str, object | None]) -> list[str | os.PathLike[str]]:
    """`{"trials": 3, "law": None}` becomes `["--trials", "3"]`."""
    arguments: list[str | os.PathLike[str]] = []
    for name, value in options.items():
        if value is not None:
            arguments += [f"--{name}", os.fspath(value) if isinstance(value, Path) else str(value)]
    return arguments
