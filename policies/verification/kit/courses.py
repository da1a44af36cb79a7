"""Courses of views for testing lines about time: what one drone reads from decision to decision, drawn by number.

A course is made of signals: each charge, goodput, phase, flag and outage is a number that changes at a few decisions. The
views follow from them as in flight: charge never rises, a descriptor that is lost grows older by a frame a decision.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from sortie.policies.contract import COVERAGE_BYTES, PERSON_FLAG, Descriptor, Disc, FleetView, TaskPhase
from sortie.scenarios.streams import stream

Steps = tuple[tuple[int, float], ...]
"""A signal: from which decision on it has which value; the first entry is of decision 0."""
Values = Mapping[str, tuple[float, ...]]
"""The values that drawn signals take, by name."""

_USUAL: dict[str, float] = {
    "soc": 1.0,
    "cpu": 1.0,
    "gpu": 1.0,
    "phase": TaskPhase.SEARCH,
    "region": 1.0,
    "targets": 0.0,
    "person": 0.0,
    "lost": 0.0,
    "goodput": 50.0,
    "x_m": 0.0,
    "y_m": 0.0,
    "vx_mps": 0.0,
    "vy_mps": 0.0,
}
"""Of a goodput: to each other drone. Places and velocities are those at first, and do not change."""
_SHARES = (0.05, 0.2999, 0.3, 0.5999, 0.6, 0.9, 1.0)
_FLAGS, _PLACES_M, _VELOCITIES_MPS = (0.0, 1.0), (0.0, -80.0, -25.0, 25.0, 80.0), (-10.0, -3.0, 3.0, 10.0)
_GOODPUT_MBPS = (0.0, 1.0, 4.99, 5.0, 20.0, 50.0, 600.0)
LATENCY_FRAMES = 0.2
"""Age of a descriptor that arrived, in frames."""
REGIONS_APART_M = 50.0
"""Each drone has a region of its own, beside that of the drone before."""


class Course(NamedTuple):
    """What drone 0 of a fleet reads at `decisions` decisions, one a frame."""

    drones: int
    decisions: int
    frame_s: float
    period_s: float
    """The plane's period, which ages are compared with: one frame or several."""
    detached_after_periods: float
    signals: Mapping[tuple[str, int, int], Steps]
    """By name, drone and, of a goodput, the other drone (else −1). One that is left out has its usual value."""

    def views(self) -> Iterator[FleetView]:
        """The views, in the order of time."""
        soc, age_s = dict.fromkeys(range(self.drones), 1.0), dict.fromkeys(range(self.drones), 0.0)
        known: dict[int, Descriptor] = {}
        for k in range(self.decisions):
            for i in range(self.drones):
                soc[i] = min(soc[i], self._value(k, "soc", i))
                if i and k and self._value(k, "lost", i):
                    age_s[i] += self.frame_s
                else:
                    age_s[i] = LATENCY_FRAMES * self.frame_s * (i > 0)
                    known[i] = self._descriptor(k, i, soc[i])
            yield FleetView(0, self.period_s, dict(known), dict(age_s), self.detached_after_periods)

    def _value(self, k: int, name: str, drone: int, other: int = -1) -> float:
        steps = self.signals.get((name, drone, other))
        return _USUAL[name] if steps is None else next(value for since, value in reversed(steps) if since <= k)

    def _descriptor(self, k: int, i: int, soc: float) -> Descriptor:
        t_s = k * self.frame_s
        vx_mps, vy_mps = self._value(k, "vx_mps", i), self._value(k, "vy_mps", i)
        return Descriptor(
            stamp_ns=round(t_s * 1e9),
            agent_id=i,
            position_m=(self._value(k, "x_m", i) + vx_mps * t_s, self._value(k, "y_m", i) + vy_mps * t_s, 60.0),
            orientation_xyzw=(0.0, 0.0, 0.0, 1.0),
            velocity_mps=(vx_mps, vy_mps, 0.0),
            footprint_radius_m=42.0,
            battery_soc=soc,
            cpu_headroom=self._value(k, "cpu", i),
            gpu_headroom=self._value(k, "gpu", i),
            peer_goodput_mbps=tuple([self._value(k, "goodput", i, j) for j in range(self.drones) if j != i]),
            coverage_grid=bytes(COVERAGE_BYTES),
            novelty_flags=PERSON_FLAG * bool(self._value(k, "person", i)),
            task_phase=TaskPhase(int(self._value(k, "phase", i))),
            region=Disc(REGIONS_APART_M * i, 0.0, 32.0) if self._value(k, "region", i) else None,
            priority_target_ids=(7,) if self._value(k, "targets", i) else (),
        )


def values_at(constants: Iterable[float]) -> Values:
    """The values that drawn signals take: round ones, and those beside a policy's own constants."""
    known = sorted(set(constants))
    shares = (*_SHARES, *(x for c in known if 0 <= c <= 1 for x in (c - 1e-4, c, c + 1e-4) if 0 <= x <= 1))
    rates_mbps = (*_GOODPUT_MBPS, *(x for c in known if 0 < c <= 1e5 for x in (0.9 * c, c, 1.2 * c)))
    return {
        **dict.fromkeys(_USUAL, _FLAGS),
        **dict.fromkeys(("soc", "cpu", "gpu"), shares),
        "goodput": rates_mbps,
        "phase": tuple(map(float, TaskPhase)),
        **dict.fromkeys(("x_m", "y_m"), _PLACES_M),
        **dict.fromkeys(("vx_mps", "vy_mps"), _VELOCITIES_MPS),
    }


def draw_course(number: int, still: Course, values: Values) -> Course:
    """Course `number`, as long as `still`: some signals change a few times, some flip to and fro, most stay."""
    rng = stream(0, number, (), "verify.course")
    drones, lively = range(still.drones), float(rng.choice([0.15, 0.4, 0.8]))
    keys = [(name, i, -1) for name in _USUAL if name != "goodput" for i in drones if name != "lost" or i]
    keys += [("goodput", i, j) for i in drones for j in drones if i != j]
    signals = {
        key: _draw_signal(rng, values[key[0]], 1 if key[0].endswith(("_m", "_mps")) else still.decisions)
        for key in keys
        if rng.random() < lively
    }
    return still._replace(signals=signals)


def _draw_signal(rng: np.random.Generator, values: tuple[float, ...], decisions: int) -> Steps:
    if decisions > 1 and rng.random() < 0.4:  # to and fro, more often fast than slowly
        every, pair = int(max(1.0, decisions / 3) ** rng.random()), rng.choice(values, 2, replace=False).tolist()
        return tuple((k, pair[k // every % 2]) for k in range(0, decisions, every))
    times = {0, *rng.integers(1, decisions, int(rng.integers(0, 4))).tolist()} if decisions > 1 else {0}
    return tuple((k, float(rng.choice(values))) for k in sorted(times))


def shrink_course(course: Course, failing: Callable[[Course], int]) -> Course:
    """A course that still fails, with fewer drones, signals and changes, as found by one pass over them.

    Args:
        course: a course that fails.
        failing: the number of decisions up to the one at which a course fails; 0 where it does not fail.
    """

    def keep(smaller: Course) -> bool:
        nonlocal course
        decisions = failing(smaller)
        if decisions:
            course = smaller._replace(decisions=decisions)
        return decisions > 0

    keep(course)
    for drones in range(2, course.drones):
        if keep(course._replace(drones=drones)):
            break
    for key in list(course.signals):
        keep(course._replace(signals={k: steps for k, steps in course.signals.items() if k != key}))
    for key, steps in list(course.signals.items()):
        for k in range(len(steps) - 1, 0, -1):
            now = course.signals[key]
            keep(course._replace(signals={**course.signals, key: now[:k] + now[k + 1 :]}))
    return course
