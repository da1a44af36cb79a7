"""One node of a live flight: its payloads and their deadlines, its directives, its counts, and a policy's answers."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from memory_bus import MemoryBus
from policies_examples import fleet_of
from sim_examples import example

from sortie.fleet.gate import HEADER_BYTES, Payload
from sortie.fleet.messages.wire import decode_directive, encode_directive
from sortie.perception.types import Capture
from sortie.policies.checks import check_directives
from sortie.policies.contract import Directive, Disc, PolicyError, Representation
from sortie.policies.staleness import LinkHealth
from sortie.sim.export.topics import CONTEXT, Topic, TopicKind
from sortie.sim.live.bench import Bench
from sortie.sim.live.node import _HEADER, LiveNode
from sortie.sim.live.payload_message import pack_bytes, unpack_bytes
from sortie.sim.live.policy_process import Ask, Decision, _decide, _plain, take_notices
from sortie.sim.live.reports import Count, HealthChange, Notice
from sortie.sim.live.rules import rules_of
from sortie.sim.live.seals import Seals
from sortie.sim.results.record import Recorder

FRESH, DEGRADED, DETACHED = LinkHealth.FRESH, LinkHealth.DEGRADED, LinkHealth.DETACHED
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
        f"fleet.drones={drones}",
        "context={rate_hz: 5, authentication: false}",
        "perception.compute_delay_s=0.1",
        "fleet.makes=[{name: slow, drones: [1], compute_delay_s: 0.5}]",
    )
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
        order = content[HEADER_BYTES : HEADER_BYTES + len(encode_directive(directive(0, 2)))]
        assert decode_directive(order).destination == 2


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


def fault_of(made: LiveNode, content: bytes, topic: Topic) -> str | None:
    """Why a node does not take a payload."""
    found = made._find_fault(content, topic)
    return None if found is None else found[0]


def test_a_payload_is_late_by_its_sender_s_clock_delay_and_moment() -> None:
    """The deadline of 0.3 s begins when the sender can be ready: its own delay, and 10 ms, after the capture."""
    for sender, ready_s in ((1, 0.5), (2, 0.1)):
        made, topic, order = node(MemoryBus()), Topic(FEATURES, sender, 0), directive(sender, 0)
        last_s = 50.0 - (ready_s + 0.01 + 0.3)
        assert fault_of(made, content(sender, last_s + 0.005, order), topic) is None
        assert fault_of(made, content(sender, last_s - 0.005, order), topic) == "late"
        (age_s,) = made.report(60.0).new.data_age_s
        assert age_s == pytest.approx(50.0 - last_s - 0.005, abs=1e-6)


def test_a_payload_of_another_link_is_refused_whichever_part_says_so() -> None:
    made, topic = node(MemoryBus()), Topic(FEATURES, 1, 0)
    for sender, source, destination in ((2, 1, 0), (1, 2, 0), (1, 1, 2)):
        assert fault_of(made, content(sender, 49.9, directive(source, destination)), topic) == "of another link"
    assert fault_of(made, content(1, 49.9, directive(1, 0)), topic) is None


def test_a_sender_that_is_doubted_is_heard_and_one_without_any_trust_is_not() -> None:
    made, topic = node(MemoryBus()), Topic(FEATURES, 1, 0)
    for trust, fault in (({1: 0.25}, None), ({1: 0.0}, "not trusted"), ({0: 0.0, 1: 1.0}, None)):
        made._memory.trust |= trust  # type: ignore[attr-defined]
        assert fault_of(made, content(1, 49.9, directive(1, 0)), topic) == fault


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


# --- a policy's process ---------------------------------------------------------------------------------------------


def test_a_node_counts_what_it_sends_by_kind_and_receives_from_its_own_links_alone() -> None:
    bus = MemoryBus()
    first, second, third = (node(bus, d) for d in range(3))
    first.handshake(1, 24, CAPTURE, 0.1)
    first.handshake(1, 30, CAPTURE, 0.1)
    first.gate.enforce(Directive(0, 2, Representation.DETECTIONS, 0.0, None, 5.0, reason="x"))
    first.gate.republish()
    first.gate.republish()
    for each in (first, second, third):
        each.take()
    told = [each.report(60.0) for each in (first, second, third)]
    assert [(r.drone, r.begin_s, r.t_s) for r in told] == [(d, 50.0, 60.0) for d in range(3)]
    sent = [decode_directive(cdr).rate_hz for cdr in bus.written[Topic(ORDER, 0, 2)]]
    assert sent == [5.0, 5.0], "every directive in force is published again"
    assert told[0].sent == {ORDER: Count(2, 72), FEATURES: Count(2, 54), COMPACT: Count()}
    assert [r.received[FEATURES] for r in told] == [Count(), Count(2, 54), Count()]
    assert [r.received[COMPACT] for r in told] == [Count()] * 3
    assert first.gate.in_force(2) is not None  # its own gate reads it, and no other drone's
    assert second.gate.in_force(0) is None
    assert third.gate.in_force(0) is None


def test_each_health_of_a_peer_is_told_once_with_its_age() -> None:
    made = node(MemoryBus())
    view = SimpleNamespace(peers=(1, 2))
    for ages in ({1: 0.2, 2: 10.0}, {1: 0.3, 2: 10.2}, {1: 0.9, 2: 0.2}, {1: 3.0, 2: 0.2}):
        view.age_s = ages
        made.note_health(view)  # type: ignore[arg-type]
    assert made.report(1.0).new.health == [
        HealthChange(50.0, 0, 1, FRESH, 0.2),
        HealthChange(50.0, 0, 1, DEGRADED, 0.9),
        HealthChange(50.0, 0, 2, FRESH, 0.2),
        HealthChange(50.0, 0, 1, DETACHED, 3.0),
    ]
    assert made.report(2.0).new.health == []


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
        (lambda view: [directive(0, 7)], "7"),
        (lambda view: [directive(1, 2)], "1"),
        (refuses, "by its own words"),
        (breaks, "division by zero"),
    ):
        pilot.check = check_directives  # type: ignore[attr-defined]
        answer = _decide(pilot, Ask(3, fleet_of(3)))  # type: ignore[arg-type]
        assert (answer.number, answer.directives, answer.elapsed_ns) == (3, (), 0)
        assert words in answer.fault


def test_notices_are_taken_once_and_the_time_of_a_decision_that_was_not_used_is_none() -> None:
    recorder = Recorder()
    recorder.rows["events"].append((1.0, 2, "policy", "took over"))
    recorder.rows["interventions"].append((1.5, 2, 0, "worked", "gate", "replaced"))
    assert take_notices(recorder) == (Notice(1.0, 2, "took over"), Notice(1.5, 2, "gate → 0: replaced"))
    assert take_notices(recorder) == ()
    made = node(MemoryBus())
    for elapsed_ns, text in ((7, "a"), (0, "b"), (9, "c")):
        made.decided(Decision(1, elapsed_ns=elapsed_ns, notices=(Notice(1.0, 0, text),)))
    told = made.report(2.0).new
    assert (told.decide_ns, [notice.text for notice in told.notices]) == ([7, 9], ["a", "b", "c"])
