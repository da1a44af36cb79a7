"""Drones of a large fleet take turns at being scored: who, when, and that the estimate is of the whole fleet."""

from __future__ import annotations

import functools
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow as pa
from recorded import recorded
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

FLEET = ("fleet.drones=12", "perception.detector=surrogate", "fleet.formation={shape: grid, spacing_m: 40}")
FIVE = "perception.egos=5"
BOXES = ("detections", "truths", "fusions")


@functools.cache
def flown(egos: int) -> SortieRecord:
    """A flight of its own: all of a fleet, and some of it."""
    return run_sortie(example(*FLEET, "duration_s=5", f"perception.egos={egos}"))


def keys(table: pa.Table) -> list[tuple[float, int]]:
    return list(zip(table["t_s"].to_pylist(), table["drone"].to_pylist(), strict=True))


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
    first = [next(iter(taking_turns(scenario, seed, 0))) for seed in range(1000)]
    share = np.bincount(np.concatenate(first), minlength=12) / 1000
    assert np.abs(share - 5 / 12).max() < 5 * np.sqrt(5 / 12 * 7 / 12 / 1000), "the same chance at every moment"


def test_who_may_be_scored() -> None:
    for sets, scored in (
        (("fleet.drones=50",), 50),
        (("fleet.drones=51",), 50),
        (("fleet.drones=51", "perception.egos=51"), 51),
        (("fleet.drones=51", "perception.motion_compensation=false"), 51),
        (("fleet.drones=4", "perception.egos=3", "fleet.ground=[{drone: 1, position_m: [0, 20, 3]}]"), 3),
    ):
        scenario = example("perception.detector=surrogate", *sets, "duration_s=1")
        drones = next(iter(taking_turns(scenario, 1, 0)))
        assert len(drones) == scenario.scored_drones == scored
        assert set(drones) <= set(scenario.scorable_drones)
        assert scenario.takes_turns == (scored < len(scenario.scorable_drones))
        if scenario.fleet.ground:
            assert drones == [0, 2, 3], "the station is not scored"


def test_a_drone_that_is_scored_has_the_boxes_that_it_has_where_all_are() -> None:
    """And nothing that flies differs."""
    whole, some = flown(12), flown(5)
    fusions = some.tables["fusions"]
    moments = sorted(set(fusions["t_s"].to_pylist()))
    turns = [sorted(d for t, d in keys(fusions) if t == moment) for moment in moments]
    assert turns == list(taking_turns(some.scenario, 1, 0))
    scored = set(keys(fusions))
    for name, table in whole.tables.items():
        kept = table.filter(pa.array([key in scored for key in keys(table)])) if name in BOXES else table
        assert str(kept.to_pylist()) == str(some.tables[name].to_pylist()), name  # also where both are NaN


def test_the_mean_over_many_draws_is_the_fleets_and_turns_are_more_precise_than_drones_drawn_once() -> None:
    whole, scenario = flown(12), flown(5).scenario
    moments = sorted({t for t, _ in keys(whole.tables["fusions"])})
    turns = [list(taking_turns(scenario, seed, 0)) for seed in range(400)]
    for scope, least in (("full_scene", 0.6), ("mission", 0.95)):
        fusions = both_matched(whole)[scope]  # type: ignore[literal-required]

        def ap_of(drawn: list[list[int]], fusions: dict = fusions) -> float:  # type: ignore[type-arg]
            scored = [(t, drone) for t, drones in zip(moments, drawn, strict=True) for drone in drones]
            return average_precision([fusions[key] for key in scored if key in fusions])

        by_turns = np.array([ap_of(each) for each in turns])
        once = np.array([ap_of([each[0]] * len(moments)) for each in turns])
        fleet = average_precision(list(fusions.values()))
        assert abs(by_turns.mean() - fleet) < 4 * by_turns.std() / 20 + 0.002
        assert by_turns.std() < least * once.std()


def test_what_needs_all_boxes_is_null_and_the_outcome_has_who_was_scored() -> None:
    everyone, turns, traffic = (outcome(record) for record in (flown(12), flown(5), recorded("base")))
    drones = [(o["ap50"]["scored_drones"], o["ap50"]["scorable_drones"]) for o in (everyone, turns, traffic)]
    assert drones == [(12, 12), (5, 12), (0, 5)]
    assert everyone["ap50"]["scored_fusions"] * 5 == turns["ap50"]["scored_fusions"] * 12
    assert None not in everyone["tracking"].values()
    assert set(turns["tracking"].values()) == {None}
    for name in ("target_detected_share", "target_longest_undetected_s"):
        assert everyone["mission"][name] is not None
        assert turns["mission"][name] is None
    assert turns["mission"]["target_in_view_share"] == everyone["mission"]["target_in_view_share"]
    words = ", 5 of 12 drones scored at a time"
    assert [turns_in_words(o["ap50"]) for o in (everyone, turns, traffic)] == ["", words, ""]
    cells = [str(c) for c in outcome_table(turns).columns[1].cells]
    assert any(f"{turns['ap50']['scored_fusions']} fusions{words}; the surrogate" in cell for cell in cells)


def test_fewer_boxes_need_less_memory() -> None:
    fleet = ("fleet.drones=200", "perception.detector=surrogate", "duration_s=60")
    every, some = (needs(example(*fleet, f"perception.egos={n}")).memory for n in (200, 50))
    assert every - some > 50e6


def test_a_run_of_a_version_without_turns_keeps_what_it_found(tmp_path: Path) -> None:
    """A short flight of its own, of a fleet in which nobody takes turns by that setting alone."""
    sets = ("fleet.drones=51", "perception.egos=51", "duration_s=0.3", "mission.phases=[{}]", *FLEET[1:])
    record = run_sortie(example(*sets), "silence")
    run_folder.save(record, tmp_path / "run")
    file = tmp_path / "run" / SCENARIO
    file.write_text(file.read_text().replace("  egos: 51\n", ""))
    again = run_folder.load(tmp_path / "run")
    assert again.scenario == record.scenario
    assert outcome(again)["ap50"] == outcome(record)["ap50"]
