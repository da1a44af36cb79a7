"""What studies hand to the sorties that they fly, and what they take of their records."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from sortie.scenarios.reading.load import loads
from sortie.sim.studies import multifidelity
from sortie.sim.studies.compare import Compared, Contender, _over_sorties
from sortie.sim.studies.multifidelity import METRICS, Batch, Row
from sortie.sim.studies.surrogate_draws import KeepsMoments

pytestmark = pytest.mark.slow

# --- comparisons -------------------------------------------------------------------------------------


def _compared(policy: str, seed: int, flown_share: float, blind: float, gain: float) -> Compared:
    areas = ("full_scene", "mission")
    outcome = {"mission": {"flown_share": flown_share}, "ap50": {"grounded_blind": dict.fromkeys(areas, blind)}}
    return Compared(policy, seed, 0, outcome, dict.fromkeys(areas, gain), None)


def test_gains_over_all_drones_are_told_where_any_policy_lost_a_drone_and_are_each_sortie_s_own() -> None:
    flown = [
        _compared("a", 1, 0.8, 0.30, 0.0), _compared("b", 1, 1.0, 0.40, 0.1),
        _compared("a", 2, 1.0, 0.60, 0.0), _compared("b", 2, 1.0, 0.62, 0.3),
    ]  # fmt: skip
    gains = {g.metric: (g.policy, pytest.approx(g.gain), g.count) for g in _over_sorties(flown)}
    assert gains == {
        "ap50.full_scene": ("b", 0.2, 2), "ap50.mission": ("b", 0.2, 2),
        "ap50.grounded_blind.full_scene": ("b", 0.06, 2), "ap50.grounded_blind.mission": ("b", 0.06, 2),
    }  # fmt: skip


def _rows(by: str, count: int) -> list[Row]:
    return [Row(by, k, {"b": {METRICS[0]: 0.01 * k}}, 1.0) for k in range(count)]


@pytest.mark.parametrize(("looks", "uses"), [(1, False), (2, True)])
def test_whether_the_surrogate_is_used_is_decided_after_the_pilot_for_good(
    looks: int, uses: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is predicted to save a twentieth only: too little after the pilot, and no reason to stop later."""
    plan = SimpleNamespace(expensive=30, cheap=60, cost_ratio=0.95)
    monkeypatch.setattr(multifidelity, "plan_units", lambda *args, **more: plan)
    plans = [Batch(12, 0, control=True), Batch(12, 4, control=True)][:looks]
    flown = multifidelity.Flown(_rows("torch", 12), _rows("surrogate", 16), plans)
    batch = multifidelity.next_batch(flown, ["b"], multifidelity.Settings(1e-6))
    assert batch is not None
    assert (batch.control, batch.further > 0) == (uses, uses)
    assert batch.paired == 24, "twice as many at most"


def test_further_seeds_lie_far_from_paired_ones_and_nothing_is_flown_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = loads("name: x\nseed: 5\nperception: {detector: surrogate}")
    contenders = [Contender(label, scenario) for label in ("a", "b")]
    batches = iter([Batch(2, 2, control=True), Batch(3, 3, control=True), None])
    monkeypatch.setattr(multifidelity, "next_batch", lambda *_: next(batches))
    for name in ("torch", "surrogate"):
        monkeypatch.setattr(multifidelity, f"fly_{name}", lambda _, seed, n=name: Row(n, seed, {}, 1.0))
    kept: list[Row | Batch] = []
    flown = multifidelity.run(
        contenders, multifidelity.Settings(0.1), multifidelity.Flown(), kept.append, lambda *_: None
    )
    assert [row.seed for row in flown.torch] == [5, 6, 7]
    far = 5 + multifidelity.FURTHER
    assert [row.seed for row in flown.surrogate] == [5, 6, far, far + 1, 7, far + 2]
    assert [item for item in kept if isinstance(item, Row) and item.by == "torch"] == flown.torch


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
