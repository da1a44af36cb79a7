"""The laboratory's pages tell commands that are there, and the examples in its docstrings give what they say."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest
from page_commands import commands_in, fault
from places import ROOT

from research.__main__ import app

PROGRAM = "python -m research"
PAGES = sorted(p for p in ROOT.glob("[!.]*/**/*.md") if "runs" not in p.parts)
SOURCES = [
    p for p in sorted((ROOT / "research").rglob("*.py")) if ">>> " in p.read_text("utf-8") and "tests" not in p.parts
]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_every_command_told_is_one_with_these_options(page: Path) -> None:
    for told in commands_in(page, PROGRAM):
        assert fault(app, told, PROGRAM) is None, told


@pytest.mark.parametrize("told", ["soar", "train --speed 3", "study fly"])
def test_a_command_that_is_none_is_found(told: str) -> None:
    assert fault(app, f"{PROGRAM} {told}", PROGRAM) is not None


@pytest.mark.parametrize("source", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_examples_of_docstrings_run(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    name = ".".join(source.relative_to(ROOT).with_suffix("").parts)
    failed, _ = doctest.testmod(importlib.import_module(name), extraglobs={"folder": tmp_path})
    assert not failed
