"""One role of a drone as a node of its own: context publisher, policy node or gate, over any bus.

`sortie live` has all roles in one process. In ROS 2 (`ros2/sortie_ros`) each is a node. Both use the parts of
`sortie.fleet.agent.Agent`, `sortie.sim.live.node` and `sortie.sim.live.watchdog`.

    publisher    senses, and publishes the drone's descriptor
    policy node  reads all descriptors, its own drone's too; decides on every link in each frame, and repeats its directives
    gate         takes the pose from its own drone's descriptor, and sends what the directives allow

A gate that hears no directive for as long as peers would detach a silent drone applies the fallback to every link. A policy
node that hears no descriptor of its own drone for as long decides nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Any

import simpy

from sortie.fleet.agent import Agent, Alone
from sortie.fleet.coverage import View
from sortie.fleet.flight.frames import yaw_rad
from sortie.fleet.logs.geodesy import Origin
from sortie.fleet.memory import PeerMemory
from sortie.fleet.senses import Sensed
from sortie.perception.types import Capture
from sortie.policies.contract import Descriptor, Directive, FleetView
from sortie.policies.staleness import cap_by_age
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import phase_of
from sortie.sim.live.clock import WallClock
from sortie.sim.live.context import ReplaySenses, traces, unflown
from sortie.sim.live.events import LiveEvents, status_of
from sortie.sim.live.node import LiveNode, Role
from sortie.sim.live.platform import MavlinkLink, MavlinkSenses
from sortie.sim.live.policy_process import Begin, PolicyOrders, take_notices
from sortie.sim.live.reports import Report
from sortie.sim.live.rules import guard_of, rules_of
from sortie.sim.live.seals import Seals, Secrets
from sortie.sim.live.transport import Bus
from sortie.sim.live.watchdog import DETECTIONS, Fallback, Watchdog
from sortie.sim.results.record import Recorder

LONGEST_WAIT_S = 0.05


def _silent(text: str) -> None:
    """The publisher says what happens to the drone; its other nodes do not repeat it."""


@dataclass(frozen=True, slots=True)
class RoleOrders:
    """What a node is made with."""

    scenario: Scenario
    drone: int
    begin_unix_s: float
    """When the scenario's time 0 is, s since 1970; the same for all nodes."""
    secrets: Secrets | None
    """None: messages come bare."""
    fallback: Fallback = DETECTIONS
    mavlink: str | None = None
    origin: Origin | None = None
    mavlink_key: bytes | None = None
    """The signing key of the vehicle's link; None: signatures are not checked."""


class RoleNode:
    """A node with one role. `step` in a loop makes it work; `close` ends it."""

    def __init__(self, role: Role, bus: Bus, orders: RoleOrders) -> None:
        scenario, drone = orders.scenario, orders.drone
        self._role, self._fallback = role, orders.fallback
        self._bus, self._link, self._policy = bus, None, None
        trace = traces(scenario)[drone] if role == Role.PUBLISHER else unflown(scenario, drone)
        replay = ReplaySenses(scenario, drone, trace, 0.0)
        if role == Role.POLICY:
            self._policy = Watchdog(
                PolicyOrders(scenario, drone),
                fallback=orders.fallback,
                deadline_s=scenario.frame_s,
            )
            self._policy.wait_until_loaded()
        begin_monotonic_s = time.monotonic() + orders.begin_unix_s - time.time()
        self._clock = clock = WallClock(0.0, begin_monotonic_s)
        self._rules = rules = rules_of(scenario, 0.0, scenario.duration_s)
        self._memory = memory = PeerMemory(drone, rules, status_of(scenario, drone, orders.begin_unix_s))
        self._recorder, phase_s = Recorder(), phase_of(scenario, scenario.seed, 0, drone)
        self.node = node = LiveNode(
            bus, Seals(orders.secrets, drone), drone, scenario.fleet.drones, seed=scenario.seed, role=role
        )
        senses: ReplaySenses | MavlinkSenses = replay
        if role == Role.PUBLISHER and orders.mavlink is not None:
            self._link = MavlinkLink(orders.mavlink, orders.origin, orders.mavlink_key)
            self._link.wait_until_found()
            senses = MavlinkSenses(self._link, replay, drone, node.note, scenario.policy.hysteresis)
            senses.begin(-begin_monotonic_s, rules)
            node.is_muted = lambda: isinstance(senses, MavlinkSenses) and senses.muted
        self._senses = senses
        self._agent = Agent(
            clock,
            memory,
            rules=rules,
            pilot=Alone(
                self._decide,
                guard=guard_of(scenario, drone, clock, self._recorder) if role == Role.POLICY else None,
            ),
            senses=senses,
            modem=node,
            gate=node.gate,
            log=node,
            sealer=None,  # the node seals what it writes
            phase_s=phase_s,
        )
        node.fly(clock, memory, rules, senses.goodput_mbps)
        self._events = LiveEvents(
            scenario, drone, clock, memory.status, node.note if role == Role.PUBLISHER else _silent
        )
        if role == Role.PUBLISHER and orders.mavlink is None:
            self._events.follow(trace)
        if self._policy is not None:
            self._policy.begin(Begin(0.0, begin_monotonic_s), node.note, node.decided)
        self._looked_ns = 0
        self._by_fallback = self._alone = False
        clock.process(self._fly(phase_s))

    @property
    def over(self) -> bool:
        """Whether the scenario's time is over."""
        return float(self._clock.now) >= self._rules.frames * self._rules.period_s

    def step(self) -> None:
        """Wait for a message or the next moment to act, and handle what is due."""
        self._bus.wait(max(0.0, min(self._clock.peek() - self._clock.now, LONGEST_WAIT_S)))
        self._events.read()
        self.node.take()
        self._clock.catch_up()

    def report(self) -> Report:
        """The counts, and the events since the last report."""
        report = self.node.report(self._clock.now)
        report.new.notices.extend(take_notices(self._recorder))
        report.refused.update(self._senses.refused)
        return report

    def close(self) -> None:
        """End what the node has started."""
        if self._policy is not None:
            self._policy.close()
        if self._link is not None:
            self._link.close()

    def _fly(self, phase_s: float) -> Generator[simpy.Event, Any, None]:
        clock, period_s = self._clock, self._rules.period_s
        first = max(0, math.ceil((clock.now - phase_s) / period_s))  # a node that starts late leaves out what is past
        for frame in range(first, self._rules.frames):
            yield clock.timeout(max(0.0, frame * period_s + phase_s - clock.now))
            self._tick(frame)

    def _tick(self, frame: int) -> None:
        agent, own = self._agent, self.node.own
        if self._role == Role.PUBLISHER:
            if self._memory.status.airborne:
                agent.look(frame, agent.publish(frame))
        elif own is not None and self._role == Role.POLICY:
            if self._hears_itself():
                self.node.note_health(self._memory.view(self._clock.now))
                agent.decide(frame)
        elif own is not None and self._role == Role.GATE:
            agent.judge(frame)
            self._hold_links()
            if own.stamp_ns > self._looked_ns:  # without a new pose there is nothing to send
                self._looked_ns = own.stamp_ns
                agent.look(frame, self._sensed(own))

    def _hears_itself(self) -> bool:
        """Whether the drone's own descriptor is one that peers would still decide on. Without it, nothing is decided."""
        limit_s = self._rules.descriptor_period_s * self._rules.detached_after_periods
        alone = self._memory.heard_ago_s(self.node.drone, self._clock.now) > limit_s
        if alone and not self._alone:
            self.node.note("decides nothing: the drone's own descriptor does not come")
        self._alone = alone
        return not alone

    def _decide(self, view: FleetView) -> Sequence[Directive]:
        return () if self._policy is None else self._policy(view)

    def _hold_links(self) -> None:
        """Apply the fallback while the policy node is silent; its next directive ends that."""
        silent_s = self._clock.now - self.node.ordered_at_s
        if silent_s <= self._rules.descriptor_period_s * self._rules.detached_after_periods:
            self._by_fallback = False
            return
        if not self._by_fallback:
            self._by_fallback = True
            self.node.note("fallback: no directive from the policy node")
        rules, view = self._rules, self._memory.view(self._clock.now)
        for directive in self._fallback.directives(view, "the policy node is silent"):
            age_s = view.age_s[directive.destination]
            self.node.gate.apply(cap_by_age(directive, rules.health(age_s), age_s))

    def _sensed(self, own: Descriptor) -> Sensed:
        """The drone as its own descriptor states it; the look's coverage is the publisher's."""
        t_s = own.stamp_ns * 1e-9 - self._memory.status.clock_skew_s
        yaw = float(yaw_rad(own.orientation_xyzw))
        capture = Capture(own.agent_id, t_s, own.position_m, own.orientation_xyzw, own.position_m, yaw)
        return Sensed(
            capture, own.velocity_mps, own.footprint_radius_m, View(0, 0, own.coverage_grid), own.orientation_xyzw
        )
