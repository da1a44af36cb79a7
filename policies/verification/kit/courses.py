"""Courses of views for testing lines about time: what one drone reads from decision to decision, drawn from a seed.

A course is made of signals: each charge, goodput, phase, flag and outage is a number that changes at a few decisions. The
views follow from them as in flight: charge never rises, a descriptor that is lost grows older by a period a decision.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from sortie.policies.contract import (
    COVERAGE_BYTES,
    PERSON_FLAG,
    Descriptor,
    Disc,
    FleetView,
    TaskPhase,
)
from sortie.scenarios.streams import stream

Steps = tuple[tuple[int, float], ...]
"""A signal: from which decision on it has which value; the first entry is of decision 0."""

_AT_FIRST: dict[str, float] = {
    "soc": 1.0, "cpu": 1.0, "gpu": 1.0, "phase": TaskPhase.SEARCH, "region": 1.0, "targets": 0.0, "person": 0.0, "lost": 0.0,
}  # fmt: skip
_SOC = (0.05, 0.2999, 0.3, 0.5999, 0.6, 0.9, 1.0)
_GOODPUT_MBPS = (0.0, 1.0, 4.99, 5.0, 20.0, 50.0, 600.0)
LATENCY_FRAMES = 0.2
"""Age of a descriptor that arrived, in frames."""
REGIONS_APART_M = 50.0
"""Each drone has a region of its own, beside that of the drone before."""
_PLAIN_PLACE = (0.0, 0.0, 0.0, 0.0)


class Course(NamedTuple):
    """What drone 0 of a fleet reads at `decisions` decisions, one a frame."""

    drones: int
    decisions: int
    frame_s: float
    period_s: float
    """The plane's period, which ages are compared with: one frame or several."""
    detached_after_periods: float
    signals: Mapping[tuple[str, int, int], Steps]
    """By name, drone and, of a goodput, the other drone. One that is left out has its usual value."""
    places: Mapping[int, tuple[float, float, float, float]]
    """By drone: x and y at first, m, and velocity, m/s. One that is left out stays where the ego is."""

    def views(self) -> Iterator[FleetView]:
        """The views, in the order of time."""
        soc = dict.fromkeys(range(self.drones), 1.0)
        age_s = dict.fromkeys(range(self.drones), 0.0)
        known: dict[int, Descriptor] = {}
        now = {key: _value_of(steps) for key, steps in self.signals.items()}
        for k in range(self.decisions):

            def value(name: str, drone: int, other: int = -1, k: int = k) -> float:
                read = now.get((name, drone, other))
                return read(k) if read is not None else _AT_FIRST.get(name, 50.0)

            for i in range(self.drones):
                soc[i] = min(soc[i], value("soc", i))
                if i and k and value("lost", i):
                    age_s[i] += self.frame_s
                    continue
                age_s[i] = LATENCY_FRAMES * self.frame_s * (i > 0)
                known[i] = self._descriptor(i, k, soc[i], value)
            yield FleetView(0, self.period_s, dict(known), dict(age_s), self.detached_after_periods)

    def _descriptor(self, i: int, k: int, soc: float, value: Callable[..., float]) -> Descriptor:
        x_m, y_m, vx_mps, vy_mps = self.places.get(i, _PLAIN_PLACE)
        t_s = k * self.frame_s
        return Descriptor(
            stamp_ns=round(t_s * 1e9),
            agent_id=i,
            position_m=(x_m + vx_mps * t_s, y_m + vy_mps * t_s, 60.0),
            orientation_xyzw=(0.0, 0.0, 0.0, 1.0),
            velocity_mps=(vx_mps, vy_mps, 0.0),
            footprint_radius_m=42.0,
            battery_soc=soc,
            cpu_headroom=value("cpu", i),
            gpu_headroom=value("gpu", i),
            peer_goodput_mbps=tuple([value("goodput", i, j) for j in range(self.drones) if j != i]),
            coverage_grid=bytes(COVERAGE_BYTES),
            novelty_flags=PERSON_FLAG * bool(value("person", i)),
            task_phase=TaskPhase(int(value("phase", i))),
            region=Disc(REGIONS_APART_M * i, 0.0, 32.0) if value("region", i) else None,
            priority_target_ids=(7,) if value("targets", i) else (),
        )


def _value_of(steps: Steps) -> Callable[[int], float]:
    def read(k: int) -> float:
        return next(value for since, value in reversed(steps) if since <= k)

    return read


# --- drawing -------------------------------------------------------------------------------------


class Values(NamedTuple):
    """The values that drawn signals take: round ones, and those beside a policy's own constants."""

    soc: tuple[float, ...]
    goodput_mbps: tuple[float, ...]

    @classmethod
    def of(cls, constants: Iterable[float]) -> Values:
        """The values beside these constants."""
        known = sorted(set(constants))
        shares = [x for c in known if 0 <= c <= 1 for x in (c - 1e-4, c, c + 1e-4) if 0 <= x <= 1]
        rates = [x for c in known if 0 < c <= 1e5 for x in (0.9 * c, c, 1.2 * c)]
        return cls((*_SOC, *shares), (*_GOODPUT_MBPS, *rates))


def draw_course(seed: int, number: int, still: Course, values: Values) -> Course:
    """Course `number` of a seed, as long as `still`: some signals change a few times, some flip to and fro, most stay."""
    rng = stream(seed, number, (), "verify.course")
    lively = float(rng.choice([0.15, 0.4, 0.8]))
    signals = {
        key: _signal(rng, key[0], still.decisions, values) for key in _keys(still.drones) if rng.random() < lively
    }
    spread_m = float(rng.choice([0.0, 30.0, 100.0]))
    places = {
        i: (*(spread_m * rng.uniform(-1, 1, 2)).tolist(), *rng.uniform(-10, 10, 2).tolist())
        for i in range(still.drones)
    }
    return still._replace(signals=signals, places=places)


def changed_course(course: Course, seed: int, number: int, values: Values) -> Course:
    """A course that differs from one in a few signals: drawn anew, moved in time, or left out."""
    rng = stream(seed, number, (), "verify.change")
    signals, keys = dict(course.signals), _keys(course.drones)
    for _ in range(int(rng.integers(1, 4))):
        key = keys[int(rng.integers(len(keys)))]
        known = signals.get(key)
        if known is None or rng.random() < 0.4:
            signals[key] = _signal(rng, key[0], course.decisions, values)
        elif rng.random() < 0.3:
            del signals[key]
        else:
            by = int(rng.integers(-6, 7))
            moved = {max(1, since + by): value for since, value in known[1:]}
            signals[key] = (known[0], *sorted(moved.items()))
    return course._replace(signals=signals)


def _keys(drones: int) -> list[tuple[str, int, int]]:
    one = [(name, i, -1) for name in _AT_FIRST for i in range(drones) if name != "lost" or i]
    return one + [("goodput", i, j) for i in range(drones) for j in range(drones) if i != j]


def _signal(rng: np.random.Generator, name: str, decisions: int, values: Values) -> Steps:
    def draw() -> float:
        if name == "phase":
            return float(rng.integers(len(TaskPhase)))
        if name == "goodput":
            return float(rng.choice(values.goodput_mbps))
        if name in ("region", "targets", "person", "lost"):
            return float(rng.random() < 0.5)
        return float(rng.choice(values.soc))

    if rng.random() < 0.3:  # to and fro
        every, pair = int(rng.integers(1, max(2, decisions // 3))), (draw(), draw())
        return tuple((k, pair[k // every % 2]) for k in range(0, decisions, every))
    times = sorted({0, *rng.integers(1, decisions, int(rng.integers(0, 4))).tolist()})
    return tuple((k, draw()) for k in times)


# --- shrinking -----------------------------------------------------------------------------------


def shrink_course(course: Course, fails: Callable[[Course], bool]) -> Course:
    """A course that still fails, with fewer drones, signals and changes, as found by one pass over them.

    Args:
        course: a course that fails.
        fails: whether a course fails.
    """

    def kept(candidate: Course) -> bool:
        nonlocal course
        if candidate != course and fails(candidate):
            course = candidate
            return True
        return False

    for drones in range(2, course.drones):
        if kept(course._replace(drones=drones)):
            break
    kept(course._replace(places={}))
    for key in list(course.signals):
        kept(course._replace(signals={k: v for k, v in course.signals.items() if k != key}))
    for key, steps in list(course.signals.items()):
        for k in range(len(steps) - 1, 0, -1):
            now = course.signals[key]
            kept(course._replace(signals={**course.signals, key: now[:k] + now[k + 1 :]}))
    low, high = 1, course.decisions
    while low < high:  # an end of the course after the break changes nothing before it
        middle = (low + high) // 2
        low, high = (low, middle) if fails(course._replace(decisions=middle)) else (middle + 1, high)
    kept(course._replace(decisions=high))
    return course
