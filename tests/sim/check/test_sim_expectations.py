"""What an outcome is held to."""

from __future__ import annotations

from typing import Any

import pytest
from sim_examples import example

from sortie.scenarios.schema import Expectation
from sortie.sim.check.expectations import check
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome


@pytest.mark.parametrize(
    ("metric", "equals", "holds"),
    [
        ("drones.0.airborne", True, True),
        ("drones.0.airborne", 1.0, False),
        ("replication", 0.0, True),
        ("replication", False, False),
        ("scenario", "example", True),
        ("duration_s", "0.5", False),
        ("duration_s", 0.5, True),
    ],
)
def test_a_truth_is_no_number(metric: str, equals: Any, holds: bool) -> None:
    record = run_sortie(example("duration_s=0.5"))
    held = record.scenario.model_copy(update={"expect": (Expectation(metric=metric, equals=equals),)})
    (verdict,) = check(held, record, outcome(record))
    assert verdict.holds is holds


@pytest.mark.parametrize(
    ("metric", "holds"),
    [
        ("payload_fates.lost/no_link", True),
        ("descriptor_drops.forged", True),
        ("distrusted_by.0", True),
        ("payload_fates.lost/no_lnk", False),
        ("distrusted_by.99", False),
        ("policies.decisions.other", False),
    ],
)
def test_nothing_of_a_kind_is_a_count_of_zero_and_an_unknown_kind_fails(metric: str, holds: bool) -> None:
    record = run_sortie(example("duration_s=0.5"))
    held = record.scenario.model_copy(update={"expect": (Expectation(metric=metric, at_most=0),)})
    (verdict,) = check(held, record, outcome(record))
    assert (verdict.holds, verdict.got == "0") == (holds, holds)
