"""Digests of the code: what changes them, and what does not."""

from __future__ import annotations

from pathlib import Path

import pytest

from sortie.scenarios import code_digest


@pytest.fixture
def rooms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("perception/joining.py", "perception/deep/ap.py", "perception/net.safetensors", "radio/air.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("before")
    monkeypatch.setattr(code_digest, "files", lambda name: tmp_path / name.removeprefix("sortie."))
    monkeypatch.setattr(code_digest, "version", lambda library: "1")
    return tmp_path


def digest(libraries: tuple[str, ...] = ("torch",)) -> str:
    return code_digest.sources_digest.__wrapped__(("perception",), libraries)


@pytest.mark.parametrize("name", ["perception/joining.py", "perception/deep/ap.py", "perception/deep/new.py"])
def test_a_source_of_the_room_counts(rooms: Path, name: str) -> None:
    before = digest()
    (rooms / name).write_text("after")
    assert digest() != before


@pytest.mark.parametrize("name", ["perception/net.safetensors", "radio/air.py", "perception/README.md"])
def test_weights_pages_and_other_rooms_do_not_count(rooms: Path, name: str) -> None:
    before = digest()
    (rooms / name).write_text("after")
    assert digest() == before


def test_the_version_of_a_library_counts(rooms: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = digest()
    assert before != digest(())
    monkeypatch.setattr(code_digest, "version", lambda library: "2")
    assert digest() != before
