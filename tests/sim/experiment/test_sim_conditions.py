"""Policies over sets of conditions."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest
from cli_examples import command
from sim_examples import Seer

from sortie.policies.registry import POLICIES
from sortie.scenarios.reading.load import ScenarioError, condition_sets, library, load, load_conditions
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.cli import conditions as commands
from sortie.sim.experiment import detectors
from sortie.sim.experiment.conditions import Cell, best_fixed, fly_conditions, scenario_of, summarise
from sortie.sim.folders import RunError

pytestmark = pytest.mark.slow

SMALL = """
base: track_target
set: [perception.detector=surrogate, duration_s=3, "mission.phases=[{at_s: 0, phase: search}]", policy.dwell_s=0.3]
conditions:
  - {name: poor, budget: 0.02}
  - {name: rich, budget: 0.25, set: [fleet.formation.shape=line]}
"""


SETS = ("conditions", "conditions_second", "conditions_third", "conditions_fourth")


def held_out(name: str) -> ConditionSet:
    conditions = load_conditions(name)
    assert conditions is not None
    return conditions


def test_the_held_out_conditions_load_under_every_policy_at_their_budget_and_none_is_in_two_sets() -> None:
    sets = {name: held_out(name) for name in SETS}
    for name, conditions in sets.items():
        assert name in condition_sets()
        assert name not in library()
        for condition, policy in itertools.product(conditions.conditions, POLICIES):
            scenario = scenario_of(conditions, condition, policy)
            assert set(scenario.policy.params.values()) <= {condition.budget}
            assert (condition.metric == "mission") == (scenario.mission.phases[0].phase == "track")
    for first, second in itertools.combinations([each.conditions for each in sets.values()], 2):
        assert not {c.name for c in first} & {c.name for c in second}
        assert not {c.budget for c in first} & {c.budget for c in second}


def test_what_is_wrong_with_a_set_is_named(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    for old, new, words in (
        ("budget: 0.02", "budget: 2", r"conditions\.0\.budget"),
        ("name: rich", "name: poor", "'poor', must be named once"),
        ("conditions:", "contexts:", r"c\.yaml:4: contexts: unknown key, it is now called conditions"),
    ):
        path.write_text(SMALL.replace(old, new))
        with pytest.raises(ScenarioError, match=words):
            load_conditions(path)
    with pytest.raises(ScenarioError, match=r"c\.yaml:4: contexts: unknown key, it is now called conditions"):
        load(path)


def cell(policy: str, condition: str, ap: float) -> Cell:
    return Cell(policy, condition, ap, 1e6, 1e3, 0.0)


def test_gains_are_over_the_best_fixed_policy_and_the_oracle_takes_the_best_of_each_condition() -> None:
    ap = {"all-4": (0.4, 0.2, 0.3), "best-2": (0.2, 0.3, 0.3), "learned": (0.5, 0.3, 0.4)}
    rows = summarise([cell(p, f"c{k}", a) for p, values in ap.items() for k, a in enumerate(values)])
    by_name = {r.policy: r for r in rows}
    assert best_fixed(rows) == "all-4"
    assert by_name["all-4"].gain == (0.0, 0.0, 0.0)
    assert by_name["learned"].gain[0] == pytest.approx(0.1)
    assert by_name["learned"].gain[1:] == pytest.approx((0.1, 0.1)), "the same gain in every condition"
    assert by_name["learned"].of_oracle == pytest.approx(1.2 / 1.0)
    assert by_name["best-2"].gain[1] < 0 < by_name["best-2"].gain[2]
    alike = summarise([cell(p, f"c{k}", a) for p in ("adaptive", "all-4") for k, a in enumerate((0.4, 0.2))])
    assert best_fixed(alike) == "all-4", "also where another is as good"


def test_a_condition_without_a_car_counts_for_nothing() -> None:
    """Its accuracy is undefined; before, the interval was too, and the best fixed policy was not found."""
    nan = float("nan")
    ap = {"all-4": (0.4, nan, 0.2), "best-2": (0.2, nan, nan), "boxes": (0.5, nan, 0.9)}
    rows = summarise([cell(p, f"c{k}", a) for p, values in ap.items() for k, a in enumerate(values)])
    assert [(r.policy, r.ap) for r in rows] == [("all-4", 0.4), ("best-2", 0.2), ("boxes", 0.5)]
    assert best_fixed(rows) == "all-4"
    assert rows[2].gain == pytest.approx((0.1, nan, nan), nan_ok=True), "one condition is left, which has no interval"
    with pytest.raises(RunError, match="no condition has an accuracy under every policy"):
        summarise([cell("all-4", "c0", nan), cell("boxes", "c0", nan)])


def test_where_the_fixed_policies_find_nothing_there_is_no_share_of_them() -> None:
    rows = summarise([cell(p, "c0", ap) for p, ap in (("all-4", 0.0), ("adaptive", 0.1))])
    assert [r.of_oracle for r in rows] == [None, None]
    assert [r.gain[0] for r in rows] == [0.0, pytest.approx(0.1)]


def test_conditions_without_a_detector_are_refused_before_anything_flies(tmp_path: Path) -> None:
    path = tmp_path / "small.yaml"
    path.write_text(SMALL.replace("detector=surrogate", "detector=none"))
    conditions = load_conditions(path)
    assert conditions is not None
    told = r"condition poor: perception\.detector is none, conditions are compared by accuracy"
    with pytest.raises(RunError, match=told):
        fly_conditions(conditions, ["all-4"], progress=lambda policy, k: pytest.fail("flown"))


def test_conditions_name_those_in_which_drones_left_the_air_and_take_policies_with_parameters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A drone is lost half-way: of two drones' 2 s each, 3 s are flown."""
    path, out = tmp_path / "small.yaml", tmp_path / "out.json"
    event = "{kind: drone_lost, at_s: 1, drone: 1}"
    lost = f"{{name: lost, budget: 0.1, set: ['duration_s=2', 'fleet.drones=2', 'events=[{event}]']}}"
    path.write_text(f"{SMALL.partition('  - {name: rich')[0]}  - {lost}\n")
    policies = "silence,best-2(received_budget=0.3)"
    monkeypatch.setenv("COLUMNS", "200")
    assert command("compare", path, "--policies", policies, "--out", out) == 0
    printed = " ".join(capsys.readouterr().out.split())
    told = "not all drones flew all the time in lost (75.0 % of drone-seconds flown): AP is of those that fly"
    assert told in printed
    shares = {(c["policy"], c["condition"]): c["flown_share"] for c in json.loads(out.read_text())["cells"]}
    assert shares == pytest.approx({(p, c): s for p in policies.split(",") for c, s in (("poor", 1.0), ("lost", 0.75))})


def test_a_single_condition_has_no_interval(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where the figure stood twice, it looked certain."""
    path, out = tmp_path / "one.yaml", tmp_path / "out.json"
    path.write_text(SMALL.partition("  - {name: rich")[0])
    cells = [cell(policy, "poor", ap) for policy, ap in (("all-4", 0.25), ("boxes", 0.375))]
    monkeypatch.setattr(commands, "fly_conditions", lambda *_, **__: cells)
    monkeypatch.setenv("COLUMNS", "200")
    assert command("compare", path, "--policies", "all-4,boxes", "--out", out) == 0
    printed = capsys.readouterr().out
    assert "+12.5" in printed
    assert "[" not in printed
    kept = json.loads(out.read_text(), parse_constant=pytest.fail)
    assert [r["gain"] for r in kept["summary"]] == [[0.0, None, None], [0.125, None, None]]


def test_conditions_are_scored_by_torch_over_the_surrogates_traffic(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "small.yaml"
    path.write_text(SMALL)
    conditions = load_conditions(path)
    assert conditions is not None
    ours = fly_conditions(conditions, ["all-4", "boxes"])
    monkeypatch.setattr("sortie.perception.network.detector.TorchDetector", Seer)
    detectors._answers.cache_clear()
    theirs = fly_conditions(conditions, ["all-4", "boxes"], by_torch=True)
    assert [c.data_bytes for c in theirs] == [c.data_bytes for c in ours]
    assert all(c.ap > 0.9 for c in theirs)
    assert Seer.asked == 2 * 2 * 5 * 6  # policies, conditions, drones, moments
