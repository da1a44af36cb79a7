"""People, thermal cameras, and the paper's property: never drop detection sharing while a human is in the region."""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import recorded
from sim_examples import example

from sortie.fleet.gate import HEADER_BYTES
from sortie.fleet.messages.wire import DIRECTIVE_BYTES
from sortie.perception.classes import PERSON
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.thermal import people_boxes
from sortie.perception.types import Boxes, Capture, Share
from sortie.policies.contract import Directive, Disc, FleetView, Policy, Representation
from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.proof.proof import prove
from sortie.scenarios.reading.load import load
from sortie.sim.engine import people as engine_people
from sortie.sim.engine.people import KEPT_S, People
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import Recorder, SortieRecord

PROPERTY = "when human_in_region and peers >= 1: any_link(representation >= detections and rate_hz >= 2)"
TIRED = """
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import nothing

def tired(view):
    '''The worked policy, but silent below 24.9 % charge.'''
    if view.me.battery_soc < 0.249:
        return [nothing(view.ego, p, "saves energy") for p in view.peers]
    return worked(view)
"""


def crossing(*overrides: str, policy: str | None = None) -> SortieRecord:
    """A flight of its own: the recorded one has the shield, its cameras and its seed."""
    sets = ["perception.detector=none", "expect=[]", "duration_s=14", *overrides]
    return run_sortie(load("person_crossing", sets), policy)


# --- the property --------------------------------------------------------------------------------


def test_the_property_is_kept_with_the_shield_and_breaks_without() -> None:
    kept = outcome(crossing())["policies"]
    assert (kept["invariant_violations"], kept["shield_interventions"] >= 1) == (0, True)
    bare = outcome(crossing("policy.shield=false"))["policies"]
    assert bare["violations_by_cause"] == {"policy": 0, "staleness": 0, "damping": 1, "no_peer": 0}


def test_a_planted_policy_breaks_the_property_and_its_proof(tmp_path: Path) -> None:
    path = tmp_path / "tired.py"
    path.write_text(TIRED)
    result = outcome(crossing("policy.shield=false", policy=f"{path}:tired"))
    assert result["policies"]["violations_by_cause"]["policy"] >= 3, "every drone"
    assert f"{PROPERTY}: broken by policy" in [e["text"] for e in result["events"] if e["kind"] == "violation"]
    shielded = outcome(crossing(policy=f"{path}:tired"))["policies"]
    assert shielded["invariant_violations"] == 0, "the shield keeps it over any policy"
    for policy, wanted in (("worked", "proved"), (f"{path}:tired", "refuted")):
        verdicts = prove(resolve(policy), parse(PROPERTY), max_drones=2, views=50)
        assert [v.outcome for v in verdicts if v.name == PROPERTY] == [wanted]


def test_what_drones_know_comes_from_their_cameras_alone() -> None:
    """Without cameras nobody knows of the person. What is unknown is counted again, one frame after the other."""
    kept = recorded("person")
    there = outcome(kept)["people"]
    blind = crossing("perception.thermal=null", "duration_s=12")
    assert blind.tables["alerts"].num_rows == blind.tables["sightings"].num_rows == 0
    unseen = outcome(blind)["people"]
    assert unseen["in_region_drone_s"] == there["in_region_drone_s"] > 10
    assert (unseen["unknown_share"], unseen["ap_2m"]) == (1.0, None)
    flags = {(r["drone"], bool(r["novelty_flags"] & 4)) for r in kept.tables["descriptors"].to_pylist()}
    assert {(d, True) for d in range(3)} <= flags
    people = np.array([(r["t_s"], r["x_m"], r["y_m"]) for r in kept.tables["people"].to_pylist()])
    inside = people[np.hypot(people[:, 1] - 13, people[:, 2]) <= 10, 0]
    unknown = 0
    for drone in range(3):
        changes = [(r["t_s"], r["known"]) for r in kept.tables["alerts"].to_pylist() if r["drone"] == drone]
        for t_s in inside:
            known = [k for at, k in changes if at <= t_s + 0.09]
            unknown += not (known and known[-1])
    assert there["unknown_share"] == pytest.approx(unknown / (3 * len(inside)))
    assert 0 < unknown < 0.2 * 3 * len(inside)


def test_a_drone_whose_camera_sees_nobody_hears_it_from_its_peers() -> None:
    """Two of the drones are too far from the region for their cameras; they know a frame or two after the third."""
    apart = crossing("fleet.formation={shape: line, spacing_m: 100, altitude_m: 60}", "events=[]", "duration_s=10")
    (seer,) = {r["drone"] for r in apart.tables["sightings"].to_pylist()}
    alerts = {r["drone"]: r["t_s"] for r in reversed(apart.tables["alerts"].to_pylist()) if r["known"]}
    assert set(alerts) == {0, 1, 2}
    assert all(0 < alerts[drone] - alerts[seer] < 0.3 for drone in {0, 1, 2} - {seer})


def test_draws_do_not_depend_on_what_is_sent_and_a_blocked_camera_finds_nobody() -> None:
    kept = recorded("person").tables["sightings"]
    silent = crossing("policy.shield=false", "duration_s=12", policy="silence")
    assert silent.tables["sightings"].equals(kept)
    alarms = "perception.thermal={false_alarms_per_min: 600}"
    events = "events=[{kind: camera_blocked, at_s: 1, until_s: 2, drone: 1}]"
    record = run_sortie(example("duration_s=3", "fleet.drones=2", alarms, events), "silence")
    second = {drone: set() for drone in (0, 1)}
    for row in record.tables["sightings"].to_pylist():
        second[row["drone"]].add(int(row["t_s"] + 1e-6))
    assert second == {0: {0, 1, 2}, 1: {0, 2}}
    assert set(outcome(recorded("base"))["people"].values()) == {None}, "without people nothing changes"


# --- people in payloads --------------------------------------------------------------------------


@functools.cache
def shared(policy: Any, *overrides: str) -> SortieRecord:
    """A flight of its own, with places that are true, so that what is missed was not seen."""
    sure = "perception.thermal={position_error_m: 0.1, false_alarms_per_min: 0}"
    sets = ["events=[]", "policy.shield=false", "expect=[]", "duration_s=16", "fleet.formation.spacing_m=45", sure]
    return run_sortie(load("person_crossing", [*sets, *overrides]), policy)


@functools.cache
def sends(rung: Representation, weight: float = 1.0) -> Policy:
    rho = 0.05 if rung is Representation.FEATURES else 0.0

    def decide(view: FleetView) -> list[Directive]:
        return [Directive(view.ego, p, rung, rho, None, 10.0, fusion_weight=weight, reason="all") for p in view.peers]

    return decide


def located(record: SortieRecord) -> tuple[float, float]:
    people = outcome(record)["people"]
    return people["located_share"], people["located_alone_share"]


def test_a_person_whom_one_drone_sees_reaches_another_with_its_boxes_or_tracks_and_not_with_maps() -> None:
    """A payload has twelve tracks, mostly cars, so fewer people come with tracks than with boxes."""
    silent, boxes, tracks, maps = (
        shared(policy)
        for policy in ("silence", *(sends(Representation[r]) for r in ("DETECTIONS", "TRACKS", "FEATURES")))
    )
    alone = located(silent)[0]
    assert located(silent)[1] == located(boxes)[1] == pytest.approx(alone), "a drone's own camera is the same"
    assert alone < 0.7
    assert located(boxes)[0] > alone + 0.2
    assert alone < located(tracks)[0] < located(boxes)[0]
    assert located(maps) == located(silent)
    ap, before = (outcome(r)["ap_by_class"]["person"]["full_scene"] for r in (boxes, silent))
    assert ap > before + 0.2
    assert outcome(tracks)["tracking"]["hota"] is not None


def test_detections_are_counted_to_the_byte() -> None:
    boxes = shared(sends(Representation.DETECTIONS)).tables
    sent = boxes["transmissions"].to_pylist()
    assert {r["payload_bytes"] - 25 * r["boxes"] for r in sent} == {HEADER_BYTES + DIRECTIVE_BYTES}
    found = {(r["drone"], round(10 * r["t_s"])) for r in boxes["sightings"].to_pylist()}
    plain = shared(sends(Representation.DETECTIONS), "perception.thermal=null").tables["transmissions"].to_pylist()
    assert {r["payload_bytes"] - 24 * r["boxes"] for r in plain} == {HEADER_BYTES + DIRECTIVE_BYTES}
    more = {(r["drone"], r["peer"], r["captured_s"]): r["boxes"] for r in sent}
    both = [r for r in plain if (r["drone"], r["peer"], r["captured_s"]) in more]
    extra = [more[r["drone"], r["peer"], r["captured_s"]] - r["boxes"] for r in both]
    seen = [int((r["drone"], round(10 * r["captured_s"])) in found) for r in both]
    assert extra == seen, "one box more in every frame in which the camera found the person"
    assert sum(seen) > 0


def test_people_are_looked_for_where_they_are_at_the_scoring() -> None:
    """A flight of its own: she runs, a fusion comes 0.8 s after its frame, and a lost drone is to find her too."""
    runs = "perception.people=[{waypoints_m: [[-30, 5], [60, 5]], speed_mps: 10}]"
    seeing = ("perception.detector=surrogate", "perception.fusion_delay_s=0.8", "perception.thermal={}", runs)
    lost = "events=[{kind: drone_lost, at_s: 0.9, drone: 2}]"
    record = run_sortie(example("duration_s=3", "fleet.drones=3", *seeing, lost), "silence")
    rows = [r for r in record.tables["truths"].to_pylist() if r["kind"] == PERSON]
    assert {r["drone"] for r in rows if r["t_s"] > 2.0} == {0, 1, 2}
    for r in rows:
        assert (r["x_m"], r["y_m"]) == pytest.approx((-30.0 + 10.0 * r["t_s"], 5.0), abs=1e-3)


# --- one camera, by hand -------------------------------------------------------------------------


def people_of(*sets: str) -> People:
    scenario = load("person_crossing", ["expect=[]", *sets])
    scene = SceneModel(scenario.perception.scene, None, (0.0, 0.0, 20.0, 0.0), people=scenario.perception.people)
    return People(scenario, scene, Recorder(classes=True), (1, 0))


SURE = "perception.thermal={near_probability: 1, half_range_m: 2000, false_alarms_per_min: 0, remembers_s: 1.0}"
BLIND = "perception.thermal={near_probability: 0, false_alarms_per_min: 0}"


def at(drone: int, t_s: float, x_m: float = 13.0) -> Capture:
    """Level at 60 m; without a place above the street, where the person crosses it."""
    return Capture(drone, t_s, (x_m, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (x_m, 0.0, 60.0), 0.0)


def test_what_a_camera_found_is_of_its_own_moment() -> None:
    people = people_of(SURE)
    for frame in (128, 130):
        people.look(at(0, frame / 10), frame)
    assert len(people.found(at(0, 13.0))) == len(people.found(at(0, 12.8))) == 1
    for drone, other_s in ((0, 12.7), (0, 12.9), (0, 13.1), (1, 13.0)):
        assert len(people.found(at(drone, other_s))) == 0
    ((box,),) = people.found(at(0, 13.0)).xy_m[None].tolist()
    assert len(people.joined(Boxes.empty(), at(0, 13.0))) == 1
    assert math.hypot(box[0] - 13.0, box[1]) < 30.0
    assert people.truth(13.0, at(0, 13.0)).car.tolist() == [0]


def test_a_person_in_a_region_is_known_from_the_own_delay_on_for_as_long_as_the_camera_s_memory() -> None:
    people = people_of(SURE, "fleet.makes=[{name: slow, drones: [1], compute_delay_s: 0.5}]")
    for drone, delay_s in ((0, 0.03), (1, 0.5)):
        people.look(at(drone, 13.0), 130)
        x_m, y_m = people.found(at(drone, 13.0)).xy_m[0].tolist()
        assert not people.known_in(drone, Disc(x_m, y_m, 1.0), 13.0 + delay_s - 0.01)
        assert people.known_in(drone, Disc(x_m, y_m, 1.0), 13.0 + delay_s)
        assert len(people.known(at(drone, 13.0), [], 13.0 + delay_s - 0.01)) == 0
        assert len(people.known(at(drone, 13.0), [], 13.0 + delay_s)) == 1
    x_m, y_m = people.found(at(0, 13.0)).xy_m[0].tolist()
    assert people.known_in(0, Disc(x_m + 5.0, y_m, 5.001), 13.5)
    assert not people.known_in(0, Disc(x_m + 5.0, y_m, 4.9), 13.5)
    assert not people.known_in(0, None, 13.5)
    assert not people.known_in(2, Disc(x_m, y_m, 1.0), 13.5)
    for t_s, frame, known in ((13.9, 139, True), (14.1, 141, False)):
        people.look(at(0, t_s, 5000.0), frame)
        assert people.known_in(0, Disc(x_m, y_m, 1.0), t_s + 0.1) is known
    people.look(at(0, 13.0 + KEPT_S, 5000.0), 180)
    assert len(people.found(at(0, 13.0))) == 1, "kept for trackers that make up for looks"


def test_trucks_stand_before_people_where_the_scene_has_any(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the moment at which the camera looks."""
    given: list[Any] = []
    monkeypatch.setattr(engine_people, "look", lambda *args: given.append(args[-1]) or [])
    for trucks in (0.0, 0.5):
        people_of(f"perception.scene.trucks={trucks}").look(at(0, 7.0, 0.0), 70)
    without, there = given
    assert without is None
    scenario = load("person_crossing", ["expect=[]", "perception.scene.trucks=0.5"])
    scene = SceneModel(scenario.perception.scene, None, (0.0, 0.0, 20.0, 0.0), people=scenario.perception.people)
    wanted = scene.trucks(7.0)
    assert len(wanted) > 0
    np.testing.assert_array_equal(there.x_m, wanted.x_m)
    assert not np.array_equal(there.x_m, scene.trucks(0.0).x_m)


# --- joining, by hand ----------------------------------------------------------------------------


def found_nobody(*overrides: str) -> tuple[People, Capture]:
    """A drone over (0, 0), whose camera has looked and found nobody, and its capture."""
    people, here = people_of(BLIND, *overrides), at(0, 1.0, 0.0)
    people.look(here, 10)
    return people, here


def received(at_m: tuple[float, float], score: float = 0.9, drone_m: float = 30.0, **changes: Any) -> Share:
    boxes = people_boxes(np.array([at_m]), np.array([score]))
    return Share(at(1, 1.0, drone_m), "detections", 0.0, None, 1.0, people=boxes)._replace(**changes)


def test_a_received_person_counts_by_weight_and_age() -> None:
    people, here = found_nobody()

    def score(**changes: Any) -> float:
        known = people.known(here, [received((60.0, 0.0), **changes)], 1.1)
        assert known.kind.tolist() == [PERSON]
        return float(known.score[0])

    assert score() == score(representation="uncertain_boxes") == pytest.approx(0.9)
    assert score(weight=0.5) == pytest.approx(0.45)
    reach = [1.0 - np.exp(-4.0 / (2.0 * (1.0 + (1.4 * age) ** 2))) for age in (0.5, 0.0)]
    assert score(age_s=0.5) == pytest.approx(0.9 * (0.1 + 0.9 * reach[0] / reach[1]), rel=1e-5)
    assert len(people.known(here, [received((60.0, 0.0), weight=0.0)], 1.1)) == 0
    assert len(people.known(here, [received((110.0, 0.0), drone_m=80.0)], 1.1)) == 0, "outside the ego's square"


def test_only_cameras_that_could_see_a_place_vote_a_person_down() -> None:
    """A cone of 70° reaches 42 m at 60 m. The mean's score is over all whose cone holds the place."""
    people, here = found_nobody("perception.join=average")
    silent = received((0.0, 0.0), people=people_boxes(np.zeros((0, 2)), np.zeros(0)))
    aside = silent._replace(roi=Disc(10.0, 0.0, 5.0))
    beyond = silent._replace(roi=Disc(90.0, 0.0, 62.0))  # overlaps the cone: where it does is no disc
    for shares, score in (
        ([received((60.0, 0.0))], 0.9),
        ([received((30.0, 0.0))], 0.45),  # the drone's own camera looked there and found nobody
        ([received((30.0, 0.0)), silent], 0.3),
        ([received((30.0, 0.0)), aside], 0.45),
        ([received((30.0, 0.0)), beyond], 0.45),
    ):
        assert people.known(here, shares, 1.03).score[0] == pytest.approx(score, rel=1e-3)


def test_a_blocked_thermal_camera_finds_nobody_and_votes_nobody_down() -> None:
    """From the moment at which its covered frame would be known; what it found before stands until then."""
    people, here = found_nobody("perception.join=average")
    share = [received((30.0, 0.0))]
    people.look(here._replace(t_s=1.1), 11, is_blocked=True)
    assert people.known(here, share, 1.12).score[0] == pytest.approx(0.45, rel=0.01)
    assert people.known(here, share, 1.13).score[0] == pytest.approx(0.9, rel=1e-3)
    assert len(people.found(here._replace(t_s=1.1))) == 0
