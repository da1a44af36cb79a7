"""Fusions of two arms of sorties, side by side."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from research.validation import pairs_of_records
from sortie.perception.metrics.ap import Matched


def named(name: float, *keys: tuple[float, int]) -> dict[tuple[float, int], Matched]:
    """Fusions of a sortie, each with a score that says which it is."""
    found = np.array([True])
    return {key: Matched(np.array([name + key[0] / 100 + key[1] / 1e4]), found, 1) for key in keys}


def test_fusions_are_paired_by_sortie_time_and_drone_and_grouped_by_blocks_of_a_sortie(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Egos and instants of a block of 5 s stand or fall together; two sorties at the same times are still two."""
    records: dict[str, Any] = {
        "a0": named(10, (1.0, 0), (4.9, 1), (5.0, 0), (6.0, 2)),
        "b0": named(20, (4.9, 1), (1.0, 0), (5.0, 0), (5.0, 1)),
        "a1": named(30, (1.0, 0), (5.0, 2), (9.5, 0)),
        "b1": named(40, (9.5, 0), (1.0, 0), (5.0, 2)),
    }
    monkeypatch.setattr(pairs_of_records, "matched", lambda record, **how: records[record])
    arms: tuple[Any, Any] = ["a0", "a1"], ["b0", "b1"]
    first, second, groups = pairs_of_records.pair_up(*arms, mission=False)
    keys = [(1.0, 0), (4.9, 1), (5.0, 0), (1.0, 0), (5.0, 2), (9.5, 0)]
    of_sortie = [0, 0, 0, 1, 1, 1]
    for arm, names in ((first, (10, 30)), (second, (20, 40))):
        wanted = [names[k] + t_s / 100 + drone / 1e4 for k, (t_s, drone) in zip(of_sortie, keys, strict=True)]
        assert [float(m.score[0]) for m in arm] == pytest.approx(wanted)
    assert groups == [0, 0, 1, 2, 3, 3]
    without = pairs_of_records.pair_up(*arms, mission=False, leaving_out={0})
    assert (len(without[0]), without[2]) == (2, [0, 1])
