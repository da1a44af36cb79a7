"""Every example of the guide is executed as it stands; its links lead somewhere, and its commands are commands."""

from __future__ import annotations

import re
import shlex
import sys
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from page_commands import commands_in, fault
from places import ROOT
from typer.testing import CliRunner

from sortie.policies.verification.kit.conformance import conform
from sortie.scenarios.reading.load import load
from sortie.sim.cli.app import app

GUIDE = sorted((ROOT / "docs" / "guide").glob("*.md"))
PAGES = [
    *sorted(p for p in ROOT.glob("[!.]*/**/*.md") if "runs" not in p.parts),
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
]
LANGUAGES = {"yaml", "python", "sh", "toml"}


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


@pytest.mark.parametrize(
    "page", [pytest.param(p, id=p.stem, marks=[pytest.mark.slow] * (p.stem == "learn")) for p in GUIDE]
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


def test_the_guide_is_there_and_has_examples() -> None:
    assert [p.stem for p in GUIDE] == [
        "README",
        "detector",
        "event",
        "fusion",
        "learn",
        "link_model",
        "metric",
        "mobility",
        "policy",
        "power_model",
        "scenario",
        "sensor",
    ]
    assert sum(len(examples(p)) for p in GUIDE) >= 12


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[\w-]+)?\)", page.read_text("utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name}: {target}"


ROOM_PAGES = [page for page in PAGES if page.name == "README.md" and page.parent.name not in ("docs", "guide")]
NOT_OURS = {
    "mavlogdump.py",
    "my_policy.py",
    "policy.py",
    "file.py",
    "mine.py",
    "path/to/file.py",
    "fusion.py",
    "my_fusion.py",
}
"""Programs of others, and names that stand for a user's file."""


@pytest.mark.parametrize("page", ROOM_PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_a_file_that_a_page_names_is_there(page: Path) -> None:
    """From the page's folder, from the root, or, for a bare name, anywhere below the page's folder."""
    for name in set(re.findall(r"`([\w/]+\.py)`", page.read_text("utf-8"))) - NOT_OURS:
        places = [page.parent / name, ROOT / name, *(page.parent.rglob(name) if "/" not in name else ())]
        assert any(place.is_file() for place in places), f"{page.relative_to(ROOT)}: {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_every_command_told_is_one_with_these_options(page: Path) -> None:
    for told in commands_in(page, "sortie"):
        assert fault(app, told) is None, told


@pytest.mark.parametrize(
    "words", [["soar"], ["fly", "track_target", "--speed", "3"], ["recording", "break"], ["live", "--loss", "lots"]]
)
def test_a_command_that_is_none_is_found(words: list[str]) -> None:
    assert fault(app, shlex.join(["sortie", *words])) is not None


def test_the_readme_s_example_flies_and_its_policy_is_one(capsys: pytest.CaptureFixture[str]) -> None:
    """It decides for every peer, within the contract."""
    (example,) = [e for e in examples(ROOT / "README.md") if e.language == "python"]
    names: dict[str, Any] = {"__name__": "readme"}
    exec(compile(example.text, "README.md", "exec"), names)  # noqa: S102 - our own page
    accuracy, sent = map(float, capsys.readouterr().out.split())
    assert 0.0 < accuracy < 1.0
    assert sent > 1e6
    assert {check.name: check.what for check in conform(names["decide"], count=50) if not check.holds} == {}
