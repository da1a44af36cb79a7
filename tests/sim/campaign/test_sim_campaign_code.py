"""What counts as another code: sources and shipped weights of the rooms, not what only looks at runs."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from sortie.sim.campaign import code


@pytest.fixture
def rooms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("fleet/agent.py", "perception/network/weights/net.safetensors", "policies/catalogue/learned.json", "sim/campaign/plan.py",
                 "sim/cli/app.py", "sim/campaign/report.py", "perception/study/weights/full-0.safetensors",
                 "scenarios/library/traces/links.json", "fleet/README.md"):  # fmt: skip
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("before")
    monkeypatch.setattr(code, "ROOT", tmp_path)
    return tmp_path


def changed(rooms: Path, name: str, text: str) -> bool:
    before = code.code_version.__wrapped__()
    (rooms / name).write_text(text)
    return code.code_version.__wrapped__() != before


@pytest.mark.parametrize(
    "name", ["fleet/agent.py", "fleet/new.py", "perception/network/weights/net.safetensors", "policies/catalogue/learned.json", "sim/campaign/plan.py"]
)  # fmt: skip
def test_what_decides_a_run_changes_its_code_version(rooms: Path, name: str) -> None:
    assert changed(rooms, name, "after")


@pytest.mark.parametrize(
    "name", ["sim/cli/app.py", "sim/campaign/report.py", "perception/study/weights/full-0.safetensors", "scenarios/library/traces/links.json", "fleet/README.md"]
)  # fmt: skip
def test_what_only_looks_at_runs_does_not(rooms: Path, name: str) -> None:
    assert not changed(rooms, name, "after")


def test_every_shipped_file_that_a_run_may_read_is_looked_at() -> None:
    """A shipped suffix that nobody knows here would be a file that changes runs behind their keys."""
    asked = tomllib.loads((code.ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    shipped = {
        path.suffix
        for name, globs in asked.items()
        for g in globs
        for path in (code.ROOT / name.replace(".", "/")).glob(g)
    }
    told_otherwise = {".md", ".typed", ".msg", ".xml", ".txt", ".toml", ".yaml", ".csv"}  # of the study, or in tasks
    assert shipped - {""} - told_otherwise == set(code.SUFFIXES) - {".py"}


@pytest.mark.parametrize("name", [*code.LOOKS, *code.DECIDES])
def test_what_is_named_is_there(name: str) -> None:
    """A file that moved away from its name would count again, or not any more."""
    assert any(code.ROOT.glob(name))
