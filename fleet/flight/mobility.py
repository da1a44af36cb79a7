"""Models of mobility: random ones, and those of a user's own that give positions over time.

A model is asked once for the whole flight of its drones. What it returns is their nominal motion; jitter, wind and the
errors of what drones believe come on top, as in a formation.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from sortie.fleet.flight.route import MAX_YAW_RATE_RADPS
from sortie.fleet.flight.steps import Point, Staircase, Step
from sortie.scenarios.plugins.reference import PluginError, checked_array, name_of, resolve

Array = npt.NDArray[np.float64]

MAX_ACCELERATION_MPS2 = 20.0
"""No drone is asked for more: twice its weight as thrust to the side."""
FAR_M = 20_000.0


class OwnMobility(Protocol):
    """A model that gives positions, `fleet.mobility`. Keyword-only arguments are its parameters."""

    def __call__(self, times_s: Array, starts_m: Array, rng: np.random.Generator) -> Any:
        """The motion of some drones.

        Args:
            times_s: [T], the begin of each frame, and of two more than fly.
            starts_m: [n, 3], ENU, the drones' slots at the begin.
            rng: for all random numbers.

        Returns:
            [T, n, 3], ENU, smooth enough to be flown.
        """


class Area(NamedTuple):
    """The fence of the random models, ENU."""

    west_m: float
    south_m: float
    east_m: float
    north_m: float

    @property
    def middle_m(self) -> tuple[float, float]:
        """Its middle."""
        return (self.west_m + self.east_m) / 2, (self.south_m + self.north_m) / 2


def random_waypoint(
    times_s: Array,
    starts_m: Array,
    rng: np.random.Generator,
    *,
    west_m: float = -150.0,
    south_m: float = -150.0,
    east_m: float = 150.0,
    north_m: float = 150.0,
    height_range_m: float = 0.0,
    slowest_mps: float = 3.0,
    fastest_mps: float = 10.0,
    pause_s: float = 0.0,
    turn_time_s: float = 5.0,
) -> Array:
    """Each drone flies to places drawn evenly in a rectangle, each at a speed drawn evenly, and rests between them.

    Long ways take longer than short ones, and slow ways longer than fast ones. So a drone is near the middle more often
    than at the edge, and its mean speed over time is (fastest − slowest) / ln(fastest / slowest) where it does not rest.

    Args:
        times_s: [T], s.
        starts_m: [n, 3], ENU, within the rectangle.
        rng: for all random numbers; drone k has the same whatever n is.
        west_m, south_m, east_m, north_m: the rectangle.
        height_range_m: the heights of places lie this far about the start's, in all.
        slowest_mps, fastest_mps: the speeds.
        pause_s: the rest at each place is drawn evenly up to this.
        turn_time_s: the time over which each change of velocity is spread.

    Returns:
        [T, n, 3], ENU.
    """
    if not (0.0 < slowest_mps <= fastest_mps and min(pause_s, height_range_m) >= 0.0 and turn_time_s > 0):
        speeds = f"slowest_mps {slowest_mps:g}, fastest_mps {fastest_mps:g}"
        others = f"pause_s {pause_s:g}, height_range_m {height_range_m:g}, turn_time_s {turn_time_s:g}"
        must = "must be 0 < slowest_mps ≤ fastest_mps, turn_time_s > 0 and the others ≥ 0"
        raise PluginError(f"mobility random_waypoint: {speeds}, {others}, {must}")
    area = _area(west_m, south_m, east_m, north_m, starts_m, "random_waypoint")

    def steps(start_m: Array, draw: np.random.Generator) -> Iterator[Step]:
        here = start_m
        while True:
            low, high = (*area[:2], start_m[2] - height_range_m / 2), (*area[2:], start_m[2] + height_range_m / 2)
            there, speed_mps = draw.uniform(low, high), draw.uniform(slowest_mps, fastest_mps)
            rest_s = draw.uniform(0.0, pause_s)
            lasts_s = float(np.linalg.norm(there - here)) / speed_mps
            if lasts_s > 0.0:
                yield Step(_point((there - here) / lasts_s), lasts_s)
            if rest_s > 0.0:
                yield Step((0.0, 0.0, 0.0), rest_s)
            here = there

    return _along(times_s, starts_m, rng, steps, turn_time_s)


def gauss_markov(
    times_s: Array,
    starts_m: Array,
    rng: np.random.Generator,
    *,
    west_m: float = -150.0,
    south_m: float = -150.0,
    east_m: float = 150.0,
    north_m: float = 150.0,
    height_range_m: float = 0.0,
    speed_mps: float = 8.0,
    speed_sigma_mps: float = 1.5,
    heading_sigma_deg: float = 30.0,
    climb_sigma_mps: float = 0.5,
    alpha: float = 0.85,
    step_s: float = 1.0,
    turn_time_s: float = 5.0,
    margin_m: float = 40.0,
) -> Array:
    """Speed and heading of each drone are first-order autoregressive processes (Liang & Haas 1999).

    Every `step_s`, each is α times its last value, 1 − α times its mean, and √(1 − α²) times a normal draw. The mean
    heading is drawn once; nearer to the edge than `margin_m` it is the direction to the middle (Camp, Boleng & Davies
    2002). A step that would still leave the rectangle is reflected.

    Args:
        times_s: [T], s.
        starts_m: [n, 3], ENU, within the rectangle.
        rng: for all random numbers; drone k has the same whatever n is.
        west_m, south_m, east_m, north_m: the rectangle.
        height_range_m: drones stay this near to the start's height, above and below together.
        speed_mps, speed_sigma_mps: mean and standard deviation of the speed over ground.
        heading_sigma_deg, climb_sigma_mps: standard deviations about the mean heading, and of the climb.
        alpha: 0 (no memory) … 1.
        step_s: time between draws.
        turn_time_s: the time over which each change of velocity is spread.
        margin_m: from the edge.

    Returns:
        [T, n, 3], ENU.
    """
    if not (0.0 <= alpha < 1.0 and min(speed_mps, step_s, turn_time_s) > 0.0 and speed_sigma_mps >= 0.0):
        speeds = f"speed_mps {speed_mps:g}, speed_sigma_mps {speed_sigma_mps:g}"
        given = f"alpha {alpha:g}, {speeds}, step_s {step_s:g}, turn_time_s {turn_time_s:g}"
        must = "must be 0 ≤ alpha < 1, speed_sigma_mps ≥ 0 and the others > 0"
        raise PluginError(f"mobility gauss_markov: {given}, {must}")
    area = _area(west_m, south_m, east_m, north_m, starts_m, "gauss_markov")
    longest_m = (speed_mps + 8.0 * speed_sigma_mps) * step_s
    if longest_m > min(area.east_m - area.west_m, area.north_m - area.south_m) / 2:
        raise PluginError(f"mobility gauss_markov: steps of {longest_m:g} m are too long for {tuple(area)}")
    new, sigma_rad = math.sqrt(1.0 - alpha**2), math.radians(heading_sigma_deg)

    def steps(start_m: Array, draw: np.random.Generator) -> Iterator[Step]:
        x, y, z = start_m.tolist()
        mean_rad = draw.uniform(-math.pi, math.pi)
        shown = draw.standard_normal(3)
        speed, off, climb = speed_mps + speed_sigma_mps * shown[0], sigma_rad * shown[1], climb_sigma_mps * shown[2]
        heading = mean_rad + off
        while True:
            fast = min(max(speed, 0.0), longest_m / step_s)
            vx, vy, vz = fast * math.cos(heading), fast * math.sin(heading), climb if height_range_m > 0 else 0.0
            if not area.west_m <= x + vx * step_s <= area.east_m:
                vx, heading, mean_rad = -vx, math.pi - heading, math.pi - mean_rad
            if not area.south_m <= y + vy * step_s <= area.north_m:
                vy, heading, mean_rad = -vy, -heading, -mean_rad
            if abs(z + vz * step_s - start_m[2]) > height_range_m / 2:
                vz = climb = -climb
                vz = vz if abs(z + vz * step_s - start_m[2]) <= height_range_m / 2 else 0.0
            yield Step((vx, vy, vz), step_s)
            x, y, z = x + vx * step_s, y + vy * step_s, z + vz * step_s
            towards = mean_rad
            if min(x - area.west_m, area.east_m - x, y - area.south_m, area.north_m - y) < margin_m:
                towards = math.atan2(area.middle_m[1] - y, area.middle_m[0] - x)
            away = (towards - heading + math.pi) % (2 * math.pi) - math.pi
            shown = draw.standard_normal(3)
            heading += (1.0 - alpha) * away + new * sigma_rad * shown[1]
            speed = alpha * speed + (1.0 - alpha) * speed_mps + new * speed_sigma_mps * shown[0]
            climb = alpha * climb + new * climb_sigma_mps * shown[2]

    return _along(times_s, starts_m, rng, steps, turn_time_s)


MOBILITY: Mapping[str, Callable[..., Any]] = {"random_waypoint": random_waypoint, "gauss_markov": gauss_markov}
"""The built-in models by name; `formation` is none of them."""


def found_mobility(reference: str, params: Mapping[str, object]) -> Callable[..., Any]:
    """A mobility model with its parameters bound.

    Raises:
        PluginError: it is not there, does not load, or has no such parameter.
    """
    return resolve("mobility", reference, params, MOBILITY)


def is_planner(model: Callable[..., Any]) -> bool:
    """Whether a model is a class, which plans in flight, and not a function of time."""
    return inspect.isclass(inspect.unwrap(getattr(model, "func", model)))


def positions_m(model: OwnMobility, times_s: Array, starts_m: Array, rng: np.random.Generator) -> Array:
    """What a model that is no planner returns, [T, n, 3], checked.

    Raises:
        PluginError: it fails, or returns what cannot be flown.
    """
    shape = (len(times_s), *starts_m.shape)
    found = checked_array("mobility", model, shape, times_s, starts_m, rng)
    name, frame_s = name_of(model), float(times_s[1] - times_s[0])
    low, high = np.array((-FAR_M, -FAR_M, 0.0)), np.array((FAR_M, FAR_M, FAR_M))
    wrong = ((found < low) | (found > high)).any(axis=-1)
    if wrong.any():
        frame, drone = np.argwhere(wrong)[0]
        place = tuple(round(v, 1) for v in found[frame, drone].tolist())
        bound = f"must be within ±{FAR_M:g} m, at or above the ground"
        raise PluginError(
            f"mobility {name}: drone {drone} of its drones is at {place} at {times_s[frame]:g} s, {bound}"
        )
    push = np.linalg.norm(np.diff(found, n=2, axis=0), axis=-1) / frame_s**2
    if push.size and push.max() > MAX_ACCELERATION_MPS2:
        frame, drone = np.unravel_index(np.argmax(push), push.shape)
        what = f"drone {drone} of its drones accelerates by {push.max():.0f} m/s² at {times_s[frame + 1]:g} s"
        raise PluginError(f"mobility {name}: {what}, must be at most {MAX_ACCELERATION_MPS2:g}")
    return found


def heading_rad(velocity_mps: Array, frame_s: float) -> Array:
    """Headings [T, n] that follow the velocities [T, n, 3]: their mean course over the last seconds, 0 before any.

    The mean is over the time in which the fastest turn of a formation reverses it. It reads nothing of the future.
    """
    moving = np.hypot(velocity_mps[..., 0], velocity_mps[..., 1]) > 0.5
    course = np.arctan2(velocity_mps[..., 1], velocity_mps[..., 0])
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moving))[:, None], -1), axis=0)
    held = np.where(last < 0, 0.0, np.take_along_axis(course, np.maximum(last, 0), axis=0))
    turned = np.unwrap(held, axis=0)
    n = max(1, round(math.pi / MAX_YAW_RATE_RADPS / frame_s))
    sums = np.cumsum(np.concatenate([np.repeat(turned[:1], n, axis=0), turned]), axis=0)
    mean: Array = (sums[n:] - sums[:-n]) / n
    return mean


def _along(
    times_s: Array,
    starts_m: Array,
    rng: np.random.Generator,
    steps: Callable[[Array, np.random.Generator], Iterator[Step]],
    turn_time_s: float,
) -> Array:
    """The smooth flight of each drone along its endless steps; it begins at rest."""
    ways = []
    for start_m, draw in zip(starts_m, rng.spawn(len(starts_m)), strict=True):
        end_s = turn_time_s / 2
        taken = [Step((0.0, 0.0, 0.0), end_s)]
        for step in steps(start_m, draw):
            taken.append(step)
            end_s += step.lasts_s
            if end_s > times_s[-1] + turn_time_s:
                break
        ways.append(Staircase(_point(start_m), taken, turn_time_s).at(times_s)[0])
    return np.stack(ways, axis=1)


def _point(vector: Array) -> Point:
    x, y, z = vector.tolist()
    return x, y, z


def _area(west_m: float, south_m: float, east_m: float, north_m: float, starts_m: Array, name: str) -> Area:
    area = Area(west_m, south_m, east_m, north_m)
    if not (west_m < east_m and south_m < north_m):
        raise PluginError(f"mobility {name}: {tuple(area)}, must be west_m < east_m and south_m < north_m")
    for x, y, _ in starts_m.tolist():
        if not (west_m <= x <= east_m and south_m <= y <= north_m):
            raise PluginError(f"mobility {name}: a drone begins at ({x:g}, {y:g}), must be within {tuple(area)}")
    return area
