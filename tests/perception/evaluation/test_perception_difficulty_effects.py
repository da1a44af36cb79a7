"""The table of difficulties: every parameter has its row, rows differ in one parameter, the README keeps the rest."""

import hashlib
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from sortie.perception.benchmark.difficulty import Difficulty
from sortie.perception.evaluation.difficulty_effects import BEGIN, END, Effect, moves, table, write_table
from sortie.perception.metrics.ap import Matched
from sortie.perception.metrics.bootstrap import compare


def test_every_parameter_but_speed_is_moved_and_alone() -> None:
    first, *rest = moves()
    assert first.difficulty == Difficulty()
    assert {m.parameter for m in rest} == {f.name for f in fields(Difficulty)} - {"seen", "moving_speed_mps"}
    for m in rest:
        moved = {f.name for f in fields(Difficulty) if getattr(m.difficulty, f.name) != getattr(Difficulty(), f.name)}
        assert moved == {m.parameter}
    assert len({(m.parameter, m.value) for m in rest}) == len(rest)


def unit(hits: list[bool]) -> Matched:
    return Matched(np.linspace(0.9, 0.1, len(hits)), np.array(hits), 4)


def test_the_table_tells_what_was_measured(tmp_path: Path) -> None:
    weights = tmp_path / "some.safetensors"
    weights.write_bytes(b"weights")
    label = np.arange(6)
    bad, good = [unit([True, False, False])] * 6, [unit([True, True, True, True])] * 6
    rows = moves()[:2]
    effects = [Effect(rows[0], compare(bad, good, label), None)]
    effects.append(Effect(rows[1], compare(bad, bad, label), compare(good, bad, label)))
    text = table(effects, weights, 6)
    digest = hashlib.sha256(b"weights").hexdigest()[:12]
    assert f"`some.safetensors` (SHA-256 {digest}…): 6 scenes" in text
    assert "| as it is |  | 0.250 | 1.000 | +0.750 | – |" in text
    assert "| `density` | sparse | 0.250 | 0.250 | +0.000 | **-0.750 [-0.750, -0.750]** |" in text

    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    write_table(readme, text)
    write_table(readme, text)
    assert readme.read_text() == f"before\n{BEGIN}\n{text}\n{END}\nafter\n"
    readme.write_text("no markers")
    with pytest.raises(ValueError, match="are missing, the table goes between them"):
        write_table(readme, text)
    with pytest.raises(ValueError, match=r"nothing\.md: missing"):
        write_table(tmp_path / "nothing.md", text)
