"""Strangers, repeated and late messages, and members that lie: refused, counted and shown, while the drones fly on."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import dds_attacker
import pytest
from dds_domains import domain
from live_flights import PATIENT, Seen, fly_until, refusal_of
from policies_examples import fleet_of
from sim_examples import example

from sortie.fleet.memory import PeerMemory
from sortie.fleet.messages.auth import TRAILER_BYTES, Dropped, DropReason, Opened, Sealer
from sortie.fleet.messages.wire import encode_descriptor, encode_directive
from sortie.fleet.plane import DroneStatus
from sortie.policies.contract import Directive, Representation
from sortie.sim.export.topics import CONTEXT, Topic, TopicKind
from sortie.sim.folders import RunError
from sortie.sim.live import node as node_module
from sortie.sim.live.bus import LOOPBACK, Bus
from sortie.sim.live.node import _HEADER, LiveNode
from sortie.sim.live.payload_message import pack_bytes
from sortie.sim.live.rules import rules_of
from sortie.sim.live.seals import KEY_ID, KEY_VARIABLE, Seals, find_key, secrets_of
from sortie.sim.live.sentences import describe_changes

MASTER = bytes(range(32))
ORDER = Topic(TopicKind.DIRECTIVE, 0, 1)
PAYLOAD = Topic(TopicKind.FEATURES, 0, 1)


def seals(drone: int, at_s: float = 1000.0, master: bytes = MASTER) -> Seals:
    """A drone's seals; its clock stands."""
    return Seals(secrets_of(master, drone), drone, clock_ns=lambda: round(at_s * 1e9))


def test_each_message_is_accepted_once() -> None:
    sender, receiver = seals(0), seals(1)
    sealed = sender.seal(PAYLOAD, b"content")
    assert len(sealed) == len(b"content") + TRAILER_BYTES
    assert receiver.open(PAYLOAD, sealed) == b"content"
    again = receiver.open(PAYLOAD, sealed)
    assert isinstance(again, Dropped)
    assert again.reason == DropReason.REPLAYED
    assert receiver.open(PAYLOAD, sender.seal(PAYLOAD, b"more")) == b"more"


def test_what_is_no_message_of_the_topic_is_refused_by_reason() -> None:
    moved = Topic(TopicKind.FEATURES, 2, 1)
    for sealed, reason in (
        (b"bare", DropReason.TRUNCATED),
        (encode_directive(Directive(0, 1)), DropReason.UNKNOWN_KEY),
        (seals(0, master=bytes(32)).seal(PAYLOAD, b"x"), DropReason.FORGED),
        (seals(0).seal(PAYLOAD, b"x")[:-1] + b"?", DropReason.FORGED),
        (seals(0).seal(moved, b"x"), DropReason.FORGED),
        (seals(0, 990.0).seal(PAYLOAD, b"x"), DropReason.REPLAYED),  # recorded before the receiver started
    ):
        found = seals(1).open(PAYLOAD, sealed)
        assert isinstance(found, Dropped)
        assert found.reason == reason
    found = seals(1).open_descriptor(seals(0, 990.0).seal(CONTEXT, encode_descriptor(fleet_of(2).descriptors[0])))
    assert isinstance(found, Dropped)
    assert found.reason == DropReason.REPLAYED


def test_no_member_commands_the_gate_of_another() -> None:
    for member in (1, 2):
        found = seals(0).open(ORDER, seals(member).seal(ORDER, encode_directive(Directive(0, 1))))
        assert isinstance(found, Dropped)
        assert found.reason == DropReason.FORGED
    assert isinstance(seals(0).open(ORDER, seals(0).seal(ORDER, b"")), bytes)


# --- the key -----------------------------------------------------------------------------------------


def test_the_key_comes_from_a_file_of_its_owner_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "fleet.key"
    path.write_text(MASTER.hex())
    path.chmod(0o640)
    with pytest.raises(RunError, match=r"its mode is 640, must be 600: others may read or write the key$"):
        find_key(path)
    path.chmod(0o600)
    assert find_key(path) == MASTER
    monkeypatch.setenv(KEY_VARIABLE, MASTER.hex())
    assert find_key(None) == MASTER
    monkeypatch.setenv(KEY_VARIABLE, "secret")
    with pytest.raises(RunError) as error:
        find_key(None)
    assert str(error.value) == "SORTIE_KEY has 6 characters, must be 64 hexadecimal digits"
    monkeypatch.delenv(KEY_VARIABLE)
    assert find_key(None) != find_key(None)
    assert refusal_of("--key", str(tmp_path / "none")) == f"{tmp_path / 'none'}: No such file or directory"


# --- a flight among strangers --------------------------------------------------------------------------


def test_a_stranger_does_not_silence_a_drone() -> None:
    """Two drones and a stranger who writes in drone 0's name, until enough has arrived and was refused."""
    sent: dict[int, int] = {}

    def enough(seen: Seen) -> bool:
        gate, receiver = seen.last(0), seen.last(1)
        if gate is None or receiver is None:
            return False
        sent.update({r.drone: r.sent[TopicKind.FEATURES].samples for r in (gate, receiver)})
        arrived = [r.received[TopicKind.FEATURES].samples + r.refused.get("payload late", 0) for r in (gate, receiver)]
        wanted = "payload forged", "payload replayed", "descriptor replayed"
        return (
            gate.refused.get("directive unknown key", 0) > 50
            and gate.refused.get("directive replayed", 0) > 0
            and all(receiver.refused.get(why, 0) > 0 for why in wanted)
            and min(arrived) > 25
        )

    command = [sys.executable, str(Path(dds_attacker.__file__)), str(domain(__name__))]
    environment = {**os.environ, "CYCLONEDDS_URI": LOOPBACK}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as stranger:
        try:
            assert stranger.stdout is not None
            assert stranger.stdout.readline() == "listening\n"
            policy = "policy={name: all-4, params: {received_budget: 0.03125}, dwell_s: 0.3}"
            result = fly_until(enough, "fleet.drones=2", policy, PATIENT, domain=domain(__name__), decide_within_s=1.0)
        finally:
            stranger.kill()
    gate = result.each[0]
    assert sent[0] > 0.3 * gate.published  # it was not thinned out either: nearly each frame has a payload
    text = "\n".join(describe_changes(result))
    assert "drone 0: refused a directive unknown key: for drone 1, key id" in text


# --- deadlines and trust, at one node --------------------------------------------------------------------


class FixedClock:
    """A clock that the test moves."""

    now = 10.0


def node_of(drone: int) -> tuple[LiveNode, FixedClock, PeerMemory]:
    """A drone's node, alone on its bus, in the scenario's flight."""
    scenario = example("fleet.drones=2")
    node = LiveNode(Bus(domain(__name__ + ".1")), seals(drone), drone, 2, seed=0, loss=0.0)
    clock, rules = FixedClock(), rules_of(scenario, 0.0, 6.0)
    memory = PeerMemory(drone, rules, DroneStatus())
    node.fly(clock, memory, rules, lambda: (1.0,))  # type: ignore[arg-type]
    return node, clock, memory


def payload(sender: Seals, stamp_s: float, deadline_s: float = 0.1, source: int = 0) -> bytes:
    """A payload from drone 0 to drone 1 as its gate writes it."""
    header = _HEADER.pack(round(stamp_s * 1e9), source, 0, 0, 60, 0, 0, 0, 1)
    order = Directive(0, 1, Representation.FEATURES, 0.1, None, 10.0, deadline_s)
    return sender.seal(PAYLOAD, header + encode_directive(order) + bytes(500))


def test_a_descriptor_in_the_drone_s_own_name_is_refused() -> None:
    node, _, _ = node_of(1)
    datagram = encode_descriptor(fleet_of(2).descriptors[1])
    node._on_descriptor(node._seals.seal(CONTEXT, datagram))
    assert not node._refused
    node._on_descriptor(seals(0, 1001.0).seal(CONTEXT, datagram))  # a member that poses as drone 1
    assert node._refused == {"descriptor in this drone's name": 1}
    bare = seals(0).open_descriptor(datagram)
    assert isinstance(bare, Dropped)
    for padding in range(4):
        found = seals(0).open_descriptor(seals(1).seal(CONTEXT, datagram) + bytes(padding))
        assert isinstance(found, Opened)
    wrong = Sealer(bytes(32), KEY_ID)
    assert isinstance(seals(0).open_descriptor(wrong.seal(datagram)), Dropped)


# --- counters that no clock shows ------------------------------------------------------------------------


def sealed_at(counter: int, topic: Topic, content: bytes) -> bytes:
    """What a member of the fleet can seal: any counter."""
    sealer = Sealer(seals(2)._key(topic), KEY_ID, counter - 1)
    return sealer.seal(content)


def test_a_member_s_counter_from_the_future_locks_nobody_out() -> None:
    """One message refused all later ones of drone 0, for good."""
    datagram = encode_descriptor(fleet_of(2).descriptors[0])
    for counter in (2**64 - 1, round(1002.1e9)):
        receiver = seals(1)
        found = receiver.open(PAYLOAD, sealed_at(counter, PAYLOAD, b"x"))
        assert isinstance(found, Dropped)
        assert "ahead of this clock, must be at most 2 s" in found.detail
        assert receiver.open(PAYLOAD, seals(0).seal(PAYLOAD, b"x")) == b"x"
        assert isinstance(receiver.open_descriptor(sealed_at(counter, CONTEXT, datagram)), Dropped)
        assert isinstance(receiver.open_descriptor(seals(0).seal(CONTEXT, datagram)), Opened)
        assert isinstance(receiver.open_descriptor(seals(0, 1001.9).seal(CONTEXT, datagram)), Opened)


def test_what_is_refused_makes_no_link_and_no_fleet_grows_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    node, _, memory = node_of(1)
    claim = fleet_of(2).descriptors[0]
    sealed = seals(0).seal(CONTEXT, encode_descriptor(claim._replace(agent_id=7)))
    node._on_descriptor(sealed[:-1] + b"?")
    node._on_descriptor(seals(0, 990.0).seal(CONTEXT, encode_descriptor(claim._replace(agent_id=8))))
    assert sorted(node._links) == [0]
    monkeypatch.setattr(node_module, "MOST_PEERS", 2)
    node._on_descriptor(sealed)
    assert sorted(node._links) == [0, 7]
    node._on_descriptor(seals(0, 1000.1).seal(CONTEXT, encode_descriptor(claim._replace(agent_id=9))))
    assert sorted(node._links) == [0, 7]
    assert node._refused["descriptor of too many drones"] == 1
    assert memory.peers == [7]


def test_a_payload_of_a_peer_with_a_wrong_clock_is_judged_by_its_age() -> None:
    """All payloads of a drone that was 0.3 s behind were refused as late, though its offset was known."""
    node, clock, memory = node_of(1)
    sender, reader = seals(0), node._links[0].readers[1]
    for frame in range(12):
        clock.now = 10.0 + 0.1 * frame
        stamped = fleet_of(2).descriptors[0]._replace(stamp_ns=round((clock.now - 0.3) * 1e9))
        node._on_descriptor(sender.seal(CONTEXT, encode_descriptor(stamped)))
    assert memory.clocks.offset_s[0] == pytest.approx(0.25, abs=0.01)  # known to half a frame
    node._on_payload(pack_bytes(payload(sender, clock.now - 0.3 - 0.05)), reader)
    assert not node._refused
    node._on_payload(pack_bytes(payload(sender, clock.now - 0.3 - 0.2)), reader)
    assert node._refused["payload late"] == 1
