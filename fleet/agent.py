"""One drone's part in the plane: it publishes its descriptor, reads the fleet, decides, gates and sends.

An agent sees its own state through `Senses`, the air through `Modem`, and other drones only through its `PeerMemory`.
It holds no other drone and no world. Each drone is one SimPy process that wakes once a frame.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
import simpy
from numpy.typing import NDArray

from sortie.fleet.chart import Chart
from sortie.fleet.coverage import LOOK_STANDS_S, NOTHING_SEEN, NOVEL_FLAG, TARGET_FLAG, View, placed
from sortie.fleet.gate import FoundLast, Gate, Payload, make_payload
from sortie.fleet.memory import PeerMemory
from sortie.fleet.messages.auth import Sealer
from sortie.fleet.messages.compact import FULL, encode_compact
from sortie.fleet.messages.wire import decode_descriptor, decode_directive, encode_descriptor, encode_directive
from sortie.fleet.peers import loops
from sortie.fleet.plane import FleetRules
from sortie.fleet.senses import Sensed
from sortie.fleet.standings import Standing
from sortie.fleet.trust import JUDGED_EVERY_S
from sortie.perception.budget import loops as cell_loops
from sortie.perception.motion import Tracks
from sortie.perception.types import Boxes, Capture, Found
from sortie.policies.checks import check_directives, differing
from sortie.policies.contract import (
    COVERAGE_CELL_M,
    COVERAGE_CELLS,
    PERSON_FLAG,
    Descriptor,
    Directive,
    Disc,
    FleetView,
    Policy,
    Roster,
    TaskPhase,
    nothing,
)
from sortie.policies.damping import apply_hysteresis
from sortie.policies.decision_loop import Change, DecisionLoop, Guard, OutgoingLink
from sortie.policies.geometry import rank_loop
from sortie.policies.staleness import LinkHealth
from sortie.scenarios.frames import instant


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
    person_in_region: bool = False
    """Whether its own thermal camera found a person in the region lately."""


class Senses(Protocol):
    """A drone's own sensors and mission computer."""

    def sense(self, frame: int) -> Sensed: ...
    def platform(self) -> Platform: ...
    def task(self) -> Task: ...
    def count_boxes(self, capture: Capture, roi: Disc | None) -> int: ...
    def perceived(self, capture: Capture) -> None: ...
    def tracks_in(self, capture: Capture, roi: Disc | None) -> Tracks | None: ...
    def people_in(self, capture: Capture, roi: Disc | None) -> Boxes: ...


class Modem(Protocol):
    """A drone's end of the air."""

    def broadcast(self, datagram: bytes) -> None: ...
    def send(self, peer: int, payload: Payload, capture: Capture, deadline_s: float) -> None: ...
    def handshake(self, peer: int, size_bytes: int, capture: Capture, deadline_s: float) -> None: ...
    def goodput_mbps(self, to: Sequence[int] | None = None, /) -> tuple[float, ...]: ...


class Decides(Protocol):
    """Who decides for a drone: its policy, and what stands about it."""

    @property
    def guard(self) -> Guard | None:
        """Has the last word before the gates; None where there are no invariants."""

    @property
    def handshake_bytes(self) -> int:
        """What its sharing method puts on every link and frame before payloads, at the moment."""

    def read(self, heard: FleetView) -> FleetView:
        """What the drone reads in place of what it heard."""

    def __call__(self, view: FleetView) -> Sequence[Directive]:
        """The directives, not yet checked."""

    def check(self, directives: Sequence[Directive], view: FleetView) -> None:
        """Refuse an answer that breaks the contract."""


@dataclass(frozen=True)
class Alone:
    """A policy, and nothing about it."""

    policy: Policy
    handshake_bytes: int = 0
    guard: Guard | None = None

    def read(self, heard: FleetView) -> FleetView:
        return heard

    def __call__(self, view: FleetView) -> Sequence[Directive]:
        return self.policy(view)

    def check(self, directives: Sequence[Directive], view: FleetView) -> None:
        check_directives(directives, view)


class Finds(Protocol):
    """What every drone found when it last fused."""

    def last(self, drone: int, roi: Disc | None) -> Found | None: ...


Ages = Sequence[float] | NDArray[np.float64]


class AgentLog(Protocol):
    """Where an agent's acts are written down."""

    def descriptor(self, t_s: float, descriptor: Descriptor, wire_bytes: int) -> None: ...
    def directive(self, t_s: float, asked: Directive, enforced: Directive, link: LinkHealth, reason: str) -> None: ...
    def trust(self, t_s: float, drone: int, peer: int, standing: Standing) -> None: ...
    def decision(self, t_s: float, drone: int, elapsed_ns: int, peer_ages_s: Ages) -> None: ...
    def event(self, t_s: float, drone: int, kind: str, text: str) -> None: ...
    def alert(self, t_s: float, drone: int, known: bool) -> None: ...


class Agent:
    """A drone from take-off until it lands, is lost, or the sortie ends."""

    def __init__(
        self,
        env: simpy.Environment,
        memory: PeerMemory,
        *,
        rules: FleetRules,
        pilot: Decides,
        senses: Senses,
        modem: Modem,
        gate: Gate,
        log: AgentLog,
        sealer: Sealer | None,
        phase_s: float,
        finding: Finds | None = None,
    ) -> None:
        """Put a drone together; `start` begins its process.

        Args:
            env: the clock.
            memory: the drone's number, its shared status, and what it receives.
            rules: the plane's periods.
            pilot: decides on the links once a frame.
            senses: the drone's own sensors.
            modem: the drone's end of the air.
            gate: enforces the directives.
            log: gets every act of the drone.
            sealer: signs descriptors; None publishes them unauthenticated.
            phase_s: when in each frame this drone acts.
            finding: has what the drone found when it last fused; None does not send it.
        """
        self.drone, self.status, self.memory = memory.drone, memory.status, memory
        self.here: Capture | None = None
        """The drone's pose in this frame, whether or not perception runs."""
        self.latest: Capture | None = None
        """The newest capture with computed features."""
        self._env = env
        self._rules = rules
        self._compute_delay_s = rules.equipment(self.drone).compute_delay_s
        self._pilot = pilot
        self._senses = senses
        self._modem = modem
        self._gate = gate
        self._log = log
        self._sealer = sealer
        self._phase_s = phase_s
        self._loop = DecisionLoop(self.drone, rules, pilot.guard)
        self._found_last: FoundLast | None = None if finding is None else partial(finding.last, self.drone)
        self._period_s = rules.descriptor_period_s
        self._encode = encode_descriptor if rules.form == FULL else partial(encode_compact, form=rules.form)
        self._fresh_s = rules.fresh_s
        self._answer: Sequence[Directive] = ()  # what the policy answered last; it was checked
        self._asked_of: dict[int, Directive] = {}  # the same by peer
        self._ids: NDArray[np.int64] | None = None  # `memory.ids` as it was then; None: check all anew
        table, row = memory.table, memory.row
        self._heard_s = table.heard_s[row]
        self._busy, self._at_rest, self._blamed = table.busy[row], table.at_rest[row], table.blamed[row]
        self._find_overdue = loops().overdue
        self._overdue_ids = np.empty(table.heard_s.shape[1], np.int64)  # that it writes into
        rank_loop()  # policies may rank peers, and gates count cells
        cell_loops()
        self._alert = False  # whether it knows of a person in its region
        self._last_own: Descriptor | None = None  # published or not
        self._roster = Roster(0, (self.drone,))
        self._listed: NDArray[np.int64] = np.empty(0, np.int64)
        """Those to whom its descriptor lists goodput."""
        self._chart = Chart()
        self._clock_off_s = 0.0
        self._look: Sensed | None = None
        """What it sensed at its latest look."""
        self._judged_every = max(1, round(JUDGED_EVERY_S / rules.period_s))

    def start(self) -> None:
        """Begin the drone's process; call once."""
        self._env.process(self._fly())

    def _fly(self) -> Generator[simpy.Event, Any, None]:
        env, rules, is_away = self._env, self._rules, False
        for frame in range(rules.frames):
            yield env.timeout(max(0.0, frame * rules.period_s + self._phase_s - env.now))
            if self.status.airborne:
                if is_away:
                    self._come_back()
                self._tick(frame)
            is_away = not self.status.airborne

    def _come_back(self) -> None:
        """Begin every link with nothing: the drone asked for nothing while it was away."""
        self._put_in_force(self._loop.come_back())
        self._ids = None  # what the policy answered then is no answer of now

    def _tick(self, frame: int) -> None:
        sensed = self.publish(frame)
        self.decide(frame)
        self.look(frame, sensed)

    def publish(self, frame: int) -> Sensed:
        """The publisher's part of a frame: sense, and publish the descriptor if one is due."""
        sensed = self._senses.sense(frame)
        self.here = sensed.capture
        own = self._publish(sensed, due=frame % self._rules.publish_every == 0)
        self.memory.hold(own, self._env.now)
        if frame % self._judged_every == 0:
            self._chart.fold(self.memory.believed())
            self._check_clock()
        return sensed

    def decide(self, frame: int) -> None:
        """The policy node's part: judge the peers' claims, and decide on every link."""
        self.judge(frame)
        self._decide()

    def judge(self, frame: int) -> None:
        """Judge the peers' claims, once a second."""
        if self._rules.trust and frame % self._judged_every == 0:
            for peer, standing in self.memory.judge(self._env.now):
                self._log.trust(self._env.now, self.drone, peer, standing)

    def look(self, frame: int, sensed: Sensed) -> None:
        """The gate's part: look in as many frames as its directives want, and send what the look gives."""
        duty = self._gate.duty_percent
        looks = self.status.looks and not self.status.blocked
        self.status.perceiving = looks and (frame + 1) * duty // 100 > frame * duty // 100
        self.status.work.looks += self.status.perceiving
        if self.status.perceiving:
            self._look = sensed
            delay_s = self._compute_delay_s + self.status.slowed_s
            self._env.timeout(delay_s, sensed.capture).callbacks.append(self._send)

    # --- the context plane ---------------------------------------------------------------------

    def _publish(self, sensed: Sensed, due: bool) -> Descriptor:
        """Publish this frame's descriptor if one is due, and return it as rounded by the wire."""
        capture, velocity_mps, footprint_m, here, orientation_xyzw = sensed
        grid, novel = self._covered(capture.t_s, here, due)
        soc, cpu_headroom, gpu_headroom = self._senses.platform()
        phase, region, target_ids, person = self._senses.task()
        roster = self._renew_roster(capture.est_position_m) if self._rules.roster else None
        descriptor = Descriptor(
            stamp_ns=round((capture.t_s + self.status.clock_skew_s) * 1e9),
            agent_id=self.drone,
            position_m=capture.est_position_m,
            orientation_xyzw=orientation_xyzw,
            velocity_mps=velocity_mps,
            footprint_radius_m=footprint_m,
            battery_soc=soc,
            cpu_headroom=cpu_headroom,
            gpu_headroom=gpu_headroom,
            peer_goodput_mbps=self._goodput_mbps(),
            coverage_grid=grid,
            novelty_flags=NOVEL_FLAG * novel + TARGET_FLAG * bool(target_ids) + PERSON_FLAG * person,
            task_phase=phase,
            region=region,
            priority_target_ids=target_ids,
            feature_space=self.status.feature_space,
            roster=roster,
            codebook=self.status.codebook,
        )
        if self._last_own is not None:
            # by the publisher, not by those who hear it: what they read would depend on which packets they lost
            descriptor = apply_hysteresis(self._last_own, descriptor, self._rules.hysteresis)
        self._last_own = descriptor
        if not due:
            return decode_descriptor(self._encode(descriptor))
        claimed = descriptor
        for lie in self.status.lies.values():
            claimed = lie(claimed)
        payload = self._encode(claimed)
        datagram = payload if self._sealer is None else self._sealer.seal(payload)
        self._modem.broadcast(datagram)
        self._log.descriptor(self._env.now, claimed, len(datagram))
        # a drone that lies decides by its true state
        return decode_descriptor(payload if claimed is descriptor else self._encode(descriptor))

    def _renew_roster(self, here_m: tuple[float, float, float]) -> Roster:
        """The drone's roster by what it has heard up to now; a new epoch where that is another set."""
        members = self.memory.members(self._env.now, here_m)
        if members != self._roster.members:
            self._roster = Roster(self._roster.epoch + 1, members)
            listed = np.array(members, np.int64)
            self._listed = listed[listed != self.drone]
        return self._roster

    def _goodput_mbps(self) -> tuple[float, ...]:
        """Goodput to the other members of its roster, to the scenario's whole fleet without one; probes stand where none was measured."""
        if self._rules.roster:
            measured_mbps = self._modem.goodput_mbps(self._listed.tolist())
        else:
            measured_mbps = self._modem.goodput_mbps()
            if len(measured_mbps) != len(self._listed):
                others = [i for i in range(len(measured_mbps) + 1) if i != self.drone]
                self._listed = np.array(others[: len(measured_mbps)], np.int64)
        return self.memory.probes.fill(self._listed, measured_mbps, self._env.now)

    def _covered(self, now_s: float, here: View, told: bool) -> tuple[bytes, bool]:
        """The coverage grid, by the latest look, and whether it shows what the fleet had not seen; nothing without a look."""
        look = self._look
        if look is None or instant(now_s - look.capture.t_s) > instant(LOOK_STANDS_S):
            return NOTHING_SEEN, False
        grid = placed(look.view, here.row, here.column)
        return self._chart.mark(grid, here.row, here.column, partial(self._seen_near, here), told)

    def _seen_near(self, here: View) -> list[Descriptor]:
        """The latest descriptors of believed peers whose grids may overlap one of these rows and columns."""
        y_m, x_m = ((corner + COVERAGE_CELLS // 2) * COVERAGE_CELL_M for corner in (here.row, here.column))
        return self.memory.believed_near(x_m, y_m, (COVERAGE_CELLS + 1) * COVERAGE_CELL_M)

    def _check_clock(self) -> None:
        """Report where the own clock is off the fleet's, and where it no longer is."""
        clocks = self.memory.clocks
        off_s = clocks.own_offset_s(self.memory.peers)
        if abs(off_s - self._clock_off_s) > clocks.delay_s / 2:
            self._clock_off_s = off_s
            way = "ahead of" if off_s > 0 else "behind"
            text = (
                f"clock {abs(off_s):.2f} s {way} the fleet's, ± {clocks.delay_s / 2:.2f} s: ages are corrected for it"
            )
            self._log.event(
                self._env.now, self.drone, "clock", text if off_s else "clock agrees with the fleet's again"
            )

    def _decide(self) -> None:
        now_s, me, memory = self._env.now, self.drone, self.memory
        ages = memory.ages(now_s)
        heard = memory.view(now_s, ages)
        view = self._pilot.read(heard)
        if self._rules.people and view.human_in_region != self._alert:
            self._alert = not self._alert
            self._log.alert(now_s, me, self._alert)
        begin_ns = time.perf_counter_ns()
        directives = self._pilot(view)
        elapsed_ns = time.perf_counter_ns() - begin_ns
        is_heard = view is heard
        known, changed = self._ids, None
        peers: list[int] | None = None  # all
        if is_heard and known is not None:
            changed = differing(self._answer, directives, view, self._asked_of)
        if changed is None:
            self._pilot.check(directives, view)
            self._asked_of = {d.destination: d for d in directives}
        else:
            due = {*self._overdue(ages, now_s), *[d.destination for d in changed]}
            if known is not None and known is not memory.ids:
                due.update(np.setdiff1d(memory.ids, known, assume_unique=True).tolist())
            peers = sorted(due - {me})
            self._asked_of.update([(d.destination, d) for d in changed])
        self._ids = memory.ids if is_heard else None
        self._answer = tuple(directives)
        begun = len(self._loop.links)
        decided = self._loop.decide(view, self._asked_of, now_s, peers)
        for peer in list(self._loop.links)[begun:] if len(self._loop.links) > begun else ():
            self._gate.enforce(nothing(me, peer, ""))  # until more is asked of it, it asks for perception in full
        self._note_links(decided.stepped, view, now_s)
        self._put_in_force(decided.changes)
        self.status.work.decisions += 1
        if is_heard:
            others: Ages = ages.take(memory.others)
        else:
            others = [age_s for peer, age_s in view.age_s.items() if peer != me]
        self._log.decision(now_s, me, elapsed_ns, others)

    def _overdue(self, ages_s: NDArray[np.float64], now_s: float) -> list[int]:
        """Peers to which the link's directive may change although the policy asks for nothing new."""
        found = self._overdue_ids
        count = self._find_overdue(
            self.drone,
            now_s,
            self._fresh_s,
            self._period_s,
            self._rules.degraded_after_periods,
            self.memory.clocks.delay_s,
            self.memory.ids,
            ages_s,
            self._heard_s,
            self._busy,
            self._at_rest,
            self._blamed,
            found,
        )
        return found[:count].tolist() if count else []

    def _note_links(self, stepped: Iterable[OutgoingLink], view: FleetView, now_s: float) -> None:
        """Keep in the table which links may change by themselves."""
        for link in stepped:
            self._blame_clock(link.peer, link.health, view.age_s[link.peer], now_s)
            self._at_rest[link.peer], self._busy[link.peer] = link.is_at_rest, link.is_busy

    def _put_in_force(self, changes: Iterable[Change]) -> None:
        """Hand the links' gates their new directives, as the wire rounds them."""
        for asked, directive, fidelity in changes:
            enforced = decode_directive(encode_directive(directive))
            self._gate.enforce(enforced)
            self._log.directive(self._env.now, asked, enforced, fidelity, directive.reason)

    def _blame_clock(self, peer: int, fidelity: LinkHealth, age_s: float, now_s: float) -> None:
        """Report a link that begins to be reduced because a descriptor was too old by its stamp when it came."""
        heard_ago_s, before = self.memory.heard_ago_s(peer, now_s), self._blamed[peer]
        self._blamed[peer] = is_blamed = (
            fidelity != LinkHealth.FRESH and age_s - heard_ago_s > self.memory.clocks.delay_s
        )
        if is_blamed and not before:
            text = (
                f"link to {peer} {fidelity.name.lower()}: its descriptor came {heard_ago_s:.2f} s ago and is {age_s:.2f} s "
                "old by its stamp: a clock is wrong, or it waited for the channel"
            )
            self._log.event(now_s, self.drone, "clock", text)

    # --- the data plane ------------------------------------------------------------------------

    def _send(self, computed: simpy.Event) -> None:
        """The capture's features are there: hand each link that is due what its directive allows."""
        capture = cast(Capture, computed.value)
        is_old = self.latest is not None and capture.t_s < self.latest.t_s  # it took longer than a later one
        if is_old or not self.status.airborne:
            return
        self.latest = capture
        self._senses.perceived(capture)
        handshake_bytes = self._pilot.handshake_bytes
        if handshake_bytes:
            self._shake_hands(handshake_bytes, capture)
        pose, count_boxes = capture.est_pose, partial(self._senses.count_boxes, capture)
        tracks_in, rules = partial(self._senses.tracks_in, capture), self._rules
        people_in = partial(self._senses.people_in, capture) if rules.people else None
        made: dict[tuple[Any, ...], Payload | None] = {}  # what goes to several peers is made once
        for directive in self._gate.due(self._env.now):
            what = (directive.representation, directive.rho, directive.roi, directive.fusion_weight)
            if what not in made:
                payload = make_payload(
                    directive,
                    *pose,
                    count_boxes,
                    rules.tile_limit_bytes,
                    tracks_in,
                    people_in,
                    self._found_last,
                    classes=rules.classes,
                    code_bytes=rules.code_bytes,
                    bring_look=rules.maps_bring_looks,
                )
                if payload is not None and (self.status.feature_space or self.status.codebook):
                    payload = payload._replace(
                        feature_space=self.status.feature_space,
                        codebook=self.status.codebook if payload.code_bytes else "",
                    )
                made[what] = payload
            payload = made[what]
            if payload is not None:
                self.status.work.payload_bytes += payload.size_bytes
                self._modem.send(directive.destination, payload, capture, directive.deadline_s)

    def _shake_hands(self, size_bytes: int, capture: Capture) -> None:
        """Send the method's request or answer to every peer that is not detached."""
        limit_s = self._period_s * self._rules.detached_after_periods
        for peer, age_s in self.memory.ages_s(self._env.now).items():
            if peer != self.drone and age_s <= limit_s:
                self.status.work.payload_bytes += size_bytes
                self._modem.handshake(peer, size_bytes, capture, self._rules.period_s)
