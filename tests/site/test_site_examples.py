"""Every example of the guide and of the README is executed as it stands. Two run in the short suite, the others nightly."""

from __future__ import annotations

import re
import shlex
import sys
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from places import ROOT
from typer.testing import CliRunner

from sortie.policies.verification.kit.conformance import conform
from sortie.scenarios.reading.load import load
from sortie.sim.cli.app import app

GUIDE = sorted((ROOT / "docs" / "guide").glob("*.md"))
LANGUAGES = {"yaml", "python", "sh", "toml"}


class Example(NamedTuple):
    """A fenced block: its language, its text, and the line on which it begins."""

    language: str
    text: str
    line: int


def examples(page: Path) -> list[Example]:
    """Every fenced block of a page, in order."""
    text = page.read_text("utf-8")
    blocks = re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.M | re.S)
    return [Example(block[1], block[2], text[: block.start()].count("\n") + 1) for block in blocks]


@pytest.mark.parametrize(
    "page", [pytest.param(p, id=p.stem, marks=[pytest.mark.slow] * (p.stem != "policy")) for p in GUIDE]
)
def test_every_example_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, in one folder: `# file:` names what is written there, other Python runs, and so does each command."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for page_s_own in re.findall(r"^# file: (\w+)\.py$", page.read_text("utf-8"), re.M):
        monkeypatch.delitem(sys.modules, page_s_own, raising=False)  # and forgotten again after the test
    for language, text, line in examples(page):
        assert language in LANGUAGES, f"{page.name}:{line}: an example in {language or 'no language'} is not executed"
        named = re.match(r"# file: (\S+)\n", text)
        if named is not None:
            (tmp_path / named[1]).write_text(text)
        if language == "sh":
            for command in text.strip().splitlines():
                program, *arguments = shlex.split(command)
                assert program == "sortie", f"{page.name}:{line}: {command}"
                said = CliRunner().invoke(app, arguments)
                assert said.exit_code == 0, f"{page.name}:{line}: {command}\n{said.output}\n{said.exception}"
        elif language == "python" and named is None:
            exec(compile(text, f"{page.name}:{line}", "exec"), {"__name__": "example"})  # noqa: S102 - our own pages
        elif language == "toml":
            tomllib.loads(text)
        elif language == "yaml":
            load(str(tmp_path / named[1]) if named is not None else text)


def test_examples_are_found() -> None:
    assert sum(len(examples(page)) for page in GUIDE) >= 12


def test_the_readme_s_example_flies_and_its_policy_is_one(capsys: pytest.CaptureFixture[str]) -> None:
    """It decides for every peer, within the contract."""
    (example,) = [e for e in examples(ROOT / "README.md") if e.language == "python"]
    names: dict[str, Any] = {"__name__": "readme"}
    exec(compile(example.text, "README.md", "exec"), names)  # noqa: S102 - our own page
    accuracy, sent = map(float, capsys.readouterr().out.split())
    assert 0.0 < accuracy < 1.0
    assert sent > 1e6
    assert {check.name: check.what for check in conform(names["decide"], count=50) if not check.holds} == {}
