"""Every example in a docstring runs, and gives what is written there."""

from __future__ import annotations

import doctest
import importlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from places import ROOT

import sortie


def modules_with_examples() -> Iterator[str]:
    """Of all rooms, and of the public API."""
    for room in sorted({path.parent.name for path in ROOT.glob("*/__init__.py")} - {"research"}):
        for path in sorted((ROOT / room).rglob("*.py")):  # not through the links by which rooms lie in `sortie`
            if ">>> " in path.read_text("utf-8"):
                parts = path.relative_to(ROOT).with_suffix("").parts
                yield ".".join(parts if room == "sortie" else ("sortie", *parts))


def failing(names: Sequence[str], folder: Path) -> list[str]:
    """The modules with an example that gives something else; pytest shows what doctest prints."""
    known = {"sortie": sortie, "folder": folder}
    return [name for name in names if doctest.testmod(importlib.import_module(name), extraglobs=known).failed]


def test_examples_of_docstrings_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = list(modules_with_examples())
    assert {"sortie._api", "sortie.scenarios.intervals", "sortie.scenarios.shipped"} <= set(names)
    assert failing(names, tmp_path) == []


def test_an_example_that_says_something_else_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "says_otherwise.py").write_text('"""\n>>> 1 + 1\n3\n"""\n')
    monkeypatch.syspath_prepend(tmp_path)
    assert failing(["says_otherwise"], tmp_path) == ["says_otherwise"]
