"""What moves drones away from the nominal flight, and the flight that results, read block of frames by block of frames.

A manoeuvre changes one drone's way from a frame on. What was flown before stays bit for bit. Attitude follows from the
thrust that the way needs in the drone's own wind, as without manoeuvres; what a drone believes keeps its errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from sortie.fleet.flight.frames import up_vector, wrapped, yaw_rad
from sortie.fleet.flight.motion import OF_A_DRONE, Trajectories, attitude, body_rates, continuous, thrust_mps2
from sortie.fleet.flight.route import across, turned
from sortie.fleet.flight.steering import SteeredWay, Vector
from sortie.fleet.flight.viewpoints import Course, Plan, shifts
from sortie.scenarios import scratch

Array = npt.NDArray[np.float64]
Shift = tuple[Array, Array, Array, Array]
"""Of a drone's place, ENU, with its two derivatives in time, [F, 2] or [F, 3] each; and the heading, [F]."""

BLOCK = 32
"""At least so many frames are worked out at once."""


@dataclass(frozen=True, slots=True)
class Shifted:
    """A drone flies at a shift from its slot, which its moves to viewpoints change."""

    drone: int
    frame: int
    plan: Plan
    course: Course

    def shift(self, nominal: Trajectories, frames: slice) -> Shift:
        """How far it is away from its nominal place in some frames. The shift turns with the formation, as it looks ahead."""
        path = self.course.path
        rate, rate_change = path.yaw_rate_radps[frames, None], path.yaw_acceleration_radps2[frames, None]
        shift, speed, push = (turned(v, path.yaw_rad[frames]) for v in shifts(self.plan, nominal.time_s))
        push = push + 2 * rate * across(speed) + rate_change * across(shift) - rate**2 * shift
        return shift, speed + rate * across(shift), push, nominal.frame_yaw_rad


@dataclass(frozen=True, slots=True)
class Steered:
    """A drone flies its planner's way instead of hovering at its start."""

    drone: int
    frame: int
    way: SteeredWay
    start_m: Vector

    def shift(self, nominal: Trajectories, frames: slice) -> Shift:
        """How far it is away from its nominal place in some frames. It looks east, as where it hovers."""
        place, speed, push = self.way.at(nominal.time_s)
        return place - np.array(self.start_m), speed, push, np.zeros(len(place))


@dataclass(frozen=True, slots=True)
class Descent:
    """A drone follows its way and goes down to the ground. Its attitude and acceleration stay those of its way."""

    drone: int
    frame: int
    from_m: float
    descent_mps: float

    def height_m(self, time_s: Array, frames: slice) -> Array:
        """Its height in some frames of all."""
        height_m: Array = np.maximum(0.0, self.from_m - self.descent_mps * (time_s[frames] - time_s[self.frame]))
        return height_m


@dataclass(frozen=True, slots=True)
class Appearance:
    """A drone that was on the ground is at the height of its way again."""

    drone: int
    frame: int


Manoeuvre = Shifted | Steered | Descent | Appearance


class Motion:
    """A fleet's flight: the nominal flight, and the manoeuvres that change it.

    `motion[frames]` gives the states of some frames. They are worked out when they are first read, and kept until a
    manoeuvre changes them.
    """

    def __init__(self, nominal: Trajectories) -> None:
        self.nominal = nominal
        self.frames, self.drones = nominal.position_m.shape[:2]
        self._step_s = float(nominal.time_s[1] - nominal.time_s[0]) if self.frames > 1 else 1.0
        self._ways: dict[int, Shifted | Steered] = {}
        self.descents: dict[int, Descent] = {}
        """By drone, those that lead down."""
        self._flown: dict[str, Array] = {}  # there are none before the first manoeuvre
        self._until = 0  # so many frames of them are worked out

    def __getitem__(self, frames: slice) -> Trajectories:
        """Some frames."""
        nominal = self.nominal[frames]
        if not self._flown:
            return nominal
        end = frames.indices(self.frames)[1]
        if end > self._until:
            self._work_out(max(end, self._until + BLOCK))
        return replace(nominal, **{name: values[frames] for name, values in self._flown.items()})

    def poses(self, frames: slice) -> tuple[Array, Array]:
        """Positions and the bodies' z axes, [F, N, 3] each, ENU."""
        flown = self[frames]
        return flown.position_m, up_vector(flown.orientation_xyzw)

    def rest_m(self, frame: int) -> Array:
        """Positions [F, N, 3] from a frame to the end, as planned now."""
        rest = slice(frame, self.frames)
        nominal = self.nominal[rest]
        position = nominal.position_m.copy()
        for drone, way in self._ways.items():
            shift, *_ = way.shift(nominal, rest)
            position[:, drone, : shift.shape[1]] += shift
        for drone, descent in self.descents.items():
            position[:, drone, 2] = descent.height_m(self.nominal.time_s, rest)
        return position

    def change(self, manoeuvres: Sequence[Manoeuvre]) -> None:
        """Change the flight by manoeuvres that begin with one frame. Later ones of a drone replace earlier ones."""
        frame = manoeuvres[0].frame
        self._flown = self._flown or {n: scratch.empty(getattr(self.nominal, n).shape) for n in OF_A_DRONE}
        self._work_out(frame + 1)  # the body rates of the frame before lead to where the drones would have been
        self._until = frame
        for manoeuvre in manoeuvres:
            match manoeuvre:
                case Descent():
                    self.descents[manoeuvre.drone] = manoeuvre
                case Appearance():
                    self.descents.pop(manoeuvre.drone, None)
                case _:
                    self._ways[manoeuvre.drone] = manoeuvre

    def _work_out(self, end: int) -> None:
        begin, last = self._until, self.frames - 1
        if end <= begin:
            return
        end = end if end < last else self.frames  # the last frame has the body rates of the one before
        blocks = scratch.blocks(end - begin, sum(values[0].nbytes for values in self._flown.values()))
        for rows in blocks:
            self._fill(slice(begin + rows.start, begin + rows.stop))
            if len(blocks) > 1:
                scratch.release()
        self._until = end

    def _fill(self, frames: slice) -> None:
        flown = self._flown
        for name, values in flown.items():
            values[frames] = getattr(self.nominal, name)[frames]
        if self._ways:
            drones = list(self._ways)
            for name, values in self._on_ways(frames, drones).items():
                flown[name][frames, drones] = values[: frames.stop - frames.start]
        for drone, descent in self.descents.items():
            of, height_m = (frames, drone, 2), descent.height_m(self.nominal.time_s, frames)
            flown["est_position_m"][of] += height_m - flown["position_m"][of]
            flown["position_m"][of] = height_m
            flown["velocity_mps"][of] = np.where(height_m > 0.0, -descent.descent_mps, 0.0)

    def _on_ways(self, frames: slice, drones: list[int]) -> dict[str, Array]:
        """The states of drones on ways of their own, in some frames and the next one, which decides the last body rates."""
        frames_and_next = slice(frames.start, min(frames.stop + 1, self.frames))
        nominal = self.nominal[frames_and_next]
        states = {name: np.take(getattr(nominal, name), drones, axis=1) for name in (*OF_A_DRONE, "wind_mps")}
        velocity, acceleration, yaw = states["velocity_mps"], states["acceleration_mps2"], states["yaw_rad"]
        heading = np.empty_like(yaw)
        for k, way in enumerate(self._ways.values()):
            shift, speed, push, heading[:, k] = way.shift(nominal, frames_and_next)
            of = slice(None), k, slice(shift.shape[1])
            for values, by in ((states["position_m"], shift), (states["est_position_m"], shift), (velocity, speed)):
                values[of] += by
            acceleration[of] += push
        before = self._flown["orientation_xyzw"][max(frames.start - 1, 0), drones]
        thrust = thrust_mps2(velocity, acceleration, states.pop("wind_mps"))
        orientation = continuous(attitude(thrust, heading), before)
        rates = body_rates(orientation, self._step_s)
        if len(rates) == 1 and frames.start:  # the last frame: who flies on keeps his rates
            goes_on = [way.frame < frames.start for way in self._ways.values()]
            rates[:, goes_on] = self._flown["body_rates_radps"][frames.start - 1, drones][goes_on]
        tilted = {"orientation_xyzw": orientation, "body_rates_radps": rates, "yaw_rad": yaw_rad(orientation)}
        return states | tilted | {"est_yaw_rad": wrapped(tilted["yaw_rad"] + states["est_yaw_rad"] - yaw)}
