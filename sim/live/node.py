"""One drone's nodes on the bus: context publisher, policy node and gate, around the simulator's own `Agent`.

    publisher    /fleet/context                      the broadcasts of `sortie.fleet.agent`
    policy node  /fleet/context → /…/directive       staleness rules and damping as in the simulator; it repeats every
                                                     directive in force with every tick, as the paper's node does
    gate         /…/directive → /…/features, compact payloads of the size that `sortie.fleet.gate` gives them

Policy node and gate speak through DDS alone, though they share a process.
"""

from __future__ import annotations

import struct
import time
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from sortie.fleet.gate import HEADER_BYTES, Gate, Payload
from sortie.fleet.memory import PeerMemory
from sortie.fleet.messages.auth import Dropped, DropReason, Opened, open_datagram
from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.fleet.messages.wire import DIRECTIVE_BYTES, decode_directive, encode_directive
from sortie.fleet.plane import PlaneRules
from sortie.fleet.staleness import LinkHealth, health
from sortie.fleet.trust import Standing
from sortie.perception.types import Capture
from sortie.policies.contract import Descriptor, Directive, FleetView, Policy
from sortie.scenarios.representation import NAME_OF
from sortie.scenarios.streams import stream
from sortie.sim.export.topics import CONTEXT, PAYLOADS, Topic, TopicKind
from sortie.sim.live.bus import MAX_DEPTH, Bus, Reader, Writer
from sortie.sim.live.clock import WallClock
from sortie.sim.live.messages import pack_bytes, unpack_bytes
from sortie.sim.live.reports import Count, HealthChange, NewDirective, Report, SinceLastReport

_HEADER = struct.Struct("<qI3f4f")
"""Capture stamp (ns since 1970), sender, estimated position, attitude: the 40 B of `sortie.fleet.gate`."""


class PeerTopics:
    """One drone's readers and writers for one peer."""

    def __init__(self, bus: Bus, me: int, peer: int) -> None:
        self.peer = peer
        self.directive = bus.writer(Topic(TopicKind.DIRECTIVE, me, peer))
        self.payload = {kind: bus.writer(Topic(kind, me, peer)) for kind in PAYLOADS}
        self.ordered = bus.reader(Topic(TopicKind.DIRECTIVE, me, peer))
        self.incoming = [bus.reader(Topic(kind, peer, me)) for kind in PAYLOADS]

    @property
    def writers(self) -> list[Writer]:
        """The writers."""
        return [self.directive, *self.payload.values()]


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

    def __init__(self, bus: Bus, drone: int, drones: int, *, seed: int, loss: float) -> None:
        """Args: `loss` is the share of others' descriptors that is dropped on arrival, 0 … 1, drawn by link."""
        self.drone = drone
        self._bus, self._seed, self._loss = bus, seed, loss
        self._context = bus.writer(CONTEXT)
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
        self._began_cpu_s = 0.0

    def all_found(self, drones: int) -> bool:
        """Whether every writer has found its readers: each drone's and the bench's."""
        others = [w for link in self._links.values() for w in link.writers]
        return self._context.listeners > drones and all(w.listeners >= 2 for w in others)

    def fly(
        self, clock: WallClock, memory: PeerMemory, rules: PlaneRules, goodput_mbps: Callable[[], tuple[float, ...]]
    ) -> None:
        """Begin the flight: what comes in goes to `memory`, and processor time counts from here."""
        self._clock, self._memory, self._rules = clock, memory, rules
        self.goodput_mbps = goodput_mbps
        self._began_cpu_s = time.process_time()

    def watched(self, decide: Policy) -> Policy:
        """The policy, with a record of its time and of the health of every peer."""

        def watching(view: FleetView) -> Sequence[Directive]:
            self._note_health(view)
            begin_ns = time.thread_time_ns()
            directives = decide(view)
            self._new.decide_ns.append(time.thread_time_ns() - begin_ns)
            return directives

        return watching

    def wait(self, timeout_s: float) -> None:
        """Sleep until a sample arrives or the time is over."""
        self._bus.wait(timeout_s)

    def take(self) -> None:
        """Handle the samples that have arrived, directives first, because the gate may need them at once."""
        for link in list(self._links.values()):
            for cdr in link.ordered.take():
                self._on_directive(cdr, link.peer)
            for reader in link.incoming:
                for cdr in reader.take():
                    self._on_payload(cdr, reader)
        for cdr in self._fleet.take():
            self._on_descriptor(cdr)

    def report(self, t_s: float) -> Report:
        """The counts, and what happened since the last report."""
        new, self._new = self._new, SinceLastReport()
        return Report(
            self.drone, t_s, time.process_time() - self._began_cpu_s, self._published, self._heard, self._lost,
            dict(self._refused), self._late_s, dict(self._sent), dict(self._received), new,
        )  # fmt: skip

    # --- sortie.fleet.agent.Modem -----------------------------------------------------------------------

    goodput_mbps: Callable[[], tuple[float, ...]]

    def broadcast(self, datagram: bytes) -> None:
        self._published += 1
        self._context.write(datagram)

    def send(self, peer: int, payload: Payload, capture: Capture, deadline_s: float) -> None:
        """Publish a payload of its exact size: header and directive as they are, zeros for the features."""
        directive = self.gate.in_force(peer)
        if directive is None:
            return
        stamp_ns = round((capture.t_s + self._memory.status.clock_skew_s) * 1e9)
        header = _HEADER.pack(stamp_ns, self.drone, *capture.est_position_m, *capture.orientation_xyzw)
        content = (header + encode_directive(directive)).ljust(payload.size_bytes, b"\0")
        self._write(peer, TopicKind.of(payload.representation), content)

    def handshake(self, peer: int, size_bytes: int, capture: Capture, deadline_s: float) -> None:
        self._write(peer, TopicKind.FEATURES, bytes(size_bytes))

    # --- sortie.fleet.agent.AgentLog --------------------------------------------------------------------

    def descriptor(self, t_s: float, descriptor: Descriptor, wire_bytes: int) -> None:
        clock_s = t_s + self._memory.status.clock_skew_s
        self._late_s = max(self._late_s, clock_s - descriptor.stamp_ns * 1e-9)

    def directive(self, t_s: float, asked: Directive, enforced: Directive, link: LinkHealth, reason: str) -> None:
        rung = NAME_OF[enforced.representation]
        self._new.orders.append(NewDirective(t_s, self.drone, enforced.destination, rung, enforced.rate_hz, reason))

    def trust(self, t_s: float, drone: int, peer: int, standing: Standing) -> None:
        """Trust is off here."""

    def decision(self, t_s: float, drone: int, elapsed_ns: int, peer_ages_s: Sequence[float]) -> None:
        self.gate.republish()

    # --- what comes in ---------------------------------------------------------------------------

    def _on_descriptor(self, cdr: bytes) -> None:
        heard = open_descriptor(cdr)
        if isinstance(heard, Opened):
            sender = heard.descriptor.agent_id
            if sender == self.drone:
                return
            if self._loss and self._loss_stream(sender).random() < self._loss:
                self._lost += 1
                return
            if sender not in self._links:
                self._add_peer(sender)
        refused = self._memory.hear(heard, self._clock.now)
        if isinstance(refused, DropReason):
            self._refused[f"descriptor {refused}"] += 1
        else:
            self._heard += 1

    def _on_directive(self, cdr: bytes, peer: int) -> None:
        try:
            directive = decode_directive(cdr)
        except MalformedDatagram:
            self._refused["directive malformed"] += 1
            return
        if (directive.source, directive.destination) != (self.drone, peer):
            self._refused["directive of another link"] += 1
            return
        self.gate.apply(directive)

    def _on_payload(self, cdr: bytes, reader: Reader) -> None:
        kind = reader.topic.kind
        try:
            content = unpack_bytes(cdr)
            self._received[kind] = self._received[kind].plus(len(content))
            if len(content) < HEADER_BYTES + DIRECTIVE_BYTES or not any(content[:HEADER_BYTES]):
                return  # a handshake
            decode_directive(content[HEADER_BYTES : HEADER_BYTES + DIRECTIVE_BYTES])
        except MalformedDatagram:
            self._refused["payload malformed"] += 1
            return
        self._new.data_age_s.append(time.time() - _HEADER.unpack_from(content)[0] * 1e-9)

    # --- helpers ---------------------------------------------------------------------------------

    def _add_peer(self, peer: int) -> None:
        self._links[peer] = PeerTopics(self._bus, self.drone, peer)

    def _publish_directive(self, directive: Directive) -> None:
        self._sent[TopicKind.DIRECTIVE] = self._sent[TopicKind.DIRECTIVE].plus(DIRECTIVE_BYTES)
        self._links[directive.destination].directive.write(encode_directive(directive))

    def _write(self, peer: int, kind: TopicKind, content: bytes) -> None:
        self._sent[kind] = self._sent[kind].plus(len(content))
        self._links[peer].payload[kind].write(pack_bytes(content))

    def _loss_stream(self, sender: int) -> np.random.Generator:
        if sender not in self._draws:
            self._draws[sender] = stream(self._seed, 0, (sender, self.drone), "live loss")
        return self._draws[sender]

    def _note_health(self, view: FleetView) -> None:
        rules, now_s = self._rules, self._clock.now
        for peer in view.peers:
            age_s = view.age_s[peer]
            found = health(age_s, rules.descriptor_period_s, rules.degraded_after_periods, rules.detached_after_periods)
            if found != self._health.get(peer, LinkHealth.DETACHED):
                self._health[peer] = found
                self._new.health.append(HealthChange(now_s, self.drone, peer, found, age_s))


def open_descriptor(cdr: bytes) -> Opened | Dropped:
    """Check a descriptor. DDS fills samples to a multiple of 4 B, and a descriptor may end on 2 B."""
    whole = open_datagram(cdr, None)
    if isinstance(whole, Dropped) and cdr[-2:] == b"\0\0":
        shorter = open_datagram(cdr[:-2], None)
        return shorter if isinstance(shorter, Opened) else whole
    return whole
