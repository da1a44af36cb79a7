"""What learning hands to the sorties that it flies, and what it takes from their records."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from policies_examples import fleet_of

from research.learn import learn
from research.learn.learn import Lesson, fit
from sortie.perception.metrics.ap import Matched
from sortie.policies.catalogue.adaptive import ARMS, features, spend
from sortie.policies.contract import FleetView, TaskPhase
from sortie.sim.folders import RunError


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
