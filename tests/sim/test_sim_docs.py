"""Every example of the guide is executed as it stands; its links lead somewhere, and its commands are commands."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from typer.testing import CliRunner

from perception.detectors import DETECTORS
from scenarios.load import load
from sim.cli import app

ROOT = Path(__file__).resolve().parents[2]
GUIDE = sorted((ROOT / "docs" / "guide").glob("*.md"))
LANGUAGES = {"yaml", "python", "sh"}


class Example(NamedTuple):
    """A fenced block: its language, its text, and the line on which it begins."""

    language: str
    text: str
    line: int


def examples(page: Path) -> list[Example]:
    """Every fenced block of a page, in order."""
    text = page.read_text("utf-8")
    return [
        Example(m[1], m[2], text[: m.start()].count("\n") + 1) for m in re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.M | re.S)
    ]  # fmt: skip


@pytest.mark.parametrize("page", GUIDE, ids=lambda p: p.stem)
def test_every_example_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, in one folder: `# file:` names what is written there, other Python runs, and so does each command."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for page_s_own in re.findall(r"^# file: (\w+)\.py$", page.read_text("utf-8"), re.M):
        monkeypatch.delitem(sys.modules, page_s_own, raising=False)  # and forgotten again after the test
    for name, kind in list(DETECTORS.items()):
        monkeypatch.setitem(DETECTORS, name, kind)
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
        elif language == "yaml":
            load(str(tmp_path / named[1]) if named is not None else text)


def test_the_guide_is_there_and_has_examples() -> None:
    assert [p.stem for p in GUIDE] == ["README", "detector", "link_model", "policy", "scenario"]
    assert sum(len(examples(p)) for p in GUIDE) >= 12


@pytest.mark.parametrize("page", [*GUIDE, ROOT / "README.md", ROOT / "CONTRIBUTING.md"], ids=lambda p: p.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[\w-]+)?\)", page.read_text("utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name}: {target}"
