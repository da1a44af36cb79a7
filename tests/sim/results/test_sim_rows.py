"""What stands between a record and its readers, by hand: slices of traffic, discs, sightings, rosters and views."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import record_by_hand as by_hand
import simpy
from policies_examples import fleet_of
from sim_examples import example

from sortie.policies.contract import Directive, Disc, FleetView, Representation, Roster
from sortie.policies.staleness import LinkHealth
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results import rosters
from sortie.sim.results.accuracy import score
from sortie.sim.results.box_rows import fusion_blocks, fusions_of
from sortie.sim.results.disagreement import measure
from sortie.sim.results.flown_scene import scene_of, vehicles
from sortie.sim.results.link_traffic import LinkTraffic
from sortie.sim.results.mission_outcome import _flown, _lately
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import AgentNotes, Recorder
from sortie.sim.results.regions import Regions
from sortie.sim.results.sightings import sightings
from sortie.sim.results.spool import InTime, in_blocks
from sortie.sim.results.views import Decision, Journal, decisions

# --- rows in blocks and slices -------------------------------------------------------------------


def test_blocks_hold_every_fusion_once_and_all_of_one_time_together(monkeypatch: pytest.MonkeyPatch) -> None:
    t_s = np.array([0.0, 0.0, 0.0, 1.0, 2.0, 2.0, 3.0, 3.0, 3.0, 3.0])
    for size in (1, 2, 3, 4, 20):
        monkeypatch.setattr("sortie.sim.results.box_rows.BLOCK_FUSIONS", size)
        blocks = list(fusion_blocks(t_s))
        assert [k for here, _ in blocks for k in range(len(t_s))[here]] == list(range(len(t_s)))
        firsts = [t_s[here][0] for here, _ in blocks]
        assert [until_s for _, until_s in blocks] == [*firsts[1:], math.inf]
        assert len(set(t_s.tolist())) == sum(len(set(t_s[here].tolist())) for here, _ in blocks)


def test_behind_the_last_fusion_blocks_without_one_go_on_to_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sortie.sim.results.box_rows.REST_S", 2.0)
    blocks = list(fusion_blocks(np.array([0.0, 1.0]), 6.0))
    assert blocks == [(slice(0, 2), 3.0), (slice(2, 2), 5.0), (slice(2, 2), math.inf)]
    assert list(fusion_blocks(np.zeros(0), 3.0)) == [(slice(0, 0), 2.0), (slice(0, 0), math.inf)]


def test_rows_belong_to_the_fusion_of_their_time_and_their_drone() -> None:
    rows = {"t_s": np.array([1.0, 1.0, 1.0, 2.0, 2.0, 3.0]), "drone": np.array([0, 1, 1, 1, 0, 0])}
    keys = [(1.0, 0), (1.0, 1), (2.0, 1), (3.0, 0)]
    assert fusions_of(keys, rows).tolist() == [0, 1, 1, 2, -1, 3]
    assert fusions_of(keys, {name: values[:0] for name, values in rows.items()}).tolist() == []


def test_a_table_comes_in_time_and_in_blocks_however_it_is_cut() -> None:
    values = [0.0, 1.0, 1.0, 2.0, 3.0, 3.0]
    for cuts in ([], [1], [2, 4], [3], [1, 2, 3, 4, 5]):
        parts = [values[a:b] for a, b in zip([0, *cuts], [*cuts, len(values)], strict=True)]
        chunks = pa.chunked_array([pa.array(part, pa.float64()) for part in parts])
        tables = {"x": pa.table({"t_s": chunks})}
        table = InTime(tables, "x")
        before = [table.before(t)["t_s"].to_pylist() for t in (0.0, 1.0, 1.5, 2.0, 3.0, math.inf)]
        assert before == [[], [0.0], [1.0, 1.0], [], [2.0], [3.0, 3.0]]
        blocks = [piece["t_s"].to_pylist() for piece in in_blocks(tables, "x", ["t_s"], 4)]
        assert blocks == [values[:4], values[4:]]


DESCRIBED = [(0.5, 0, 10.0), (1.0, 1, 20.0), (1.5, 0, 30.0), (3.0, 0, 40.0)]
"""When a drone of two published, and its goodput to the other."""
SENT = [(0.2, 0, 1, 1000), (0.6, 1, 0, 500), (0.9, 0, 1, 3000), (2.5, 0, 1, 700), (math.nan, 0, 1, 10**6)]
"""When a payload was settled, from whom to whom, bytes; the last one is still on its way."""


def _traffic_in(slices: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Goodput and traffic of frames at 2 Hz, told slice by slice."""
    taken = LinkTraffic(2, 2.0)
    out = []
    for begin_s, end_s in slices:
        t_s = np.array([t for t in np.arange(8) / 2 if begin_s <= t < end_s])
        d = [row for row in DESCRIBED if begin_s <= row[0] < end_s]
        s = [row for row in SENT if begin_s <= row[0] < end_s or (math.isnan(row[0]) and begin_s == 0.0)]
        descriptors = pa.table(
            {
                "t_s": pa.array([r[0] for r in d], pa.float64()),
                "drone": pa.array([r[1] for r in d], pa.int32()),
                "goodput_mbps": pa.array([[r[2]] for r in d], pa.list_(pa.float64())),
            }
        )
        names = ("t_done_s", "drone", "peer", "payload_bytes")
        sent = pa.table({n: pa.array([float(r[k]) for r in s], pa.float64()) for k, n in enumerate(names)})
        out.append(taken.add(t_s, descriptors, sent))
    goodput, recent = zip(*out, strict=True)
    return np.concatenate(goodput), np.concatenate(recent)


def test_a_link_carried_what_was_settled_in_the_second_before() -> None:
    """Frames each half second; also where a slice has no frame, what came in it counts."""
    for slices in (
        [(0, 4)],
        [(0, 1), (1, 2), (2, 3), (3, 4)],
        [(0, 2), (2, 4)],
        [(0, 0.75), (0.75, 0.95), (0.95, 4)],
    ):
        goodput, recent = _traffic_in(slices)
        assert goodput[:, 0, 1].tolist() == [0, 0, 10, 10, 30, 30, 30, 40]
        assert goodput[:, 1, 0].tolist() == [0, 0, 0, 20, 20, 20, 20, 20]
        kilobytes = recent / 8e-6 / 1e3
        assert kilobytes[:, 0, 1] == pytest.approx([0, 1, 4, 3, 0, 0, 0.7, 0.7])
        assert kilobytes[:, 1, 0] == pytest.approx([0, 0, 0.5, 0.5, 0, 0, 0, 0])
        assert not recent[:, [0, 1], [0, 1]].any()


def test_a_scene_is_made_of_all_the_ways_that_were_flown() -> None:
    """The record's states come in several batches."""
    tables = by_hand.tables_of(by_hand.rows())
    whole = by_hand.record(tables=tables)
    cut = pa.concat_tables([tables["states"].slice(0, 6), tables["states"].slice(6)])  # at the end all are far off
    assert scene_of(by_hand.record(tables=tables | {"states": cut})).rect == scene_of(whole).rect
    assert scene_of(whole).rect[2] - scene_of(whole).rect[0] > by_hand.FAR_M


def test_stations_are_no_vehicles_whether_they_have_cameras_or_not() -> None:
    station = "{drone: %d, position_m: [0, 0, 2], camera: %s}"
    fleet = example("fleet.drones=4", f"fleet.ground=[{station % (1, 'true')}, {station % (3, 'false')}]").fleet
    assert vehicles(fleet) == [0, 2]


# --- accuracy --------------------------------------------------------------------------------------


def test_a_fusion_at_the_begin_of_a_time_is_of_it_and_one_at_its_end_is_not() -> None:
    pool = score(by_hand.record(), [0]).pools[0, "full_scene"]
    assert pool.ap(0.5, 2.5) == pool.ap(0.0, 2.4)
    assert pool.ap(2.5, 3.5) == pool.ap(2.4, 3.4)
    assert pool.ap(3.5) == 1.0
    assert pool.ap(0.5, 2.5) != pool.ap(2.5, 3.5)
    late = score(by_hand.record(), [0], begin_s=2.5).pools[0, "full_scene"]
    assert list(late.by_fusion()) == [(2.5, 0), (2.5, 1), (3.5, 0)]


def test_people_about_a_drone_that_is_gone_are_no_cars_that_it_missed() -> None:
    tables = by_hand.tables_of(by_hand.rows())
    cars = score(by_hand.record(tables=tables), [0]).grounded
    assert dict(cars) == {"full_scene": 1, "mission": 1}
    truths = tables["truths"].append_column("kind", pa.array([0] * 6 + [2], pa.int8()))
    found = tables["detections"].append_column("kind", pa.array([0] * 4, pa.int8()))
    people = score(by_hand.record(tables=tables | {"truths": truths, "detections": found}), [0]).grounded
    assert dict(people) == {"full_scene": 0, "mission": 0}


def test_a_fleet_without_a_flying_drone_found_none_of_the_cars_there() -> None:
    """Nothing was scored, so that AP is nothing; with those that are gone counted as blind it is 0."""
    rows = by_hand.rows() | {"fusions": [], "detections": []}
    scored = score(by_hand.record(tables=by_hand.tables_of(rows)), [0])
    assert scored.ap(0) == {"full_scene": None, "mission": None}
    assert scored.grounded_blind() == {"full_scene": 0.0, "mission": 0.0}


def test_a_sighting_takes_its_own_boxes_and_its_own_cars() -> None:
    record = by_hand.record()
    regions = Regions(record.tables["mission"], record.scenario.mission)
    told = [(s.t_s, s.drone, len(s.hits), len(s.false), len(s.missed)) for s in sightings(record.tables, regions)]
    assert told == [(0.5, 0, 1, 1, 1), (2.5, 0, 1, 0, 1), (2.5, 1, 0, 0, 1), (3.5, 0, 1, 0, 0)]
    several = list(sightings(record.tables, regions))
    assert several[0].hits.score.tolist() == pytest.approx([0.9])
    assert several[0].false.xy_m.tolist() == [[60.0, 0.0]]
    assert several[1].missed.xy_m.tolist() == [[40.0, 0.0]]
    assert [s.mission is None for s in several] == [True, False, False, False]


def test_hits_are_told_from_false_boxes_whatever_the_order_of_scores() -> None:
    rows = by_hand.rows()
    rows["detections"][0]["score"], rows["detections"][1]["score"] = 0.2, 0.8  # the hit is the less sure one
    record = by_hand.record(tables=by_hand.tables_of(rows))
    first = next(sightings(record.tables, Regions(record.tables["mission"], record.scenario.mission)))
    assert (first.hits.xy_m.tolist(), first.false.xy_m.tolist()) == ([[0.0, 0.0]], [[60.0, 0.0]])


# --- rosters ---------------------------------------------------------------------------------------


def test_a_roster_is_the_latest_from_its_instant_on_and_kept_where_it_changes() -> None:
    log = rosters.RosterLog()
    one, other = Roster(1, (0, 1)), Roster(2, (0, 1, 2))
    for t_s, drone, roster in ((0.0, 0, one), (0.5, 1, one), (1.0, 0, one), (2.0, 0, other), (3.0, 0, other)):
        log.published(t_s, drone, roster)
    table = log.table()
    assert table["t_s"].to_pylist() == [0.0, 0.5, 2.0]
    at = rosters.of({rosters.TABLE: table})
    assert [at(0, t) for t in (-0.1, 0.0, 1.9, 2.0, 9.0)] == [None, one, one, other, other]
    assert [at(1, t) for t in (0.4, 0.5)] == [None, one]
    assert rosters.of({})(0, 1.0) is None


# --- what is written down and read back ------------------------------------------------------------


def test_a_directive_is_kept_as_it_is_enforced_beside_what_was_asked() -> None:
    recorder = Recorder()
    notes = AgentNotes(recorder, [SimpleNamespace(policy=SimpleNamespace(name=f"policy of {d}")) for d in range(3)])
    asked = Directive(2, 0, Representation.FEATURES, 0.5, None, 10.0, deadline_s=0.3, reason="asked")
    enforced = Directive(
        2, 1, Representation.DETECTIONS, 0.25, Disc(1.0, 2.0, 3.0), 4.0, deadline_s=0.2, fusion_weight=0.5
    )
    notes.directive(1.5, asked, enforced, LinkHealth.DEGRADED, "why")
    (row,) = recorder.finish()["directives"].to_pylist()
    kept = {"representation": "detections", "rho": 0.25, "rate_hz": 4.0, "deadline_s": 0.2, "fusion_weight": 0.5}
    disc = {"roi_x_m": 1.0, "roi_y_m": 2.0, "roi_radius_m": 3.0, "duty_percent": enforced.duty_percent}
    was = {"asked": "features", "asked_rate_hz": 10.0, "link": "degraded", "reason": "why", "policy": "policy of 2"}
    assert row == {"t_s": 1.5, "drone": 2, "peer": 1, **kept, **disc, **was}


def test_what_is_kept_beside_the_record_is_no_part_of_its_fingerprint() -> None:
    record = by_hand.record()
    more = replace(record, tables={**record.tables, "views": record.tables["energy"]}, wall={"wall_s": 9.0})
    assert more.fingerprint == record.fingerprint
    assert replace(record, totals={**record.totals, "decisions": 1}).fingerprint != record.fingerprint


def test_a_view_comes_back_with_each_drone_s_own_age_in_whatever_order_they_stood() -> None:
    journal = Journal(simpy.Environment())
    view = fleet_of(3)._replace(age_s={2: 0.3, 0: 0.1, 1: 0.2}, detached_after_periods=7.0)
    journal.decided(0, "p", view, [], None)
    (decision,) = decisions(journal.tables())
    assert dict(decision.view.age_s) == {0: 0.1, 1: 0.2, 2: 0.3}
    assert decision.view.detached_after_periods == 7.0


def test_an_episode_in_which_one_would_once_not_send_is_one_about_sending() -> None:
    """In the first frame they differ about whether drone 0 sends at all, then about how often."""

    def policy(view: FleetView) -> list[Directive]:
        assert view.me is not None
        soc = view.me.battery_soc
        rung = Representation.NONE if soc < 0.3 else Representation.DETECTIONS
        return [Directive(view.ego, p, rung, rate_hz=10.0 if soc > 0.6 else 2.0) for p in view.peers]

    def seen(drone: int, soc: float) -> FleetView:
        view = fleet_of(2)
        known = {i: d._replace(battery_soc=soc) if i == 0 else d for i, d in view.descriptors.items()}
        return view._replace(ego=drone, descriptors=known)

    told = [
        Decision(0.1 * frame, drone, "p", seen(drone, 0.9 if drone == 0 else soc), ())
        for frame, soc in enumerate((0.2, 0.5, 0.9))
        for drone in (0, 1)
    ]
    (pair,) = measure(told, lambda decision: policy, 0.1)
    (episode,) = pair.episodes
    assert (episode.source, episode.destination, episode.begin_s, episode.sends) == (0, 1, 0.0, True)
    assert episode.duration_s == pytest.approx(0.2)


def test_a_look_counts_for_its_frames_and_the_last_frame_does_as_the_one_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Looks before each of five frames: drone 0 looks in each, 1 in the first, 2 in the one before the last."""
    looks = np.array([[0, 0, 0], [1, 1, 0], [2, 1, 0], [3, 1, 0], [4, 1, 1]], np.int32)

    def looked(frames: int) -> Any:
        t_s, airborne = np.repeat(np.arange(frames) / 10, 3), [True] * 3 * frames
        states = pa.table({"t_s": t_s, "airborne": airborne, "looks": looks[:frames].ravel()})
        return _flown({"states": states}, 3)[2]

    for block in (1, 2, 3, 9):
        monkeypatch.setattr("sortie.sim.results.mission_outcome.BLOCK_FRAMES", block)
        first, last = [True] + [False] * 4, [False] * 3 + [True] * 2
        assert _lately(looked(5), 1).T.tolist() == [[True] * 5, first, last]
        assert _lately(looked(5), 2).T.tolist() == [[True] * 5, [True] * 2 + [False] * 3, last]
        assert _lately(looked(1), 3).tolist() == [[True] * 3]


def test_accuracy_is_sampled_no_oftener_than_frames_come_and_fused_as_the_detector_that_flew() -> None:
    record = by_hand.record()

    def ap(flown: str = "surrogate", **changes: Any) -> dict[str, Any]:
        perception = record.scenario.perception.model_copy(update=changes)
        scenario = record.scenario.model_copy(update={"perception": perception})
        return outcome(replace(record, scenario=scenario, detector=flown))["ap50"]  # type: ignore[no-any-return]

    assert ap()["sample_rate_hz"] == 1.0
    assert ap()["fusion"] == record.scenario.perception.fusion
    assert ap("another")["fusion"] is None
    assert ap("mine.py:Finds", detector="mine.py:Finds")["fusion"] is None
    assert ap(recorded_fusion="late")["fusion"] == "late"
    often = record.scenario.context.model_copy(update={"rate_hz": 0.5})
    slow = replace(record, scenario=record.scenario.model_copy(update={"context": often}))
    assert outcome(slow)["ap50"]["sample_rate_hz"] == 0.5


def test_a_phase_that_the_end_cuts_short_ends_with_the_sortie() -> None:
    """The plan begins its second phase at 1.5 s and its third one at 10 s."""
    phases = "mission.phases=[{at_s: 0, phase: search}, {at_s: 1.5, phase: track}, {at_s: 10, phase: search}]"
    for duration_s, ends_s in ((1.0, [1.0]), (2.0, [1.5, 2.0])):
        record = run_sortie(example(f"duration_s={duration_s}", phases, "fleet.drones=2"))
        flown = outcome(record)["phases"]
        assert [phase["end_s"] for phase in flown] == ends_s
        begin_s = flown[-1]["begin_s"]
        rows = record.tables["transmissions"].select(["captured_s", "payload_bytes"]).to_pylist()
        sent_bytes = sum(row["payload_bytes"] for row in rows if row["captured_s"] >= begin_s)
        assert flown[-1]["data_rate_mbps"] == pytest.approx(sent_bytes * 8e-6 / (duration_s - begin_s))
        assert sent_bytes > 0
