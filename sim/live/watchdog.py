"""A drone's watchdog over its policy: a decision has a deadline, and a safe rung takes over until the policy answers.

answers in time         its directives
raises, breaks rules    the fallback, for this decision
is late                 the fallback until it answers; when a peer as silent would be detached, its process is killed
its process ends        the fallback; a new process is started, at most one each `RESTART_S`
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import NamedTuple

from sortie.policies.contract import DIRECTIVE_BOUNDS, Directive, FleetView, PolicyError, Representation
from sortie.scenarios.representation import NAME_OF
from sortie.sim.folders import RunError
from sortie.sim.live.policy_process import Ask, Begin, Decision, Loaded, PolicyOrders, serve

RESTART_S = 1.0
"""The shortest time from one start of the process to the next."""
LOAD_S = 300.0
"""The longest time for a policy to load."""
_EXIT_S = 2.0


class Fallback(NamedTuple):
    """What each link gets while the policy does not answer."""

    representation: Representation = Representation.DETECTIONS
    rate_hz: float = 2.0

    def directives(self, view: FleetView, reason: str) -> list[Directive]:
        """The same to every peer; the staleness rules then leave out peers that are detached."""
        return [
            Directive(view.ego, peer, self.representation, rate_hz=self.rate_hz, reason=f"fallback: {reason}")
            for peer in view.peers
        ]


DETECTIONS = Fallback()
"""The paper's lowest rung."""


def parse_fallback(text: str) -> Fallback:
    """`none`, `detections@2` or `tracks@5`: a representation and its rate in Hz.

    Raises:
        RunError: it is none of these.
    """
    safe = {NAME_OF[r]: r for r in (Representation.NONE, Representation.TRACKS, Representation.DETECTIONS)}
    name, _, rate = text.partition("@")
    try:
        rate_hz = float(rate) if name != "none" else 0.0
        if (
            name in safe
            and DIRECTIVE_BOUNDS["rate_hz"].breaks("rate", rate_hz) is None
            and (name != "none" or not rate)
        ):
            return Fallback(safe[name], rate_hz)
    except ValueError:
        pass
    most = DIRECTIVE_BOUNDS["rate_hz"].high
    raise RunError(f"fallback is {text!r}, must be none, detections@RATE or tracks@RATE with at most {most:g} Hz")


class Watchdog:
    """A policy in a process of its own, as a policy that always answers in time."""

    def __init__(self, orders: PolicyOrders, *, fallback: Fallback, deadline_s: float) -> None:
        """
        Args:
            orders: what the process is started with.
            fallback: what links get without the policy.
            deadline_s: the longest time for a decision; the drone waits so long at most once for a policy that hangs.
        """
        self._orders, self._fallback, self._deadline_s = orders, fallback, deadline_s
        context = orders.scenario.context
        self._hangs_s = context.detached_after_periods * context.publish_every * orders.scenario.frame_s
        """A policy that has not answered for this long is killed: after as long, a silent peer is detached."""
        self._begin: Begin | None = None
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None
        self._loaded = False
        self._asked_s: float | None = None
        """When the policy was asked what it has not answered yet."""
        self._started_s = 0.0
        self._number = 0
        self._down_since: tuple[float, int] | None = None
        self._ended_cpu_s = self._cpu_s = 0.0
        self.handshake_bytes = 0
        self.fallbacks = 0
        """Decisions by the fallback."""
        self.restarts = 0
        self._start()

    @property
    def cpu_s(self) -> float:
        """Processor time of the policy's processes in flight."""
        return self._ended_cpu_s + self._cpu_s

    @property
    def pid(self) -> int | None:
        """Number of the present process."""
        return None if self._process is None else self._process.pid

    def wait_until_loaded(self) -> None:
        """Wait for the policy before the flight.

        Raises:
            PolicyError: it cannot be loaded.
        """
        whose = f"the policy of drone {self._orders.drone}"
        if self._pipe is None or not self._pipe.poll(LOAD_S):
            raise PolicyError(f"{whose} did not load within {LOAD_S:g} s")
        try:
            loaded: Loaded = self._pipe.recv()
        except (EOFError, ConnectionResetError) as error:
            raise PolicyError(f"the process of {whose} ended as it loaded") from error
        if loaded.fault:
            raise PolicyError(loaded.fault)

    def begin(self, begin: Begin, note: Callable[[str], None], decided: Callable[[Decision], None]) -> None:
        """Start the clock of the loaded policy.

        Args:
            begin: the time.
            note: called with each event as text.
            decided: called with each answer; one that was late or gave no directives comes without its processor time.
        """
        self._note, self._decided = note, decided
        assert self._pipe is not None  # noqa: S101 - it was loaded just now
        self._begin, self._loaded = begin, True
        try:
            self._pipe.send(begin)
        except (BrokenPipeError, ConnectionResetError):
            # it ended after it was loaded; the first decision starts a new one
            self._end(kill=False)

    def __call__(self, view: FleetView) -> Sequence[Directive]:
        """The policy's directives, or the fallback's."""
        answer = self._ask(view)
        if isinstance(answer, Decision):
            self._cpu_s, self.handshake_bytes = answer.cpu_s, answer.handshake_bytes
            if not answer.fault:
                if self._down_since is not None:
                    since_s, before = self._down_since
                    self._down_since = None
                    lasted_s, by_fallback = time.monotonic() - since_s, self.fallbacks - before
                    self._note(
                        f"the policy decides again after {lasted_s:.1f} s and {by_fallback} decisions by fallback"
                    )
                self._decided(answer)
                return answer.directives
            self._decided(answer._replace(elapsed_ns=0))
        reason = answer.fault if isinstance(answer, Decision) else answer
        if self._down_since is None:
            self._down_since = time.monotonic(), self.fallbacks
            rung = NAME_OF[self._fallback.representation]
            self._note(f"fallback to {rung} at {self._fallback.rate_hz:g} Hz: {reason}")
        self.fallbacks += 1
        return self._fallback.directives(view, reason)

    def close(self) -> None:
        """End the process."""
        self._end(kill=True)

    # --- the process -----------------------------------------------------------------------------

    def _ask(self, view: FleetView) -> Decision | str:
        """The decision on a view, or why there is none."""
        try:
            if self._pipe is None:
                return self._restart()
            if not self._loaded:
                why_not = self._finish_loading()
                if why_not:
                    return why_not
            if self._asked_s is not None:
                return self._late(view)
            return self._ask_now(view)
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return self._end(kill=False)

    def _ask_now(self, view: FleetView) -> Decision | str:
        assert self._pipe is not None  # noqa: S101 - `_ask` has checked
        self._number += 1
        self._pipe.send(Ask(self._number, view))
        if self._pipe.poll(self._deadline_s):
            decision: Decision = self._pipe.recv()
            return decision
        self._asked_s = time.monotonic() - self._deadline_s
        return f"the policy did not answer within {self._deadline_s:g} s"

    def _late(self, view: FleetView) -> Decision | str:
        """A late answer is on an old view, so it is dropped, and the policy is asked anew."""
        assert self._pipe is not None  # noqa: S101 - `_ask` has checked
        assert self._asked_s is not None  # noqa: S101 - `_ask` has checked
        if self._pipe.poll():
            late: Decision = self._pipe.recv()
            self._decided(late._replace(elapsed_ns=0))
            self._asked_s = None
            return self._ask_now(view)
        waited_s = time.monotonic() - self._asked_s
        if waited_s > self._hangs_s:
            self._end(kill=True)
            self._note(f"the policy's process was killed: no answer for {waited_s:.1f} s")
        return f"the policy did not answer within {self._deadline_s:g} s"

    def _finish_loading(self) -> str:
        """Why a new process cannot decide yet; empty once it can."""
        assert self._pipe is not None  # noqa: S101 - `_ask` has checked
        assert self._begin is not None  # noqa: S101 - a process is restarted in flight alone
        if not self._pipe.poll():
            if time.monotonic() - self._started_s > LOAD_S:
                self._end(kill=True)
                self._note(f"the policy's process was killed: it did not load within {LOAD_S:g} s")
            return "the policy's process is starting"
        loaded: Loaded = self._pipe.recv()
        if loaded.fault:
            self._end(kill=True)
            return loaded.fault
        self._pipe.send(self._begin)
        self._loaded = True
        return ""

    def _restart(self) -> str:
        if time.monotonic() - self._started_s >= RESTART_S:
            self.restarts += 1
            self._start()
        return "the policy's process is starting"

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would copy the bus without its threads
        ours, theirs = context.Pipe()
        name = f"policy of drone {self._orders.drone}"
        process = context.Process(target=serve, args=(self._orders, theirs), name=name, daemon=True)
        process.start()
        theirs.close()
        self._process, self._pipe, self._loaded, self._asked_s = process, ours, False, None
        self._started_s = time.monotonic()

    def _end(self, *, kill: bool) -> str:
        process, pipe = self._process, self._pipe
        self._process = self._pipe = self._asked_s = None
        self._ended_cpu_s, self._cpu_s = self.cpu_s, 0.0
        if pipe is not None:
            pipe.close()
        if process is None:
            return ""
        if not kill:
            process.join(_EXIT_S)
        process.kill()  # unless it has ended
        process.join(_EXIT_S)
        code = process.exitcode
        return f"the policy's process ended with exit code {code}"
