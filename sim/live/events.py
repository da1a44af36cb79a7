"""What the scenario's events do to one drone of a live fleet: its clock, its lies, and whether it is in the fleet.

Clocks and lies act here, as in a simulated flight (`Event.acts_live`). Joins, departures and losses are those of the
simulated flight (`Trace.aloft`). A drone on the ground neither speaks nor hears.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from sortie.fleet.clock import DroneClock, oscillators
from sortie.fleet.plane import DroneStatus, codebooks
from sortie.scenarios.frames import with_frame
from sortie.scenarios.schema import Event, Lasting, Scenario
from sortie.scenarios.schema.events.base import About, Claim
from sortie.sim.engine.events import Going
from sortie.sim.engine.world import at
from sortie.sim.live.clock import WallClock
from sortie.sim.live.context import Trace


def status_of(scenario: Scenario, drone: int, zero_s: float) -> DroneStatus:
    """A live drone's status; a perfect clock shows `zero_s` at the scenario's time 0."""
    looks = not scenario.context_only[drone]
    codebook = codebooks(scenario)[drone]
    return DroneStatus(scenario.feature_spaces[drone], looks=looks, clock_skew_s=zero_s, codebook=codebook)


@dataclass(frozen=True)
class LiveFleet:
    """What an event of a live flight acts on: one drone's clock and words (`sortie.scenarios.schema.events.base.Fleet`)."""

    t_s: float
    index: int
    drone: int
    own_clock: DroneClock
    status: DroneStatus
    tell: Callable[[str], None]

    @property
    def members(self) -> tuple[int]:
        return (self.drone,)

    def note(self, text: str, drone: int = -1, kind: str | None = None) -> None:
        self.tell(text)

    def lift(self) -> None:
        self.status.lift(self.index)

    def clock(self, drone: int) -> DroneClock:
        return self.own_clock

    def read_clocks(self) -> None:
        self.own_clock.read(self.t_s)

    def lie(self, drone: int, about: About, claim: Claim) -> None:
        self.status.lie(self.index, about, claim)


class LiveEvents:
    """Puts one drone's events on the wall clock. Those of before the flight act as it begins."""

    def __init__(
        self, scenario: Scenario, drone: int, clock: WallClock, status: DroneStatus, note: Callable[[str], None]
    ) -> None:
        """Args: `note` is called with each event as text; `status` is as `status_of` made it."""
        clocks = scenario.fleet.clock
        drawn = oscillators(clocks, scenario.fleet.drones, scenario.seed, 0)[drone]
        self._clock, self._drone, self._status, self._note = clock, drone, status, note
        self._own_clock = DroneClock(status, drawn, gnss=clocks.gnss, zero_s=status.clock_skew_s)
        self._going = Going()
        due: list[tuple[float, bool, int, Event]] = []
        for index, event in enumerate(scenario.events):
            if event.acts_live and getattr(event, "drone", None) in (None, drone):
                due.append((with_frame(event.at_s, scenario.frame_s), False, index, event))
                if isinstance(event, Lasting) and event.until_s is not None:
                    due.append((with_frame(event.until_s, scenario.frame_s), True, index, event))
        for at_s, over, index, event in sorted(due, key=lambda each: each[:3]):  # ends come after begins
            at(clock, at_s, partial(self._act, event, index, over, at_s))
        self.read()

    def read(self) -> None:
        """Bring the drone's clock to the present."""
        self._own_clock.read(float(self._clock.now))

    def follow(self, trace: Trace) -> None:
        """Be in the fleet when the drone of the simulated flight was, and say what happened to it."""
        clock, status = self._clock, self._status
        now_s = float(clock.now)
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

    def _act(self, event: Event, index: int, over: bool, t_s: float) -> None:
        fleet = LiveFleet(t_s, index, self._drone, self._own_clock, self._status, self._note)
        if over and isinstance(event, Lasting):
            self._going.end(event, fleet)
        else:
            self._going.begin(event, fleet)
