"""Learning from training conditions: their draws, the fit, and what it finds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from sim_examples import Seer

from research.learn import learn
from research.learn.learn import Lesson, draw_condition, fit, save
from sortie.policies.catalogue.adaptive import ARMS, FEATURES, read_model
from sortie.scenarios.reading.load import load_conditions
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.experiment.conditions import scenario_of

SETS = ("conditions", "conditions_second", "conditions_third", "conditions_fourth")


def held_out(name: str) -> ConditionSet:
    conditions = load_conditions(name)
    assert conditions is not None
    return conditions


def test_no_held_out_condition_is_one_of_training() -> None:
    for conditions, condition in [(held_out(name), c) for name in SETS for c in held_out(name).conditions]:
        scenario = scenario_of(conditions, condition, "all-4")
        assert condition.budget not in learn.BUDGETS
        assert scenario.fleet.formation.shape not in learn.SHAPES
        assert scenario.perception.scene.seed not in range(1000, 10**6)
        assert (scenario.radio.tx_power_dbm, scenario.radio.path_loss_exponent) != (5, 2.4), "training's weak links"


def test_a_lesson_by_torch_asks_it_at_fewer_moments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sortie.perception.network.detector.TorchDetector", Seer)
    monkeypatch.setattr(learn, "SECONDS", 4)
    before = Seer.asked
    lesson = learn.fly_lesson(0, 7, by_torch=True)
    assert min(lesson.ap) > 0.8
    assert Seer.asked - before == len(ARMS) * 5 * 2
    ours = learn.fly_lesson(0, 7)
    # a descriptor that names a target is longer, and meets other frames: goodputs differ a little
    assert lesson.features == pytest.approx(ours.features, rel=0.02)
    assert max(ours.ap) < 0.9


# --- learning ------------------------------------------------------------------------------------


def test_training_conditions_are_drawn_from_their_streams() -> None:
    first, rho = draw_condition(0, 3)
    again, same_rho = draw_condition(0, 3)
    other, _ = draw_condition(0, 4)
    assert (first, rho) == (again, same_rho)
    assert other != first
    assert rho in learn.BUDGETS


def test_training_conditions_and_the_fit_name_what_is_overridden(tmp_path: Path) -> None:
    plain, _ = draw_condition(0, 3)
    changed, _ = draw_condition(0, 3, ["perception.join=nms"])
    perception = plain.perception.model_copy(update={"join": "nms"})
    assert plain.perception.join == "average"
    assert changed == plain.model_copy(update={"perception": perception})
    lessons = [planted(np.random.default_rng(k), 0.0) for k in range(9)]
    save(tmp_path / "model.json", lessons, 5, by_torch=True, sets=["perception.join=nms"])
    about = json.loads((tmp_path / "model.json").read_text())["about"]
    assert about.startswith("python -m research learn --by-torch --set perception.join=nms, 9 conditions of seed 5")


def planted(rng: np.random.Generator, noise: float) -> Lesson:
    """The last arm gains with the first feature, arm 1 loses always."""
    x = rng.normal(size=len(FEATURES))
    ap = np.full(len(ARMS), 0.3)
    ap[2] -= 0.05 * x[0]
    ap[1] -= 0.1
    return Lesson(tuple(x), tuple(ap + noise * rng.normal(size=len(ARMS))), "")


def test_the_fit_finds_planted_gains(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    lessons = [planted(rng, 0.002) for _ in range(3000)]
    save(tmp_path / "model.json", lessons, 0)
    model = read_model(tmp_path / "model.json")
    assert model.weights[1][0] == pytest.approx(-0.1, abs=0.002)
    slope = model.weights[2][1] / model.scale[0]
    assert slope == pytest.approx(-0.05, abs=0.003)
    assert np.abs(np.array(model.weights[1][1:])).max() < 0.002, "what does not matter has no slope"
    assert model.weights[0] == (0.0,) * 6, "gains are over the first arm"


def test_gains_by_phase_and_budget_by_hand() -> None:
    def lesson(rho: float, tracking: float, *ap: float) -> Lesson:
        return Lesson((np.log10(rho), tracking, 0.6, 2.0, 0.9), ap, "")

    lessons = [
        lesson(0.01, 0.0, 0.2, 0.1, 0.23), lesson(0.01, 0.0, 0.2, 0.1, 0.21), lesson(0.2, 1.0, 0.5, 0.5, 0.4),
    ]  # fmt: skip
    found = learn.gains(lessons, 2)
    assert found.keys() == {("search", 0.01), ("track", 0.2)}
    two, one = found["search", 0.01], found["track", 0.2]
    assert (two.mean, two.count) == (pytest.approx(0.02), 2)
    assert two.half_width == pytest.approx(12.706 * 0.01, rel=0.01), "Student's, with one degree of freedom"
    assert (one.mean, one.count) == (pytest.approx(-0.1), 1)
    assert np.isnan(one.half_width)


def test_boxes_are_worth_it_up_to_where_their_gain_falls_through_zero() -> None:
    def lesson(rho: float, tracking: float, gain: float) -> Lesson:
        return Lesson((np.log10(rho), tracking, 0.6, 2.0, 0.9), (0.3, 0.2, 0.3 + gain), "")

    falls = [lesson(0.01, 1.0, 0.03), lesson(0.01, 1.0, 0.01), lesson(0.04, 1.0, -0.02)]
    never = [lesson(0.01, 0.0, -0.01), lesson(0.2, 0.0, -0.03)]
    always = [lesson(0.01, 0.0, 0.01), lesson(0.6, 0.0, 0.02)]
    assert learn.thresholds([*falls, *never]) == pytest.approx({"search": 0.01, "track": 0.02})
    assert learn.thresholds(always) == {"search": np.inf}


def test_one_lesson_leaves_no_slope() -> None:
    fitted = fit([planted(np.random.default_rng(1), 0.0)])
    assert np.allclose(np.array(fitted["weights"])[:, 1:], 0)
