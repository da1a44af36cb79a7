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


def test_the_table_has_a_row_for_each_room() -> None:
    assert mutate.table({"radio": (8, ["x", "y"]), "sim": (0, [])}) == [
        "| room | changes | survived | share |",
        "|---|---|---|---|",
        "| radio | 8 | 2 | 25% |",
        "| sim | 0 | 0 | – |",
    ]


def test_the_files_and_tests_that_it_names_are_there() -> None:
    for room in mutate.ROOMS.values():
        for name in (*room.files, *room.tests):
            assert (mutate.ROOT / name).exists(), name


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
    (tmp_path / "halves.py").write_text(code)
    test = "from halves import half\n\ndef test_half():\n    assert half(4) == {}\n"
    (tmp_path / "test_halves.py").write_text(test.format(2))
    two = [mutate.Change("halves.py", code.replace(*pair)) for pair in (("x / 2", "x * 2"), ("> 1", "> 2"))]
    monkeypatch.setattr(mutate, "drawn", lambda *_: iter(two))
    room = mutate.Room(("halves.py",), ("test_halves.py",))
    left = "halves.py:2: return x / 2 if x > 1 else None  →  return x / 2 if x > 2 else None"
    assert mutate.survivors(tmp_path, "toy", room, 0, 1) == (2, [left])
    assert capsys.readouterr().out.splitlines()[1] == f"toy 2: SURVIVED  {left}"
    assert (tmp_path / "halves.py").read_text() == code
    (tmp_path / "test_halves.py").write_text(test.format(3))
    with pytest.raises(SystemExit, match=r"toy: its tests fail without any change; see pytest test_halves\.py"):
        mutate.survivors(tmp_path, "toy", room, 1, 1)
