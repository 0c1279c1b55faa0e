"""Collects scenario files as tests of pytest."""

from __future__ import annotations

import json
import shlex
import shutil
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ._program import start

FAILED, NOTHING_TO_RUN = 1, 4
# Top-level keys that only scenarios have.
SCENARIO_KEYS = {"controller", "duration_ms", "expect"}


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("platebench")
    group.addoption("--platebench-rig", metavar="RIG", help="rig of the controller, as for platebench run --rig")
    group.addoption("--platebench-args", metavar="ARGS", help="further options of platebench run")
    parser.addini("platebench_rig", "rig of the controller", default="")
    parser.addini("platebench_args", "further options of platebench run", default="")


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    if file_path.suffix != ".toml":
        return None
    try:
        content = tomllib.loads(file_path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        # It may be a scenario, so it must not be skipped. The program reports the error.
        content = {"duration_ms": None}
    if not SCENARIO_KEYS & content.keys():
        return None
    return ScenarioFile.from_parent(parent, path=file_path)


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
    # Other plugins, such as labgrid's, read it of every test.
    fixturenames: tuple[str, ...] = ()

    def __init__(self, *, content: dict[str, Any], case: Path, **arguments: Any) -> None:
        super().__init__(**arguments)
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
            return
        record = _record(folder / "run")
        if done.returncode == NOTHING_TO_RUN and record is not None and record.get("not_applicable"):
            shutil.rmtree(folder, ignore_errors=True)
            pytest.skip(f"not applicable: {record['not_applicable'][0]['reason']}")
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
