"""The times of a log's rows: which cannot be, where the clock restarted, and the vehicle's clock of a telemetry log.

Rows come in the order in which they were written. Their times run evenly there but for pauses, so that a row whose time
lies far from those of its neighbours is damaged, and a fall that stays is a restart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Numbers = npt.NDArray[np.int64]

AROUND = 15
"""Rows before and after one with which its time is compared."""
ODD_S = 2.0
"""A time that is further from its neighbours', and than some rows last, cannot be. A smaller step back is disorder."""
AGREE_S = 1.0
"""Times of arrival stand while they keep so close to the vehicle's clock: telemetry comes late, and in bursts."""
DRIFT_S = 0.25
"""By more the two clocks may not part between the halves of a log."""
_LATEST = 20
"""Rows by which a ground computer's clock is placed: the last ones, since a clock that is set is right afterwards."""
_WRAP = 2.0**32
_SLOW = 0.1
"""What runs at less than this share of the ground's time is no clock."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """The rows of a log that belong together, [K] in the log's order."""

    kept: Mask
    """Rows of the longest run of the clock with times that can be."""
    odd: Mask
    """Rows with an impossible time."""
    begin: int
    """The first row of the run; 0 if no other comes before."""
    end: int
    """The row after its last; K if no other comes after."""
    restarts: int
    """How often the clock began anew."""


def longest_stretch(time_s: Array, kind: Numbers) -> Stretch:
    """The longest run of a clock without its damaged rows.

    Args:
        time_s: of each row, in the order in which they were written.
        kind: what each row is. One row of each kind at the begin or the end that is far from the rest is damaged, and so
            are a few rows that are further away than all others last.
    """
    odd = ~np.isfinite(time_s)
    rows = np.flatnonzero(~odd)
    if len(rows) < 3:
        return Stretch(~odd, odd, 0, len(time_s), 0)
    times = time_s[rows]
    span = min(AROUND // 3, len(times) - 1)
    far_s = max(ODD_S, 1.5 * float(np.median(np.abs(times[span:] - times[:-span]))))
    wrong = np.abs(times - _running_median(times)) > far_s
    for forward in (True, False):
        likely = np.flatnonzero(~wrong)[:: 1 if forward else -1]
        wrong[likely[: _apart(times[likely], kind[rows[likely]], far_s)]] = True
    odd[rows[wrong]] = True
    rows, times = rows[~wrong], times[~wrong]
    steps = np.diff(_running_median(times))
    usual_s = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    least_s = max(ODD_S, 3 * usual_s)
    falls = np.flatnonzero((steps < -least_s) & _fallen(times, kind[rows], least_s)) + 1
    begins, ends = [0, *falls.tolist()], [*falls.tolist(), len(rows)]
    lasted_s = [float(np.ptp(times[begin:end])) for begin, end in zip(begins, ends, strict=True)]
    longest = int(np.argmax(lasted_s))
    begin = int(rows[begins[longest]]) if longest else 0
    end = int(rows[ends[longest] - 1]) + 1 if longest < len(falls) else len(time_s)
    kept = ~odd
    kept[:begin] = kept[end:] = False
    return Stretch(kept, odd, begin, end, len(falls))


def _running_median(values: Array) -> Array:
    """The median of the rows around each; fewer towards the ends, where as many stand on both sides."""
    width = 2 * AROUND + 1
    out: Array = median_filter(values, width) if len(values) >= width else values.copy()
    for k in range(min(AROUND, (len(values) + 1) // 2)):
        out[k], out[-1 - k] = np.median(values[: 2 * k + 1]), np.median(values[len(values) - 2 * k - 1 :])
    return out


def _fallen(times: Array, kind: Numbers, least_s: float) -> Mask:
    """Between which rows the time of a kind of rows falls: rows that were added at the end of a log are no restart."""
    order = np.argsort(kind, kind="stable")
    before, after = order[:-1], order[1:]
    falls = (kind[before] == kind[after]) & (times[after] < times[before] - least_s)
    within = np.zeros(len(times), dtype=int)
    np.add.at(within, before[falls], 1)
    np.add.at(within, after[falls], -1)
    out: Mask = within.cumsum()[:-1] > 0
    return out


def _apart(times: Array, kind: Numbers, far_s: float) -> int:
    """How many rows at the begin are damaged, as far from the rest as they are."""
    seen: set[int] = set()
    apart, once = 0, True
    for k in range(len(times) - 1):
        once = once and int(kind[k]) not in seen
        seen.add(int(kind[k]))
        if not once and k >= AROUND:
            break
        away_s = abs(times[k + 1] - times[k])
        if away_s > far_s and (once or away_s > abs(times[-1] - times[k + 1])):
            apart = k + 1
    return apart


@dataclass(frozen=True, slots=True)
class Arrivals:
    """A vehicle's messages on one clock, [K] in the order in which they came."""

    kept: Mask
    """Messages of the longest time between two starts of the vehicle."""
    begin: int
    end: int
    """The first of them, and the one after the last."""
    time_us: Numbers
    """When they were sent, by the ground computer's clock as it was in the end."""
    odd: int
    """Messages left out: what they say of the vehicle's clock cannot be."""
    restarts: int
    moved: int
    """Messages that the ground computer dated wrongly."""


def sent_when(arrived_us: Numbers, boot_ms: Array, kind: Numbers) -> Arrivals:
    """When a vehicle sent its messages.

    The times of arrival stand where they agree with the vehicle's own clock. Otherwise the ground computer's clock was
    set meanwhile, or the link held messages back or changed their order, and the vehicle's clock is taken. Messages without a time of the
    vehicle's lie between their neighbours.

    Args:
        arrived_us: the ground computer's stamps.
        boot_ms: the vehicle's clock, 32 bits of ms since it started, or any other clock of its; NaN where a message has none.
        kind: which message each is. One that always says the same time, or nearly so, does not say any.
    """
    boot_ms = boot_ms.copy()
    for each in np.unique(kind):
        told = boot_ms[kind == each]
        if len(told) > 1 and np.ptp(told) == 0:
            boot_ms[kind == each] = np.nan
    known = np.flatnonzero(np.isfinite(boot_ms))
    everything = np.ones(len(arrived_us), dtype=bool)
    if len(known) < 3:
        return Arrivals(everything, 0, len(everything), arrived_us, 0, 0, 0)
    boot_s = np.unwrap(boot_ms[known], period=_WRAP) * 1e-3
    span = min(AROUND, len(known) - 1)
    own_ms, ground_us = (np.median(np.abs(of[span:] - of[:-span])) for of in (boot_ms[known], arrived_us[known]))
    if own_ms * 1e3 < _SLOW * ground_us:
        return Arrivals(everything, 0, len(everything), arrived_us, 0, 0, 0)
    run = longest_stretch(boot_s, kind[known])
    kept = everything
    begin = int(known[run.begin]) if run.begin else 0
    end = int(known[run.end - 1]) + 1 if run.end < len(known) else len(kept)
    kept[:begin] = kept[end:] = kept[known[run.odd]] = False
    known, boot_s, odd = known[run.kept], boot_s[run.kept], int(run.odd.sum())
    arrived_s = (arrived_us - arrived_us[known[0]]) * 1e-6
    late_s = arrived_s[known] - (boot_s - boot_s[0])
    first, second = (float(np.median(half_s)) for half_s in np.array_split(late_s, 2))
    steady = abs(first - second) <= DRIFT_S and (np.abs(late_s - np.median(late_s)) <= AGREE_S).all()
    if steady and not _fallen(boot_s, kind[known], 0.0).any():
        return Arrivals(kept, begin, end, arrived_us, odd, run.restarts, 0)
    own_s = boot_s - boot_s[0] + float(np.median(late_s[-_LATEST:]))
    rows = np.arange(len(arrived_us))
    before = np.clip(np.searchsorted(known, rows, side="right") - 1, 0, len(known) - 1)
    after = np.clip(np.searchsorted(known, rows), 0, len(known) - 1)
    low_s = np.where(rows < known[0], own_s[0] - AGREE_S, np.minimum(own_s[before], own_s[after]))
    high_s = np.where(rows > known[-1], own_s[-1] + AGREE_S, np.maximum(own_s[before], own_s[after]))
    sent_s = (low_s + high_s) / 2
    for near in (after, before):  # by the stamps of a neighbour, if they were written by the same clock
        by_near_s = own_s[near] + arrived_s - arrived_s[known[near]]
        sent_s = np.where((by_near_s >= low_s) & (by_near_s <= high_s), by_near_s, sent_s)
    moved = int((np.abs(arrived_s - sent_s)[kept] > DRIFT_S).sum())
    sent_us = arrived_us[known[0]] + np.round(sent_s * 1e6).astype(np.int64)
    return Arrivals(kept, begin, end, sent_us, odd, run.restarts, moved)
