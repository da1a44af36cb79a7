"""People, thermal cameras, and the paper's property: never drop detection sharing while a human is in the region."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
from sim_examples import example

from sortie.fleet.gate import HEADER_BYTES
from sortie.fleet.messages.wire import DIRECTIVE_BYTES
from sortie.perception.classes import PERSON
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.thermal import people_boxes
from sortie.perception.types import Capture, Share
from sortie.policies.contract import Directive, Disc, FleetView, Policy, Representation
from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.proof.proof import prove
from sortie.scenarios.reading.load import load
from sortie.sim.engine.people import People
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import Recorder, SortieRecord

PROPERTY = "when human_in_region and peers >= 1: any_link(representation >= detections and rate_hz >= 2)"
QUICK = ("perception.detector=none", "expect=[]")
FAULT = """
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import nothing

def tired(view):
    '''The worked policy, but silent below 24.7 % charge.'''
    if view.me.battery_soc < 0.247:
        return [nothing(view.ego, p, "saves energy") for p in view.peers]
    return worked(view)
"""


def crossing(*overrides: str, policy: str | None = None) -> SortieRecord:
    return run_sortie(load("person_crossing", overrides=[*QUICK, *overrides]), policy)


@pytest.fixture(scope="module")
def kept() -> SortieRecord:
    return crossing()


def test_the_property_is_kept_with_the_shield_and_dwelling_breaks_it_without(kept: SortieRecord) -> None:
    told = outcome(kept)
    assert told["policies"]["invariant_violations"] == 0
    assert told["policies"]["shield_interventions"] >= 1
    bare = outcome(crossing("policy.shield=false"))["policies"]
    assert bare["violations_by_cause"] == {"policy": 0, "staleness": 0, "damping": 1, "no_peer": 0}


def test_a_planted_policy_breaks_the_property_and_its_proof(tmp_path: Path) -> None:
    path = tmp_path / "tired.py"
    path.write_text(FAULT)
    told = outcome(crossing("policy.shield=false", policy=f"{path}:tired"))
    assert told["policies"]["violations_by_cause"]["policy"] >= 3, "every drone"
    texts = [e["text"] for e in told["events"] if e["kind"] == "violation"]
    assert f"{PROPERTY}: broken by policy" in texts
    shielded = outcome(crossing(policy=f"{path}:tired"))["policies"]
    assert shielded["invariant_violations"] == 0, "the shield keeps it over any policy"


@pytest.mark.parametrize(("name", "outcome_"), [("worked", "proved"), ("tired", "refuted")])
def test_sortie_verify_can_prove_the_property(name: str, outcome_: str, tmp_path: Path) -> None:
    path = tmp_path / "tired.py"
    path.write_text(FAULT)
    policy = resolve("worked" if name == "worked" else f"{path}:{name}")
    (verdict,) = [v for v in prove(policy, parse(PROPERTY), max_drones=2, views=50) if v.name == PROPERTY]
    assert verdict.outcome == outcome_


def test_what_drones_know_comes_from_their_cameras_alone(kept: SortieRecord) -> None:
    """Without cameras nobody knows of the person, though the truth is the same."""
    blind = crossing("perception.thermal=null")
    assert blind.tables["alerts"].num_rows == blind.tables["sightings"].num_rows == 0
    there, unseen = outcome(kept)["people"], outcome(blind)["people"]
    assert unseen["in_region_drone_s"] == there["in_region_drone_s"] > 40
    assert unseen["unknown_share"] == 1.0
    assert 0 < there["unknown_share"] < 0.05
    assert unseen["ap_2m"] is None
    flags = {(r["drone"], bool(r["novelty_flags"] & 4)) for r in kept.tables["descriptors"].to_pylist()}
    assert {(d, True) for d in range(3)} <= flags


def test_a_drone_whose_camera_sees_nobody_hears_it_from_its_peers() -> None:
    """Two of the drones are too far from the region for their cameras; they know a frame or two after the third."""
    apart = crossing("fleet.formation={shape: line, spacing_m: 100, altitude_m: 60}", "events=[]")
    (seer,) = {r["drone"] for r in apart.tables["sightings"].to_pylist()}
    alerts = {r["drone"]: r["t_s"] for r in reversed(apart.tables["alerts"].to_pylist()) if r["known"]}
    assert set(alerts) == {0, 1, 2}
    assert all(0 < alerts[drone] - alerts[seer] < 0.3 for drone in {0, 1, 2} - {seer})


def test_draws_do_not_depend_on_what_is_sent(kept: SortieRecord) -> None:
    silent = crossing("policy.shield=false", policy="silence")
    assert silent.tables["sightings"].equals(kept.tables["sightings"])
    other = run_sortie(load("person_crossing", overrides=list(QUICK)), seed=2)
    assert not other.tables["sightings"].equals(kept.tables["sightings"])


def test_unknown_time_is_what_alerts_and_truth_say(kept: SortieRecord) -> None:
    """Counted again, one frame after the other, for the drone that knew first."""
    people = np.array([(r["t_s"], r["x_m"], r["y_m"]) for r in kept.tables["people"].to_pylist()])
    inside = people[np.hypot(people[:, 1] - 13, people[:, 2]) <= 10, 0]
    unknown = 0
    for drone in range(3):
        changes = [(r["t_s"], r["known"]) for r in kept.tables["alerts"].to_pylist() if r["drone"] == drone]
        for t_s in inside:
            known = [k for at, k in changes if at <= t_s + 0.09]
            unknown += not (known and known[-1])
    assert outcome(kept)["people"]["unknown_share"] == pytest.approx(unknown / (3 * len(inside)))


def test_a_ground_station_without_a_camera_changes_no_figure_about_people() -> None:
    """It is no drone, and its thermal camera, which it does not have, overlooks nobody."""
    station = (
        "fleet.drones=4", "fleet.ground=[{drone: 3, position_m: [13, 0, 20]}]",
        "events=[{kind: link_drop, at_s: 0, drone: 3, loss_db: 200}]",
    )  # fmt: skip
    drones, with_station = (
        outcome(crossing("duration_s=10", "perception.detector=none", "events=[]", *more))["people"]
        for more in ((), station)
    )
    assert drones["in_region_drone_s"] > 5
    for name in ("ap_2m", "in_region_drone_s", "unknown_share", "unknown_longest_s", "false_alert_share"):
        assert with_station[name] == pytest.approx(drones[name])


def test_without_people_nothing_changes() -> None:
    told = outcome(run_sortie(example()))["people"]
    assert set(told.values()) == {None}


# --- people in payloads ----------------------------------------------------------------------------

SCORED = ("perception.detector=surrogate", "events=[]", "policy.shield=false", "expect=[]")
APART = "fleet.formation.spacing_m=45"


@functools.cache
def shared(policy: object, *overrides: str) -> SortieRecord:
    """With places that are true, so that what is missed was not seen. Several tests compare with the same sortie."""
    sure = "perception.thermal={position_error_m: 0.1, false_alarms_per_min: 0}"
    return run_sortie(load("person_crossing", [*SCORED, APART, sure, *overrides]), policy)  # type: ignore[arg-type]


@functools.cache
def sends(rung: Representation, rate_hz: float = 10.0, weight: float = 1.0) -> Policy:
    def decide(view: FleetView) -> list[Directive]:
        return [
            Directive(view.ego, p, rung, 0.0, None, rate_hz, fusion_weight=weight, reason="all") for p in view.peers
        ]

    return decide


def located(record: SortieRecord) -> tuple[float, float]:
    people = outcome(record)["people"]
    return people["located_share"], people["located_alone_share"]


def test_a_person_whom_one_drone_sees_reaches_another_with_its_detections() -> None:
    silent, told = shared("silence"), shared(sends(Representation.DETECTIONS))
    assert silent.tables["sightings"].equals(told.tables["sightings"])
    alone, share = located(silent)[0], located(told)
    assert located(silent)[1] == share[1] == pytest.approx(alone), "a drone's own camera is the same"
    assert alone < 0.7
    assert share[0] > alone + 0.2
    ap, before = (outcome(r)["ap_by_class"]["person"]["full_scene"] for r in (told, silent))
    assert ap > before + 0.2


def test_a_weight_of_zero_brings_nobody() -> None:
    assert located(shared(sends(Representation.DETECTIONS, weight=0.0))) == located(shared("silence"))


def test_people_are_tracked_and_sent_as_tracks() -> None:
    """A payload has a drone's twelve best tracks, mostly cars, so fewer people come with tracks than with detections."""
    told, silent = shared(sends(Representation.TRACKS)), shared("silence")
    assert located(silent)[0] < located(told)[0] < located(shared(sends(Representation.DETECTIONS)))[0]
    few = shared(sends(Representation.TRACKS), "perception.score_threshold=0.8")
    assert located(few)[0] > located(silent)[0] + 0.1, "where few cars are tracked"
    assert outcome(told)["tracking"]["hota"] is not None
    assert not silent.tables["transmissions"].num_rows


def test_feature_maps_carry_no_people() -> None:
    """The property allows them, as they stand above detections on the ladder; where a person is they do not say."""

    def maps(view: FleetView) -> list[Directive]:
        return [Directive(view.ego, p, Representation.FEATURES, 0.05, None, 10.0, reason="all") for p in view.peers]

    assert located(shared(maps)) == located(shared("silence"))


def test_detections_are_counted_to_the_byte() -> None:
    told = shared(sends(Representation.DETECTIONS)).tables
    sent = told["transmissions"].to_pylist()
    assert {r["payload_bytes"] - 25 * r["boxes"] for r in sent} == {HEADER_BYTES + DIRECTIVE_BYTES}
    found = {(r["drone"], round(10 * r["t_s"])) for r in told["sightings"].to_pylist()}
    cars = {}
    for r in sent:
        cars.setdefault(r["drone"], []).append((r["boxes"], (r["drone"], round(10 * r["captured_s"])) in found))
    assert any(seen for counts in cars.values() for _, seen in counts)
    plain = shared(sends(Representation.DETECTIONS), "perception.thermal=null").tables["transmissions"].to_pylist()
    assert {r["payload_bytes"] - 24 * r["boxes"] for r in plain} == {HEADER_BYTES + DIRECTIVE_BYTES}
    more = {(r["drone"], r["peer"], r["captured_s"]): r["boxes"] for r in sent}
    extra = [more[key] - r["boxes"] for r in plain if (key := (r["drone"], r["peer"], r["captured_s"])) in more]
    of = [
        (r["drone"], round(10 * r["captured_s"])) in found
        for r in plain
        if (r["drone"], r["peer"], r["captured_s"]) in more
    ]
    assert extra == [int(seen) for seen in of], "one box more in every frame in which the camera found the person"


# --- joining, by hand ------------------------------------------------------------------------------


def people_of(*overrides: str) -> tuple[People, Capture]:
    """One drone of three at 60 m over (0, 0), whose camera has looked and found nobody, and its capture."""
    sure = "perception.thermal={near_probability: 0, false_alarms_per_min: 0}"
    scenario = load("person_crossing", ["expect=[]", sure, *overrides])
    scene = SceneModel(scenario.perception.scene, None, (0.0, 0.0, 20.0, 0.0), people=scenario.perception.people)
    here = Capture(0, 1.0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 60.0), 0.0)
    people = People(scenario, scene, Recorder(classes=True), (1, 0))
    people.look(here, 10)
    return people, here


def received(at_m: tuple[float, float], score: float = 0.9, drone_m: float = 30.0, **changes: object) -> Share:
    sender = Capture(1, 1.0, (drone_m, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (drone_m, 0.0, 60.0), 0.0)
    boxes = people_boxes(np.array([at_m]), np.array([score]))
    return Share(sender, "detections", 0.0, None, 1.0, people=boxes)._replace(**changes)


def test_a_received_person_counts_by_weight_and_age() -> None:
    people, here = people_of()

    def score(**changes: object) -> float:
        known = people.known(here, [received((60.0, 0.0), **changes)], 1.1)  # type: ignore[arg-type]
        assert known.kind.tolist() == [PERSON]
        return float(known.score[0])

    assert score() == pytest.approx(0.9)
    assert score(weight=0.5) == pytest.approx(0.45)
    reach = [1.0 - np.exp(-4.0 / (2.0 * (1.0 + (1.4 * age) ** 2))) for age in (0.5, 0.0)]
    assert score(age_s=0.5) == pytest.approx(0.9 * (0.1 + 0.9 * reach[0] / reach[1]), rel=1e-5)
    assert len(people.known(here, [received((60.0, 0.0), weight=0.0)], 1.1)) == 0
    assert len(people.known(here, [received((110.0, 0.0), drone_m=80.0)], 1.1)) == 0, "outside the ego's square"


def test_only_cameras_that_could_see_a_place_vote_a_person_down() -> None:
    """A cone of 70° reaches 42 m at 60 m. The mean's score is over all whose cone holds the place."""
    people, here = people_of("perception.join=average")
    assert people.known(here, [received((60.0, 0.0))], 1.03).score[0] == pytest.approx(0.9, rel=1e-3)
    halved = people.known(here, [received((30.0, 0.0))], 1.03).score[0]
    assert halved == pytest.approx(0.45, rel=1e-3), "the drone's own camera looked there and found nobody"
    silent = received((0.0, 0.0), drone_m=30.0)._replace(people=people_boxes(np.zeros((0, 2)), np.zeros(0)))
    three = people.known(here, [received((30.0, 0.0)), silent], 1.03).score[0]
    assert three == pytest.approx(0.3, rel=1e-3)
    aside = silent._replace(roi=Disc(10.0, 0.0, 5.0))
    assert people.known(here, [received((30.0, 0.0)), aside], 1.03).score[0] == pytest.approx(0.45, rel=1e-3)
    beyond = silent._replace(roi=Disc(90.0, 0.0, 62.0))  # overlaps the cone: where it does is no disc
    assert people.known(here, [received((30.0, 0.0)), beyond], 1.03).score[0] == pytest.approx(0.45, rel=1e-3)


def test_the_own_camera_is_known_after_the_delay_of_perception() -> None:
    scenario = load("person_crossing", ["expect=[]", "perception.thermal={near_probability: 1, half_range_m: 2000}"])
    scene = SceneModel(scenario.perception.scene, None, (0.0, 0.0, 20.0, 0.0), people=scenario.perception.people)
    people = People(scenario, scene, Recorder(classes=True), (1, 0))
    t_s = 13.0  # the person is in the middle of the street
    here = Capture(0, t_s, (13.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (13.0, 0.0, 60.0), 0.0)
    people.look(here, 130)
    assert len(people.known(here, [], t_s + 0.02)) == 0
    assert len(people.known(here, [], t_s + 0.03)) == len(people.found(here)) == 1
    assert len(people.found(here._replace(t_s=t_s + 0.1))) == 0
    assert people.truth(t_s, here).car.tolist() == [0]


def test_a_blocked_thermal_camera_finds_nobody_and_votes_nobody_down() -> None:
    """From the moment at which its covered frame would be known; what it found before stands until then."""
    people, here = people_of("perception.join=average")
    share = [received((30.0, 0.0))]
    people.look(here._replace(t_s=1.1), 11, is_blocked=True)
    assert people.known(here, share, 1.12).score[0] == pytest.approx(0.45, rel=0.01)
    assert people.known(here, share, 1.13).score[0] == pytest.approx(0.9, rel=1e-3)
    assert len(people.found(here._replace(t_s=1.1))) == 0


def test_camera_blocked_covers_the_thermal_camera_too() -> None:
    alarms = "perception.thermal={false_alarms_per_min: 600}"
    events = "events=[{kind: camera_blocked, at_s: 1, until_s: 2, drone: 1}]"
    record = run_sortie(example("duration_s=3", "perception.detector=none", alarms, events), "silence")
    rows = record.tables["sightings"].to_pandas()
    second = {drone: set((its.t_s + 1e-6).astype(int)) for drone, its in rows.groupby("drone")}
    assert (second[0], second[1]) == ({0, 1, 2}, {0, 2})


def test_people_are_looked_for_where_they_are_at_the_scoring() -> None:
    """One runs 10 m/s, and a fusion comes 0.8 s after its frame. A drone that was lost would have had to find her as well."""
    record = run_sortie(
        example(
            "duration_s=3", "perception.detector=surrogate", "perception.fusion_delay_s=0.8", "perception.thermal={}",
            "perception.people=[{waypoints_m: [[-30, 5], [60, 5]], speed_mps: 10}]",
            "events=[{kind: drone_lost, at_s: 0.9, drone: 2}]",
        ),
        "silence",
    )  # fmt: skip
    rows = [r for r in record.tables["truths"].to_pylist() if r["kind"] == PERSON]
    assert {r["drone"] for r in rows if r["t_s"] > 2.0} == set(range(5))
    assert len(rows) > 10
    for r in rows:
        assert (r["x_m"], r["y_m"]) == pytest.approx((-30.0 + 10.0 * r["t_s"], 5.0), abs=1e-3)
