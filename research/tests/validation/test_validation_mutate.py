"""The mutation tester: which changes have a meaning, what is noticed, and what it prints."""

from __future__ import annotations

from pathlib import Path

import pytest

from research.validation import mutate

PLAIN = '''"""About."""
from functools import lru_cache

@lru_cache(maxsize=4)
def half(x: int | float) -> float | None:
    """Half of it."""
    assert x >= 0
    return x / 2 if x > 1 else None
'''


@pytest.mark.parametrize(
    ("old", "new", "alike"),
    [
        ("int | float", "int + float", True),
        ("float | None", "float & None", True),
        ("maxsize=4", "maxsize=5", True),
        ("x >= 0", "x < 0", True),
        ("Half of it", "Some of it", True),
        ("x / 2", "x * 2", False),
        ("x > 1", "x >= 1", False),
        ("2 if", "3 if", False),
    ],
)
def test_only_what_a_run_can_notice_has_a_meaning(old: str, new: str, alike: bool) -> None:
    changed = PLAIN.replace(old, new)
    assert changed != PLAIN
    assert (mutate.meaning(changed) == mutate.meaning(PLAIN)) == alike


def test_a_change_names_its_line() -> None:
    change = mutate.Change("a/b.py", PLAIN.replace("x / 2", "x * 2"))
    assert change.where(PLAIN) == "a/b.py:8: return x / 2 if x > 1 else None  →  return x * 2 if x > 1 else None"


def test_two_logs_are_compared_by_room_and_by_change() -> None:
    old = [{"room": "radio", "change": "x", "by": None}, {"room": "sim", "change": "y", "by": "tests/a.py::test_a"}]
    new = [{"room": "radio", "change": "x", "by": "tests/b.py::test_b"}, {"room": "sim", "change": "y", "by": None}]
    lines = mutate.table([old, new])
    assert lines[0] == "| room | changes | survived | survived |"
    for row in ("| radio | 1 | 1 | 0 |", "| sim | 1 | 0 | 1 |", "| fleet | 0 | 0 | 0 |", "| all | 2 | 1 | 1 |"):
        assert row in lines
    assert mutate.differing(old, new) == [
        "now noticed: x, by tests/b.py::test_b",
        "no longer noticed: y, by tests/a.py::test_a",
    ]


def test_every_pattern_finds_files() -> None:
    for room, patterns in mutate.ROOMS.items():
        assert [one for one in patterns if not list((mutate.ROOT / room).glob(one))] == [], room


def test_the_tests_of_the_nearest_folder_come_first() -> None:
    assert mutate.stages(mutate.ROOT, "radio/mac/edca.py") == [
        ["tests/radio/mac"],
        ["tests/radio", "--ignore=tests/radio/mac"],
        ["tests", "--ignore=tests/radio/mac", "--ignore=tests/radio"],
    ]
    assert mutate.stages(mutate.ROOT, "radio/air.py") == [
        ["tests/radio"],
        [],
        ["tests", "--ignore=tests/radio", "--ignore=tests/radio"],
    ]


def test_a_sample_is_drawn_of_changes_with_a_meaning() -> None:
    pytest.importorskip("cosmic_ray", reason="pip install -e '.[mutate]'")
    every = list(mutate.drawn({"a.py": PLAIN}, 0, "1"))
    lines = {change.where(PLAIN) for change in every}
    assert len(lines) == len(every) > 10
    assert all("a.py:8: " in line for line in lines)  # the only line that counts
    some = list(mutate.drawn({"a.py": PLAIN}, 4, "1"))
    assert some == list(mutate.drawn({"a.py": PLAIN}, 4, "1")) == every[:4]
    assert some != list(mutate.drawn({"a.py": PLAIN}, 4, "2"))


@pytest.mark.slow
def test_what_a_test_holds_is_noticed_and_what_none_holds_survives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code = "def half(x):\n    return x / 2 if x > 1 else None\n"
    (tmp_path / "radio").mkdir()
    (tmp_path / "tests" / "radio").mkdir(parents=True)
    (tmp_path / "radio" / "halves.py").write_text(code)
    test = "from radio.halves import half\n\ndef test_half():\n    assert half(4) == 2\n"
    (tmp_path / "tests" / "radio" / "test_halves.py").write_text(test)
    two = [mutate.Change("radio/halves.py", code.replace(*pair)) for pair in (("x / 2", "x * 2"), ("> 1", "> 2"))]
    monkeypatch.setattr(mutate, "ROOT", tmp_path)
    monkeypatch.setattr(mutate, "ROOMS", {"radio": ("*.py",)})
    monkeypatch.setattr(mutate, "drawn", lambda *_: iter(two))
    for _ in range(2):  # the second call finds everything in the log
        mutate.measure(tmp_path, tmp_path / "log", 2, "1", ("radio",), 2)
    by_new_line = {row["change"].split("→  ")[1]: row["by"] for row in mutate.read(tmp_path / "log")}
    assert by_new_line == {
        "return x * 2 if x > 1 else None": "tests/radio/test_halves.py::test_half",
        "return x / 2 if x > 2 else None": None,
    }
    assert len((tmp_path / "log").read_text().splitlines()) == 2
    assert (tmp_path / "radio" / "halves.py").read_text() == code
