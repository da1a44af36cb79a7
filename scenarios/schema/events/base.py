"""What every event is: its fields, what it does to a fleet as it begins and ends, and what it can do of that.

A kind of event is one class of this folder, and nothing else names it. `Fleet` is all that an event, one of the
user's own too, sees of the fleet and may do to it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from sortie.scenarios.schema.base import DroneId, Section
from sortie.scenarios.schema.movement import GroundStation

About = Literal["coverage", "goodput", "battery"]
Claim = Literal["much", "little"]
Misfit = tuple[str, str, str]
"""A field, its value and its bound, as errors have them."""


class Fleet(Protocol):
    """The fleet as an event sees it, and what may happen to it.

    What an event does to links, jammers, cameras, computers and words lasts until it lifts it.
    """

    @property
    def t_s(self) -> float:
        """Now, s."""

    @property
    def frame_s(self) -> float:
        """The time between two frames, s."""

    @property
    def index(self) -> int:
        """The event's place among the scenario's."""

    @property
    def prepared(self) -> Any:
        """What the event's `prepare` returned."""

    @property
    def members(self) -> Sequence[int]:
        """Whom it may change: all drones, in `sortie live` one."""

    @property
    def positions_m(self) -> NDArray[np.float64]:
        """[N, 3], ENU: where the drones are."""

    @property
    def airborne(self) -> NDArray[np.bool_]:
        """[N]: who flies."""

    def note(self, text: str, drone: int = -1, kind: str | None = None) -> None:
        """Write a line among the sortie's events. Drone −1 is the whole fleet; None is the event's own kind."""

    def lift(self) -> None:
        """Take back all that this event did and that lasts."""

    def rng(self, entity: int | tuple[int, ...], purpose: str) -> np.random.Generator:
        """A random stream of its own (`sortie.scenarios.streams.stream`)."""

    def run(self, waits_s: Iterator[float]) -> None:
        """Start something that goes on by itself: a generator of the times until it goes on, s."""

    # --- links

    def weaken(self, drone: int, peer: int | None, loss_db: float) -> None:
        """Add loss to both directions of a link, or of every link of a drone. Several calls add up."""

    def set_loss_db(self, loss_db: ArrayLike) -> None:
        """Weaken links by this event, until the next call or its end: [N, N] dB, sender by receiver, or one number."""

    def jam(self, position_m: tuple[float, float, float] | None, power_dbm: float = 20.0) -> None:
        """Put this event's jammer somewhere, ENU, or turn it off (None)."""

    # --- members and their energy

    def settle(self) -> None:
        """Drain batteries up to now, and land the drones that are empty."""

    def descends(self, drone: int) -> bool:
        """Whether a drone is on its way to the ground."""

    def join(self, drone: int) -> None:
        """A drone on the ground joins the fleet."""

    def send_home(self, drone: int) -> None:
        """A drone descends and leaves the fleet."""

    def lose(self, drone: int, text: str = "fell silent") -> None:
        """Take a drone out of the air."""

    def drain(self, drone: int, lost_fraction: float) -> None:
        """Take a fraction of the energy that a drone's battery has left."""

    def cells(self, drone: int) -> int:
        """How many cells a drone's pack has."""

    def drop_cell(self, drone: int) -> None:
        """A cell of a drone's pack fails."""

    # --- what a drone has of its own

    def clock(self, drone: int) -> Any:
        """A drone's clock (`sortie.fleet.clock.DroneClock`)."""

    def read_clocks(self) -> None:
        """Bring every drone's clock to the present."""

    def lie(self, drone: int, about: About, claim: Claim) -> None:
        """From now on a drone says something false (`sortie.fleet.lies`)."""

    def block_cameras(self, drone: int) -> None:
        """A drone's cameras see nothing."""

    def slow(self, drone: int, extra_s: float) -> None:
        """A drone's perception takes so much longer."""

    def slowed_s(self, drone: int) -> float:
        """How much longer it takes now, by all events."""

    # --- what is on the air

    def last_datagram(self, drone: int) -> bytes:
        """The latest genuine datagram of a drone; empty before the first."""

    def forger(self, key: bytes) -> Callable[[bytes, Callable[[Any], Any]], bytes]:
        """Makes a false datagram of a genuine one, under a key of one's own: by what is changed in its descriptor."""

    def inject(self, datagram: bytes, victim: int) -> None:
        """Put foreign bytes before all drones but one."""


class Event(Section):
    """Something that happens to the fleet at a given time."""

    acts_live: ClassVar[bool] = False
    """Whether it acts on a live drone itself, by `begin` and `end`."""
    in_trace: ClassVar[bool] = True
    """Whether it is part of the simulated flight that live drones replay."""
    told_live: ClassVar[frozenset[str]] = frozenset()
    """The kinds of its lines of a simulated flight that a live drone repeats."""
    not_live: ClassVar[str] = ""
    """Why it does not act in a live flight; empty where it does, or where the simulated flight that is replayed has it."""

    at_s: float = Field(ge=0, description="When it begins.")
    kind: str

    def misfit(self, station: GroundStation | None) -> Misfit | None:
        """What of it does not fit.

        Args:
            station: the ground station that its `drone` is, if it is one.
        """
        return None

    def prepare(self, fleet: Fleet) -> Any:
        """Called before the flight; what it returns is `fleet.prepared`."""

    def begin(self, fleet: Fleet) -> None:
        """Its time has come."""
        raise NotImplementedError

    def step(self, fleet: Fleet) -> None:
        """Called at the begin of each frame from `at_s` on and before its end."""

    def why_not_live(self, with_vehicle: bool) -> str:
        """Why a live flight leaves it out; empty where it does not.

        Args:
            with_vehicle: whether its drone has a MAVLink vehicle, which flies as its pilot wants.
        """
        return self.not_live


class Lasting(Event):
    """An event that has an end."""

    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")

    def misfit(self, station: GroundStation | None) -> Misfit | None:
        if self.until_s is not None and self.until_s <= self.at_s:
            return "until_s", f"{self.until_s:g}", f"above at_s = {self.at_s:g}"
        return super().misfit(station)

    def overlaps(self, other: Event) -> bool:
        """Whether another event that lasts keeps up what this one did."""
        return self.kind == other.kind and getattr(self, "drone", -1) == getattr(other, "drone", -1)

    def end(self, fleet: Fleet, lasts: bool) -> None:
        """It is over.

        Args:
            lasts: whether one that overlaps goes on.
        """
        raise NotImplementedError

    def note_end(self, fleet: Fleet, lasts: bool, over: str, text: str, still: str) -> None:
        """Write down that it is over, as a line of kind `over`; or `still`, where one that overlaps goes on."""
        drone = getattr(self, "drone", -1)
        if lasts:
            fleet.note(still, drone)
        else:
            fleet.note(text, drone, over)


class MemberEvent(Event):
    """What happens to a member of the fleet, and changes nothing where it is on the ground, or flies already."""

    presence: ClassVar[str] = ""
    """"in" where it brings the drone into the fleet, "out" where it takes it away."""

    drone: DroneId

    def begin(self, fleet: Fleet) -> None:
        fleet.settle()
        if why := self.no_effect(bool(fleet.airborne[self.drone]), fleet.descends(self.drone)):
            fleet.note(f"{self.kind}: {why}", self.drone, "no_effect")
        else:
            self.happen(fleet)

    def no_effect(self, flies: bool, descends: bool) -> str:
        """Why it changes nothing; empty where it does."""
        return "" if flies else "it is not in the fleet"

    def happen(self, fleet: Fleet) -> None:
        """What it does."""
        raise NotImplementedError

    def why_not_live(self, with_vehicle: bool) -> str:
        return f"drone {self.drone} does as its vehicle does" if with_vehicle else ""


class PackEvent(MemberEvent):
    """What happens to a battery: a ground station on mains power has none."""

    def misfit(self, station: GroundStation | None) -> Misfit | None:
        if station is not None and station.mains:
            return "drone", f"{self.drone}", "a drone that flies, it is a ground station on mains power"
        return super().misfit(station)


class PoseFault(Lasting):
    """What makes drones believe to be elsewhere, or to look elsewhere, than they do."""

    @property
    def who(self) -> int | None:
        """The drone that is wrong; None for all that fly."""
        drone: int | None = getattr(self, "drone", None)
        return drone

    def pose_error(
        self, since_s: NDArray[np.float64], frame_s: float, rng: np.random.Generator
    ) -> NDArray[np.float64] | None:
        """The error of one drone's believed pose in the frames in which it lasts.

        Args:
            since_s: [T], the time since its begin.
            rng: for all its random numbers; each drone has its own.

        Returns:
            [T, 4]: x, y, z in metres (ENU), and heading in radians, counter-clockwise; None where it does not touch the pose.
        """
        raise NotImplementedError

    def overlaps(self, other: Event) -> bool:
        return isinstance(other, PoseFault) and other.touches_pose and other.who in (None, self.who)

    @property
    def touches_pose(self) -> bool:
        """Whether it changes what a drone believes of its pose."""
        return True

    def end(self, fleet: Fleet, lasts: bool) -> None:
        usual, still = (
            "its believed pose has its usual errors again",
            "its believed pose is still wrong: another fault lasts",
        )
        self.note_end(fleet, lasts, f"{self.kind}_over", usual, still)


class Jammer(Lasting):
    """A sender in the fleet's channel that stands somewhere; pictures show it."""

    position_m: tuple[float, float, float] = Field(description="The jammer, ENU (x, y, z).")
    power_dbm: float = Field(20.0, ge=-50, le=60, description="Its power in the channel.")


def joining(events: Iterable[Event]) -> set[int]:
    """The drones that events bring into the fleet."""
    return {event.drone for event in events if isinstance(event, MemberEvent) and event.presence == "in"}
