"""The trained example of docs/guide/learn.md: the policy that is kept is the page's, and the plan's verdicts are what intervals say."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest

from research.validation import learned_example as example
from sortie.policies.registry import resolve
from sortie.policies.verification.kit.conformance import conform
from sortie.scenarios.reading.load import load, load_conditions
from sortie.sim.experiment.flight import Flight
from sortie.sim.experiment.places import METRICS
from sortie.sim.experiment.rank import load_suite

TWO = [1001, 1002]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    example.forget()


def test_the_kept_policy_is_what_the_page_freezes(here: Path) -> None:
    """If this fails, the page's program changed: make figures FIGURE=learned_example."""
    example.program(here).freeze(example.kept_weights(), "again.py")
    assert Path("again.py").read_text("utf-8") == example.KEPT.read_text("utf-8")


def test_the_kept_policy_keeps_the_rules() -> None:
    policy = resolve(example.LEARNED, {})
    assert {check.name: check.what for check in conform(policy, count=50) if not check.holds} == {}


def test_the_page_shows_the_plan() -> None:
    plan, page = example.plan(), example.PAGE.read_text("utf-8")
    first, last = plan["train_seeds"][0], plan["train_seeds"][-1]
    assert plan["train_seeds"] == list(range(first, last + 1))
    assert (
        f"generations={plan['generations']}, candidates={plan['candidates']}, seeds=range({first}, {last + 1})" in page
    )
    held = plan["held_out_seeds"]
    assert f"range({held[0]}, {held[-1] + 1}), duration_s={plan['duration_s']}" in page
    assert held == list(range(held[0], held[-1] + 1))


def test_no_held_out_condition_was_trained_in() -> None:
    plan = example.plan()
    train, development, held = (set(plan[f"{name}_seeds"]) for name in ("train", "development", "held_out"))
    assert not train & held
    assert not development & held
    assert not train & development
    assert len(held) == len(plan["held_out_seeds"]) == 30


def test_a_file_of_conditions_is_what_the_learner_flies(here: Path) -> None:
    """The same scenario from the file as from the page's function, but for its length; the metric is that of its phase."""
    train = example.program(here)
    train.write_conditions("held_out.yaml", TWO, 20)
    found = load_conditions("held_out.yaml")
    assert found is not None
    assert found.seeds == ()
    for seed, one in zip(TWO, found.conditions, strict=True):
        drawn = train.condition(seed)
        from_file = load(found.base, [*found.set, *one.set])
        assert from_file == load("track_target", {**train.BASE, **drawn, "duration_s": 20})
        assert from_file.seed == from_file.perception.scene.seed == seed
        assert one.metric == ("mission" if from_file.mission.phases[0].region else "full_scene")


def test_costs_are_those_of_a_drone_and_second(here: Path) -> None:
    """Five drones for 20 s: 100 MB cost a point a drone-second, and so do 100 kJ."""
    example.program(here).write_conditions("held_out.yaml", TWO, 20)
    suite = load_suite("held_out.yaml")

    def flight(ap: float, sent: float, spent_j: float) -> Flight:
        known = {"ap50.mission": ap, "ap50.full_scene": ap, "bytes.data_sent": sent, "energy_j.total": spent_j}
        return Flight("", "", {name: known.get(name) for name in METRICS})

    flights = {"costly": {"seed_1001": flight(0.5, 100e6, 100e3), "seed_1002": flight(0.4, 0.0, 0.0)}}
    assert example.less_costs(flights, suite)["costly"].mean == pytest.approx((0.5 - 0.02 + 0.4) / 2)


@pytest.mark.parametrize(
    ("found", "verdict"),
    [
        ((2.0, 1.0, 3.0), "holds"),
        ((2.0, 0.0, 3.0), "not decided"),
        ((-2.0, -3.0, -1.0), "is refuted"),
        ((0.0, 0.0, 0.0), "is refuted"),
        ((math.nan, math.nan, math.nan), "not decided"),
    ],
)
def test_an_interval_decides(found: tuple[float, float, float], verdict: str) -> None:
    assert example.verdict(found) == verdict
