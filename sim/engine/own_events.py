"""Events from outside: a user's class acts on the fleet from one moment to another, frame by frame."""

from __future__ import annotations

from numbers import Integral
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sortie.scenarios.plugins.reference import Guard, PluginError, checked_call, real_array, resolve
from sortie.scenarios.schema import Own, Scenario
from sortie.scenarios.streams import stream
from sortie.sim.engine.world import World


class OwnEvent(Protocol):
    """An event of one's own. It is made with a numpy random generator; keyword-only arguments are its parameters.

    It may also have `begin(fleet)` and `end(fleet)`, which are called once.
    """

    def step(self, fleet: FleetHandle) -> None:
        """Called at the begin of each frame from `at_s` on and before `until_s`."""


class FleetHandle:
    """What an event of one's own sees of the fleet, and what it may do to it.

    Attributes:
        t_s: now.
        frame_s: time between two frames.
    """

    __slots__ = ("_event", "_index", "_world", "frame_s")

    def __init__(self, world: World, scenario: Scenario, event: Own, index: int) -> None:
        self._world, self._event, self._index = world, event, index
        self.frame_s = scenario.frame_s

    @property
    def t_s(self) -> float:
        return float(self._world.env.now)

    @property
    def positions_m(self) -> NDArray[np.float64]:
        """[N, 3], ENU: where the drones are. To be read; an event cannot move them."""
        motion = self._world.motion
        frame = min(int(self.t_s / self.frame_s + 1e-6), motion.frames - 1)
        return _read_only(motion[frame : frame + 1].position_m[0].copy())

    @property
    def airborne(self) -> NDArray[np.bool_]:
        """[N]: who flies. To be read; `lose` takes a drone out of the air."""
        return _read_only(np.array([drone.airborne for drone in self._world.drones]))

    def set_loss_db(self, loss_db: ArrayLike) -> None:
        """Weaken links by this event, until the next call or its end: [N, N] dB, sender by receiver, or one number."""
        n = len(self._world.drones)
        asked = self._numbers(loss_db, f"of shape ({n}, {n}), or one number")
        if asked.shape not in ((), (n, n)):
            raise PluginError(
                f"event {self._event.model}: a loss of shape {asked.shape}, must be of shape ({n}, {n}), or one number"
            )
        given = np.broadcast_to(asked, (n, n)).copy()
        np.fill_diagonal(given, 0.0)
        wrong = ~(np.isfinite(given) & (given >= 0.0))
        if wrong.any():
            raise PluginError(f"event {self._event.model}: a loss of {given[wrong][0]:g} dB, must be finite and ≥ 0")
        self._world.own_losses_db[self._index] = given

    def jam(self, position_m: tuple[float, float, float] | None, power_dbm: float = 20.0) -> None:
        """Put this event's jammer somewhere, ENU, or turn it off (None)."""
        if position_m is None:
            self._world.jammers.pop(self._index, None)
            return
        at_m, power = self._numbers(position_m, "three, ENU"), self._numbers(power_dbm, "one")
        if at_m.shape != (3,) or power.shape:
            raise PluginError(
                f"event {self._event.model}: a jammer of {power_dbm!r:.60} dBm at {position_m!r:.60}, must be one number at three"
            )
        if not np.isfinite([*at_m, power]).all():
            raise PluginError(f"event {self._event.model}: a jammer of {power_dbm} dBm at {position_m}, must be finite")
        x_m, y_m, z_m = at_m.tolist()
        self._world.jammers[self._index] = ((x_m, y_m, z_m), float(power))

    def drain(self, drone: int, lost_fraction: float) -> None:
        """Take a fraction of the energy that a drone's battery has left."""
        self._check(drone)
        if not 0.0 < lost_fraction <= 1.0:
            raise PluginError(f"event {self._event.model}: lost_fraction is {lost_fraction}, must be > 0 and ≤ 1")
        self._world.drain()
        if self._world.drones[drone].airborne:
            self._world.batteries.fault(drone, lost_fraction)
            self._world.ground_landed()

    def lose(self, drone: int, text: str = "fell silent") -> None:
        """Take a drone out of the air."""
        self._check(drone)
        self._check_text(text)
        self._world.drain()
        if self._world.drones[drone].airborne:
            self._world.remove(drone, "drone_lost", text)

    def note(self, text: str, drone: int = -1) -> None:
        """Write a line among the sortie's events; drone −1 is the whole fleet."""
        self._check(drone, first=-1)
        self._check_text(text)
        self._world.note(drone, "own", text)

    def _numbers(self, given: object, must: str) -> NDArray[np.float64]:
        if (found := real_array(given)) is None:
            raise PluginError(f"event {self._event.model}: {given!r:.60}, must be numbers, {must}")
        return found

    def _check(self, drone: int, first: int = 0) -> None:
        n = len(self._world.drones)
        if not (isinstance(drone, Integral) and first <= drone < n):
            must = f"must be a whole number, {first} … {n - 1}"
            raise PluginError(f"event {self._event.model}: drone {drone!r:.60}, {must}")

    def _check_text(self, text: object) -> None:
        if not isinstance(text, str):
            raise PluginError(f"event {self._event.model}: text {text!r:.60}, must be a str")


def _read_only(values: NDArray[Any]) -> NDArray[Any]:
    values.flags.writeable = False
    return values


class OwnEvents:
    """The events from outside of one sortie."""

    def __init__(self, scenario: Scenario, world: World, seed: int, replication: int) -> None:
        """Raises:
        PluginError: an event that is not there, does not load, or has no such parameter.
        """
        self._events: dict[int, tuple[Any, FleetHandle]] = {}
        for index, event in enumerate(scenario.events):
            if isinstance(event, Own):
                rng = stream(seed, replication, index, "own event")
                made = checked_call("event", resolve("event", event.model, event.params), rng)
                self._events[index] = Guard("event", made, ("step",)), FleetHandle(world, scenario, event, index)
        self._world, self._going = world, list[int]()

    def begin(self, index: int, text: str) -> None:
        """An event's time has come."""
        event, fleet = self._events[index]
        self._world.note(-1, "own", f"{text} begins")
        self._going.append(index)
        if hasattr(event, "begin"):
            event.begin(fleet)

    def end(self, index: int, text: str) -> None:
        """It is over: its losses and its jammer are gone."""
        event, fleet = self._events[index]
        self._going.remove(index)
        if hasattr(event, "end"):
            event.end(fleet)
        self._world.own_losses_db.pop(index, None)
        self._world.jammers.pop(index, None)
        self._world.note(-1, "own", f"{text} ends")

    def step(self, frame: int) -> None:
        """A frame begins."""
        for index in self._going:
            event, fleet = self._events[index]
            event.step(fleet)
