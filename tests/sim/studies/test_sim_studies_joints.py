"""What studies hand to the sorties that they fly, and what they take of their records."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from policies_examples import fleet_of

from research.learn import learn
from research.learn.learn import Lesson, fit
from research.overhead import overhead
from sortie.perception.metrics.ap import Matched
from sortie.policies.catalogue.adaptive import ARMS, features, spend
from sortie.policies.contract import FleetView, TaskPhase
from sortie.scenarios.reading.load import loads
from sortie.sim.folders import RunError
from sortie.sim.studies import multifidelity
from sortie.sim.studies.compare import Compared, Contender, _over_sorties
from sortie.sim.studies.multifidelity import METRICS, Batch, Row
from sortie.sim.studies.surrogate_draws import KeepsMoments


@pytest.mark.parametrize("tracks", [False, True])
def test_a_lesson_has_what_the_first_arm_saw_once_it_had_settled_and_each_arm_s_own_ap(
    tracks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten views of falling charge; each arm's flight sees other ones. Settled is the second half."""
    numbers = (n for n in range(1000) if (learn.draw_condition(3, n)[0].mission.phases[0].phase == "track") == tracks)
    number = next(numbers)
    scenario, budget = learn.draw_condition(3, number)
    scopes, flown = list[bool](), list[Any]()

    def views(arm: int) -> list[FleetView]:
        return [fleet_of(3, soc=0.9 - 0.01 * k - 0.2 * arm, phase=TaskPhase.TRACK) for k in range(10)]

    def run(flies: Any, decide: Any, **_: Any) -> int:
        arm = len(flown)
        flown.append(flies)
        for view in views(arm):
            assert decide(view) == spend(view, ARMS[arm], budget, "lesson")
        return arm

    def matched(record: int, *, mission: bool) -> dict[Any, Matched]:
        scopes.append(mission)
        hits = np.arange(4) <= record  # as many of four cars as the arm's number and one more
        return {(0.0, 0): Matched(np.arange(4, 0, -1.0)[hits], hits[hits], 4)}

    monkeypatch.setattr(learn, "run_sortie", run)
    monkeypatch.setattr(learn, "matched", matched)
    lesson = learn.fly_lesson(3, number)
    assert flown == [scenario] * len(ARMS)
    assert scopes == [tracks] * len(ARMS)
    assert lesson.ap == pytest.approx([0.25, 0.5, 0.75], abs=0.01)
    assert lesson.features == pytest.approx(np.mean([features(v, budget) for v in views(0)[5:]], axis=0))


def test_training_conditions_of_other_seeds_and_numbers_are_other_draws_and_overrides_come_last() -> None:
    drawn = [learn.draw_condition(seed, number)[0] for seed, number in ((0, 1), (0, 2), (1, 1))]
    assert len({s.seed for s in drawn}) == len({s.perception.scene.seed for s in drawn}) == 3
    assert learn.draw_condition(0, 1, ["duration_s=3"])[0].duration_s == 3


def test_a_slope_is_shrunk_by_ridge_regression_in_units_of_the_feature_s_spread() -> None:
    """One feature varies: its slope is Σ z g / (n + `RIDGE`), the mean gain stays."""
    x = np.array([1.0, 2.0, 4.0, 7.0])
    gain = np.array([0.3, 0.1, 0.0, -0.2])
    lessons = [Lesson((v, 5.0), (0.4, 0.4 + g), "") for v, g in zip(x.tolist(), gain.tolist(), strict=True)]
    fitted = fit(lessons)
    z = (x - 3.5) / x.std()
    assert fitted["mean"] == pytest.approx([3.5, 5.0])
    assert fitted["scale"] == pytest.approx([x.std(), 1e-6])
    assert fitted["weights"][0] == pytest.approx([0.0, 0.0, 0.0])  # type: ignore[comparison-overlap]
    assert fitted["weights"][1] == pytest.approx([gain.mean(), float(z @ gain) / (4 + learn.RIDGE), 0.0])


def test_lessons_in_which_an_arm_has_no_ap_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def lesson(seed: int, number: int, by_torch: bool, sets: Any) -> Lesson:
        assert (seed, by_torch, sets) == (7, True, ("a=1",))
        ap = {1: (math.nan, 0.2), 3: (0.1, math.nan)}.get(number, (0.1, 0.2))
        return Lesson((float(number),), ap, "")

    class Pool:
        def __init__(self, max_workers: int) -> None:
            assert max_workers == 2

        def __enter__(self) -> Pool:
            return self

        def __exit__(self, *_: Any) -> None: ...

        map = staticmethod(map)

    monkeypatch.setattr(learn, "fly_lesson", lesson)
    monkeypatch.setattr(learn, "ProcessPoolExecutor", Pool)
    done: list[int] = []
    lessons = learn.fly_lessons(7, 5, sets=("a=1",), by_torch=True, workers=2, progress=done.append)
    assert [x.features[0] for x in lessons] == [0, 2, 4]
    assert done == [1, 2, 3, 4, 5]
    monkeypatch.setattr(learn, "fly_lesson", lambda *_: Lesson((0.0,), (math.nan, 0.2), ""))
    with pytest.raises(RunError, match="no accuracy in any of 5 conditions: there was no car to be seen"):
        learn.fly_lessons(7, 5, workers=2)


@pytest.mark.parametrize(
    ("gains", "falls_at"),
    [
        ({0.01: 0.02, 0.04: -0.02}, 0.02),
        ({0.01: 0.03, 0.04: 0.01, 0.2: -0.01}, math.sqrt(0.04 * 0.2)),
        ({0.01: 0.03, 0.04: 0.0, 0.2: -0.01}, 0.04),
        ({0.01: 0.03, 0.04: 0.0, 0.2: 0.02}, 0.04),
        ({0.01: 0.0, 0.04: -0.01}, 0.01),
        ({0.01: -0.01, 0.04: 0.02}, 0.01),  # maps are better at the least budget already
        ({0.01: 0.01, 0.04: 0.02}, math.inf),
        ({0.2: 0.03, 0.6: -0.01}, 0.2 * 3 ** (3 / 4)),
    ],
)
def test_the_budget_from_which_maps_find_more_is_interpolated_on_a_log_scale(
    gains: dict[float, float], falls_at: float
) -> None:
    lessons = [Lesson((math.log10(b), 0.0, 0.0, 0.0, 0.0), (0.3, 0.9, 0.3 + g), "") for b, g in gains.items()]
    assert learn.thresholds(lessons) == pytest.approx({"search": falls_at})


def test_overhead_is_what_was_sent_a_second_and_the_later_half_of_the_decisions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Decisions of 9 ms while drones have not heard each other yet, then of 1, 2, …, 5 ms."""
    clock = iter(np.cumsum([k for ms in (9, 9, 9, 9, 9, 1, 2, 3, 4, 5) for k in (0, ms * 10**6)]).tolist())
    asked: list[Any] = []

    def run(scenario: Any, decide: Any, progress: Any) -> Any:
        asked.append(scenario)
        assert decide.__name__ == "all-4"
        monkeypatch.setattr(overhead.time, "thread_time_ns", lambda: next(clock))
        for _ in range(10):
            assert len(decide(fleet_of(3))) == 2
        return None

    told = {"bytes": {"context_sent": 3000, "data_sent": 9000, "data_delivered": 1, "handshakes_sent": 2}}
    monkeypatch.setattr(overhead, "run_sortie", run)
    monkeypatch.setattr(overhead, "outcome", lambda record: told)
    found = overhead.measure("all-4", 7, 2.0)
    assert (asked[0].fleet.drones, asked[0].duration_s, asked[0].perception.detector) == (7, 2.0, "none")
    assert (found.policy, found.drones, found.decisions) == ("all-4", 7, 5)
    assert (found.context_bytes_per_s, found.data_bytes_per_s, found.context_share) == (1500.0, 4500.0, 0.25)
    assert (found.p50_ms, found.p99_ms) == pytest.approx((3.0, 4.96))


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
