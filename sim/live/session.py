"""A live flight from its begin to its end: fly for the traces, start the processes, measure, bring everybody home."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from sortie.fleet import chart, peers
from sortie.fleet.logs.geodesy import Origin
from sortie.scenarios.frames import frame_at
from sortie.scenarios.schema import Scenario
from sortie.sim.export.endpoint import parse_address
from sortie.sim.folders import RunError
from sortie.sim.live.bench import Bench, FleetReports
from sortie.sim.live.bus import Bus
from sortie.sim.live.context import traces
from sortie.sim.live.drone import Orders, fly_one
from sortie.sim.live.reports import Failed, Go, Home, Ready, Report
from sortie.sim.live.result import LiveResult, Lost, summarise
from sortie.sim.live.scope import left_out
from sortie.sim.live.seals import secrets_of
from sortie.sim.live.watchdog import DETECTIONS, Fallback

MAX_DRONES = 20
"""The most processes that this starts on one host."""
CONNECT_S = 90.0
"""The longest time for the processes to start and to find one another."""
LEAD_S = 0.3
"""From the start signal until the flight begins."""
LAST_REPORT_S = 30.0
"""The longest time from the end of the flight until a process sends its last report. One that hangs is lost."""
EXIT_S = 5.0
"""The longest time for a process to end after the flight."""
Progress = Callable[[str, float, float], None]


@dataclass
class _Drone:
    orders: Orders
    process: BaseProcess
    pipe: Connection
    over: bool = False


def fly_live(
    scenario: Scenario,
    *,
    begin_s: float = 0.0,
    duration_s: float | None = None,
    loss: float = 0.0,
    kill: tuple[int, float] | None = None,
    start: tuple[int, float] | None = None,
    domain: int = 0,
    key: bytes | None = None,
    fallback: Fallback | None = None,
    decide_within_s: float | None = None,
    mavlink: Sequence[str] = (),
    origin: Origin | None = None,
    mavlink_key: bytes | None = None,
    warn: Callable[[str], None] | None = None,
    progress: Progress | None = None,
    begun: Callable[[dict[int, int]], None] | None = None,
) -> LiveResult:
    """Fly a scenario's context plane over DDS in real time, with one process per drone.

    Args:
        scenario: the scenario; its policy decides on every drone.
        begin_s: the scenario's time at which the fleet begins, at the begin of its frame.
        duration_s: how long it flies, s; None: to the scenario's end.
        loss: share of descriptors that each drone drops on arrival, 0 … 1.
        kill: a drone whose process is killed (SIGKILL), and the scenario's time when.
        start: a drone and the scenario's time, at the begin of its frame, when its process joins the others. If it was
            killed before, it comes back; otherwise it is not there before.
        domain: DDS domain, as `ROS_DOMAIN_ID`.
        key: the master key of 32 B, from which every drone gets its secrets; None: a new random one. Unused where the
            scenario's `context.authentication` is off.
        fallback: what links get while a policy gives no answer; None: detections at 2 Hz.
        decide_within_s: the longest time for one decision; None: one frame.
        mavlink: where the vehicles of drones 0, 1, … are heard: `udpin:HOST:PORT` or `udpout:HOST:PORT`. Further drones
            replay.
        origin: where ENU (0, 0, 0) lies for these vehicles; None: at the origin of each vehicle's own estimator.
        mavlink_key: the signing key of these links, 32 B; messages without a valid signature are refused. None: signatures
            are not checked.
        warn: called with one line that names what of the scenario the flight does not use, if it sets any such thing.
        progress: called with (what is done, how much of it, of how much).
        begun: called with the process ids by drone when the fleet begins to fly.

    Returns:
        The measurements. After Ctrl-C they are of the part that was flown, and `interrupted` is true.

    Raises:
        RunError: options that do not fit the scenario, processes that do not find one another, or a vehicle that is not
            heard.
        PolicyError: an unknown policy, or one that breaks its contract.
    """
    end_s = scenario.duration_s if duration_s is None else begin_s + duration_s
    _check(scenario, begin_s, end_s, loss, kill, start, decide_within_s, mavlink)
    unused = left_out(scenario, range(len(mavlink)))
    if unused and warn is not None:
        warn(unused)
    report_progress = progress or (lambda what, done, of: None)
    peers.loops(), chart.loops()  # compiled and kept here, so that no drone's process has to while it is waited for
    found = traces(
        scenario.model_copy(update={"duration_s": end_s}),
        lambda t_s: report_progress("flying for the context", t_s, end_s),
    )
    begin_s = _frame_of(begin_s, scenario)
    if start is not None:
        start = start[0], _frame_of(start[1], scenario)
    drones, master = scenario.fleet.drones, key or os.urandom(32)
    authentic = scenario.context.authentication
    bench, fleet = Bench(Bus(domain), drones), FleetReports()
    flown: list[_Drone] = []
    lost: list[Lost] = []
    t_s = begin_s
    present = frozenset(range(drones))
    if start is not None and (kill is None or kill[0] != start[0]):
        present -= {start[0]}

    def orders_of(drone: int, from_s: float, late: bool) -> Orders:
        held = secrets_of(master, drone) if authentic else None
        vehicle = mavlink[drone] if drone < len(mavlink) else None
        return Orders(
            scenario,
            drone,
            found[drone],
            from_s,
            end_s,
            loss,
            domain,
            present,
            held,
            fallback or DETECTIONS,
            decide_within_s,
            vehicle,
            origin,
            mavlink_key,
            late,
        )

    try:
        flown += [_start(orders_of(drone, begin_s, late=False)) for drone in sorted(present)]
        if start is not None:
            flown.append(_start(orders_of(start[0], start[1], late=True)))
        _wait_until_connected(flown, report_progress)
        go = Go(time.monotonic() + LEAD_S, time.time_ns() + round(LEAD_S * 1e9))
        for process in flown:
            after_s = process.orders.begin_s - begin_s
            process.pipe.send(Go(go.monotonic_s + after_s, go.unix_ns + round(after_s * 1e9)))
        bench.begin()
        time.sleep(LEAD_S)
        if begun is not None:
            begun({d.orders.drone: d.process.pid or 0 for d in flown if not d.orders.late})
        with _stop_on_interrupt() as stop:
            while not (stop.is_set() or all(d.over for d in flown)):
                now_s = begin_s + time.monotonic() - go.monotonic_s
                t_s = min(end_s, now_s)
                if kill is not None and t_s >= kill[1]:
                    _kill(next(d.process for d in flown if d.orders.drone == kill[0]))
                    kill = None
                bench.wait(0.05)
                bench.take()
                _collect(flown, fleet, lost, t_s)
                report_progress("in the air", t_s - begin_s, end_s - begin_s)
                if now_s > end_s + LAST_REPORT_S:
                    lost += _hanging(flown, fleet, begin_s)
                    break
        interrupted = stop.is_set()
        if interrupted:
            _request_stop(flown)
            _collect(flown, fleet, lost, t_s)
        if not fleet.last:
            raise RunError("no drone's process lived long enough to report" + (f": {lost[0].how}" if lost else ""))
        return summarise(
            scenario,
            bench,
            fleet,
            begin_s=begin_s,
            flown_s=t_s - begin_s,
            loss=loss,
            lost=lost,
            interrupted=interrupted,
        )
    finally:
        _clean_up(flown)


def _frame_of(t_s: float, scenario: Scenario) -> float:
    """When the frame of this moment begins: a process replays whole frames, and its clock begins with the first."""
    return frame_at(t_s, scenario.frame_s) * scenario.frame_s


def _check(
    scenario: Scenario,
    begin_s: float,
    end_s: float,
    loss: float,
    kill: tuple[int, float] | None,
    start: tuple[int, float] | None,
    decide_within_s: float | None,
    mavlink: Sequence[str],
) -> None:
    drones = scenario.fleet.drones
    if drones > MAX_DRONES:
        raise RunError(f"fleet.drones is {drones}, live flights have at most {MAX_DRONES}: each is a process")
    if not 0 <= begin_s < end_s <= scenario.duration_s:
        raise RunError(
            f"the flight is to be from {begin_s:g} s to {end_s:g} s, must be within the scenario's "
            f"{scenario.duration_s:g} s"
        )
    if decide_within_s is not None and not 0 < decide_within_s <= 1:
        raise RunError(f"decide_within_s is {decide_within_s:g}, must be in (0, 1]")
    if len(mavlink) > drones:
        raise RunError(f"there are {len(mavlink)} MAVLink addresses, must be at most {drones}, one for each drone")
    for address in mavlink:
        parse_address(address)
    if mavlink:
        # here, before a process of a drone finds pymavlink missing
        import_module("sortie.fleet.logs.mavlink")
    if not 0 <= loss <= 1:
        raise RunError(f"loss is {loss:g}, must be in [0, 1]")
    if kill is not None and not (0 <= kill[0] < drones and begin_s < kill[1] < end_s):
        raise RunError(f"kill {kill[0]}@{kill[1]:g}: must be a drone below {drones} and a time in the flight")
    if start is not None and not (0 <= start[0] < drones and begin_s < start[1] < end_s):
        raise RunError(f"start {start[0]}@{start[1]:g}: must be a drone below {drones} and a time in the flight")
    if start is not None and kill is not None and start[0] == kill[0] and start[1] <= kill[1]:
        raise RunError(f"start {start[0]}@{start[1]:g}: must be after the kill at {kill[1]:g} s")


def _start(orders: Orders) -> _Drone:
    """A new process; spawned, not forked: the bench's DDS threads would not survive a fork. It starts one of its own."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=fly_one, args=(orders, theirs), name=f"drone {orders.drone}")
    with _ignoring_interrupts():
        process.start()
    theirs.close()  # so that our end shows when the process is gone
    return _Drone(orders, process, ours)


@contextmanager
def _stop_on_interrupt() -> Iterator[threading.Event]:
    """Ctrl-C as an event to check. An exception would be lost if it came while the bus frees a sample."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = signal.signal(signal.SIGINT, lambda *_: stop.set())
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _ignoring_interrupts() -> Iterator[None]:
    """Processes that are started here ignore Ctrl-C from the start, because they inherit ignored signals."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set signals; `fly_one` ignores Ctrl-C later
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _wait_until_connected(flown: list[_Drone], report_progress: Progress) -> None:
    """Wait until every process has found all others. One that has may still end while the others start."""
    drone_of, until_s = {id(d.pipe): d for d in flown}, time.monotonic() + CONNECT_S
    waiting = dict(drone_of)
    while waiting:
        report_progress("starting the processes", len(flown) - len(waiting), len(flown))
        for pipe in wait([d.pipe for d in flown], timeout=0.2):
            message = _receive(pipe)  # type: ignore[arg-type]
            if isinstance(message, Ready):
                del waiting[id(pipe)]
            elif message is None:
                raise RunError(f"{drone_of[id(pipe)].process.name} ended before the flight began")
        if time.monotonic() > until_s:
            names = ", ".join(d.process.name for d in waiting.values())
            raise RunError(
                f"{names} did not find the others within {CONNECT_S:g} s: is loopback allowed (CYCLONEDDS_URI)?"
            )
    report_progress("starting the processes", len(flown), len(flown))


def _collect(flown: list[_Drone], fleet: FleetReports, lost: list[Lost], t_s: float) -> None:
    """Read every report that has arrived. A pipe that closes before its drone has ended means a lost drone."""
    for drone in flown:
        while not drone.over and drone.pipe.poll():
            message = _receive(drone.pipe)
            if isinstance(message, Report):
                fleet.add(message, drone.orders.late)
            elif isinstance(message, Home):
                drone.over = True
            elif message is None:
                drone.over = True
                drone.process.join(EXIT_S)
                lost.append(Lost(drone.orders.drone, t_s, _describe_exit(drone.process.exitcode)))


def _hanging(flown: list[_Drone], fleet: FleetReports, begin_s: float) -> Iterator[Lost]:
    """The processes that have not ended, as lost at their latest reports."""
    for drone in flown:
        if not drone.over:
            last = fleet.last.get((drone.orders.drone, drone.orders.late))
            yield Lost(drone.orders.drone, begin_s if last is None else last.t_s, _describe_exit(None))


def _receive(pipe: Connection) -> object | None:
    """The next message of a process; None if the process is gone.

    Raises:
        SortieError: what stopped it, such as a policy that cannot be loaded or a vehicle that is not heard.
    """
    try:
        message: object = pipe.recv()
    except (EOFError, ConnectionResetError):
        return None
    if isinstance(message, Failed):
        raise message.error
    return message


def _describe_exit(exitcode: int | None) -> str:
    """How a process ended, as text."""
    if exitcode is None:
        return "does not answer"
    return f"was killed by {signal.Signals(-exitcode).name}" if exitcode < 0 else f"ended with exit code {exitcode}"


def _kill(process: BaseProcess) -> None:
    if process.pid is not None and process.is_alive():
        os.kill(process.pid, signal.SIGKILL)


def _request_stop(flown: list[_Drone]) -> None:
    """Ask all processes to end, and give them time for a last report."""
    for drone in flown:
        try:
            drone.pipe.send(None)
        except OSError:
            continue  # it is gone already
    for drone in flown:
        drone.process.join(EXIT_S)


def _clean_up(flown: list[_Drone]) -> None:
    """End all processes, whatever happened."""
    for drone in flown:
        drone.pipe.close()  # a process that still waits for this one ends by itself
    for drone in flown:
        drone.process.join(EXIT_S)
        if drone.process.is_alive():
            drone.process.kill()
            drone.process.join()
