"""One drone's part in the plane: publish, read the fleet, decide, gate, send; and hold what arrives.

An agent sees its own state through `Senses`, the air through `Modem`, and other drones only through what it
heard: it holds no other drone and no world. One SimPy process a drone, one wake-up a frame.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol, cast

import simpy

from sortie.fleet.coverage import NOVEL_FLAG, TARGET_FLAG
from sortie.fleet.gate import Gate, Payload, make_payload
from sortie.fleet.messages.auth import Dropped, DropReason, Inbox, Opened, Sealer
from sortie.fleet.messages.compact import FULL, Form, encode_compact
from sortie.fleet.messages.wire import decode_descriptor, decode_directive, encode_descriptor, encode_directive
from sortie.fleet.senses import Sensed
from sortie.fleet.staleness import LinkHealth, cap_by_age, health
from sortie.fleet.trust import JUDGED_EVERY_S, UNJUDGED, Arrival, Standing, could_tell, discounted, judge
from sortie.perception.types import Capture
from sortie.policies.contract import (
    Descriptor,
    Directive,
    Disc,
    FleetView,
    Policy,
    TaskPhase,
    check_directives,
    nothing,
)
from sortie.policies.damping import LinkState, apply_hysteresis, damp

_FRESH = LinkHealth.FRESH


class Platform(NamedTuple):
    """What a drone knows about its own body, fractions 0 … 1."""

    soc: float
    cpu_headroom: float
    gpu_headroom: float


class Task(NamedTuple):
    """What a drone is to do now."""

    phase: TaskPhase
    region: Disc | None
    target_ids: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class PlaneRules:
    """The plane's periods, the same for every drone."""

    period_s: float
    frames: int
    degraded_after_periods: float
    detached_after_periods: float
    dwell_s: float
    hysteresis: float
    compute_delay_s: float
    tile_limit_bytes: int | None = None
    """Features go as tiles of at most so many bytes; None: as one sample."""
    trust: bool = False
    """Whether peers' claims are judged (`sortie.fleet.trust`)."""
    publish_every: int = 1
    """A descriptor every so many frames; staleness counts in periods of that length."""
    form: Form = FULL
    """How finely descriptors are written."""

    @property
    def descriptor_period_s(self) -> float:
        """From one descriptor of a drone to its next."""
        return self.period_s * self.publish_every


class Received(NamedTuple):
    """One payload as it arrived: what it shows, and of when."""

    capture: Capture
    payload: Payload
    t_done_s: float
    missing: tuple[int, ...] = ()
    """Ranks (0 the best) of its feature cells that did not come, ascending."""
    phy_mbps: float = math.inf
    """The data rate at which its frames came."""


class Senses(Protocol):
    """A drone's own sensors and mission computer."""

    def sense(self, frame: int) -> Sensed: ...
    def platform(self) -> Platform: ...
    def task(self) -> Task: ...
    def count_boxes(self, capture: Capture, roi: Disc | None) -> int: ...


class Modem(Protocol):
    """A drone's end of the air."""

    def broadcast(self, datagram: bytes) -> None: ...
    def send(self, peer: int, payload: Payload, capture: Capture, deadline_s: float) -> None: ...
    def handshake(self, peer: int, size_bytes: int, capture: Capture, deadline_s: float) -> None: ...
    def goodput_mbps(self) -> tuple[float, ...]: ...


class AgentLog(Protocol):
    """Where an agent's acts are written down."""

    def descriptor(self, t_s: float, descriptor: Descriptor, wire_bytes: int) -> None: ...
    def directive(self, t_s: float, asked: Directive, enforced: Directive, link: LinkHealth, reason: str) -> None: ...
    def trust(self, t_s: float, drone: int, peer: int, standing: Standing) -> None: ...
    def decision(self, t_s: float, drone: int, elapsed_ns: int, peer_ages_s: Sequence[float]) -> None: ...


class _OutgoingLink:
    """An outgoing link: what its gate enforces, and what was last asked of it while its peer was fresh."""

    __slots__ = ("asked", "state")

    def __init__(self, me: int, peer: int) -> None:
        self.state = LinkState(nothing(me, peer, ""))
        self.asked: Directive | None = None


class Agent:
    """A drone from take-off until it lands, is lost, or the sortie ends."""

    def __init__(
        self,
        env: simpy.Environment,
        drone: int,
        *,
        rules: PlaneRules,
        policy: Policy,
        senses: Senses,
        modem: Modem,
        log: AgentLog,
        sealer: Sealer | None,
        phase_s: float,
        handshake_bytes: int = 0,
    ) -> None:
        """Args: `phase_s` is when in each frame this drone acts; `sealer` None publishes unauthenticated.

        `handshake_bytes` is what its sharing method puts on every link and frame before payloads.
        """
        self.env = env
        self.drone = drone
        self.policy = policy  # may be replaced while the sortie flies
        self.clock_skew_s = 0.0
        self.airborne = True
        self.lies: dict[int, Callable[[Descriptor], Descriptor]] = {}
        """What it says against the truth; scenario events put them here."""
        self.sensed = False  # whether perception ran in the current frame
        self.here: Capture | None = None
        """Its body in this frame, whether perception runs or rests."""
        self.latest: Capture | None = None
        """The newest look whose features are computed."""
        self.held: dict[int, Received] = {}
        self.inbox = Inbox()
        self._rules = rules
        self._senses = senses
        self._modem = modem
        self._log = log
        self._sealer = sealer
        self._phase_s = phase_s
        self._period_s = rules.descriptor_period_s
        self._encode = encode_descriptor if rules.form == FULL else partial(encode_compact, form=rules.form)
        self._fresh_s = self._period_s * rules.degraded_after_periods  # surely fresh: no rule to ask
        self._claims: dict[int, Descriptor] = {}
        self._known: dict[int, Descriptor] = {}  # what policies read of them; by ascending id
        self._heard_at_s: dict[int, float] = {}
        self._links: dict[int, _OutgoingLink] = {}
        self._standings: dict[int, Standing] = {}
        self._doubted: frozenset[int] = frozenset()
        self._arrivals: dict[int, list[Arrival]] = {}
        self._judged_at_s = -math.inf
        self._judged_every = max(1, round(JUDGED_EVERY_S / rules.period_s))
        self.gate = Gate()
        self.handshake_bytes = handshake_bytes  # goes with the policy

    def start(self) -> None:
        """Begin the drone's process; call once."""
        self.env.process(self._fly())

    def stop(self) -> None:
        """The drone leaves the plane for good."""
        self.airborne = False

    def hear(self, opened: Opened | Dropped) -> DropReason | None:
        """A datagram came in: one that may be believed replaces the descriptor held of its sender (keep-last-1).

        Returns:
            Why it was refused, None where it was not.
        """
        heard = self.inbox.accept(opened)
        if isinstance(heard, DropReason):
            return heard
        if heard.agent_id != self.drone:
            self._hold(heard)
        return None

    def _hold(self, descriptor: Descriptor) -> None:
        known, sender = self._known, descriptor.agent_id
        self._claims[sender] = descriptor
        if sender in known:
            known[sender] = apply_hysteresis(known[sender], descriptor, self._rules.hysteresis)
        else:  # by ascending id, so that the order of hearing decides nothing
            self._known = dict(sorted([*known.items(), (sender, descriptor)]))
        self._heard_at_s[sender] = self.env.now

    def receive(self, received: Received) -> None:
        """A peer's payload arrived; the freshest capture is kept, late ones do not replace newer ones."""
        peer = received.capture.drone
        held = self.held.get(peer)
        if self._rules.trust:
            took_s = received.t_done_s - received.capture.t_s - self._rules.compute_delay_s
            self._arrivals.setdefault(peer, []).append(
                Arrival(
                    0 if received.missing else received.payload.size_bytes, took_s, received.phy_mbps, received.t_done_s
                )
            )
        if self.airborne and (held is None or received.capture.t_s >= held.capture.t_s):
            self.held[peer] = received

    def _fly(self) -> Generator[simpy.Event, Any, None]:
        env, rules = self.env, self._rules
        for frame in range(rules.frames):
            yield env.timeout(max(0.0, frame * rules.period_s + self._phase_s - env.now))
            if not self.airborne:
                return
            self._tick(frame)

    def _tick(self, frame: int) -> None:
        sensed = self._senses.sense(frame)
        self.here = sensed.capture
        self._hold(self._publish(sensed, due=frame % self._rules.publish_every == 0))
        if self._rules.trust and frame % self._judged_every == 0:
            self._judge()
        self._decide()
        duty = self.gate.duty_percent
        self.sensed = (frame + 1) * duty // 100 > frame * duty // 100
        if self.sensed:
            self.env.timeout(self._rules.compute_delay_s, sensed.capture).callbacks.append(self._send)

    # --- the context plane ---------------------------------------------------------------------

    def _publish(self, sensed: Sensed, due: bool) -> Descriptor:
        """Publish this frame's descriptor, where one is due; returns it as every peer reads it, rounded by the wire."""
        capture, velocity_mps, footprint_m, grid, novel = sensed
        soc, cpu_headroom, gpu_headroom = self._senses.platform()
        phase, region, target_ids = self._senses.task()
        descriptor = Descriptor(
            # A clock may be skewed below zero at the very begin; the wire's nanoseconds are unsigned.
            stamp_ns=round((capture.t_s + self.clock_skew_s) * 1e9),
            agent_id=self.drone,
            position_m=capture.est_position_m,
            orientation_xyzw=capture.orientation_xyzw,
            velocity_mps=velocity_mps,
            footprint_radius_m=footprint_m,
            battery_soc=soc,
            cpu_headroom=cpu_headroom,
            gpu_headroom=gpu_headroom,
            peer_goodput_mbps=self._modem.goodput_mbps(),
            coverage_grid=grid,
            novelty_flags=NOVEL_FLAG * novel + TARGET_FLAG * bool(target_ids),
            task_phase=phase,
            region=region,
            priority_target_ids=target_ids,
        )
        if not due:
            return decode_descriptor(self._encode(descriptor))
        told = descriptor
        for lie in self.lies.values():
            told = lie(told)
        payload = self._encode(told)
        datagram = payload if self._sealer is None else self._sealer.seal(payload)
        self._modem.broadcast(datagram)
        self._log.descriptor(self.env.now, told, len(datagram))
        # a liar decides by what is true
        return decode_descriptor(payload if told is descriptor else self._encode(descriptor))

    def _ages_s(self) -> dict[int, float]:
        """Age of every descriptor held, by this drone's clock and never less than the time since it came in."""
        now_s = self.env.now
        clock_s, heard_at_s = now_s + self.clock_skew_s, self._heard_at_s
        return {
            i: stamped_s if (stamped_s := clock_s - d.stamp_ns * 1e-9) > (heard_s := now_s - heard_at_s[i]) else heard_s
            for i, d in self._known.items()
        }

    def trust_in(self, peer: int) -> float:
        """What this drone thinks of a peer, 0 … 1; payloads are fused with their weight times this."""
        return self._standings.get(peer, UNJUDGED).trust

    def _judge(self) -> None:
        """Hold what peers claimed since the last time against what is known otherwise, each claim once."""
        now_s, before = self.env.now, self._standings
        since_s, self._judged_at_s = max(now_s - self._fresh_s, self._judged_at_s), now_s
        heard = {i: self._claims[i] for i in self._known if self._heard_at_s[i] > since_s}
        arrivals, too_old_s = {}, now_s - max(2.0 * JUDGED_EVERY_S, 2.0 * self._period_s)
        for i, came in self._arrivals.items():
            told_s = min(self._heard_at_s[i], heard[i].stamp_ns * 1e-9) if i in heard else too_old_s
            arrivals[i], later = could_tell(came, told_s)
            self._arrivals[i] = [a for a in later if a.t_done_s > too_old_s]
        self._standings = after = judge(before, self.drone, heard, arrivals, self._rules.form)
        self._doubted = frozenset([i for i, s in after.items() if s.trust < 1.0])
        for peer in heard:
            if after[peer].trust != before.get(peer, UNJUDGED).trust:
                self._log.trust(now_s, self.drone, peer, after[peer])

    def _decide(self) -> None:
        now_s, me, links, fresh_s = self.env.now, self.drone, self._links, self._fresh_s
        ages_s = self._ages_s()
        known = dict(self._known)
        for doubted in self._doubted:
            known[doubted] = discounted(known[doubted])
        view = FleetView(me, self._period_s, known, ages_s)
        begin_ns = time.perf_counter_ns()
        directives = self.policy(view)
        elapsed_ns = time.perf_counter_ns() - begin_ns
        check_directives(directives, view)
        asked_of = {d.destination: d for d in directives}
        peer_ages_s = []
        for peer, age_s in ages_s.items():
            if peer == me:
                continue
            peer_ages_s.append(age_s)
            link = links.get(peer)
            if link is None:
                link = links[peer] = _OutgoingLink(me, peer)
                self.gate.enforce(link.state.enforced)  # until more is asked of it, it asks for perception in full
            asked = asked_of.get(peer) or nothing(me, peer, "the policy gave no directive")
            changed = asked is not link.asked and asked != link.asked
            if changed or age_s > fresh_s or link.state.upgrade_since_s is not None:
                self._enforce(link, asked, age_s, now_s)
        self._log.decision(now_s, me, elapsed_ns, peer_ages_s)

    def _enforce(self, link: _OutgoingLink, asked: Directive, age_s: float, now_s: float) -> None:
        """Staleness, then damping, then the wire, then the gate; nothing where nothing changed."""
        rules, before = self._rules, link.state
        fidelity, link.asked, capped = _FRESH, asked, asked
        if age_s > self._fresh_s:
            fidelity = health(age_s, self._period_s, rules.degraded_after_periods, rules.detached_after_periods)
            link.asked, capped = None, cap_by_age(asked, fidelity, age_s)
        link.state = after = damp(before, capped, now_s, rules.dwell_s)
        if after.enforced is not before.enforced and after.enforced != before.enforced:
            enforced = decode_directive(encode_directive(after.enforced))
            self.gate.enforce(enforced)
            self._log.directive(now_s, asked, enforced, fidelity, after.enforced.reason)

    # --- the data plane ------------------------------------------------------------------------

    def _send(self, computed: simpy.Event) -> None:
        """The capture's features are there: hand each link that is due what its directive allows."""
        if not self.airborne:
            return
        self.latest = capture = cast(Capture, computed.value)
        if self.handshake_bytes:
            self._shake_hands(capture)
        pose, count_boxes = capture.est_pose, partial(self._senses.count_boxes, capture)
        made: dict[tuple[Any, ...], Payload | None] = {}  # what goes to several peers is made once
        for directive in self.gate.due(self.env.now):
            what = (directive.representation, directive.rho, directive.roi, directive.fusion_weight)
            if what not in made:
                made[what] = make_payload(directive, *pose, count_boxes, self._rules.tile_limit_bytes)
            payload = made[what]
            if payload is not None:
                self._modem.send(directive.destination, payload, capture, directive.deadline_s)

    def _shake_hands(self, capture: Capture) -> None:
        """What the method asks and answers before payloads, to every peer that is not detached."""
        limit_s = self._period_s * self._rules.detached_after_periods
        for peer, age_s in self._ages_s().items():
            if peer != self.drone and age_s <= limit_s:
                self._modem.handshake(peer, self.handshake_bytes, capture, self._rules.period_s)
