"""Both detectors on what one flight asks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sim_examples import BASE

from research.calibrate.in_flight import REGIONS, ConditionAp, flights, means, torch_answers
from sortie.perception.metrics.ap import average_precision
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.model import SHIPPED
from sortie.scenarios.reading.load import load, load_conditions
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.accuracy import both_matched
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord


def levels(policy: str, torch: list[float], surrogate: list[float], region: str = "full_scene") -> list[ConditionAp]:
    return [ConditionAp(policy, f"c{k}", region, a, b) for k, (a, b) in enumerate(zip(torch, surrogate, strict=True))]


def test_means_and_gains_by_hand() -> None:
    both = levels("all-4", [0.3, 0.4, 0.5], [0.31, 0.42, 0.53]) + levels("boxes", [0.5, 0.5, 0.5], [0.5, 0.5, 0.53])
    found = {m.what: m for m in means(both)}
    assert list(found) == ["all-4", "boxes", "boxes − all-4"]
    assert found["all-4"].torch[0] == pytest.approx(0.4)
    assert found["all-4"].surrogate == pytest.approx(0.42)
    assert found["all-4"].error[0] == pytest.approx(0.02)
    assert found["boxes − all-4"].torch[0] == pytest.approx(0.1)
    assert found["boxes − all-4"].error[0] == pytest.approx(-0.01)
    for m in found.values():
        assert m.torch[1] <= m.torch[0] <= m.torch[2]
        assert m.error[1] <= m.error[0] <= m.error[2]


def test_regions_are_told_apart_and_those_without_a_disc_left_out() -> None:
    both = levels("all-4", [0.3, 0.4], [0.3, 0.4]) + levels("all-4", [0.7], [0.6], "mission")
    assert [(m.what, m.region) for m in means(both)] == [("all-4", "full_scene"), ("all-4", "mission")]
    assert next(m for m in means(both) if m.region == "mission").error == pytest.approx(
        (-0.1, np.nan, np.nan), nan_ok=True
    ), "a single condition has no interval"
    assert not [m for m in means(levels("all-4", [0.3], [0.3])) if np.isnan(m.surrogate)]


def test_gains_are_of_the_conditions_that_both_policies_saw_something_in() -> None:
    """A policy that looks from elsewhere may have no car in a condition's disc where another has one."""
    first = levels("all-4", [0.3, 0.4, 0.5], [0.3, 0.4, 0.5])
    second = levels("vantage", [0.9, 0.5, 0.7], [0.9, 0.6, 0.7])
    gain = {m.what: m for m in means(first + second[1:])}["vantage − all-4"]
    assert (gain.torch[0], gain.surrogate) == pytest.approx((0.15, 0.2))
    gain = {m.what: m for m in means(first[:2] + second[1:])}["vantage − all-4"]
    assert (gain.torch[0], gain.surrogate) == pytest.approx((0.1, 0.2))
    assert "vantage − all-4" not in {m.what for m in means(first[:1] + second[1:])}


@pytest.mark.slow
def test_the_torch_detector_is_asked_what_its_own_sortie_asks(tmp_path: Path) -> None:
    """All-4 sends maps alone, so traffic is the same whichever detector counts boxes.

    As long as nothing that it finds changes a frame on the air: no target to name, and no link so old that it gets boxes.
    """
    quiet = "context: {degraded_after_periods: 50, detached_after_periods: 60}\n"
    search = BASE.index("  phases:"), BASE.index("perception:")
    (path := tmp_path / "example.yaml").write_text(BASE[: search[0]] + BASE[search[1] :] + quiet)
    found = {v.region: v for v in flights(str(path), SHIPPED, None, 0.5, ["all-4"])}
    sets = ["perception.detector=torch", "perception.sample_rate_hz=0.5", "policy.name=all-4", "policy.params={}"]
    scenario = load(path, sets)
    own = outcome(run_sortie(scenario))["ap50"]
    assert found["full_scene"].torch == pytest.approx(own["full_scene"])
    ours = scenario.model_copy(update={"perception": scenario.perception.model_copy(update={"detector": "surrogate"})})
    assert found["full_scene"].surrogate == pytest.approx(outcome(run_sortie(ours))["ap50"]["full_scene"])


def test_a_set_is_flown_condition_by_condition_within_its_budgets(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the surrogate in the torch detector's place, so that both say the same."""
    flown = []

    def fly(scenario: Scenario, policy: None, seed: int, *, detector_of: object) -> SortieRecord:
        flown.append((scenario.policy.name, scenario.policy.params.get("received_budget"), seed))
        return run_sortie(scenario.model_copy(update={"duration_s": 1.0}), policy, seed)

    monkeypatch.setattr("research.calibrate.in_flight.run_sortie", fly)
    told: list[tuple[str, int, int]] = []
    found = list(flights("conditions", SHIPPED, None, 2.0, ["silence", "all-4"], lambda *at: told.append(at)))
    conditions = load_conditions("conditions")
    assert conditions is not None
    assert told[-1] == ("conditions by both detectors", 2 * len(conditions.conditions), 2 * len(conditions.conditions))
    assert flown[2:4] == [("all-4", conditions.conditions[0].budget, conditions.seeds[0])] * 2
    assert {v.condition for v in found} == {c.name for c in conditions.conditions}
    assert all(v.torch == v.surrogate for v in found)


@pytest.mark.parametrize("name", ["example.yaml", "conditions"])
def test_what_is_overridden_is_overridden_in_every_sortie(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (path := tmp_path / "example.yaml").write_text(BASE)
    joins = []

    def fly(scenario: Scenario, policy: None, seed: int, *, detector_of: object) -> None:
        joins.append(scenario.perception.join)

    monkeypatch.setattr("research.calibrate.in_flight.run_sortie", fly)
    monkeypatch.setattr("research.calibrate.in_flight.both_matched", lambda record: {region: {} for region in REGIONS})
    flown = str(path) if name == "example.yaml" else name
    list(flights(flown, SHIPPED, None, 2.0, ["silence"], sets=["perception.join=nms"]))
    assert joins
    assert set(joins) == {"nms"}


def test_a_condition_is_flown_in_many_towns_and_judged_as_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Both are the surrogate here; each town is another, and a condition's AP is that of all their fusions."""
    (path := tmp_path / "example.yaml").write_text(BASE)
    flown: list[tuple[int, int, str]] = []
    records: list[SortieRecord] = []

    def fly(scenario: Scenario, policy: None, seed: int, *, detector_of: object) -> SortieRecord:
        flown.append((scenario.perception.scene.seed, seed, scenario.policy.name))
        records.append(run_sortie(scenario, policy, seed))
        return records[-1]

    monkeypatch.setattr("research.calibrate.in_flight.run_sortie", fly)
    told: list[tuple[str, int, int]] = []
    found = list(flights(str(path), SHIPPED, None, 0.5, ["silence", "all-4"], lambda *at: told.append(at), towns=3))
    scenario = load(path)
    town, seed = scenario.perception.scene.seed, scenario.seed
    assert flown[::2] == [(town + 1000 * k, seed + k, p) for k in range(3) for p in ("silence", "all-4")]
    assert told[0][1:] == (0, 6)
    assert told[-1][1:] == (6, 6)
    assert [k for _, k, _ in told] == list(range(7))
    for v in found:
        theirs = [m for r in records[::2] if r.policy == v.policy for m in both_matched(r)[v.region].values()]  # type: ignore[literal-required]
        assert v.torch == v.surrogate == average_precision(theirs)
    assert {v.policy for v in found} == {"silence", "all-4"}


def test_sorties_in_one_scene_share_the_torch_detector(tmp_path: Path) -> None:
    (path := tmp_path / "example.yaml").write_text(BASE)
    scenario, bounds = load(path), (-50.0, -50.0, 50.0, 50.0)
    make = torch_answers()

    def asked(seed: int = 1, brightness: float = 1.0, east_m: float = 50.0) -> Any:
        config = scenario.perception.scene.model_copy(update={"brightness": brightness})
        scene = SceneModel(config, scenario.mission.target, (*bounds[:2], east_m, bounds[3]))
        return make(scene, scenario.perception, seed, 0)

    first = asked()
    assert asked().detect.__self__ is first.detect.__self__
    assert asked(seed=2).detect.__self__ is not first.detect.__self__
    for other in (asked(brightness=0.5), asked(east_m=80.0), asked()):
        assert other.detect.__self__ is not first.detect.__self__
