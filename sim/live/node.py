"""One drone's nodes on the bus: context publisher, policy node and gate, around the simulator's own `Agent`.

    publisher    /fleet/context                      the broadcasts of `sortie.fleet.agent`
    policy node  /fleet/context → /…/directive       staleness rules and damping as in the simulator; it repeats every
                                                     directive in force with every tick, as the paper's node does
    gate         /…/directive → /…/features, compact payloads of the size that `sortie.fleet.gate` gives them

Policy node and gate speak through DDS alone, though they share a process. Every message is sealed where it is written and
opened where it is read (`sortie.sim.live.seals`). What is refused is counted by its reason.
"""

from __future__ import annotations

import math
import struct
import time
from collections import Counter
from collections.abc import Callable, Collection
from enum import Flag, auto

import numpy as np

from sortie.fleet.agent import Ages
from sortie.fleet.gate import HEADER_BYTES, Gate, Payload
from sortie.fleet.memory import PeerMemory
from sortie.fleet.messages.auth import Dropped, DropReason, Opened
from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.fleet.messages.wire import DIRECTIVE_BYTES, decode_directive, encode_directive
from sortie.fleet.plane import FleetRules
from sortie.fleet.standings import Standing
from sortie.perception.types import Capture
from sortie.policies.contract import Descriptor, Directive, FleetView
from sortie.policies.staleness import LinkHealth
from sortie.scenarios.representation import NAME_OF
from sortie.scenarios.streams import stream
from sortie.sim.engine.sortie import latest_phase_s
from sortie.sim.export.topics import CONTEXT, PAYLOADS, Topic, TopicKind
from sortie.sim.live.clock import WallClock
from sortie.sim.live.payload_message import pack_bytes, unpack_bytes
from sortie.sim.live.policy_process import Decision
from sortie.sim.live.reports import Count, HealthChange, NewDirective, Notice, Report, SinceLastReport
from sortie.sim.live.seals import Seals
from sortie.sim.live.transport import MAX_DEPTH, Bus, Reader, Writer

_HEADER = struct.Struct("<qI3f4f")
"""Capture stamp (ns since 1970), sender, estimated position, attitude: the 40 B of `sortie.fleet.gate`."""
DIRECTIVE_DEPTH, PAYLOAD_DEPTH = 16, 4
"""Samples that a reader stores until they are read. With one, a stranger's sample would push a genuine one out."""
MOST_PEERS = 200
"""As many drones as a scenario may have. Each costs readers and writers, so a member cannot name ever more of them."""


class Role(Flag):
    """What a process does for its drone. In `sortie live` one process does all; in ROS 2 each role is a node."""

    PUBLISHER = auto()
    POLICY = auto()
    GATE = auto()


EVERY_ROLE = Role.PUBLISHER | Role.POLICY | Role.GATE


class PeerTopics:
    """One drone's readers and writers for one peer."""

    def __init__(self, bus: Bus, me: int, peer: int, role: Role) -> None:
        self.peer = peer
        self.directive = bus.writer(Topic(TopicKind.DIRECTIVE, me, peer)) if Role.POLICY in role else None
        self.payload: dict[TopicKind, Writer] = {}
        self.readers: list[Reader] = []
        """Of directives to the gate, then of payloads from the peer."""
        if Role.GATE in role:
            self.payload = {kind: bus.writer(Topic(kind, me, peer)) for kind in PAYLOADS}
            self.readers = [bus.reader(Topic(TopicKind.DIRECTIVE, me, peer), DIRECTIVE_DEPTH)]
            self.readers += [bus.reader(Topic(kind, peer, me), PAYLOAD_DEPTH) for kind in PAYLOADS]

    @property
    def writers(self) -> list[Writer]:
        """The writers."""
        return [*([] if self.directive is None else [self.directive]), *self.payload.values()]


class BusGate(Gate):
    """The agent's gate behind the bus: it publishes the policy's directives, and applies the directives that it receives."""

    def __init__(self, publish: Callable[[Directive], None]) -> None:
        super().__init__()
        self._publish = publish
        self._ordered: dict[int, Directive] = {}

    def enforce(self, directive: Directive) -> None:
        """Publish the policy node's new directive for a link."""
        self._ordered[directive.destination] = directive

    def republish(self) -> None:
        """Publish every directive in force; repeating one changes nothing at the gate."""
        for directive in self._ordered.values():
            self._publish(directive)

    def apply(self, directive: Directive) -> None:
        """Enforce a directive that was received."""
        super().enforce(directive)


class LiveNode:
    """The nodes of one drone. It is the agent's modem and log."""

    def __init__(
        self, bus: Bus, seals: Seals, drone: int, drones: int, *, seed: int, loss: float = 0.0, role: Role = EVERY_ROLE
    ) -> None:
        """Args: `loss` is the share of others' descriptors that is dropped on arrival, 0 … 1, drawn by link."""
        self.drone, self._role = drone, role
        self._seals = seals
        self._bus, self._seed, self._loss = bus, seed, loss
        self._context = bus.writer(CONTEXT) if Role.PUBLISHER in role else None
        self._fleet = bus.reader(CONTEXT, MAX_DEPTH)
        self._links: dict[int, PeerTopics] = {}
        for peer in range(drones):
            if peer != drone:
                self._add_peer(peer)
        self.gate = BusGate(self._publish_directive)
        self._draws: dict[int, np.random.Generator] = {}
        self._health: dict[int, LinkHealth] = {}
        self._published = self._heard = self._lost = 0
        self._late_s = 0.0
        self._refused: Counter[str] = Counter()
        self._sent = dict.fromkeys((TopicKind.DIRECTIVE, *PAYLOADS), Count())
        self._received = dict.fromkeys(PAYLOADS, Count())
        self._new = SinceLastReport()
        self._began_s = self._began_cpu_s = 0.0
        self.own: Descriptor | None = None
        """The drone's latest descriptor, if another of its nodes publishes."""
        self._own_counter = 0
        self.ordered_at_s = -math.inf
        """When the latest directive was accepted."""
        self.is_muted: Callable[[], bool] = lambda: False
        """Whether the drone does not know where it is, and says nothing."""

    def all_found(self, present: Collection[int]) -> bool:
        """Whether every writer has found its readers: those of the drones that are present, and the bench's."""
        others = [w for peer, link in self._links.items() if peer in present for w in link.writers]
        heard = self._context is None or self._context.listeners > len(present)
        return heard and all(w.listeners >= 2 for w in others)

    def fly(
        self, clock: WallClock, memory: PeerMemory, rules: FleetRules, goodput_mbps: Callable[..., tuple[float, ...]]
    ) -> None:
        """Begin the flight: what comes in goes to `memory`, and processor time counts from here."""
        self._clock, self._memory, self._rules = clock, memory, rules
        self.goodput_mbps = goodput_mbps
        self._began_s, self._began_cpu_s = clock.now, time.process_time()

    def decided(self, decision: Decision) -> None:
        """Keep a decision's processor time and events for the next report."""
        if decision.elapsed_ns:
            self._new.decide_ns.append(decision.elapsed_ns)
        self._new.notices += decision.notices

    def note(self, text: str) -> None:
        """Keep an event for the next report."""
        self._new.notices.append(Notice(self._clock.now, self.drone, text))

    def wait(self, timeout_s: float) -> None:
        """Sleep until a sample arrives or the time is over."""
        self._bus.wait(timeout_s)

    def take(self) -> None:
        """Handle the samples that have arrived, directives first, because the gate may need them at once.

        A drone on the ground hears nothing.
        """
        if not self._memory.status.airborne:
            for reader in (self._fleet, *(reader for link in self._links.values() for reader in link.readers)):
                reader.take()
            return
        for link in list(self._links.values()):
            for reader in link.readers:
                for cdr in reader.take():
                    if reader.topic.kind == TopicKind.DIRECTIVE:
                        self._on_directive(cdr, reader.topic)
                    else:
                        self._on_payload(cdr, reader)
        for cdr in self._fleet.take():
            self._on_descriptor(cdr)

    def report(self, t_s: float) -> Report:
        """The counts, and what happened since the last report."""
        new, self._new = self._new, SinceLastReport()
        return Report(
            self.drone,
            self._began_s,
            t_s,
            time.process_time() - self._began_cpu_s,
            self._published,
            self._heard,
            self._lost,
            dict(self._refused),
            self._late_s,
            dict(self._sent),
            dict(self._received),
            new,
        )

    # --- sortie.fleet.agent.Modem -----------------------------------------------------------------------

    goodput_mbps: Callable[..., tuple[float, ...]]

    def broadcast(self, datagram: bytes) -> None:
        if self.is_muted() or self._context is None:
            return
        self._published += 1
        self._context.write(self._seals.seal(CONTEXT, datagram))

    def send(self, peer: int, payload: Payload, capture: Capture, deadline_s: float) -> None:
        """Publish a payload of its exact size: header and directive as they are, zeros for the features."""
        directive = self.gate.in_force(peer)
        if directive is None or self.is_muted():
            return
        stamp_ns = round((capture.t_s + self._memory.status.clock_skew_s) * 1e9)
        header = _HEADER.pack(stamp_ns, self.drone, *capture.est_position_m, *capture.orientation_xyzw)
        content = (header + encode_directive(directive)).ljust(payload.size_bytes, b"\0")
        self._write(peer, TopicKind.of(payload.representation), content)

    def handshake(self, peer: int, size_bytes: int, capture: Capture, deadline_s: float) -> None:
        if self.is_muted():
            return
        self._write(peer, TopicKind.FEATURES, bytes(size_bytes))

    # --- sortie.fleet.agent.AgentLog --------------------------------------------------------------------

    def descriptor(self, t_s: float, descriptor: Descriptor, wire_bytes: int) -> None:
        if self.is_muted():  # it was not published
            return
        clock_s = t_s + self._memory.status.clock_skew_s
        self._late_s = max(self._late_s, clock_s - descriptor.stamp_ns * 1e-9)

    def directive(self, t_s: float, asked: Directive, enforced: Directive, link: LinkHealth, reason: str) -> None:
        rung = NAME_OF[enforced.representation]
        self._new.orders.append(NewDirective(t_s, self.drone, enforced.destination, rung, enforced.rate_hz, reason))

    def trust(self, t_s: float, drone: int, peer: int, standing: Standing) -> None:
        why = f": {standing.reason}" if standing.trust < 1.0 else ""
        self._new.notices.append(Notice(t_s, drone, f"trust in drone {peer} is now {standing.trust:g}{why}"))

    def decision(self, t_s: float, drone: int, elapsed_ns: int, peer_ages_s: Ages) -> None:
        self.gate.republish()

    def event(self, t_s: float, drone: int, kind: str, text: str) -> None:
        self._new.notices.append(Notice(t_s, drone, text))

    def alert(self, t_s: float, drone: int, known: bool) -> None:
        self._new.notices.append(Notice(t_s, drone, "knows of a person in its region" if known else "knows of nobody"))

    # --- what comes in ---------------------------------------------------------------------------

    def _on_descriptor(self, cdr: bytes) -> None:
        heard = self._seals.open_descriptor(cdr)
        if isinstance(heard, Opened):
            sender = heard.descriptor.agent_id
            if sender == self.drone and self._context is None:
                self._on_own(heard)
                return
            if sender == self.drone:
                if self._seals.is_forged_self(heard):
                    self._refuse("descriptor", "in this drone's name", f"counter {heard.counter}")
                return
            if self._loss and self._loss_stream(sender).random() < self._loss:
                self._lost += 1
                return
            if sender not in self._links and len(self._links) >= MOST_PEERS:
                self._refuse(
                    "descriptor", "of too many drones", f"drone {sender}, there are {MOST_PEERS} others already"
                )
                return
        refused = self._memory.hear(heard, self._clock.now)
        if isinstance(refused, DropReason):
            told = "its counter was used" if refused == DropReason.REPLAYED else "an id that no drone has"
            self._refuse("descriptor", refused, heard.detail if isinstance(heard, Dropped) else told)
            return
        self._heard += 1
        if isinstance(heard, Opened) and heard.descriptor.agent_id not in self._links:
            self._add_peer(heard.descriptor.agent_id)

    def _on_own(self, heard: Opened) -> None:
        """Keep the drone's own descriptor, which another of its nodes published."""
        if heard.key_id is not None and heard.counter <= self._own_counter:
            self._refuse("descriptor", DropReason.REPLAYED, "its counter was used")
            return
        self._own_counter = heard.counter
        self.own = heard.descriptor
        self._memory.hold(heard.descriptor, self._clock.now)

    def _on_directive(self, cdr: bytes, topic: Topic) -> None:
        opened = self._seals.open(topic, cdr)
        if isinstance(opened, Dropped):
            self._refuse("directive", opened.reason, f"for drone {topic.destination}, {opened.detail}")
            return
        try:
            directive = decode_directive(opened)
        except MalformedDatagram as error:
            self._refuse("directive", DropReason.MALFORMED, error.reason)
            return
        if (directive.source, directive.destination) != (topic.source, topic.destination):
            self._refuse("directive", "of another link", f"{directive.source}→{directive.destination}")
            return
        self.ordered_at_s = self._clock.now
        self.gate.apply(directive)

    def _on_payload(self, cdr: bytes, reader: Reader) -> None:
        topic = reader.topic
        try:
            opened = self._seals.open(topic, unpack_bytes(cdr))
            if isinstance(opened, Dropped):
                self._refuse("payload", opened.reason, f"from drone {topic.source}, {opened.detail}")
                return
            if any(opened[:HEADER_BYTES]):
                fault = self._find_fault(opened, topic)
                if fault is not None:
                    self._refuse("payload", *fault)
                    return
        except (MalformedDatagram, struct.error) as error:
            self._refuse("payload", DropReason.MALFORMED, str(error))
            return
        self._received[topic.kind] = self._received[topic.kind].plus(len(opened))

    def _find_fault(self, content: bytes, topic: Topic) -> tuple[str, str] | None:
        """Why a payload is dropped, and the detail; None if it is accepted.

        Its deadline counts from when its features can be ready: its capture, the sender's compute delay, and the moment
        within a frame at which drones act.
        """
        stamp_ns, sender, *_ = _HEADER.unpack_from(content)
        directive = decode_directive(content[HEADER_BYTES : HEADER_BYTES + DIRECTIVE_BYTES])
        if (sender, directive.source, directive.destination) != (topic.source, topic.source, topic.destination):
            return "of another link", f"{directive.source}→{directive.destination} on {topic.name}"
        age_s = self._clock.now - self._memory.in_own_time(sender, stamp_ns * 1e-9)
        ready_s = self._rules.equipment(sender).compute_delay_s + latest_phase_s(self._rules.period_s)
        if age_s > ready_s + directive.deadline_s:
            late_s = age_s - ready_s
            return "late", f"from drone {sender}, {late_s:.2f} s after it was ready, must be {directive.deadline_s:g} s"
        if self._memory.trust_in(sender) == 0.0:
            return "not trusted", f"from drone {sender}"
        self._new.data_age_s.append(age_s)
        return None

    def _refuse(self, what: str, reason: str, detail: str) -> None:
        """Count a refused message; the first of its kind is an event."""
        kind = f"{what} {reason}".replace("_", " ")
        if kind not in self._refused:
            self.note(f"refused a {kind}: {detail}")
        self._refused[kind] += 1

    # --- helpers ---------------------------------------------------------------------------------

    def _add_peer(self, peer: int) -> None:
        self._links[peer] = PeerTopics(self._bus, self.drone, peer, self._role)

    def _publish_directive(self, directive: Directive) -> None:
        writer = self._links[directive.destination].directive
        if writer is None:
            return
        sealed = self._seals.seal(writer.topic, encode_directive(directive))
        self._sent[TopicKind.DIRECTIVE] = self._sent[TopicKind.DIRECTIVE].plus(len(sealed))
        writer.write(sealed)

    def _write(self, peer: int, kind: TopicKind, content: bytes) -> None:
        writer = self._links[peer].payload[kind]
        sealed = self._seals.seal(writer.topic, content)
        self._sent[kind] = self._sent[kind].plus(len(sealed))
        writer.write(pack_bytes(sealed))

    def _loss_stream(self, sender: int) -> np.random.Generator:
        if sender not in self._draws:
            self._draws[sender] = stream(self._seed, 0, (sender, self.drone), "live loss")
        return self._draws[sender]

    def note_health(self, view: FleetView) -> None:
        """Keep each change of a peer's health for the next report."""
        rules, now_s = self._rules, self._clock.now
        for peer in view.peers:
            age_s = view.age_s[peer]
            found = rules.health(age_s)
            if found != self._health.get(peer, LinkHealth.DETACHED):
                self._health[peer] = found
                self._new.health.append(HealthChange(now_s, self.drone, peer, found, age_s))
