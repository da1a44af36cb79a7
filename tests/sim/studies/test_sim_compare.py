"""Which fusions of two arms of sorties are compared, and what a bootstrap may not part."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sortie.perception.metrics.ap import Matched
from sortie.sim.studies import compare

pytestmark = pytest.mark.slow


def scored(name: float, *keys: tuple[float, int]) -> dict[tuple[float, int], Matched]:
    """Fusions of a sortie, each with a score that says which it is."""
    return {
        (t_s, drone): Matched(np.array([name + t_s / 100 + drone / 1e4]), np.array([True]), 1) for t_s, drone in keys
    }


def test_fusions_are_paired_by_sortie_time_and_drone_and_grouped_by_blocks_of_a_sortie(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Egos and instants of one block of 5 s stand or fall together; two sorties have the same times and are still two."""
    records: dict[str, Any] = {
        "a0": scored(10, (1.0, 0), (4.9, 1), (5.0, 0), (6.0, 2)), "b0": scored(20, (4.9, 1), (1.0, 0), (5.0, 0), (5.0, 1)),
        "a1": scored(30, (1.0, 0), (5.0, 2), (9.5, 0)), "b1": scored(40, (9.5, 0), (1.0, 0), (5.0, 2)),
    }  # fmt: skip
    monkeypatch.setattr(compare, "matched", lambda record, **how: records[record])
    arms: tuple[Any, Any] = ["a0", "a1"], ["b0", "b1"]
    first, second, groups = compare.pair_up(*arms, mission=False)
    keys = [(1.0, 0), (4.9, 1), (5.0, 0), (1.0, 0), (5.0, 2), (9.5, 0)]
    of_sortie = [0, 0, 0, 1, 1, 1]
    for arm, names in ((first, (10, 30)), (second, (20, 40))):
        wanted = [names[k] + t_s / 100 + drone / 1e4 for k, (t_s, drone) in zip(of_sortie, keys, strict=True)]
        assert [float(m.score[0]) for m in arm] == pytest.approx(wanted)
    assert groups == [0, 0, 1, 2, 3, 3]
    without = compare.pair_up(*arms, mission=False, leaving_out={0})
    assert (len(without[0]), without[2]) == (2, [0, 1])
