"""What the scenario's events do to one drone of a live fleet: its clock, its lies, and whether it is in the fleet.

Clocks and lies act here, by the simulator's own code (`sortie.sim.engine.own_state`). Joins, departures and losses are
those of the simulated flight (`Trace.aloft`). A drone on the ground neither speaks nor hears.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from sortie.fleet.clock import oscillators
from sortie.fleet.plane import DroneStatus, codebooks
from sortie.scenarios.schema import ClockDrift, ClockSkew, GnssLoss, Lie, Scenario
from sortie.sim.engine.own_state import OwnEvent, OwnState, Told, whom
from sortie.sim.engine.world import INSTANT_S, at, with_frame
from sortie.sim.live.clock import WallClock
from sortie.sim.live.context import Trace


def status_of(scenario: Scenario, drone: int, zero_s: float) -> DroneStatus:
    """A live drone's status; a perfect clock shows `zero_s` at the scenario's time 0."""
    looks = not scenario.context_only[drone]
    codebook = codebooks(scenario)[drone]
    return DroneStatus(scenario.feature_spaces[drone], looks=looks, clock_skew_s=zero_s, codebook=codebook)


class OwnEvents:
    """Puts one drone's events on the wall clock. Those of before the flight act as it begins."""

    def __init__(
        self, scenario: Scenario, drone: int, clock: WallClock, status: DroneStatus, note: Callable[[str], None]
    ) -> None:
        """Args: `note` is called with each event as text; `status` is as `status_of` made it."""
        fleet = scenario.fleet
        drawn = oscillators(fleet.clock, fleet.drones, scenario.seed, 0)[drone]
        self._clock, self._status, self._note = clock, status, note
        self._state = OwnState(status, drawn, gnss=fleet.clock.gnss, zero_s=status.clock_skew_s)
        due = []
        for index, event in enumerate(scenario.events):
            if isinstance(event, ClockSkew | ClockDrift | GnssLoss | Lie) and drone in whom(event, fleet.drones):
                due.append((with_frame(event.at_s, scenario.frame_s), 0, index, event))
                if isinstance(event, GnssLoss | Lie) and event.until_s is not None:
                    due.append((with_frame(event.until_s, scenario.frame_s), 1, index, event))
        for at_s, over, index, event in sorted(due, key=lambda each: each[:3]):  # ends come after begins
            at(clock, at_s, partial(self._act, event, index, bool(over), at_s))
        self.read()

    def read(self) -> None:
        """Bring the drone's clock to the present."""
        self._state.read(float(self._clock.now))

    def follow(self, trace: Trace) -> None:
        """Be in the fleet when the drone of the simulated flight was, and say what happened to it."""
        clock, status = self._clock, self._status
        now_s = float(clock.now) + INSTANT_S
        status.airborne = any(since_s <= now_s < until_s for since_s, until_s in trace.aloft)
        for since_s, until_s in trace.aloft:
            if since_s > now_s:
                at(clock, since_s, self._join)
            if now_s < until_s < float("inf"):
                at(clock, until_s, status.leave)
        for t_s, text in trace.events:
            if t_s > now_s:
                at(clock, t_s, partial(self._note, text))

    def _join(self) -> None:
        self._status.airborne = True

    def _act(self, event: OwnEvent, index: int, over: bool, t_s: float) -> None:
        told: Told
        if over:
            assert isinstance(event, GnssLoss | Lie)  # noqa: S101 - the others have no end
            told = self._state.end(event, index, t_s)
        else:
            told = self._state.begin(event, index, t_s)
        self._note(told.text)
