"""Which samples of a log's senders can be, and which of several senders is taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from sortie.fleet.logs.geodesy import metres_per_radian

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

GAP_S = 1.0
FAR_M = 20_000.0
"""Positions further from the flight's median are taken for errors."""
FAST_MPS = 200.0
VOLTS = 2.0, 200.0
"""No pack has less or more."""
BRIEF_S, BRIEF_ROWS = 3.0, 10
"""Values that cannot follow those before have to last for so long, and for so many rows, to be believed; a quarter of all
rows is enough."""
ENOUGH = 0.8
"""A sender is taken before later ones unless it covers less than this share of the best one's time."""
_JITTER_M, _JITTER_CHARGE, _JITTER_V, _JITTER_VOLTS = 20.0, 0.03, 1.0, 0.3
"""Steps that any two samples may have: m, share of the charge, V and share of the voltage."""
_DRAIN_PER_S = 0.01
_LOOK_BACK, _MOST_JUMPS = 64, 20_000
"""Stretches between which a step is looked for; with more jumps than that all values are noise, and stand."""


@dataclass(frozen=True, slots=True)
class Source:
    """What one sender says of one thing, in the log's order."""

    name: str
    """As the log calls it."""
    time_s: Array
    values: Array
    """[K, C], of `fix` in degrees and metres."""
    refused: Mapping[str, Mask] = field(default_factory=dict)
    """Rows that do not count, by why: words that follow *rows of …*."""
    number: int = 0
    """Of the battery that it is about."""
    fills: bool = False
    """Whether it goes on where an earlier source begins late or ends early."""


@dataclass(frozen=True, slots=True)
class Samples:
    """What counts of a source: increasing times and values that can be."""

    source: Source
    time_s: Array
    values: Array
    told: tuple[str, ...]
    """What was left out or put in order, in plain words."""

    @property
    def covered_s(self) -> float:
        """The time without gaps."""
        steps = np.diff(self.time_s)
        return float(steps[steps <= max(GAP_S, 5 * float(np.median(steps)))].sum()) if len(steps) else 0.0


def judged(what: str, source: Source) -> Samples:
    """The rows of a source that can be, in order of time.

    Args:
        what: the field of a `FlightLog`.
    """
    time_s, values = source.time_s, source.values
    told: list[str] = []

    def leave_out(bad: Mask, said: str) -> None:
        nonlocal time_s, values
        if count := int(bad.sum()):
            told.append(f"{count} {said} and are left out")
            time_s, values = time_s[~bad], values[~bad]

    why = np.zeros(len(time_s), dtype=int)
    unknown = ~np.isfinite(values[:, :1] if what == "battery" else values).all(axis=-1) | ~np.isfinite(time_s)
    reasons = [*source.refused, "are not finite"]
    for number, bad in reversed(list(enumerate([*source.refused.values(), unknown], start=1))):
        why[bad] = number
    kept = why == 0
    told += [
        f"{n} rows of {what} {reasons[k]} and are left out"
        for k in range(len(reasons))
        if (n := int((why == k + 1).sum()))
    ]
    time_s, values = time_s[kept], values[kept]
    if late := int((np.diff(time_s) < 0).sum()):
        told.append(f"{late} rows of {what} came out of order and are put in order")
        order = np.argsort(time_s, kind="stable")
        time_s, values = time_s[order], values[order]
    leave_out(np.diff(time_s, prepend=-np.inf) <= 0, f"rows of {what} have the time of another")
    if what == "charge":
        leave_out((values[:, 0] < -0.01) | (values[:, 0] > 1.01), "rows of charge are below 0 % or above 100 %")
        values = np.clip(values, 0.0, 1.0)
    if what == "battery":
        leave_out(
            (values[:, 0] < VOLTS[0]) | (values[:, 0] > VOLTS[1]), "rows of battery have a voltage that no pack has"
        )
    if what == "velocity":
        leave_out(np.linalg.norm(values, axis=-1) > FAST_MPS, f"velocities above {FAST_MPS:g} m/s")
    if what in ("position", "fix") and len(values):
        metres = values if what == "position" else local_m(np.vstack([np.median(values, axis=0), values]))[1:]
        off_m = np.linalg.norm(metres - np.median(metres, axis=0), axis=-1)
        leave_out(off_m > FAR_M, f"positions lie over {FAR_M / 1000:g} km off")
        leave_out(~_fitting(what, time_s, metres[off_m <= FAR_M]), f"rows of {what} jump away from the others")
    if what in ("charge", "battery"):
        leave_out(~_fitting(what, time_s, values), f"rows of {what} do not fit the others")
    return Samples(source, time_s, values, tuple(told))


def _fitting(what: str, time_s: Array, values: Array) -> Mask:
    """The rows that can follow one another: the most that do.

    Jumps divide the rows into stretches. A stretch may follow an earlier one where the step between them can be. It may
    do so after a step that cannot be as well if it lasts (a vehicle that is carried, an estimator that starts anew), but
    no charge rises: a second pack is another flight's.
    """
    if len(time_s) < 2:
        return np.ones(len(time_s), dtype=bool)
    ends = np.append(
        np.flatnonzero(_price(what, time_s[:-1], values[:-1], time_s[1:], values[1:]) > 0) + 1, len(time_s)
    )
    if not 1 < len(ends) <= _MOST_JUMPS:
        return np.ones(len(time_s), dtype=bool)
    begins = np.append(0, ends[:-1])
    brief = min(max(BRIEF_ROWS, BRIEF_S / float(np.median(np.diff(time_s)))), len(time_s) / 4)
    rows = np.where(values[:, 0] > 0.005, 1.0, 0.01) if what == "charge" else np.ones(len(time_s))  # 0 %: not known yet
    worth = np.add.reduceat(rows, begins)
    best, before = worth.copy(), np.full(len(ends), -1)
    for k in range(1, len(ends)):
        near = np.arange(max(0, k - _LOOK_BACK), k)
        last, first = ends[near] - 1, begins[k : k + 1]
        price = _price(what, time_s[last], values[last], time_s[first], values[first])
        gain = best[near] - np.where(price > 0, price * brief, 0.0)
        if gain.max() > 0:
            best[k], before[k] = worth[k] + gain.max(), near[gain.argmax()]
    fits = np.zeros(len(time_s), dtype=bool)
    k = int(best.argmax())
    while k >= 0:
        fits[begins[k] : ends[k]] = True
        k = int(before[k])
    return fits


def _price(what: str, time_s: Array, values: Array, later_s: Array, later: Array) -> Array:
    """Whether values can follow: 0; 1: where they last; ∞: never."""
    step, dt_s = later - values, later_s - time_s
    if what == "charge":
        falls = step[:, 0] < -(_JITTER_CHARGE + _DRAIN_PER_S * dt_s)
        return np.where(step[:, 0] > _JITTER_CHARGE, np.inf, np.where(falls, 1.0, 0.0))
    if what == "battery":
        return np.where(np.abs(step[:, 0]) > _JITTER_V + _JITTER_VOLTS * np.abs(values[:, 0]), 1.0, 0.0)
    return np.where(np.linalg.norm(step, axis=-1) > _JITTER_M + FAST_MPS * dt_s, 1.0, 0.0)


def taken(what: str, each: Sequence[Samples]) -> Samples | None:
    """The first of several sources that covers enough, with a word where it is not the first; None: all are empty.

    A source that fills goes on where the one that is taken begins late or ends early.
    """
    best_s = max((samples.covered_s for samples in each), default=0.0)
    found = next((s for s in each if len(s.time_s) and s.covered_s >= ENOUGH * best_s), None)
    if found is None:
        return None
    told = list(found.told)
    first = each[0]
    if found is not first:
        told.append(
            f"{what} is read from {found.source.name}: {len(first.time_s)} of {len(first.source.time_s)} rows of "
            f"{first.source.name} count"
        )
    found = replace(found, told=tuple(told))
    for other in each:
        if other.source.fills and other.source is not found.source:
            found = _filled(what, found, other)
    return found


def _filled(what: str, samples: Samples, other: Samples) -> Samples:
    """Samples with the rows of another source before their begin and after their end."""
    time_s, values = samples.time_s, samples.values
    early, late = other.time_s < time_s[0], other.time_s > time_s[-1]
    early &= (other.time_s < time_s[0] - GAP_S).any()
    late &= (other.time_s > time_s[-1] + GAP_S).any()
    inside = (other.time_s >= time_s[0]) & (other.time_s <= time_s[-1])
    if not (early | late).any() or (what == "position" and not inside.any()):
        return samples
    added = other.values
    if what == "position":
        own = np.stack([np.interp(other.time_s[inside], time_s, column) for column in values.T], axis=-1)
        added = added + np.median(own - added[inside], axis=0)
    told = f"{(early | late).sum()} rows of {what} before {samples.source.name} begins or after it ends are of {other.source.name}"
    return replace(
        samples,
        time_s=np.concatenate([other.time_s[early], time_s, other.time_s[late]]),
        values=np.concatenate([added[early], values, added[late]]),
        told=(*samples.told, told),
    )


def local_m(fixes: Array) -> Array:
    """Latitudes and longitudes in degrees and altitudes in metres as ENU metres from the first, [K, 3].

    On the plane tangent to the WGS-84 ellipsoid at the first, with its two radii of curvature: the inverse of
    `sortie.fleet.logs.geodesy.geodetic`.
    """
    lat, lon, alt = fixes[0].tolist()
    east_m, north_m = metres_per_radian(lat, alt)  # not by an `Origin`: a damaged first fix may lie anywhere
    east = np.radians((fixes[:, 1] - lon + 180) % 360 - 180) * east_m
    north = np.radians(fixes[:, 0] - lat) * north_m
    return np.stack([east, north, fixes[:, 2] - alt], axis=-1)
