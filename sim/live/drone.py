"""One drone as one OS process: its nodes on the bus, its agent on the wall's clock, a pipe to the bench."""

from __future__ import annotations

import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection

from sortie.fleet import chart, peers
from sortie.fleet.agent import Agent
from sortie.fleet.logs.geodesy import Origin
from sortie.fleet.memory import PeerMemory
from sortie.policies.checks import check_directives
from sortie.policies.contract import Directive, FleetView
from sortie.policies.decision_loop import Guard
from sortie.scenarios.errors import SortieError
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import phase_of
from sortie.sim.folders import RunError
from sortie.sim.live.bus import Bus
from sortie.sim.live.clock import WallClock
from sortie.sim.live.context import ReplaySenses, Trace
from sortie.sim.live.events import LiveEvents, status_of
from sortie.sim.live.node import LiveNode
from sortie.sim.live.platform import MavlinkLink, MavlinkSenses
from sortie.sim.live.policy_process import Begin, PolicyOrders, take_notices
from sortie.sim.live.reports import Failed, Go, Home, Ready
from sortie.sim.live.rules import guard_of, rules_of
from sortie.sim.live.seals import Seals, Secrets
from sortie.sim.live.watchdog import DETECTIONS, Fallback, Watchdog
from sortie.sim.results.record import Recorder

POLL_S = 0.02
"""How often a process that waits for others looks at its pipe."""


@dataclass(frozen=True, slots=True)
class Orders:
    """What a drone's process is started with."""

    scenario: Scenario
    drone: int
    trace: Trace
    begin_s: float
    """The scenario's time at which the replay begins."""
    end_s: float
    loss: float
    domain: int
    present: frozenset[int]
    """Drones that are there from the begin; the drone waits until it has found them, unless it starts later."""
    secrets: Secrets | None = None
    """None: the fleet's messages come bare."""
    fallback: Fallback = DETECTIONS
    decide_within_s: float | None = None
    """None: one frame."""
    mavlink: str | None = None
    """Where the drone's vehicle is heard; None: its poses and charge are replayed."""
    origin: Origin | None = None
    """Where ENU (0, 0, 0) lies for vehicles; None: each vehicle's own local origin."""
    mavlink_key: bytes | None = None
    """The signing key of the vehicle's link; None: signatures are not checked."""
    late: bool = False
    """Whether it starts when others are in the air."""


def fly_one(orders: Orders, pipe: Connection) -> None:
    """The process of one drone: ready, go, fly, report. It ends with its flight, or when the bench says so or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the bench handles Ctrl-C and stops every process
    scenario, drone = orders.scenario, orders.drone
    policy: Watchdog | None = None
    link: MavlinkLink | None = None
    try:
        policy = Watchdog(
            PolicyOrders(scenario, drone),
            fallback=orders.fallback,
            deadline_s=scenario.frame_s if orders.decide_within_s is None else orders.decide_within_s,
        )
        peers.loops(), chart.loops()  # loaded before the drone says that it is ready, which takes a second
        replay = ReplaySenses(scenario, drone, orders.trace, orders.begin_s)
        go = None
        if orders.late:
            policy.wait_until_loaded()
            go = _wait_for_start(drone, pipe)
            if go is None:
                return
        node = LiveNode(
            Bus(orders.domain),
            Seals(orders.secrets, drone),
            drone,
            scenario.fleet.drones,
            seed=scenario.seed,
            loss=orders.loss,
        )
        senses: ReplaySenses | MavlinkSenses = replay
        if orders.mavlink is not None:
            link = MavlinkLink(orders.mavlink, orders.origin, orders.mavlink_key)
            link.wait_until_found()
            senses = MavlinkSenses(link, replay, drone, node.note, scenario.policy.hysteresis)
        if go is None:
            while not node.all_found(orders.present):
                if pipe.poll(POLL_S):
                    return
            policy.wait_until_loaded()
            pipe.send(Ready(drone))
            go = pipe.recv()
        if isinstance(go, Go):
            policy.begin(Begin(orders.begin_s, go.monotonic_s), node.note, node.decided)
            _fly(orders, node, policy, senses, go, pipe)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # nobody is left to report to
    except SortieError as error:
        pipe.send(Failed(drone, error))
    except OSError as error:
        pipe.send(Failed(drone, RunError(str(error))))
    finally:
        if policy is not None:
            policy.close()
        if link is not None:
            link.close()
        pipe.close()


def _wait_for_start(drone: int, pipe: Connection) -> Go | None:
    """Be ready, and wait off the bus until it is time to start; None if the flight ends before."""
    pipe.send(Ready(drone))
    go = pipe.recv()
    if isinstance(go, Go) and not pipe.poll(max(0.0, go.monotonic_s - time.monotonic())):
        return go
    pipe.send(Home(drone))
    return None


class LivePilot:
    """A watched policy, and what the node says of each view (`sortie.fleet.agent.Decides`)."""

    def __init__(self, node: LiveNode, policy: Watchdog, guard: Guard | None) -> None:
        self._node, self._policy, self.guard = node, policy, guard

    @property
    def handshake_bytes(self) -> int:
        return self._policy.handshake_bytes

    def read(self, heard: FleetView) -> FleetView:
        return heard

    def __call__(self, view: FleetView) -> Sequence[Directive]:
        self._node.note_health(view)
        return self._policy(view)

    def check(self, directives: Sequence[Directive], view: FleetView) -> None:
        check_directives(directives, view)


def _fly(
    orders: Orders, node: LiveNode, policy: Watchdog, senses: ReplaySenses | MavlinkSenses, go: Go, pipe: Connection
) -> None:
    scenario, drone = orders.scenario, orders.drone
    time.sleep(max(0.0, go.monotonic_s - time.monotonic()))
    clock = WallClock(orders.begin_s, go.monotonic_s)
    rules = rules_of(scenario, orders.begin_s, orders.end_s)
    phase_s = phase_of(scenario, scenario.seed, 0, drone)
    # stamps are nanoseconds since 1970, as in ROS 2
    memory = PeerMemory(drone, rules, status_of(scenario, drone, go.unix_ns * 1e-9 - orders.begin_s))
    recorder = Recorder()

    agent = Agent(
        clock,
        memory,
        rules=rules,
        pilot=LivePilot(node, policy, guard_of(scenario, drone, clock, recorder)),
        senses=senses,
        modem=node,
        gate=node.gate,
        log=node,
        sealer=None,  # the node seals what it writes
        phase_s=orders.begin_s + phase_s,
    )
    node.fly(clock, memory, rules, senses.goodput_mbps)
    events = LiveEvents(scenario, drone, clock, memory.status, node.note)
    if isinstance(senses, MavlinkSenses):  # its vehicle says where it is, and whether it flies
        senses.begin(orders.begin_s - go.monotonic_s, rules)
        node.is_muted = lambda: senses.muted
    else:
        events.follow(orders.trace)
    agent.start()
    if orders.late:
        node.note("its process started")

    def send_report() -> None:
        report = node.report(clock.now)
        report.new.notices.extend(take_notices(recorder))
        report.refused.update(senses.refused)
        pipe.send(
            replace(
                report, cpu_s=report.cpu_s + policy.cpu_s, fallbacks=policy.fallbacks, policy_restarts=policy.restarts
            )
        )

    reported_s = orders.begin_s
    while clock.now < orders.end_s and not pipe.poll():
        node.wait(min(clock.peek(), orders.end_s) - clock.now)
        events.read()
        node.take()
        clock.catch_up()
        if clock.now - reported_s >= 1.0:
            reported_s = clock.now
            send_report()
    send_report()
    pipe.send(Home(drone))
