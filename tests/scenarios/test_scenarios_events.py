"""Kinds of events: each is one file, and what one does is taken back by itself."""

from __future__ import annotations

import re
from pathlib import Path
from unittest.mock import MagicMock, call

import pytest

from sortie.scenarios.schema import events
from sortie.scenarios.schema.events.base import Lasting

CONTRIBUTING = Path(__file__).resolve().parents[2] / "CONTRIBUTING.md"


def test_a_file_that_is_added_is_a_kind_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file that CONTRIBUTING shows."""
    page = CONTRIBUTING.read_text("utf-8")
    code = page[page.index("# file: scenarios/schema/events/fog.py") :]
    (tmp_path / "fog.py").write_text(code[: code.index("```")], "utf-8")
    monkeypatch.setattr(events, "__path__", [*events.__path__, str(tmp_path)])
    kinds = events._kinds()
    assert set(kinds) == {*events.KINDS, "fog"}
    fog = kinds["fog"](kind="fog", at_s=1.0, until_s=2.0)
    assert isinstance(fog, Lasting)
    fleet = MagicMock(members=[0, 1])
    fog.begin(fleet)
    assert fleet.mock_calls == [call.block_cameras(0), call.block_cameras(1), call.note("cameras see nothing")]
    for lasts, told in (
        (False, ("cameras see again", -1, "fog_over")),
        (True, ("there is still fog: another one lasts", -1)),
    ):
        fleet = MagicMock()
        fog.end(fleet, lasts)
        assert fleet.mock_calls == [call.lift(), call.note(*told)]


def test_nothing_but_its_file_names_a_kind() -> None:
    """The product imports no class of a kind, and asks for no kind by its name."""
    folder = Path(events.__file__).parent
    kinds = "|".join(events.KINDS)
    named = re.compile(rf"schema\.events\.(?!base)\w+ import|event\.kind (==|!=|in) |kind=\"({kinds})\"")
    wrong = [
        f"{path}: {found.group()}"
        for room in ("scenarios", "fleet", "radio", "policies", "perception", "sim")
        for path in sorted((folder.parents[2] / room).rglob("*.py"))
        if path.parent != folder and (found := named.search(path.read_text("utf-8")))
    ]
    assert wrong == []
