"""What goes between a live drone's parts: payloads and their deadlines, a vehicle's state, a policy's answers and notices.

Held: what stands in a payload's header, which clocks, delays and trust decide over one that comes in, whom a node waits for
before the flight, what a vehicle's telemetry becomes, and what a policy's process answers.
"""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from memory_bus import MemoryBus
from policies_examples import fleet_of
from sim_examples import example

from sortie.fleet.agent import Platform, Task
from sortie.fleet.coverage import View
from sortie.fleet.gate import HEADER_BYTES, Payload
from sortie.fleet.logs.vehicle import VehicleState
from sortie.fleet.messages.wire import decode_directive, encode_directive
from sortie.perception.geometry import USUAL
from sortie.perception.types import Capture
from sortie.policies.checks import check_directives
from sortie.policies.contract import Directive, Disc, PolicyError, Representation, TaskPhase
from sortie.sim.export.topics import CONTEXT, Topic, TopicKind
from sortie.sim.live import platform
from sortie.sim.live.bench import Bench
from sortie.sim.live.node import _HEADER, LiveNode
from sortie.sim.live.payload_message import pack_bytes, unpack_bytes
from sortie.sim.live.platform import MavlinkSenses
from sortie.sim.live.policy_process import Ask, Decision, _decide, _plain, take_notices
from sortie.sim.live.reports import Notice
from sortie.sim.live.rules import rules_of
from sortie.sim.live.seals import Seals
from sortie.sim.results.record import Recorder

FEATURES, COMPACT, ORDER = TopicKind.FEATURES, TopicKind.COMPACT, TopicKind.DIRECTIVE
CAPTURE = Capture(0, 7.5, (1.0, 2.0, 60.0), (0.0, 0.0, 0.6, 0.8), (3.0, 4.0, 61.0), 0.25)


class Memory:
    """What a node knows of its peers: their clocks are their number of seconds ahead, and trust is by drone."""

    def __init__(self) -> None:
        self.status = SimpleNamespace(airborne=True, clock_skew_s=100.0)
        self.trust = {0: 1.0, 1: 1.0, 2: 1.0}

    def in_own_time(self, peer: int, stamp_s: float) -> float:
        return stamp_s - 100.0 - peer

    def trust_in(self, peer: int) -> float:
        return self.trust[peer]


def node(bus: MemoryBus, drone: int = 0, drones: int = 3) -> LiveNode:
    """Drone 1 takes half a second to look, the others a tenth; the frames are of 0.2 s."""
    scenario = example(
        f"fleet.drones={drones}", "context={rate_hz: 5, authentication: false}", "perception.compute_delay_s=0.1",
        "fleet.makes=[{name: slow, drones: [1], compute_delay_s: 0.5}]",
    )  # fmt: skip
    made = LiveNode(bus, Seals(None, drone), drone, drones, seed=4)  # type: ignore[arg-type]
    made.fly(SimpleNamespace(now=50.0), Memory(), rules_of(scenario, 0.0, 6.0), tuple)  # type: ignore[arg-type]
    return made


def directive(source: int, destination: int, **more: Any) -> Directive:
    asked = {"rho": 0.25, "rate_hz": 5.0, "deadline_s": 0.3, "reason": "asked"} | more
    return Directive(source, destination, Representation.FEATURES, **asked)


# --- payloads -------------------------------------------------------------------------------------------------------


def test_a_payload_tells_its_capture_s_stamp_and_believed_pose_and_goes_where_its_content_belongs() -> None:
    """Boxes are sent for want of anything better, though maps were ordered: they go to the topic of boxes."""
    bus = MemoryBus()
    made = node(bus)
    made.gate.apply(directive(0, 2))
    for representation, kind in ((Representation.FEATURES, FEATURES), (Representation.DETECTIONS, COMPACT)):
        made.send(2, Payload(representation, 0.25, None, 1.0, 3, 0, 0, 500), CAPTURE, 0.3)
        (cdr,) = bus.written[Topic(kind, 0, 2)]
        content = unpack_bytes(cdr)
        stamp_ns, sender, *pose = _HEADER.unpack_from(content)
        assert (len(content), stamp_ns, sender) == (500, 107_500_000_000, 0)
        assert pose == pytest.approx([3.0, 4.0, 61.0, 0.0, 0.0, 0.6, 0.8])
        assert (
            decode_directive(content[HEADER_BYTES : HEADER_BYTES + len(encode_directive(directive(0, 2)))]).destination
            == 2
        )


def test_who_does_not_know_where_it_is_sends_nothing() -> None:
    bus = MemoryBus()
    made = node(bus)
    made.gate.apply(directive(0, 2))
    payload = Payload(Representation.FEATURES, 0.25, None, 1.0, 3, 0, 0, 500)
    made.send(1, payload, CAPTURE, 0.3)  # to which nothing was ordered
    made.is_muted = lambda: True
    made.send(2, payload, CAPTURE, 0.3)
    made.handshake(2, 24, CAPTURE, 0.3)
    made.broadcast(b"datagram")
    told = made.report(60.0)
    assert (bus.written, told.published) == ({}, 0)
    made.is_muted = lambda: False
    made.broadcast(b"datagram")
    assert (list(bus.written), made.report(61.0).published) == ([CONTEXT], 1)


def content(sender: int, captured_s: float, order: Directive) -> bytes:
    """A payload of a peer, stamped by its own clock."""
    stamp_ns = round((captured_s + 100.0 + sender) * 1e9)
    return _HEADER.pack(stamp_ns, sender, 0.0, 0.0, 60.0, 0.0, 0.0, 0.0, 1.0) + encode_directive(order)


@pytest.mark.parametrize(("sender", "ready_s"), [(1, 0.5), (2, 0.1)])
def test_a_payload_is_late_by_its_sender_s_clock_delay_and_moment(sender: int, ready_s: float) -> None:
    """The deadline of 0.3 s begins when the sender can be ready: its own delay, and 10 ms, after the capture."""
    made, topic, order = node(MemoryBus()), Topic(FEATURES, sender, 0), directive(sender, 0)
    last_s = 50.0 - (ready_s + 0.01 + 0.3)
    assert made._find_fault(content(sender, last_s + 0.005, order), topic) is None
    fault = made._find_fault(content(sender, last_s - 0.005, order), topic)
    assert fault is not None
    assert fault[0] == "late"
    (age_s,) = made.report(60.0).new.data_age_s
    assert age_s == pytest.approx(50.0 - last_s - 0.005, abs=1e-6)


def test_a_payload_of_another_link_is_refused_whichever_part_says_so() -> None:
    made, topic = node(MemoryBus()), Topic(FEATURES, 1, 0)
    for sender, source, destination in ((2, 1, 0), (1, 2, 0), (1, 1, 2)):
        fault = made._find_fault(content(sender, 49.9, directive(source, destination)), topic)
        assert fault is not None, (sender, source, destination)
        assert fault[0] == "of another link"
    assert made._find_fault(content(1, 49.9, directive(1, 0)), topic) is None


def test_a_sender_that_is_doubted_is_heard_and_one_without_any_trust_is_not() -> None:
    made, topic = node(MemoryBus()), Topic(FEATURES, 1, 0)
    for trust, fault in ((0.25, None), (0.0, "not trusted")):
        made._memory.trust[1] = trust  # type: ignore[attr-defined]
        found = made._find_fault(content(1, 49.9, directive(1, 0)), topic)
        assert (None if found is None else found[0]) == fault
    made._memory.trust |= {0: 0.0, 1: 1.0}  # type: ignore[attr-defined]
    assert made._find_fault(content(1, 49.9, directive(1, 0)), topic) is None


def test_a_directive_of_another_link_is_refused_and_one_of_this_link_is_timed() -> None:
    made, topic = node(MemoryBus()), Topic(ORDER, 0, 1)
    for source, destination in ((0, 2), (2, 1)):
        made._on_directive(encode_directive(directive(source, destination)), topic)
    assert made.gate.in_force(1) is None
    assert made.ordered_at_s == -np.inf
    made._on_directive(encode_directive(directive(0, 1)), topic)
    assert made.gate.in_force(1) is not None
    assert made.ordered_at_s == 50.0
    assert made.report(60.0).refused == {"directive of another link": 2}


def test_every_directive_in_force_is_published_again() -> None:
    bus = MemoryBus()
    made = node(bus)
    for destination, rate_hz in ((1, 5.0), (2, 4.0), (1, 3.0)):
        made.gate.enforce(directive(0, destination, rate_hz=rate_hz))
    made.gate.republish()
    made.gate.republish()
    for destination, rate_hz in ((1, 3.0), (2, 4.0)):
        sent = [decode_directive(cdr).rate_hz for cdr in bus.written[Topic(ORDER, 0, destination)]]
        assert sent == [rate_hz, rate_hz]


def test_the_longest_delay_of_a_descriptor_is_kept_by_the_drone_s_own_clock() -> None:
    made = node(MemoryBus())
    for t_s, stamp_s in ((1.0, 100.99), (2.0, 101.95), (3.0, 102.98)):
        made.descriptor(t_s, SimpleNamespace(stamp_ns=round(stamp_s * 1e9)), 180)  # type: ignore[arg-type]
    made.is_muted = lambda: True  # what a drone without telemetry does not publish has no delay
    made.descriptor(4.0, SimpleNamespace(stamp_ns=round(101.0 * 1e9)), 180)  # type: ignore[arg-type]
    assert made.report(4.0).late_s == pytest.approx(0.05, abs=1e-6)


def test_a_node_waits_for_the_readers_of_those_that_are_present_and_of_the_bench() -> None:
    """Of three drones the third comes later."""
    bus = MemoryBus()
    first = node(bus)
    assert not first.all_found({0, 1})
    node(bus, 1)
    assert not first.all_found({0, 1}), "nobody counts yet"
    Bench(bus, 3)  # type: ignore[arg-type]
    assert first.all_found({0, 1})
    assert not first.all_found({0, 1, 2})
    node(bus, 2)
    assert first.all_found({0, 1, 2})
    for topic in (CONTEXT, Topic(ORDER, 0, 1), Topic(FEATURES, 0, 2)):
        gone = bus.readers[topic].pop()
        assert not first.all_found({0, 1, 2}), topic
        bus.readers[topic].append(gone)


def test_a_report_is_not_changed_by_what_comes_later() -> None:
    bus = MemoryBus()
    made = node(bus)
    made.note("first")
    told = made.report(1.0)
    made.note("second")
    made.handshake(1, 24, CAPTURE, 0.3)
    assert [notice.text for notice in told.new.notices] == ["first"]
    made._on_payload(pack_bytes(content(1, 49.9, directive(1, 0))), bus.readers[Topic(FEATURES, 1, 0)][0])
    assert (told.sent[FEATURES].samples, told.received[FEATURES].samples) == (0, 0)
    later = made.report(2.0)
    assert ([notice.text for notice in later.new.notices], later.received[FEATURES].samples) == (["second"], 1)


def test_the_time_of_a_decision_that_was_not_used_is_no_time_of_a_decision() -> None:
    made = node(MemoryBus())
    for elapsed_ns, text in ((7, "a"), (0, "b"), (9, "c")):
        made.decided(Decision(1, elapsed_ns=elapsed_ns, notices=(Notice(1.0, 0, text),)))
    told = made.report(2.0).new
    assert (told.decide_ns, [notice.text for notice in told.notices]) == ([7, 9], ["a", "b", "c"])


# --- a vehicle ------------------------------------------------------------------------------------------------------


def senses(monkeypatch: pytest.MonkeyPatch, **state: Any) -> tuple[MavlinkSenses, dict[str, Any], list[str]]:
    """Drone 2's, which publishes in every second frame of a tenth of a second."""
    seen: dict[str, Any] = {"sensed": [], "perceived": []}

    def views(poses: Any, field: Any, cameras: Any) -> list[list[View]]:
        seen["poses"], seen["field"], seen["cameras"] = poses, field, cameras
        return [[View(1, 2, b"cells")]]

    monkeypatch.setattr(platform, "views", views)
    replay = SimpleNamespace(
        sense=seen["sensed"].append, perceived=seen["perceived"].append, cameras=USUAL, height_field="field",
        platform=lambda: Platform(0.9, 0.8, 0.7), task=lambda: Task(TaskPhase.TRACK, Disc(1.0, 2.0, 3.0)),
    )  # fmt: skip
    link, notes = SimpleNamespace(state=VehicleState(**state), refused=0), list[str]()
    made = MavlinkSenses(link, replay, 2, notes.append)  # type: ignore[arg-type]
    made.begin(
        500.0, rules_of(example("context={rate_hz: 10, publish_every: 2, detached_after_periods: 10}"), 0.0, 6.0)
    )
    return made, seen, notes


def test_what_a_vehicle_says_is_what_its_drone_senses(monkeypatch: pytest.MonkeyPatch) -> None:
    heard_s = time.monotonic()
    half = 0.35
    made, seen, _ = senses(
        monkeypatch, position_m=(1.0, 2.0, 30.0), velocity_mps=(4.0, 5.0, 6.0), soc=0.25,
        orientation_xyzw=(0.0, 0.0, float(np.sin(half)), float(np.cos(half))), position_s=heard_s, attitude_s=heard_s + 3.0,
    )  # fmt: skip
    sensed = made.sense(7)
    capture = sensed.capture
    assert (capture.drone, capture.t_s) == (2, heard_s + 500.0), "when the older of position and attitude came in"
    assert capture.position_m == capture.est_position_m == (1.0, 2.0, 30.0)
    assert capture.est_yaw_rad == pytest.approx(2 * half)
    assert (sensed.velocity_mps, sensed.view) == ((4.0, 5.0, 6.0), View(1, 2, b"cells"))
    made.sense(8)
    assert (seen["sensed"], seen["field"]) == ([7, 8], "field")
    for heading in (seen["poses"].yaw_rad, seen["poses"].est_yaw_rad):
        assert heading.tolist() == [[pytest.approx(2 * half)]]
    assert seen["poses"].position_m.tolist() == seen["poses"].est_position_m.tolist() == [[[1.0, 2.0, 30.0]]]
    low, high = (
        sensed.footprint_radius_m,
        senses(monkeypatch, position_m=(1.0, 2.0, 60.0))[0].sense(0).footprint_radius_m,
    )
    assert high == pytest.approx(2 * low)
    made.perceived(capture)
    assert seen["perceived"] == [capture]


def test_a_vehicle_s_charge_rises_only_by_more_than_the_band() -> None:
    """Headrooms are replayed as they were published, and have no second band."""
    replay = SimpleNamespace(platform=lambda: Platform(0.9, *headrooms))
    link = SimpleNamespace(state=VehicleState(), refused=0)
    made = MavlinkSenses(link, replay, 2, str, hysteresis=0.2)  # type: ignore[arg-type]
    told = []
    for soc, headrooms in (
        (None, (0.1, 0.2)),
        (0.5, (0.8, 0.7)),
        (0.4, (0.1, 0.2)),
        (0.44, (0.8, 0.7)),
        (0.6, (0.8, 0.7)),
    ):
        link.state = VehicleState(soc=soc)
        told.append(made.platform().soc)
        assert made.platform()[1:] == headrooms
    assert told == pytest.approx([0.9, 0.5, 0.4, 0.4, 0.5])


def test_charge_and_phase_are_the_vehicle_s_where_it_knows_them(monkeypatch: pytest.MonkeyPatch) -> None:
    for soc, wanted in ((None, 0.9), (0.25, 0.25), (0.0, 0.0)):
        assert senses(monkeypatch, soc=soc)[0].platform() == Platform(wanted, 0.8, 0.7)
    for landed, phase in ((False, TaskPhase.TRACK), (True, TaskPhase.LANDING)):
        task = senses(monkeypatch, landed=landed)[0].task()
        assert (task.phase, task.region) == (phase, Disc(1.0, 2.0, 3.0))


def test_old_telemetry_is_told_once_and_mutes_when_peers_would_detach(monkeypatch: pytest.MonkeyPatch) -> None:
    """Descriptors come every 0.2 s: after ten of them peers would detach, so that 2 s are the limit."""
    made, _, notes = senses(monkeypatch)
    rules = made._rules
    assert rules is not None
    for age_s, stale, muted in (
        (rules.fresh_s - 0.01, False, False), (rules.fresh_s + 0.01, True, False), (1.99, True, False), (2.01, True, True),
        (2.5, True, True), (1.0, True, False), (0.05, False, False), (0.05, False, False),
    ):  # fmt: skip
        made._judge_age(age_s)
        assert (made._stale, made.muted) == (stale, muted), age_s
    assert [note.partition(":")[0] for note in notes] == [
        "telemetry is stale",
        "publishes nothing",
        "telemetry is back",
    ]


# --- a policy's process ---------------------------------------------------------------------------------------------


def test_a_directive_crosses_processes_with_every_field_in_its_place() -> None:
    given = Directive(0, 2, Representation.FEATURES, 0.25, Disc(1, 2, 3), 5, 0.35, 0.6, 80, "why")
    plain = _plain(given)
    assert plain == given
    assert [type(value) for value in plain] == [int, int, Representation, float, Disc, float, float, float, int, str]
    assert _plain(given._replace(roi=None)).roi is None


def test_an_answer_has_its_number_and_the_time_of_its_own_decision(monkeypatch: pytest.MonkeyPatch) -> None:
    view, seen = fleet_of(3), list[Any]()

    def pilot(given: Any) -> list[Directive]:
        seen.append(given)
        return [directive(0, 1), directive(0, 2)]

    pilot.check = check_directives  # type: ignore[attr-defined]
    clock_ns = iter((5_000, 5_700))
    monkeypatch.setattr(time, "thread_time_ns", lambda: next(clock_ns))
    answer = _decide(pilot, Ask(17, view))  # type: ignore[arg-type]
    assert answer.elapsed_ns == 700
    assert (answer.number, answer.fault) == (17, "")
    assert [d.destination for d in answer.directives] == [1, 2]
    with pytest.raises(TypeError):
        seen[0].age_s[1] = 0.0  # a policy cannot change what was read


def test_what_breaks_a_rule_or_raises_is_a_fault_without_directives() -> None:
    def refuses(view: Any) -> list[Directive]:
        raise PolicyError("by its own words")

    def breaks(view: Any) -> list[Directive]:
        raise ZeroDivisionError("division by zero")

    for pilot, words in (
        (lambda view: [directive(0, 7)], "7"), (lambda view: [directive(1, 2)], "1"), (refuses, "by its own words"),
        (breaks, "division by zero"),
    ):  # fmt: skip
        pilot.check = check_directives  # type: ignore[attr-defined]
        answer = _decide(pilot, Ask(3, fleet_of(3)))  # type: ignore[arg-type]
        assert (answer.number, answer.directives, answer.elapsed_ns) == (3, (), 0)
        assert words in answer.fault


def test_notices_are_of_events_and_interventions_and_taken_once() -> None:
    recorder = Recorder()
    recorder.rows["events"].append((1.0, 2, "policy", "took over"))
    recorder.rows["interventions"].append((1.5, 2, 0, "worked", "gate", "replaced"))
    assert take_notices(recorder) == (Notice(1.0, 2, "took over"), Notice(1.5, 2, "gate → 0: replaced"))
    assert take_notices(recorder) == ()
