"""One drone as one OS process: its nodes on the bus, its agent on the wall's clock, a pipe to the bench."""

from __future__ import annotations

import signal
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection

from sortie.fleet.agent import Agent
from sortie.fleet.memory import PeerMemory
from sortie.fleet.plane import DroneStatus, PlaneRules
from sortie.policies.contract import PolicyError
from sortie.scenarios.schema import Scenario
from sortie.scenarios.streams import stream
from sortie.sim.engine.pilot import Audit, Pilot, plan_of, schedule_policies
from sortie.sim.engine.sortie import PHASE_SHARE
from sortie.sim.engine.world import at
from sortie.sim.live.bus import Bus
from sortie.sim.live.clock import WallClock
from sortie.sim.live.context import ReplaySenses, Trace
from sortie.sim.live.node import LiveNode
from sortie.sim.live.reports import Failed, Go, Home, Notice, Ready, Report
from sortie.sim.live.seals import Seals, Secrets
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
    secrets: Secrets | None = None
    """None: the fleet's messages come bare."""


def rules_of(scenario: Scenario, begin_s: float, end_s: float) -> PlaneRules:
    """The plane's rules on the bus: samples go whole, descriptors in full."""
    return PlaneRules(
        period_s=scenario.frame_s,
        frames=round((end_s - begin_s) / scenario.frame_s),
        degraded_after_periods=scenario.context.degraded_after_periods,
        detached_after_periods=scenario.context.detached_after_periods,
        dwell_s=scenario.policy.dwell_s,
        hysteresis=scenario.policy.hysteresis,
        compute_delay_s=scenario.perception.compute_delay_s,
        publish_every=scenario.context.publish_every,
        trust=scenario.context.trust,
    )


def fly_one(orders: Orders, pipe: Connection) -> None:
    """The process of one drone: ready, go, fly, report. It ends with its flight, or when the bench says so or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the bench handles Ctrl-C and stops every process
    try:
        node = LiveNode(
            Bus(orders.domain), Seals(orders.secrets, orders.drone), orders.drone, orders.scenario.fleet.drones,
            seed=orders.scenario.seed, loss=orders.loss,
        )  # fmt: skip
        senses = ReplaySenses(orders.scenario, orders.drone, orders.trace, orders.begin_s)
        while not node.all_found(orders.scenario.fleet.drones):
            if pipe.poll(POLL_S):
                return
        pipe.send(Ready(orders.drone))
        go = pipe.recv()
        if isinstance(go, Go):
            _fly(orders, node, senses, go, pipe)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # nobody is left to report to
    except (PolicyError, OSError) as error:
        pipe.send(Failed(orders.drone, str(error)))
    finally:
        pipe.close()


def _fly(orders: Orders, node: LiveNode, senses: ReplaySenses, go: Go, pipe: Connection) -> None:
    scenario, drone = orders.scenario, orders.drone
    time.sleep(max(0.0, go.monotonic_s - time.monotonic()))
    clock = WallClock(orders.begin_s, go.monotonic_s)
    recorder = Recorder()
    plan = plan_of(scenario.policy)._replace(replays=())
    pilot = Pilot(drone, plan, Audit(clock, recorder))
    rules = rules_of(scenario, orders.begin_s, orders.end_s)
    phase_s = PHASE_SHARE * scenario.frame_s * float(stream(scenario.seed, 0, drone, "phase").random())
    # stamps are nanoseconds since 1970, as in ROS 2
    memory = PeerMemory(drone, rules, DroneStatus(clock_skew_s=go.unix_ns * 1e-9 - orders.begin_s))
    agent = Agent(
        clock,
        memory,
        rules=rules,
        policy=node.watched(pilot),
        senses=senses,
        modem=node,
        gate=node.gate,
        log=node,
        sealer=None,  # the node seals what it writes
        phase_s=orders.begin_s + phase_s,
        handshake_bytes=pilot.handshake_bytes,
    )
    node.fly(clock, memory, rules, senses.goodput_mbps)
    schedule_policies(clock, plan, [pilot], scenario.frame_s)
    if orders.trace.end_s < orders.end_s:
        at(clock, orders.trace.end_s, memory.status.leave)
    agent.start()

    def send_report() -> None:
        pipe.send(_with_notices(node.report(clock.now), recorder))

    reported_s = orders.begin_s
    while clock.now < orders.end_s and not pipe.poll():
        node.wait(min(clock.peek(), orders.end_s) - clock.now)
        node.take()
        clock.catch_up()
        if clock.now - reported_s >= 1.0:
            reported_s = clock.now
            send_report()
    send_report()
    pipe.send(Home(drone))


def _with_notices(report: Report, recorder: Recorder) -> Report:
    """The report with what the audit wrote since the last one."""
    for t_s, drone, _, text in recorder.rows["events"]:
        report.new.notices.append(Notice(t_s, drone, text))
    for t_s, drone, peer, _, kind, text in recorder.rows["interventions"]:
        report.new.notices.append(Notice(t_s, drone, f"{kind} → {peer}: {text}"))
    recorder.rows["events"].clear()
    recorder.rows["interventions"].clear()
    return report
