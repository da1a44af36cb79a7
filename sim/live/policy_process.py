"""The policy node's process: it decides on the views that it is sent, and answers one at a time.

It is a process of its own, so that a policy that hangs, crashes or uses up memory cannot stop its drone.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.connection import Connection, wait
from typing import NamedTuple

from sortie.policies.contract import Directive, Disc, FleetView, PolicyError, Representation
from sortie.policies.registry import describe_error
from sortie.scenarios.exit_codes import FAILED
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.audit import Audit
from sortie.sim.engine.pilot import Pilot, plan_for, schedule_policies
from sortie.sim.live.clock import WallClock
from sortie.sim.live.reports import Notice
from sortie.sim.results.record import Recorder


@dataclass(frozen=True, slots=True)
class PolicyOrders:
    """What a policy's process is started with."""

    scenario: Scenario
    drone: int


class Begin(NamedTuple):
    """Time is `begin_s` when the host's monotonic clock shows `monotonic_s`. This is the first message to the process."""

    begin_s: float
    monotonic_s: float


class Ask(NamedTuple):
    """A view to decide on."""

    number: int
    view: FleetView


class Loaded(NamedTuple):
    """The policy is loaded, and can be asked. `fault` says why it cannot."""

    fault: str = ""


class Decision(NamedTuple):
    """The answer to a view."""

    number: int
    directives: tuple[Directive, ...] = ()
    fault: str = ""
    """Why there are no directives: what the policy raised, or what its directives break."""
    elapsed_ns: int = 0
    """Processor time of the decision."""
    cpu_s: float = 0.0
    """Processor time of the process since it was told to begin."""
    handshake_bytes: int = 0
    notices: tuple[Notice, ...] = ()


def serve(orders: PolicyOrders, pipe: Connection) -> None:
    """Answer views until the drone is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the bench handles Ctrl-C and stops every process
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        try:
            plan = plan_for(orders.scenario)._replace(replays=())
        except PolicyError as error:
            pipe.send(Loaded(str(error)))
            return
        pipe.send(Loaded())
        begin: Begin = pipe.recv()
        clock, recorder = WallClock(*begin), Recorder()
        pilot = Pilot(orders.drone, plan, Audit(clock, recorder))
        schedule_policies(clock, plan, [pilot], orders.scenario.frame_s)
        began_s = time.process_time()
        while True:
            ask: Ask = pipe.recv()
            clock.catch_up()
            decision = _decide(pilot, ask)
            pipe.send(
                decision._replace(
                    cpu_s=time.process_time() - began_s,
                    handshake_bytes=pilot.handshake_bytes,
                    notices=take_notices(recorder),
                )
            )
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


def _decide(pilot: Pilot, ask: Ask) -> Decision:
    begin_ns = time.thread_time_ns()
    try:
        directives = pilot(ask.view.frozen)
        elapsed_ns = time.thread_time_ns() - begin_ns
        pilot.check(directives, ask.view)
        return Decision(ask.number, tuple([_plain(d) for d in directives]), elapsed_ns=elapsed_ns)
    except Exception as error:
        return Decision(ask.number, fault=str(error) if isinstance(error, PolicyError) else describe_error(error))


def _plain(d: Directive) -> Directive:
    """The directive in types that every process knows; a policy may use subclasses of its own."""
    roi = None if d.roi is None else Disc(*(float(v) for v in d.roi))
    return Directive(
        int(d.source),
        int(d.destination),
        Representation(int(d.representation)),
        float(d.rho),
        roi,
        float(d.rate_hz),
        float(d.deadline_s),
        float(d.fusion_weight),
        int(d.duty_percent),
        str(d.reason),
    )


def take_notices(recorder: Recorder) -> tuple[Notice, ...]:
    """What the audit wrote since the last call."""
    rows = recorder.rows
    notices = [Notice(t_s, drone, text) for t_s, drone, _, text in rows["events"]]
    notices += [
        Notice(t_s, drone, f"{kind} → {peer}: {text}") for t_s, drone, peer, _, kind, text in rows["interventions"]
    ]
    rows["events"].clear()
    rows["interventions"].clear()
    return tuple(notices)


def _end_with_parent() -> None:
    """End this process when its drone is gone, also while its policy hangs."""
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(FAILED)
