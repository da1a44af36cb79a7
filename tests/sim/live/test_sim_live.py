"""The context plane over DDS: real processes, a real bus, and a peer that shares no code with them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import dds_peer
import live_flights
import pytest
from dds_domains import domain
from live_flights import LONGEST_S, PATIENT, Seen, fly_until, refusal_of
from sim_examples import example

from sortie.fleet.messages.auth import Dropped, Opened
from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.fleet.messages.wire import DESCRIPTOR_NAME, DIRECTIVE_NAME, encode_descriptor, encode_directive
from sortie.policies.contract import Descriptor, Directive, Disc, Representation, TaskPhase
from sortie.policies.staleness import LinkHealth
from sortie.sim.export.topics import BYTES_NAME, CONTEXT, Topic, TopicKind, links
from sortie.sim.folders import RunError
from sortie.sim.live.bus import LOOPBACK, Bus
from sortie.sim.live.clock import WallClock
from sortie.sim.live.messages import dds_name, dds_type
from sortie.sim.live.payload_message import pack_bytes, unpack_bytes
from sortie.sim.live.result import LiveResult, overhead_rows
from sortie.sim.live.seals import Seals
from sortie.sim.live.sentences import describe_changes
from sortie.sim.live.session import MAX_DRONES, fly_live

STAMP_NS = 1_700_000_000_123_456_789


def said_by_hand(agent_id: int = 9) -> Descriptor:
    """What `dds_peer.context` says, as this project has it; one priority target, so that it ends on 2 B."""
    pose = (5.0, 5.0, 60.0), (0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
    coverage = bytes([0b10101010]) * 64
    return Descriptor(
        *(STAMP_NS, agent_id, *pose, 42.0, 0.5, 1.0, 1.0, (50.0,) * 9), coverage, 0, TaskPhase.SEARCH, None, (7,)
    )


# --- the bytes -------------------------------------------------------------------------------------


def test_types_written_by_hand_give_the_names_the_types_and_the_bytes_of_the_wire() -> None:
    assert CONTEXT.dds_name == "rt/fleet/context"
    assert Topic(TopicKind.DIRECTIVE, 0, 12).dds_name == "rt/drone_0/to_drone_12/directive"
    assert links(3) == [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]
    by_hand: Any
    types = {DESCRIPTOR_NAME: dds_peer.Context, DIRECTIVE_NAME: dds_peer.Directive, BYTES_NAME: dds_peer.Bytes}
    for ros_name, by_hand in types.items():
        made = dds_type(ros_name)
        assert made.__idl__.get_type_id() == by_hand.__idl__.get_type_id()
        assert made.__idl_typename__ == by_hand.__idl_typename__ == dds_name(ros_name)
    order = Directive(0, 9, Representation.FEATURES, 0.25, Disc(1.0, 2.0, 32.0), 5.0, 0.1, 0.5, 80)
    for by_hand, ours in (
        (dds_peer.context(9, STAMP_NS), encode_descriptor(said_by_hand())),
        (dds_peer.Directive(0, 9, 3, 80, [1.0, 2.0, 32.0], 0.25, 5.0, 0.1, 0.5), encode_directive(order)),
        (dds_peer.Bytes(dds_peer.Layout([], 0), list(b"abcde")), pack_bytes(b"abcde")),
    ):
        assert by_hand.serialize(use_version_2=False) == ours


def test_a_writer_s_farewell_is_no_sample_and_no_error() -> None:
    bus = Bus(domain(__name__))
    topic = Topic(TopicKind.COMPACT, 0, 1)
    reader, writer = bus.reader(topic, 4), Bus(domain(__name__)).writer(topic)
    while not writer.listeners:
        time.sleep(0.01)
    writer.write(pack_bytes(b"abc"))
    assert bus.wait(600.0)
    assert [unpack_bytes(cdr) for cdr in reader.take()] == [b"abc"]
    del writer  # its participant goes with it, and tells so
    assert bus.wait(600.0)
    assert reader.take() == []


def test_a_descriptor_that_dds_filled_up_is_the_descriptor() -> None:
    open_descriptor = Seals(None).open_descriptor
    cdr = encode_descriptor(said_by_hand())
    assert len(cdr) % 4 == 2
    for sample in (cdr, cdr + b"\0\0"):
        found = open_descriptor(sample)
        assert isinstance(found, Opened)
        assert found.descriptor == said_by_hand()._replace(stamp_ns=STAMP_NS)
    assert isinstance(open_descriptor(cdr + b"\0\1"), Dropped)
    assert isinstance(open_descriptor(cdr + bytes(8)), Dropped)  # fewer are padding, and a version without fields


def test_payload_bytes_come_back_filled_up_or_not_and_others_are_refused() -> None:
    for content in (b"", b"abc", bytes(70_000)):
        cdr = pack_bytes(content)
        assert unpack_bytes(cdr) == content
        assert unpack_bytes(cdr.ljust(-len(cdr) % 4 + len(cdr), b"\0")) == content
    good = pack_bytes(b"abc")
    for cdr in (b"", good[:-1], good + bytes(4), b"\0\1\0\0" + bytes([1] * 12)):
        with pytest.raises(MalformedDatagram):
            unpack_bytes(cdr)


# --- the clock -------------------------------------------------------------------------------------


def test_a_late_event_finds_the_clock_at_the_time_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    wall_s = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: wall_s[0])
    clock, seen = WallClock(50.0, 1000.0), []

    def steps() -> Any:
        for _ in range(2):
            yield clock.timeout(1.0)
            seen.append(clock.now)

    clock.process(steps())
    clock.catch_up()
    wall_s[0] = 1000.9
    clock.catch_up()
    assert seen == []
    wall_s[0] = 1003.0  # two seconds late
    clock.catch_up()
    assert seen == [53.0]
    assert clock.peek() == pytest.approx(54.0)  # a second from when it was handled
    wall_s[0] = 1004.5
    clock.catch_up()
    assert seen == [53.0, 54.5]


def test_a_clock_that_is_always_late_returns_after_each_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise a drone with a slow policy decides on and on, and reads no message."""
    wall_s = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: wall_s[0])
    clock, frames = WallClock(0.0, 1000.0), []

    def fly() -> Any:
        for frame in range(5):
            yield clock.timeout(max(0.0, frame - clock.now))
            frames.append(frame)
            wall_s[0] += 1.5  # the frame takes longer than its period

    clock.process(fly())
    for done in range(6):
        assert len(frames) <= done
        clock.catch_up()
    assert len(frames) >= 4


# --- a flight with a peer, and a process that is killed ----------------------------------------------


class Flown(NamedTuple):
    """What became of it."""

    result: LiveResult
    peer: dict[str, Any]
    pids: dict[int, int]


@pytest.fixture(scope="module")
def flown() -> Flown:
    """Three drones and a peer of another maker, which falls silent; number 2 is killed at 8 s. All have to notice."""
    environment = {**os.environ, "CYCLONEDDS_URI": LOOPBACK}
    command = [sys.executable, str(Path(dds_peer.__file__)), str(domain(__name__))]
    pids: dict[int, int] = {}

    def noticed(seen: Seen) -> bool:
        return all(
            seen.healths(drone, gone)[-1:] == [LinkHealth.DETACHED]
            and seen.carried(drone, gone)[-1:] == ["none"]
            and "features" in seen.carried(drone, 1 - drone)
            and "descriptor malformed" in (report := seen.last(drone)).refused  # type: ignore[union-attr]
            and report.published > seen.last(2).published  # type: ignore[union-attr]
            for drone in (0, 1)
            for gone in (2, dds_peer.ME)
        )

    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as peer:
        try:
            assert peer.stdout is not None
            assert peer.stdout.readline() == "listening\n"
            result = fly_until(
                noticed,
                "fleet.drones=3",
                "context.authentication=false",
                "context.detached_after_periods=60",  # a policy that does not answer as long is killed
                "policy={name: all-4, params: {received_budget: 0.03125}, dwell_s: 0.3}",
                kill=(2, 8.0),
                domain=domain(__name__),
                begun=pids.update,
            )
            told, _ = peer.communicate(timeout=600)
        finally:
            peer.kill()
    return Flown(result, json.loads(told), pids)


def test_the_peer_reads_what_the_drones_publish(flown: Flown) -> None:
    assert set(flown.peer["contexts"]) == {"0", "1", "2"}
    for drone, said in flown.peer["last"].items():
        assert said["agent_id"] == int(drone)
        assert said["position"][2] == pytest.approx(60.0, abs=3.0)  # the scenario's altitude
        assert abs(said["stamp"]["sec"] - time.time()) < 3600  # as ROS 2 stamps: since 1970
        assert 0 < said["battery"] <= 1
        assert len(said["peer_goodput"]) == 2
        assert any(said["coverage_grid"])


def test_the_fleet_shares_with_a_peer_that_was_on_no_roster(flown: Flown) -> None:
    met = [c for c in flown.result.health if c.peer == dds_peer.ME]
    assert {c.drone for c in met if c.health == LinkHealth.FRESH} >= {0, 1}
    orders = flown.peer["directives"]
    assert {(o["source"], o["destination"]) for o in orders} == {(0, dds_peer.ME)}
    assert Representation.FEATURES in {o["representation"] for o in orders}
    assert orders[-1]["representation"] == Representation.NONE  # it fell silent and was detached
    shared = [o for o in orders if o["representation"] == Representation.FEATURES]
    assert {round(o["rho"], 6) for o in shared} == {0.03125}
    assert 128 * 160 < min(flown.peer["payload_bytes"]) < 129 * 160 + 600


def test_a_killed_process_is_noticed_by_age_and_the_others_fly_on(flown: Flown) -> None:
    result = flown.result
    (gone,) = result.lost
    assert (gone.drone, gone.how) == (2, "was killed by SIGKILL")
    assert result.noticed[0].by == 2
    for drone in (0, 1):
        seen = [c for c in result.health if (c.drone, c.peer) == (drone, 2)]
        assert seen[-1].health == LinkHealth.DETACHED
        assert seen[-1].age_s > 1.0
        if seen[-2].health == LinkHealth.DEGRADED:  # a host that stalls for a second jumps over it
            assert 0.3 < seen[-2].age_s < seen[-1].age_s
        last = [o for o in result.orders if (o.drone, o.peer) == (drone, 2)][-1]
        assert last.representation == "none"
        assert last.reason.startswith("detached")
        other = [o for o in result.orders if (o.drone, o.peer) == (drone, 1 - drone)]
        assert "features" in {o.representation for o in other}
        refused = {why: n for why, n in result.each[drone].refused.items() if why != "payload late"}  # a busy host
        assert list(refused) == ["descriptor malformed"], "what cannot be a drone"
    assert [d.drone for d in result.each] == [0, 1, 2]
    assert "drone 2: its process was killed by SIGKILL" in describe_changes(result)[0]
    assert set(flown.pids) == {0, 1, 2}
    for pid in flown.pids.values():
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_the_bench_counts_every_topic(flown: Flown) -> None:
    result = flown.result
    by_kind = dict(zip(TopicKind, result.topics, strict=True))
    assert by_kind[TopicKind.CONTEXT].type == DESCRIPTOR_NAME
    # what all-4 sends while three peers share its budget; of fewer each gets more
    to_three = min(flown.peer["payload_bytes"])
    assert to_three - 1 <= by_kind[TopicKind.FEATURES].mean_bytes <= 3 * to_three
    assert by_kind[TopicKind.DIRECTIVE].mean_bytes == 36
    assert result.data_bytes_per_s > 0
    assert result.decisions > 0
    assert result.drones_cpu_percent > 0
    assert dict(overhead_rows(result))["descriptor, serialised"] == f"{result.descriptor_bytes:.0f} B"
    json.dumps(result.as_json())


# --- loss, interruption, options ---------------------------------------------------------------------


def test_ctrl_c_ends_the_flight_and_tells_what_was_measured_and_all_context_lost_leaves_everybody_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pids: dict[int, int] = {}
    took_over = "all-4 → best-2(received_budget=0.05): time 0.3 s"
    changing = "policy={name: all-4, dwell_s: 0, changes: [{at_s: 0.3, name: best-2, params: {received_budget: 0.05}}]}"

    def changed(seen: Seen) -> bool:
        return all((r := seen.last(i)) is not None and r.lost > 0 and seen.notices(i) == [took_over] for i in (0, 1))

    # in place of asking the processes to stop, as the helper does
    monkeypatch.setattr(live_flights, "stop", lambda _: signal.raise_signal(signal.SIGINT))
    result = fly_until(
        changed, "fleet.drones=2", PATIENT, changing, loss=1.0, domain=domain(__name__), begun=pids.update
    )
    assert result.interrupted
    assert result.flown_s < LONGEST_S
    assert result.lost == []
    assert [d.heard for d in result.each] == [0, 0]
    assert all(d.published > 0 and d.dropped_by_loss > 0 for d in result.each)
    assert (result.data_bytes_per_s, result.context_share, result.health) == (0, None, [])
    assert sorted((n.drone, n.text) for n in result.notices) == [(0, took_over), (1, took_over)]
    for pid in pids.values():
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_a_fleet_that_is_gone_before_it_reports_is_an_error() -> None:
    def killed(pids: dict[int, int]) -> None:
        os.kill(pids[0], signal.SIGKILL)

    with pytest.raises(RunError, match=r"^no drone's process lived long enough to report: was killed by SIGKILL$"):
        fly_live(example("fleet.drones=1"), domain=domain(__name__), begun=killed)


IN_THE_FLIGHT = "must be a drone below 5 and a time in the flight"
DO_NOT_FIT: list[tuple[str, dict[str, Any], str]] = [
    (f"fleet.drones={MAX_DRONES + 1}", {}, "fleet.drones is 21, live flights have at most 20: each is a process"),
    ("", {"begin_s": 4.0, "duration_s": 3.0}, "the flight is to be from 4 s to 7 s, must be within the scenario's 6 s"),
    ("", {"loss": 1.5}, "loss is 1.5, must be in [0, 1]"),
    ("", {"kill": (7, 1.0)}, f"kill 7@1: {IN_THE_FLIGHT}"),
    ("", {"kill": (1, 9.0)}, f"kill 1@9: {IN_THE_FLIGHT}"),
    ("", {"start": (7, 1.0)}, f"start 7@1: {IN_THE_FLIGHT}"),
    ("", {"start": (1, 9.0)}, f"start 1@9: {IN_THE_FLIGHT}"),
    ("", {"start": (1, 1.0), "kill": (1, 2.0)}, "start 1@1: must be after the kill at 2 s"),
    ("", {"decide_within_s": 2.0}, "decide_within_s is 2, must be in (0, 1]"),
    (
        "",
        {"mavlink": ["udpin:127.0.0.1:0"] * 6},
        "there are 6 MAVLink addresses, must be at most 5, one for each drone",
    ),
]


def test_options_that_do_not_fit_are_named() -> None:
    said = []
    for field, options, _ in DO_NOT_FIT:
        with pytest.raises(RunError) as error:
            fly_live(example(*filter(None, [field])), domain=domain(__name__), **options)
        said.append(str(error.value))
    assert said == [message for *_, message in DO_NOT_FIT]


def test_a_kill_that_is_none_and_a_missing_extra_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    assert refusal_of("--kill", "2") == "--kill '2', must be a drone and a time, as in 2@70"
    for name in [m for m in sys.modules if m.startswith(("cyclonedds", "sortie.sim.live"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    assert refusal_of("track_target") == "cyclonedds is missing: pip install 'sortie-sim[dds]'"


@pytest.mark.slow
def test_a_drone_that_was_killed_comes_back_and_is_believed() -> None:
    """Its counters begin above those that it used before."""
    result = fly_until(
        lambda seen: seen.healths(0, 1)[1:] == [LinkHealth.DETACHED, LinkHealth.FRESH] and seen.last(1, late=True),
        "fleet.drones=2",
        "policy={name: all-4, params: {received_budget: 0.03125}, dwell_s: 0.3}",
        "context={degraded_after_periods: 59, detached_after_periods: 60}",
        kill=(1, 8.0),
        start=(1, 22.0),
        domain=domain(__name__ + ".1"),
    )
    assert [d.drone for d in result.each] == [0, 1, 1]
    assert all(set(d.refused) <= {"payload late"} for d in result.each)  # a busy host is late
    assert [gone.drone for gone in result.lost] == [1]
    assert result.noticed[0].by == 1
