"""Drones of a large fleet take turns at being scored: who, when, and that the estimate is of the whole fleet."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from sim_examples import example

from sortie.perception.metrics.ap import average_precision
from sortie.sim.engine.needs import needs
from sortie.sim.engine.scoring import taking_turns
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results import run_folder
from sortie.sim.results.accuracy import both_matched
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.run_files import SCENARIO
from sortie.sim.results.sentences import turns_in_words
from sortie.sim.results.summary import outcome_table
from sortie.sim.studies.compare import Contender, compare
from sortie.sim.studies.comparison_text import comparison_markdown, heading

FLEET = ("fleet.drones=12", "perception.detector=surrogate", "fleet.formation={shape: grid, spacing_m: 40}")
FIVE = "perception.egos=5"
BOXES = ("detections", "truths", "fusions")


@pytest.fixture(scope="module")
def whole() -> SortieRecord:
    return run_sortie(example(*FLEET, "perception.egos=12"))


@pytest.fixture(scope="module")
def some() -> SortieRecord:
    return run_sortie(example(*FLEET, FIVE))


def test_every_drone_is_scored_equally_often_and_each_moment_has_so_many() -> None:
    scenario = example(*FLEET, FIVE, "duration_s=40")
    turns = list(taking_turns(scenario, 1, 0))
    assert len(turns) == len(scenario.scored_frames) == 80
    assert all(len(set(drones)) == 5 and drones == sorted(drones) for drones in turns)
    counts = Counter(drone for drones in turns for drone in drones)
    assert set(counts) == set(range(12))
    assert max(counts.values()) - min(counts.values()) <= 1
    assert turns == list(taking_turns(scenario, 1, 0))
    assert turns != list(taking_turns(scenario, 2, 0))
    assert turns != list(taking_turns(scenario, 1, 1))


def test_each_drone_has_the_same_chance_at_every_moment() -> None:
    scenario = example(*FLEET, FIVE, "duration_s=2")
    first = [next(iter(taking_turns(scenario, seed, 0))) for seed in range(3000)]
    share = np.bincount(np.concatenate(first), minlength=12) / 3000
    assert share == pytest.approx(np.full(12, 5 / 12), abs=5 * np.sqrt(5 / 12 * 7 / 12 / 3000))


@pytest.mark.parametrize(
    ("sets", "scored"),
    [
        (("fleet.drones=50",), 50),
        (("fleet.drones=51",), 50),
        (("fleet.drones=51", "perception.egos=51"), 51),
        (("fleet.drones=51", "perception.motion_compensation=false"), 51),
        (("fleet.drones=4", "perception.egos=3", "fleet.ground=[{drone: 1, position_m: [0, 20, 3]}]"), 3),
    ],
)
def test_who_may_be_scored(sets: tuple[str, ...], scored: int) -> None:
    scenario = example("perception.detector=surrogate", *sets, "duration_s=1")
    drones = next(iter(taking_turns(scenario, 1, 0)))
    assert len(drones) == scenario.scored_drones == scored
    assert set(drones) <= set(scenario.scorable_drones)
    assert scenario.takes_turns == (scored < len(scenario.scorable_drones))
    if scenario.fleet.ground:
        assert drones == [0, 2, 3], "the station is not scored"


def test_a_drone_that_is_scored_has_the_boxes_that_it_has_where_all_are(
    whole: SortieRecord, some: SortieRecord
) -> None:
    """And nothing that flies differs."""
    turns = taking_turns(some.scenario, 1, 0)
    fusions = some.tables["fusions"]
    moments = sorted(set(fusions["t_s"].to_pylist()))
    assert [sorted(d for t, d in keys(fusions) if t == moment) for moment in moments] == list(turns)
    for name, table in whole.tables.items():
        if name in BOXES:
            kept = pa.array([key in set(keys(fusions)) for key in keys(table)])
            table = table.filter(kept)
        assert str(table.to_pylist()) == str(some.tables[name].to_pylist()), name  # also where both are NaN


def keys(table: pa.Table) -> list[tuple[float, int]]:
    return list(zip(table["t_s"].to_pylist(), table["drone"].to_pylist(), strict=True))


@pytest.mark.parametrize(("scope", "least"), [("full_scene", 0.5), ("mission", 0.9)])
def test_the_mean_over_many_draws_is_the_fleets_and_turns_are_more_precise_than_drones_drawn_once(
    whole: SortieRecord, scope: str, least: float
) -> None:
    fusions = both_matched(whole)[scope]
    fleet = average_precision(list(fusions.values()))
    moments = sorted({t for t, _ in keys(whole.tables["fusions"])})
    scenario = example(*FLEET, FIVE)

    def ap_of(turns: list[list[int]]) -> float:
        scored = [(t, drone) for t, drones in zip(moments, turns, strict=True) for drone in drones]
        return average_precision([fusions[key] for key in scored if key in fusions])

    turns = [list(taking_turns(scenario, seed, 0)) for seed in range(400)]
    by_turns = np.array([ap_of(each) for each in turns])
    once = np.array([ap_of([each[0]] * len(moments)) for each in turns])
    assert by_turns.mean() == pytest.approx(fleet, abs=4 * by_turns.std() / 20 + 0.002)
    assert by_turns.std() < least * once.std()


def test_what_needs_all_boxes_is_null_and_the_outcome_says_who_was_scored(
    whole: SortieRecord, some: SortieRecord
) -> None:
    everyone, turns = outcome(whole), outcome(some)
    assert [(o["ap50"]["scored_drones"], o["ap50"]["scorable_drones"]) for o in (everyone, turns)] == [
        (12, 12),
        (5, 12),
    ]
    assert everyone["ap50"]["scored_fusions"] * 5 == turns["ap50"]["scored_fusions"] * 12
    assert None not in everyone["tracking"].values()
    assert set(turns["tracking"].values()) == {None}
    for name in ("target_detected_share", "target_longest_undetected_s"):
        assert everyone["mission"][name] is not None
        assert turns["mission"][name] is None
    assert turns["mission"]["target_in_view_share"] == everyone["mission"]["target_in_view_share"]
    traffic = outcome(run_sortie(example("fleet.drones=60", "duration_s=0.2")))["ap50"]
    assert (traffic["scored_drones"], traffic["scorable_drones"]) == (0, 60)
    assert turns_in_words(traffic) == turns_in_words(everyone["ap50"]) == ""
    assert turns_in_words(turns["ap50"]) == ", 5 of 12 drones scored at a time"
    (accuracy,) = [c for c in outcome_table(turns).columns[1].cells if "full scene" in str(c) and "fusions" in str(c)]
    assert f"{turns['ap50']['scored_fusions']} fusions, 5 of 12 drones scored at a time; the surrogate" in str(accuracy)


def test_policies_are_compared_on_the_same_drones_at_the_same_moments() -> None:
    scenario = example(*FLEET, FIVE, "duration_s=2")
    others = [
        scenario.model_copy(update={"policy": scenario.policy.model_copy(update={"name": n, "params": {}})})
        for n in ("silence", "boxes")
    ]
    flown = compare([Contender(s.policy.name, s) for s in others], [1])
    records = [s.record for s in flown.sorties]
    assert all(record is not None for record in records)
    assert len({tuple(keys(record.tables["fusions"])) for record in records if record}) == 1
    assert heading(flown).endswith("in this town, this flight, 5 of 12 drones scored at a time")
    assert "accuracy scored at 2 Hz by `surrogate`, 5 of 12 drones scored at a time." in comparison_markdown(flown, "x")


def test_fewer_boxes_need_less_memory() -> None:
    fleet = ("fleet.drones=200", "perception.detector=surrogate", "duration_s=60")
    every, some = (needs(example(*fleet, f"perception.egos={n}")).memory for n in (200, 50))
    assert every - some > 50e6


def test_a_run_of_a_version_without_turns_keeps_what_it_found(tmp_path: Path) -> None:
    sets = ("fleet.drones=51", "duration_s=0.6", "perception.detector=surrogate", "fleet.formation={shape: grid, spacing_m: 40}")  # fmt: skip
    record = run_sortie(example(*sets, "perception.egos=51", "mission.phases=[{at_s: 0, phase: search}]"))
    run_folder.save(record, tmp_path / "run")
    file = tmp_path / "run" / SCENARIO
    file.write_text(file.read_text().replace("  egos: 51\n", ""))
    again = run_folder.load(tmp_path / "run")
    assert again.scenario == record.scenario
    assert outcome(again)["ap50"] == outcome(record)["ap50"]
