"""Finds and starts the program."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sysconfig
import threading
import time
from collections.abc import Sequence
from pathlib import Path

#: Exit codes of a run that has a verdict.
VERDICTS = (0, 1, 3)
#: Longest time from a signal to the end of the program. It ends earlier, also if its output is not read.
END_TIMEOUT_S = 30.0


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
    """Runs the program to its end, whatever its exit code is.

    The program has a session of its own and ends with 0 V when this process ends, however it ends. An exception in
    this call, such as Ctrl-C or a time-out of a test, ends the program before the exception goes on. SIGTERM and SIGHUP
    act on this process after the program has ended.
    """
    command = [program(), *(os.fspath(argument) for argument in arguments)]
    environment = {**os.environ, "PLATEBENCH_PARENT": str(os.getpid())}
    with _DelayedSignals() as signals:
        process = subprocess.Popen(
            command,
            text=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            start_new_session=True,
        )
        try:
            output, errors = _outputs(process, signals)
        except BaseException as ended:
            _end(process, signal.SIGINT if isinstance(ended, KeyboardInterrupt) else signal.SIGTERM)
            raise
    return subprocess.CompletedProcess(command, process.returncode, output, errors)


class _DelayedSignals:
    """Keeps the signals of another process that would end this one, and lets them act at the end of the block."""

    def __init__(self) -> None:
        self.received: list[int] = []
        self._replaced: list[int] = []

    def __enter__(self) -> _DelayedSignals:
        # Python handles signals in its main thread only.
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGHUP):
                if signal.getsignal(number) is signal.SIG_DFL:
                    signal.signal(number, lambda received, _: self.received.append(received))
                    self._replaced.append(number)
        return self

    def __exit__(self, *_: object) -> None:
        for number in self._replaced:
            signal.signal(number, signal.SIG_DFL)
        for number in self.received[:1]:
            os.kill(os.getpid(), number)


def _outputs(process: subprocess.Popen[str], signals: _DelayedSignals) -> tuple[str, str]:
    deadline = None
    while True:
        try:
            # A short wait, so that exceptions which another thread raises in this one arrive.
            return process.communicate(timeout=0.05)
        except subprocess.TimeoutExpired:
            if signals.received and deadline is None:
                deadline = time.monotonic() + END_TIMEOUT_S
                process.send_signal(signals.received[0])
            if deadline is not None and time.monotonic() > deadline:
                process.kill()


def _end(process: subprocess.Popen[str], number: int) -> None:
    process.send_signal(number)
    deadline = time.monotonic() + END_TIMEOUT_S
    while process.poll() is None:
        # A second Ctrl-C does not end the wait, because the plate may not be at 0 V yet.
        with contextlib.suppress(BaseException):
            process.communicate(timeout=0.05)
        if time.monotonic() > deadline:
            process.kill()


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
