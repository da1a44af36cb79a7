"""How many seeds a comparison to a half-width flies, by which detector, and when it stops."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import sortie
from sortie.scenarios.reading.load import loads
from sortie.sim.experiment import half_width
from sortie.sim.experiment.compare import Contender
from sortie.sim.experiment.comparison_text import precision_lines
from sortie.sim.experiment.detectors import KeepsMoments
from sortie.sim.experiment.half_width import FURTHER, METRICS, Batch, Flown, Row, Settings, next_batch, precision_of

METRIC = "ap50.full_scene"


def row(by: str, seed: int, gain: float | None, processor_s: float = 1.0) -> Row:
    return Row(by, seed, {"silence": {METRIC: gain, "ap50.mission": None}}, processor_s, {"worked": {}, "silence": {}})


def world(correlation: float, deviation: float = 0.02) -> tuple[list[float], list[float], list[float]]:
    """Gains of 400 seeds by torch and by the surrogate, and of 400 further seeds by the surrogate."""
    z = np.random.default_rng(4).normal(size=(800, 2))
    torch = correlation * z[:, 0] + math.sqrt(1 - correlation**2) * z[:, 1]
    return (deviation * torch[:400]).tolist(), z[:400, 0].tolist(), z[400:, 0].tolist()


def flown_to(batch: Batch, correlation: float, plans: Sequence[Batch]) -> Flown:
    """Everything of a batch, in a world."""
    torch, cheap, further = world(correlation)
    flown = Flown(plans=list(plans))
    for seed in range(batch.paired):
        flown.add(row("torch", seed, torch[seed], 15.0))
        if batch.control:
            flown.add(row("surrogate", seed, cheap[seed]))
    for k in range(batch.further):
        flown.add(row("surrogate", FURTHER + k, further[k]))
    return flown


def planned(correlation: float, settings: Settings) -> list[Batch]:
    plans: list[Batch] = []
    while True:
        flown = flown_to(plans[-1], correlation, plans) if plans else Flown()
        batch = next_batch(flown, ["silence"], settings)
        if batch is None:
            return plans
        plans.append(batch)


def test_a_correlated_surrogate_takes_the_place_of_torch() -> None:
    settings = Settings(0.01)
    with_it, without = planned(0.95, settings), planned(0.0, settings)
    assert with_it[0] == without[0] == Batch(12, 0, control=True, cost_ratio=pytest.approx(math.nan, nan_ok=True))
    assert all(b.control for b in with_it)
    assert not any(b.control for b in without[1:])
    assert all(b.further == 0 for b in without)
    assert with_it[-1].paired < 0.6 * without[-1].paired
    for correlation in (0.0, 0.95):
        assert [b.paired for b in planned(correlation, Settings(0.003))][:2] == [12, 24], "at most twice as many"
    for plans in (with_it, without):
        flown = flown_to(plans[-1], 0.95 if plans is with_it else 0.0, plans)
        found = precision_of(flown, ["silence"], settings, "torch")
        assert found.reached
        assert found.contrasts[0].half_width <= 0.01
        for before, after in itertools.pairwise(plans):
            assert before.paired <= after.paired <= 2 * before.paired
            assert after.paired % 4 == 0
            assert before != after


def test_a_useless_surrogate_is_named_and_left_out() -> None:
    settings = Settings(0.01)
    plans = planned(0.0, settings)
    flown = flown_to(plans[-1], 0.0, plans)
    for seed, gain in enumerate(world(0.0)[1][:12]):
        flown.add(row("surrogate", seed, gain))
    found = precision_of(flown, ["silence"], settings, "torch")
    assert (found.control, found.further, found.contrasts[0].coefficient) == (False, 0, 0.0)
    told = "\n".join(name + text for name, text in precision_lines(found))
    assert "the surrogate was not used" in told
    assert found.cost_ratio == pytest.approx((len(flown.torch) * 15 + 12) / (15 * len(flown.torch)), rel=0.15)


def test_a_comparison_stops_when_its_seeds_are_used_up() -> None:
    settings = Settings(0.0001, most=22)
    plans = planned(0.5, settings)
    assert plans[-1].paired == 22
    found = precision_of(flown_to(plans[-1], 0.5, plans), ["silence"], settings, "torch")
    assert not found.reached
    told = "\n".join(name + text for name, text in precision_lines(found))
    assert "not reached, as the seeds were used up: --most-seeds" in told


def equal(seeds: int, plans: Sequence[Batch]) -> Flown:
    flown = Flown(plans=list(plans))
    for seed in range(seeds):
        flown.add(row("torch", seed, 0.0, 15.0))
        if seed < 12:
            flown.add(row("surrogate", seed, 0.0))
    return flown


def test_gains_that_are_all_equal_count_as_known_from_thirty_seeds_on() -> None:
    plans: list[Batch] = []
    while batch := next_batch(equal(plans[-1].paired, plans) if plans else Flown(), ["silence"], Settings(0.01)):
        plans.append(batch)
    assert plans[0].paired == 12
    assert 30 <= plans[-1].paired < 36, "policies that decide alike do not fly to the end"
    found = precision_of(equal(plans[-1].paired, plans), ["silence"], Settings(0.01), "torch")
    assert found.reached
    told = "".join(next(iter(precision_lines(found))))
    assert f": none, as the gains are all equal in {plans[-1].paired} seeds, 1 asked, reached; " in told
    few = precision_of(equal(20, [Batch(20, 0, control=False)]), ["silence"], Settings(0.01, most=20), "torch")
    assert not few.reached
    assert "all equal in 20 seeds, 1 asked, not reached" in next(iter(precision_lines(few))).text


def test_seeds_without_a_gain_count_nowhere() -> None:
    flown = Flown(plans=[Batch(12, 0, True), Batch(12, 3, True)])
    for seed in range(6):
        flown.add(row("torch", seed, None if seed == 1 else float(seed)))
        flown.add(row("surrogate", seed, None if seed == 2 else float(seed)))
    for k, gain in enumerate((1.0, None, 3.0)):
        flown.add(row("surrogate", FURTHER + k, gain))
    found = flown.estimate("silence", METRIC, control=True)
    assert found.estimate.count == 4
    assert found.estimate.mean == pytest.approx((0 + 3 + 4 + 5 + 1 + 3) / 6), "equal gains: the mean of all with one"
    assert flown.estimate("silence", METRIC, control=False).estimate.mean == pytest.approx((0 + 2 + 3 + 4 + 5) / 5)


def test_nothing_can_be_planned_without_gains() -> None:
    flown = Flown(plans=[Batch(12, 0, True)])
    for seed in range(12):
        flown.add(row("torch", seed, None))
        flown.add(row("surrogate", seed, None))
    with pytest.raises(sortie.SortieError, match=r"ap50\.full_scene: fewer than two of 12 seeds have a gain"):
        next_batch(flown, ["silence"], Settings(0.01))


def _rows(by: str, count: int) -> list[Row]:
    return [Row(by, k, {"b": {METRICS[0]: 0.01 * k}}, 1.0) for k in range(count)]


def test_whether_the_surrogate_is_used_is_decided_after_the_pilot_for_good(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is predicted to save a twentieth only: too little after the pilot, and no reason to stop later."""
    plan = SimpleNamespace(expensive=30, cheap=60, cost_ratio=0.95)
    monkeypatch.setattr(half_width, "plan_units", lambda *args, **more: plan)
    for looks, uses in ((1, False), (2, True)):
        plans = [Batch(12, 0, control=True), Batch(12, 4, control=True)][:looks]
        flown = Flown(_rows("torch", 12), _rows("surrogate", 16), plans)
        batch = half_width.next_batch(flown, ["b"], Settings(1e-6))
        assert batch is not None
        assert (batch.control, batch.further > 0) == (uses, uses)
        assert batch.paired == 24, "twice as many at most"


def test_further_seeds_lie_far_from_paired_ones_and_nothing_is_flown_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = loads("name: x\nseed: 5\nperception: {detector: surrogate}")
    contenders = [Contender(label, scenario) for label in ("a", "b")]
    batches = iter([Batch(2, 2, control=True), Batch(3, 3, control=True), None])
    monkeypatch.setattr(half_width, "next_batch", lambda *_: next(batches))
    for name in ("torch", "surrogate"):
        monkeypatch.setattr(half_width, f"fly_{name}", lambda _, seed, *kept, n=name, **more: Row(n, seed, {}, 1.0))
    flown = half_width.run(contenders, Settings(0.1))
    assert [row.seed for row in flown.torch] == [5, 6, 7]
    far = 5 + FURTHER
    assert [row.seed for row in flown.surrogate] == [5, 6, far, far + 1, 7, far + 2]


def test_other_draws_are_of_the_moments_that_were_scored_each_at_its_own_time() -> None:
    """Moments come in several calls, some of them together; truths follow each call."""

    class Surrogate:
        def detect_many(self, moments: Any) -> list[int]:
            return [len(jobs) for jobs in moments]

        def truth_many(self, t_s: Any, egos: Any) -> int:
            return len(t_s)

    def jobs(*drones: int) -> list[Any]:
        return [(SimpleNamespace(drone=d), ()) for d in drones]

    keeps = KeepsMoments.__new__(KeepsMoments)
    keeps.looks, keeps._moments, keeps._keys = Surrogate(), [], []  # type: ignore[assignment]
    assert keeps.detect_many([jobs(0, 1), jobs(1)]) == [2, 1]
    assert keeps.truth_many([1.0, 1.0, 1.0, 2.0], [None] * 4) == 4  # type: ignore[list-item]
    keeps.detect_many([jobs(2)])
    keeps.truth_many([3.0, 3.0], [None] * 2)  # type: ignore[list-item]
    assert keeps._keys == [(1.0, 0), (1.0, 1), (2.0, 1), (3.0, 2)]
