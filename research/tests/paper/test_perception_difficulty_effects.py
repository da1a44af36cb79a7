"""The table of difficulties: every parameter has its row, and rows differ in one parameter."""

from dataclasses import fields

from research.benchmark.difficulty import Difficulty
from research.paper.difficulty_effects import moves


def test_every_parameter_but_speed_is_moved_and_alone() -> None:
    first, *rest = moves()
    assert first.difficulty == Difficulty()
    assert {m.parameter for m in rest} == {f.name for f in fields(Difficulty)} - {"seen", "moving_speed_mps"}
    for m in rest:
        moved = {f.name for f in fields(Difficulty) if getattr(m.difficulty, f.name) != getattr(Difficulty(), f.name)}
        assert moved == {m.parameter}
    assert len({(m.parameter, m.value) for m in rest}) == len(rest)
