"""What the engine hands on: payloads from the air to memories, looks to trackers, people to drones, and who begins on the ground."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import simpy
from agent_rig import capture, descriptor, memory, payload
from fusing_rig import Mind, Seer, agent
from sim_examples import example

from sortie.fleet.flight.steering import GoTo, Velocity
from sortie.fleet.memory import Received
from sortie.fleet.messages.wire import decode_descriptor, encode_descriptor
from sortie.perception.motion import Tracks
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.policies.contract import Disc, Representation
from sortie.radio import Transmission
from sortie.radio.transmission import Status
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.engine import mixed as mixed_module
from sortie.sim.engine import tracking as tracking_module
from sortie.sim.engine.events import _Begin
from sortie.sim.engine.fusing import Fusing
from sortie.sim.engine.mixed import Mixed, MixedMany, mixed
from sortie.sim.engine.people import KEPT_S, People
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.scoring import Scorer
from sortie.sim.engine.sortie import build
from sortie.sim.engine.steering import Steering, area_m
from sortie.sim.engine.tracking import FleetTracking, captures_ahead
from sortie.sim.engine.transport import Transport
from sortie.sim.results.record import HANDSHAKE, Recorder

# --- payloads ----------------------------------------------------------------------------------------


class Wire:
    """An air that keeps what it was given, and settles it when it is told."""

    def __init__(self) -> None:
        self.given: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

    def send(self, *args: Any, **more: Any) -> int:
        self.given.append((args, more))
        return len(self.given)

    def goodput_mbps(self, drone: int) -> tuple[float, ...]:
        return (float(drone),)

    def broadcast(self, drone: int, size: int, to: Any) -> None:
        to([1, 2])

    def settled(self, number: int, **changes: Any) -> Transmission:
        (drone, peer, size), more = self.given[number - 1]
        whole = Transmission(
            number, drone, peer, more["kind"], size, size, 0.0, more["deadline_s"], 0.1, 0.5, Status.DELIVERED, "", 1, 0, 0,
            1, 20.0, 0.01, arrived_bytes=size,
        )._replace(**changes)  # fmt: skip
        if whole.status != Status.IN_FLIGHT:
            more["on_done"](whole)
        return whole

    def finish(self) -> list[Transmission]:
        return [self.settled(len(self.given), status=Status.IN_FLIGHT, arrived_bytes=0)]


def _transport(
    skews_s: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[Transport, Wire, list[Any], list[Received], Recorder]:
    memories, got = [memory(i) for i in range(3)], list[Received]()
    for each, skew_s in zip(memories, skews_s, strict=True):
        each.status.clock_skew_s = skew_s
        each.receive = got.append  # type: ignore[method-assign]
    wire, recorder, env = Wire(), Recorder(), simpy.Environment()
    env.run(until=0.7)
    transport = Transport(env, wire, memories, recorder, keys=None, rates_mbps=(6.5, 13.0))  # type: ignore[arg-type]
    return transport, wire, memories, got, recorder


def test_a_payload_arrives_with_its_capture_its_sender_s_time_its_gaps_and_its_rate() -> None:
    transport, wire, _, got, recorder = _transport((0.25, -3.0, 0.0))
    tiles = payload()._replace(cells=10, tile_cells=4, tile_bytes=1500, feature_space="")
    taken = capture(0, 0.2)
    modem = transport.modem(0)
    modem.send(1, tiles, taken, 0.9)
    (args, more) = wire.given[0]
    assert args == (0, 1, 20_000)
    assert (more["kind"], more["deadline_s"], more["piece_bytes"], more["reliable"]) == (
        "features",
        0.9,
        1500,
        tiles.reliable,
    )
    wire.settled(1, status=Status.PARTIAL, reason="fragment_lost", arrived_bytes=9000, missing=(0, 2), mcs=1)
    assert got == [Received(taken, tiles, 0.5, 0.45, (0, 1, 2, 3, 8, 9), 13.0)]
    assert modem.goodput_mbps() == (0.0,)
    ((_, kept, captured_s),) = recorder.rows["transmissions"]
    assert (kept, captured_s) == (tiles, 0.2)


@pytest.mark.parametrize(("mcs", "mbps"), [(0, 6.5), (1, 13.0), (2, math.inf), (-1, math.inf)])
def test_a_data_rate_is_that_of_the_mcs_or_unknown(mcs: int, mbps: float) -> None:
    transport, wire, _, got, _ = _transport()
    transport.send(2, 0, payload()._replace(feature_space=""), capture(2, 0.0), 1.0)
    wire.settled(1, mcs=mcs)
    assert [r.phy_mbps for r in got] == [mbps]


def test_what_did_not_arrive_and_what_carries_no_payload_reaches_no_memory() -> None:
    transport, wire, memories, got, recorder = _transport()
    sent = payload()._replace(feature_space="")
    transport.send(0, 1, sent, capture(0, 0.0), 1.0)
    wire.settled(1, status=Status.LOST, reason="no_link", arrived_bytes=0)
    transport.handshake(0, 1, 200, capture(0, 0.1), 1.0)
    assert wire.given[1][0] == (0, 1, 200)
    assert (wire.given[1][1]["kind"], wire.given[1][1]["reliable"]) == (HANDSHAKE, False)
    wire.settled(2)
    transport.send(0, 1, sent, capture(0, 0.2), 1.0)
    transport.finish()
    assert got == []
    assert [m.status.work.payload_bytes for m in memories] == [0, 200, 0]  # its computer reads a handshake all the same
    assert [(t.status, t.reason, c) for t, _, c in recorder.rows["transmissions"]] == [
        (Status.LOST, "no_link", 0.0), (Status.DELIVERED, "", 0.1), (Status.IN_FLIGHT, "", 0.2),
    ]  # fmt: skip


def test_a_map_of_another_network_is_told_as_such_where_it_arrived_and_by_its_loss_where_it_did_not() -> None:
    transport, wire, _, _, recorder = _transport()
    other = payload()._replace(feature_space="another")
    for _ in range(2):
        transport.send(0, 1, other, capture(0, 0.0), 1.0)
    wire.settled(1)
    wire.settled(2, status=Status.LOST, reason="no_link", arrived_bytes=0)
    assert [t.reason for t, *_ in recorder.rows["transmissions"]] == ["other_feature_space", "no_link"]


def test_descriptors_reach_those_who_fly_and_the_last_one_is_kept() -> None:
    transport, _, memories, _, recorder = _transport()
    memories[2].status.leave()
    data = encode_descriptor(descriptor(0, 0.7, coverage_grid=bytes(64)))
    transport.modem(0).broadcast(data)
    assert [0 in m.view(0.7).descriptors for m in memories] == [False, True, False]
    assert transport.last_datagram == {0: data}
    transport.inject(b"garbage", [0, 1, 2])
    assert [row[:2] for row in recorder.rows["drops"]] == [(0.7, 0), (0.7, 1)]
    assert transport.last_datagram == {0: data}


# --- who is there ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("events", "on_the_ground"),
    [
        ("{kind: drone_joins, at_s: 0.2, drone: 1}", [1]),
        ("{kind: drone_joins, at_s: 0.3, drone: 1}, {kind: drone_lost, at_s: 0.1, drone: 1}", []),
        ("{kind: drone_leaves, at_s: 0.1, drone: 1}, {kind: drone_joins, at_s: 0.2, drone: 1}", []),
        ("{kind: drone_lost, at_s: 0.3, drone: 1}, {kind: drone_joins, at_s: 0.1, drone: 1}", [1]),
        ("{kind: drone_joins, at_s: 0.2, drone: 2}, {kind: drone_lost, at_s: 0.1, drone: 1}", [2]),
        (
            "{kind: battery_fault, at_s: 0.1, drone: 1, lost_fraction: 0.1}, {kind: drone_joins, at_s: 0.2, drone: 1}",
            [1],
        ),
    ],
)
def test_a_drone_begins_on_the_ground_where_the_first_that_happens_to_it_is_that_it_joins(
    events: str, on_the_ground: list[int]
) -> None:
    scenario = example(
        "duration_s=1", "fleet.drones=3", f"events=[{events}]", "mission.phases=[{at_s: 0, phase: search}]"
    )
    world = build(scenario, plan_for(scenario), 1).world
    assert [i for i, status in enumerate(world.drones) if not status.airborne] == on_the_ground


# --- trackers ----------------------------------------------------------------------------------------


def _tracker(own: Any) -> FleetTracking:
    return FleetTracking(load("track_target", ["duration_s=10"]), own)


def test_two_targets_are_told_apart_also_in_one_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mission may change its target between two decisions: what was judged of one says nothing of the other."""
    asked: list[tuple[int, float]] = []

    def followed(tracks: Tracks, cues: dict[int, Any], before: Any, now_s: float) -> dict[int, int]:
        (target,) = cues
        asked.append((target, now_s))
        return {target: 4} if target == 1 else {}

    monkeypatch.setattr(tracking_module, "followed", followed)
    tracking = _tracker(lambda captures: [Boxes.empty() for _ in captures])
    for k in range(6):
        for target in (0, 1):
            tracking.follows(0, target, (float(k), 0.0), 0.1 * k)
    assert asked == [(0, 0.5), (1, 0.5)]
    assert tracking.follows(0, 1, (5.0, 0.0), 0.5)
    assert not tracking.follows(0, 0, (5.0, 0.0), 0.5)
    assert tracking.follows(0, 1, (5.0, 0.0), 0.5)


def test_looks_of_drones_go_to_their_own_trackers_in_whatever_order_they_come() -> None:
    """Drone 3's look comes before drone 0's; each sees one car, 100 m further east for each drone's number."""

    def own(captures: Sequence[Capture]) -> list[Boxes]:
        return [
            Boxes(np.array([[100.0 * c.drone, 0.0]]), np.array([[4.6, 1.9]]), np.zeros(1), np.full(1, 0.9))
            for c in captures
        ]

    tracking = _tracker(own)
    for frame in range(15):
        for drone in (3, 0, 2):
            tracking.perceived(capture(drone, 0.1 * frame))
    assert [[round(x) for x, _ in tracking.tracks(d).xy_m.tolist()] for d in range(5)] == [[0], [], [200], [300], []]
    before = tracking.tracks(0)
    assert tracking.tracks(0) is before
    for frame in range(15, 40):
        tracking.perceived(capture(0, 0.1 * frame))
    assert tracking.tracks(0) is not before, "after further looks it is asked for anew"


def test_what_trackers_take_in_next_is_of_all_drones_frame_by_frame() -> None:
    scenario = load("track_target", ["duration_s=10"])
    coming = captures_ahead(scenario, lambda drone, frame: capture(drone, frame * scenario.frame_s))
    frames = scenario.tracked_frames
    n = scenario.fleet.drones
    first = list(coming(-1.0))
    assert [(c.drone, round(c.t_s / scenario.frame_s)) for c in first[: 2 * n]] == [
        (d, f) for f in frames[:2] for d in range(n)
    ]
    after_s = frames[3] * scenario.frame_s
    assert next(iter(coming(after_s))).t_s == frames[4] * scenario.frame_s
    assert next(iter(coming(after_s - 0.01))).t_s == after_s
    assert list(coming(10.0)) == []


# --- people ------------------------------------------------------------------------------------------


def _people(*sets: str) -> People:
    sure = "perception.thermal={near_probability: 1, half_range_m: 2000, false_alarms_per_min: 0, remembers_s: 1.0}"
    scenario: Scenario = load("person_crossing", ["expect=[]", sure, *sets])
    scene = SceneModel(scenario.perception.scene, None, (0.0, 0.0, 20.0, 0.0), people=scenario.perception.people)
    return People(scenario, scene, Recorder(classes=True), (1, 0))


def _over(drone: int, t_s: float) -> Capture:
    """Above the street, where the person crosses it."""
    return Capture(drone, t_s, (13.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (13.0, 0.0, 60.0), 0.0)


def test_what_a_camera_found_is_of_its_own_moment() -> None:
    people = _people()
    for frame in (128, 130):
        people.look(_over(0, frame / 10), frame)
    assert len(people.found(_over(0, 13.0))) == len(people.found(_over(0, 12.8))) == 1
    for other in (12.7, 12.9, 13.1):
        assert len(people.found(_over(0, other))) == 0
    assert len(people.found(_over(1, 13.0))) == 0
    ((box,),) = people.found(_over(0, 13.0)).xy_m[None].tolist()
    assert len(people.with_people(lambda captures: [Boxes.empty() for _ in captures])([_over(0, 13.0)])[0]) == 1
    assert math.hypot(box[0] - 13.0, box[1]) < 30.0


def test_a_person_in_a_region_is_known_for_as_long_as_the_camera_s_memory_and_within_the_region_alone() -> None:
    people = _people()
    people.look(_over(0, 13.0), 130)
    x_m, y_m = people.found(_over(0, 13.0)).xy_m[0].tolist()
    assert people.known_in(0, Disc(x_m, y_m, 1.0), 13.5)
    assert people.known_in(0, Disc(x_m + 5.0, y_m, 5.001), 13.5)
    assert not people.known_in(0, Disc(x_m + 5.0, y_m, 4.9), 13.5)
    assert not people.known_in(0, None, 13.5)
    assert not people.known_in(1, Disc(x_m, y_m, 1.0), 13.5)
    far = Capture(0, 13.9, (5000.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (5000.0, 0.0, 60.0), 0.0)
    people.look(far, 139)
    assert people.known_in(0, Disc(x_m, y_m, 1.0), 14.0)
    people.look(far._replace(t_s=14.1), 141)
    assert not people.known_in(0, Disc(x_m, y_m, 1.0), 14.2)
    people.look(far._replace(t_s=13.0 + KEPT_S), 180)
    assert len(people.found(_over(0, 13.0))) == 1, "kept for trackers that make up for looks"


@pytest.mark.parametrize("rung", ["uncertain_boxes", "detections"])
def test_people_come_with_boxes_of_either_kind(rung: str) -> None:
    people = _people()
    people.look(_over(1, 13.0), 130)
    found = people.found(_over(1, 13.0))
    share = Share(_over(1, 13.0), rung, 0.0, None, 0.8, people=found)
    here = Capture(0, 13.0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 60.0), 0.0)
    assert len(people.known(here, [share], 13.1)) == 1


# --- several networks --------------------------------------------------------------------------------


class Net:
    """A detector that finds one box at its number, and can do many moments or not."""

    def __init__(self, number: int) -> None:
        self.number, self.calibration = number, f"fit {number}"
        self.asked: list[Capture] = []

    def detect(self, jobs: Sequence[tuple[Capture, Sequence[Share]]]) -> list[Boxes]:
        self.asked += [c for c, _ in jobs]
        return [Boxes(np.array([[float(self.number), 0.0]]), np.ones((1, 2)), np.zeros(1), np.ones(1)) for _ in jobs]

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        return Boxes.empty()

    def count_boxes(self, capture: Capture, roi: Any) -> int:
        return self.number

    def camera_views(self, capture: Capture) -> Any:
        return None


class ManyNet(Net):
    def detect_many(self, moments: Sequence[Any]) -> list[Boxes]:
        return [boxes for moment in moments for boxes in self.detect(moment)]

    def truth_many(self, t_s: Any, egos: Any) -> list[Boxes]:
        return [Boxes.empty() for _ in egos]


def _share(drone: int, weight: float = 1.0, what: str = "detections") -> Share:
    return Share(capture(drone, 1.0), what, 0.0, None, weight)


def test_boxes_of_weight_zero_are_not_detected_and_maps_are_left_to_the_network() -> None:
    nets = [Net(0), Net(1)]
    fleet = Mixed(nets, [0, 1, 1], [None, None])
    fleet.detect([(capture(0, 1.0), [_share(1, 0.0), _share(2, what="features")])])
    assert (nets[0].asked, nets[1].asked) == ([capture(0, 1.0)], [])
    fleet.detect([(capture(0, 1.0), [_share(1), _share(2)])])
    assert nets[1].asked == [capture(1, 1.0), capture(2, 1.0)]


def test_uncertain_boxes_bring_the_errors_of_the_network_that_made_them(monkeypatch: pytest.MonkeyPatch) -> None:
    nets = [Net(0), Net(1), Net(2)]
    monkeypatch.setattr(mixed_module, "box_errors_of", lambda d: f"errors of {d.number}")
    fleet = Mixed(nets, [0, 1, 2], [None, lambda boxes: boxes.take(slice(0, 0)), None])
    shares = [_share(1, what="uncertain_boxes"), _share(2)]
    ((_, given),) = fleet._with_foreign_boxes([[(capture(0, 1.0), shares)]])[0]
    assert [s.errors for s in given] == ["errors of 1", None]
    assert [len(s.boxes) for s in given] == [0, 1], "network 1 sends none of its boxes"


@pytest.mark.parametrize("kinds", [(Net, Net), (Net, ManyNet), (ManyNet, Net), (ManyNet, ManyNet)])
def test_networks_that_do_many_moments_do_so_where_all_can(kinds: tuple[type[Net], type[Net]]) -> None:
    makes = "fleet.makes=[{name: a, drones: [1], detector: torch}]"
    scenario = example("perception={detector: surrogate, fusion: late}", "fleet.drones=3", makes)
    made: list[str] = []

    def maker(scene: Any, perception: Any, seed: int, replication: int) -> Net:
        assert (seed, replication) == (3, 4)
        made.append(perception.detector)
        return kinds[len(made) - 1](len(made) - 1)

    fleet = mixed(maker, None, scenario, 3, 4)  # type: ignore[arg-type]
    assert isinstance(fleet, Mixed)
    assert isinstance(fleet, MixedMany) == (kinds == (ManyNet, ManyNet))
    assert made == ["surrogate", "torch"]
    assert [fleet.count_boxes(capture(d, 0.0), None) for d in range(3)] == [0, 1, 0]
    early = example("perception.detector=surrogate", "fleet.drones=3", makes)
    made.clear()
    assert mixed(maker, None, early, 3, 4)._sends == [None, None]  # type: ignore[arg-type, union-attr]
    assert [s is not None for s in fleet._sends] == [False, True], (
        "late fusion's torch drones send confident boxes alone"
    )


# --- scoring -----------------------------------------------------------------------------------------


class Nobody:
    """Stands for the people: one is known of, and none is there."""

    def known(self, here: Capture, shares: Sequence[Share], now_s: float) -> Boxes:
        return Boxes(np.full((1, 2), 7.0), np.ones((1, 2)), np.zeros(1), np.ones(1), kind=np.full(1, 2, np.int8))

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        return Boxes.empty()


def _scored(agents: Sequence[Any], *sets: str, own: Any = None) -> tuple[Seer, Recorder]:
    """Score the frame of 1 s, at 1.1 s."""
    scenario = example(
        "perception={detector: surrogate, max_age_s: 0.5, fusion_delay_s: 0.1, compute_delay_s: 0.05}",
        "fleet.drones=6", *sets,
    )  # fmt: skip
    env, seer, recorder = simpy.Environment(), Seer(), Recorder()
    env.run(until=1.1)
    planned = lambda drone, frame: capture(drone, 1000.0 + frame)  # noqa: E731
    scorer = Scorer(env, scenario, seer, agents, recorder, planned, Fusing(scenario, own), Nobody(), [])  # type: ignore[arg-type]
    scorer._score(10, agents)
    return seer, recorder


def test_a_drone_fuses_what_it_takes_to_be_fresh_by_ascending_peer_and_weighs_it_by_its_trust() -> None:
    """How old a payload is the drone judges itself: by the sender's clock, corrected as far as it knows."""
    mind = Mind([(4, 0.9, 0.5, 0.5, {}), (1, 0.2, 0.3, 1.0, {}), (3, 0.9, 0.51, 1.0, {})])
    seer, recorder = _scored([agent(0, 1.0, 0.9, mind)])
    here, shares = seer.jobs[0]
    assert here == capture(0, 0.9)
    assert [(s.capture.drone, s.weight, s.age_s, s.missing) for s in shares] == [
        (1, 0.5, 0.3, (3,)),
        (4, 0.25, 0.5, (3,)),
    ]
    ((t_s, drone, peers, rungs, ages_s, weights, found, there),) = recorder.rows["fusions"]
    assert (t_s, drone, peers, rungs, weights) == (1.1, 0, [1, 4], ["features"] * 2, [0.5, 0.25])
    assert ages_s == pytest.approx([0.9, 0.2]), "true ages"
    assert (found, there) == (2, 2), "a box and a person"


def test_own_tracks_move_boxes_that_come_late_and_nothing_else() -> None:
    own = Tracks.empty()
    boxes = {"representation": Representation.DETECTIONS}
    mind = Mind([(1, 1.0, 0.1, 1.0, {}), (2, 1.0, 0.1, 1.0, boxes)])
    asked: list[int] = []
    seer, _ = _scored([agent(3, 1.0, 1.0, mind)], own=lambda drone: asked.append(drone) or own)
    assert [s.tracks is own for s in seer.jobs[3][1]] == [False, True]
    assert asked == [3]


@pytest.mark.parametrize(
    ("latest_s", "peers", "fuses"),
    [
        (0.46, [], "own"),  # 0.5 s, and the 0.15 s that any capture takes to be fused
        (0.44, [], "nothing"),
        (0.44, [1], "peers alone"),
        (None, [1], "never looked"),
    ],
)
def test_a_look_that_is_too_old_is_left_out_and_the_drone_is_where_it_is(
    latest_s: float | None, peers: list[int], fuses: str
) -> None:
    mind = Mind([(p, 1.0, 0.1, 1.0, {}) for p in peers])
    seer, recorder = _scored([agent(0, 1.0, latest_s, mind)])
    if fuses == "own":
        assert seer.jobs[0][0] == capture(0, 0.46)
    elif fuses == "peers alone":
        assert seer.jobs[0][0] == capture(0, 1.0)._replace(looked=False)
    else:
        assert not seer.jobs
    assert len(recorder.rows["fusions"]) == (fuses != "never looked"), "who has never looked is not scored yet"
    if fuses == "nothing":
        assert recorder.rows["fusions"][0][6] == 1, "the person alone"


def test_a_slow_computer_s_look_may_be_older() -> None:
    slow = "fleet.makes=[{name: a, drones: [2], compute_delay_s: 0.2}]"
    seer, _ = _scored([agent(d, 1.0, 0.35, Mind()) for d in (0, 2)], slow)
    assert seer.jobs.keys() == {2}


def test_a_look_that_events_slow_may_be_older() -> None:
    """0.36 s and 0.4 s longer, two events together: the look is as old as it must be, and not too old."""
    agents = [agent(d, 1.0, -0.3, Mind()) for d in (0, 1, 2)]
    agents[1].status.slower_s, agents[2].status.slower_s = {0: 0.36}, {0: 0.36, 1: 0.4}
    seer, _ = _scored(agents)
    assert seer.jobs.keys() == {2}


def test_who_is_gone_or_has_just_come_back_is_scored_where_it_would_be() -> None:
    """A drone that came back has not sensed since the frame before; one that cannot look needs no look."""
    agents = [
        agent(0, 1.0, 1.0, Mind(), airborne=False),
        agent(1, 0.8, 0.8, Mind()),
        agent(2, 0.9, 0.9, Mind()),
        agent(3, 1.0, None, Mind([(1, 1.0, 0.1, 1.0, {})]), looks=False),
        agent(4, 1.0, None, Mind()),
    ]
    seer, recorder = _scored(agents)
    assert seer.jobs.keys() == {2, 3}
    assert [row[1] for row in recorder.rows["truths"]] == [0, 1, 2, 3]
    assert [row[1] for row in recorder.rows["fusions"]] == [2, 3]


def test_a_detector_of_many_moments_waits_until_there_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    class All(Seer):
        calibration = "made up"

        def detect_many(self, moments: Sequence[Any]) -> list[Boxes]:
            return [boxes for moment in moments for boxes in self.detect(moment)]

        def truth_many(self, t_s: Any, egos: Any) -> list[Boxes]:
            return [self.truth(t, e) for t, e in zip(t_s, egos, strict=True)]

    monkeypatch.setattr("sortie.sim.engine.scoring.WAITING_EGOS", 5)
    env, recorder = simpy.Environment(), Recorder()
    agents = [agent(d, 0.0, 0.0, Mind()) for d in (0, 1)]
    scenario = example("perception={detector: surrogate}", "fleet.drones=2")
    fusing = Fusing(scenario, None)  # type: ignore[arg-type]
    scorer = Scorer(env, scenario, All(), agents, recorder, None, fusing, Nobody(), [])  # type: ignore[arg-type]
    rows = []
    for _ in range(4):
        scorer._score(0, agents)
        rows.append(len(recorder.rows["fusions"]))
    scorer.flush()
    assert [*rows, len(recorder.rows["fusions"])] == [0, 0, 6, 6, 8]


# --- planners ----------------------------------------------------------------------------------------

GOES = f"fleet.mobility={Path(__file__).parent / 'own_models.py'}:Goes"
APART = (
    "fleet.drones=4",
    "fleet.formation={shape: line, spacing_m: 20}",
    "fleet.motion={pose_jitter_m: 0, pose_error_m: 0}",
)


def _steering(*sets: str) -> tuple[Steering, Any]:
    scenario = example("duration_s=20", GOES, "fleet.mobility_params={x_m: 0}", *APART, *sets)
    parts = build(scenario, plan_for(scenario), 1)
    return parts.steering, parts.world


def _command(steering: Steering, world: Any, **wishes: Any) -> list[str]:
    """Give commands by drone in one frame, and return what is said of them."""
    before = len(world._recorder.rows["events"])
    steering._wishes = {int(name[1:]): wish for name, wish in wishes.items()}
    steering.renew(0)
    return [f"{row[1]} {row[3]}" for row in world._recorder.rows["events"][before:]]


def test_of_two_commands_of_one_frame_the_second_keeps_clear_of_what_the_first_was_granted() -> None:
    steering, world = _steering("fleet.steering.separation_m=10")
    start_m = world.motion.position_m[0].copy()
    middle_m = (start_m[0] + start_m[1]) / 2
    said = _command(steering, world, d1=GoTo(*middle_m.tolist()), d0=GoTo(*middle_m.tolist()))
    end_m = world.motion.position_m[-1]
    np.testing.assert_allclose(end_m[0], middle_m, atol=1e-6)
    assert np.linalg.norm(end_m[1] - end_m[0]) >= 10.0 - 1e-6
    assert said[0] == "0 Goes: GoTo"
    np.testing.assert_array_equal(end_m[2:], start_m[2:])


def test_who_is_in_the_way_is_named_by_its_number_and_who_is_gone_is_not_in_the_way() -> None:
    steering, world = _steering("fleet.steering.separation_m=19")
    start_m = world.motion.position_m[0]
    world.remove(0, "drone_lost", "fell silent")
    (said,) = _command(steering, world, d1=GoTo(*(start_m[3] + 0.2 * (start_m[1] - start_m[3])).tolist()))
    assert said == "1 Goes: GoTo refused, it would come too near drone 3"
    assert _command(steering, world, d1=GoTo(*start_m[0].tolist())) == ["1 Goes: GoTo"]


def test_a_drone_that_goes_home_or_is_down_takes_no_commands() -> None:
    steering, world = _steering()
    world.homebound.add(0)
    world.remove(1, "drone_lost", "fell silent")
    hold = Velocity(1.0, 0.0)
    assert _command(steering, world, d0=hold, d1=hold, d2=hold) == ["2 Goes: Velocity"]
    moved = world.motion.position_m[-1] - world.motion.position_m[0]
    assert (np.abs(moved).max(axis=1) > 1.0).tolist() == [False, False, True, False]


def test_the_scene_reaches_as_far_as_drones_fly_as_planned_and_as_they_may_be_steered() -> None:
    fleet = example(GOES, "fleet.mobility_params={x_m: 0}", "fleet.steering.fence_m=[-90, -60, 20, 60]").fleet
    assert area_m(fleet, (-10.0, -500.0, 700.0, 5.0)) == (-90.0, -500.0, 700.0, 60.0)
    assert area_m(example().fleet, (-1.0, -2.0, 3.0, 4.0)) == (-1.0, -2.0, 3.0, 4.0)


# --- attackers ---------------------------------------------------------------------------------------


def _spoofed(attack: str, *sets: str) -> list[tuple[float, bytes, list[int]]]:
    """What an attacker of drone 1 puts before whom: the drone publishes from 0.3 s on, each 0.2 s."""
    until = "" if sets else ", until_s: 0.8"
    event = f"events=[{{kind: spoof, at_s: 0, drone: 1, attack: {attack}, rate_hz: 5{until}}}]"
    scenario = example("duration_s=1.5", "fleet.drones=4", event, "mission.phases=[{at_s: 0, phase: search}]", *sets)
    env, put = simpy.Environment(), list[tuple[float, bytes, list[int]]]()
    transport = SimpleNamespace(
        last_datagram={}, inject=lambda data, to: put.append((round(env.now, 3), data, list(to)))
    )
    world = SimpleNamespace(env=env, note=lambda *_: None)
    _Begin(scenario, world, transport, None, None, scenario.events[0], 0, 1, 0, {})()  # type: ignore[arg-type]

    def publish() -> Any:
        yield env.timeout(0.3)
        for k in range(10):
            transport.last_datagram = {1: _datagram(k), 0: b"another's"}
            yield env.timeout(0.2)

    env.process(publish())
    env.run(until=scenario.duration_s)
    return put


def _datagram(k: int) -> bytes:
    return encode_descriptor(descriptor(1, 0.3 + 0.2 * k, coverage_grid=bytes(64), battery_soc=0.5))


OPEN = "context.authentication=false"


def test_an_attacker_replays_the_first_datagram_that_it_heard_to_all_but_its_victim() -> None:
    put = _spoofed("replayed")
    assert [t for t, *_ in put] == [0.4, 0.6]
    assert {data for _, data, _ in put} == {_datagram(0)}
    assert [to for *_, to in put] == [[0, 2, 3]] * 2
    assert [t for t, *_ in _spoofed("replayed", OPEN)] == [0.4, 0.6, 0.8, 1.0, 1.2, 1.4], "to the end, if it has none"


def test_other_attacks_follow_the_latest_datagram() -> None:
    put = _spoofed("oversized")
    assert [data for _, data, _ in put] == [_datagram(k) + bytes(2000) for k in (0, 1)]
    put = _spoofed("malformed")
    assert [len(data) for _, data, _ in put] == [len(_datagram(0))] * 2
    assert put[0][1] != put[1][1]
    lies = [decode_descriptor(data) for _, data, _ in _spoofed("forged", OPEN)]
    assert [lie.stamp_ns for lie in lies[:2]] == [decode_descriptor(_datagram(k)).stamp_ns for k in (0, 1)]
    assert {lie.battery_soc for lie in lies} == {0.0}
    assert {g for lie in lies for g in lie.peer_goodput_mbps} == {0.0}
