"""Collects scenario files as tests of pytest."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import tempfile
import tomllib
from collections import Counter
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest

from ._program import start

FAILED, NOTHING_TO_RUN = 1, 4
# Top-level keys that only scenarios have.
SCENARIO_KEYS = {"controller", "duration_ms", "expect"}
# Some patterns of pytest's own list of folders that it skips.
DEFAULT_PATTERNS = {"*.egg", "_darcs", "CVS"}
# Property of a test report that says whether the scenario was played.
PROPERTY = "platebench"
PLAYED, NOT_APPLICABLE = "played", "not applicable"


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("platebench")
    group.addoption("--platebench-rig", metavar="RIG", help="rig of the controller, as for platebench run --rig")
    group.addoption("--platebench-args", metavar="ARGS", help="further options of platebench run")
    parser.addini("platebench_rig", "rig of the controller", default="")
    parser.addini("platebench_args", "further options of platebench run", default="")


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Tally(), "platebench-tally")


class Tally:
    """Ends a session in which no scenario applied with 4, as `platebench run` does."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        # With pytest-xdist, the main process receives the reports of all workers.
        if report.when == "call":
            self.counts.update(value for name, value in report.user_properties if name == PROPERTY)

    def nothing_applied(self) -> bool:
        return self.counts[NOT_APPLICABLE] > 0 and self.counts[PLAYED] == 0

    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        if exitstatus == pytest.ExitCode.OK and self.nothing_applied() and not hasattr(session.config, "workerinput"):
            session.exitstatus = NOTHING_TO_RUN

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        if self.nothing_applied():
            count = self.counts[NOT_APPLICABLE]
            terminalreporter.write_line(f"platebench: none of {count} scenarios applies to the controller")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Collects scenarios in folders that pytest skips by default, such as `build`, but nothing else in them."""
    skipped = {pattern for pattern in config.getini("norecursedirs") if not pattern.startswith(".")}
    if not skipped >= DEFAULT_PATTERNS:
        # The user chose the folders.
        return None
    root = config.rootpath
    inside = collection_path.relative_to(root).parts if collection_path.is_relative_to(root) else ()
    if not any(fnmatch(part, pattern) for part in inside for pattern in skipped):
        return None
    if any((folder / "pyvenv.cfg").is_file() for folder in (collection_path, *collection_path.parents)):
        # An environment of Python contains the files of packages.
        return None
    if collection_path.is_dir():
        return False if _has_scenario(collection_path) else None
    return not _is_scenario(collection_path)


def _has_scenario(folder: Path) -> bool:
    for parent, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        if any(_is_scenario(Path(parent, name)) for name in files):
            return True
    return False


def _is_scenario(path: Path) -> bool:
    if path.suffix != ".toml":
        return False
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        # It may be a scenario, so it must not be skipped. The program reports the error.
        return True
    return bool(SCENARIO_KEYS & content.keys())


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    return ScenarioFile.from_parent(parent, path=file_path) if _is_scenario(file_path) else None


class ScenarioFile(pytest.File):
    def collect(self) -> Iterator[pytest.Item]:
        try:
            content = tomllib.loads(self.path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            content = {}
        if "matrix" not in content:
            yield ScenarioItem.from_parent(self, name="scenario", content=content, case=self.path)
            return
        listed = start(["run", str(self.path), "--list", "--format", "json"])
        if listed.returncode:
            # The program reports the error again as the result of this test.
            yield ScenarioItem.from_parent(self, name="scenario", content={}, case=self.path)
            return
        for scenario in json.loads(listed.stdout)["scenarios"]:
            case = self.path.with_name(Path(scenario["file"]).name)
            name = case.stem.removeprefix(f"{self.path.stem}-")
            yield ScenarioItem.from_parent(self, name=name, content=scenario, case=case)


class ScenarioFailure(Exception):
    """The text is the report of the test."""


class ScenarioItem(pytest.Item):
    def __init__(self, *, content: dict[str, Any], case: Path, **arguments: Any) -> None:
        super().__init__(**arguments)
        # Other plugins, such as those of labgrid and pytest-embedded, read them of every test.
        self.fixturenames: list[str] = []
        self.funcargs: dict[str, Any] = {}
        self.case = case
        self.title = str(content.get("title", "faulty scenario"))
        code, tags = content.get("expected_exit") or 0, content.get("tags", [])
        # The program reports values of a wrong type.
        self.expected_exit = code if isinstance(code, int) else 0
        # `pytest -k paper` selects by tag.
        self.extra_keyword_matches.update(map(str, tags) if isinstance(tags, list) else [])

    def runtest(self) -> None:
        option = self.config.getoption
        rig = option("--platebench-rig") or self.config.getini("platebench_rig")
        further = option("--platebench-args") or self.config.getini("platebench_args")
        folder = Path(tempfile.mkdtemp(prefix="platebench-"))
        arguments = ["run", str(self.case), "--format", "json", "--out", str(folder / "run")]
        arguments += ["--rig", rig] if rig else []
        done = start([*arguments, *shlex.split(further)])
        if done.returncode == self.expected_exit:
            shutil.rmtree(folder, ignore_errors=True)
            self.user_properties.append((PROPERTY, PLAYED))
            return
        record = _record(folder / "run")
        if done.returncode == NOTHING_TO_RUN and record is not None and record.get("not_applicable"):
            shutil.rmtree(folder, ignore_errors=True)
            self.user_properties.append((PROPERTY, NOT_APPLICABLE))
            pytest.skip(f"not applicable: {record['not_applicable'][0]['reason']}")
        self.user_properties.append((PROPERTY, PLAYED))
        raise ScenarioFailure(self._describe(done.returncode, done.stderr, record, folder / "run"))

    def _describe(self, exit_code: int, stderr: str, record: dict[str, Any] | None, folder: Path) -> str:
        lines = [f"{self.title}: exit code {exit_code}, expected {self.expected_exit}"]
        for scenario in record["scenarios"] if record else []:
            for expectation in scenario["expectations"]:
                if expectation["verdict"] != "pass":
                    cause = f" ({expectation['cause']})" if expectation["cause"] else ""
                    lines.append(f"  {expectation['name']}: {expectation['verdict']}{cause}: {expectation['reason']}")
        if len(lines) == 1:
            lines.append(stderr.strip())
        else:
            # Reasons of the whole run, such as a drive after the confirmed 0 V.
            lines += [f"  {line}" for line in stderr.splitlines() if line.startswith("error: ")]
        if record is not None:
            lines.append(f"report: {folder / 'report.html'}")
        return "\n".join(lines)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        if isinstance(excinfo.value, ScenarioFailure):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        return self.path, None, f"{self.path.name}: {self.title}"


def _record(folder: Path) -> dict[str, Any] | None:
    try:
        record: dict[str, Any] = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record
