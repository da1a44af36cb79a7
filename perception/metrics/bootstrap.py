"""AP of resampled frames, and the paired difference of two APs. `sortie.scenarios.intervals` reads the draws. Free of torch.

One set of resamples serves a whole table: the same frames are drawn for every condition, so that every difference is
paired, and any arithmetic of APs has its interval by doing it to every draw.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sortie.perception.errors import InputError
from sortie.perception.metrics.ap import Matched, area, average_precision
from sortie.scenarios.intervals import DRAWS, Floats, p_value, percentile_interval, resamples

BINS = 2000
"""Points of the curve that a draw is worked out at."""


@dataclass(frozen=True, slots=True)
class Ranked:
    """Matched units by group and rank bin, ready to be weighted.

    The curve of a resample is the weighted sum of its groups' counts, a matrix product. Bins follow the scores of all
    units, best first, and end between unequal scores; each holds about as many hits, and as many misses, as any other.
    """

    hits: Floats
    """[groups, bins]"""
    detections: Floats
    """[groups, bins]"""
    truths: Floats
    """[groups]"""
    offset: float
    """What the bins take from the AP of all units, given back to every draw."""

    def ap(self, weights: Floats) -> Floats:
        """AP [b] with every group counted weights[b, group] times; NaN where nothing is left to find."""
        weights = np.asarray(weights, np.float64)
        truths = weights @ self.truths
        right = np.cumsum(weights @ self.hits, axis=1)
        seen = np.cumsum(weights @ self.detections, axis=1)
        value = area(right, right / np.maximum(seen, 1e-12), np.maximum(truths, 1e-12))
        return np.where(truths > 0, value + self.offset, np.nan)


def rank(units: Sequence[Matched], groups: ArrayLike | None = None, bins: int = BINS) -> Ranked:
    """Sort matched units into rank bins.

    Args:
        units: one per ego and frame.
        groups: [units] a label each (a frame, a scene): units of one label stand or fall together. Groups are in the
            order of their sorted labels. Left out, every unit is its own.
        bins: about how many; 0 for one per distinct score, which is exact.
    """
    label = np.unique(np.arange(len(units)) if groups is None else np.asarray(groups), return_inverse=True)[1]
    many = int(label.max()) + 1 if len(label) else 0
    truths = np.bincount(label, [u.truths for u in units], many).astype(np.float64)
    score = np.concatenate([u.score for u in units]) if units else np.zeros(0)
    hit = np.concatenate([u.hit for u in units]) if units else np.zeros(0, bool)
    owner = np.repeat(label, [len(u.score) for u in units])
    order = np.argsort(-score, kind="stable")
    score, hit, owner = score[order], hit[order], owner[order]
    ends = np.append(score[1:] != score[:-1], True) if len(score) else np.zeros(0, bool)
    if bins and ends.sum() > bins:
        # a bin ends at a hit, where precision peaks, when the hits or the misses so far enter another of bins / 2 parts
        at, so_far = np.flatnonzero(ends), np.cumsum(hit)
        at = at[np.diff(so_far[at], prepend=0) > 0]
        right, wrong = so_far[at], at + 1 - so_far[at]
        part = right * (bins // 2) // max(so_far[-1], 1) + wrong * (bins // 2) // max(wrong.max(initial=0), 1)
        ends[:] = False
        ends[at[:-1][np.diff(part) > 0]] = True
        ends[-1] = True
    bin_of = np.cumsum(ends) - ends
    width = int(ends.sum())
    cell = owner * width + bin_of
    table = [np.bincount(cell, w, many * width).reshape(many, width).astype(np.float64) for w in (hit, None)]
    plain = Ranked(table[0], table[1], truths, 0.0)
    if not bins or not truths.any():
        return plain
    return replace(plain, offset=average_precision(units) - float(plain.ap(np.ones((1, many)))[0]))


@dataclass(frozen=True, slots=True)
class Difference:
    """AP of b minus AP of a, with its paired 95 % interval; `ap_a` and `ap_b` are on all frames.

    A single frame or group has no interval: `low`, `high` and `p` are NaN.
    """

    ap_a: float
    ap_b: float
    delta: float
    low: float
    high: float
    p: float = float("nan")
    """Two-sided."""


def compare(
    a: Sequence[Matched], b: Sequence[Matched], groups: ArrayLike | None = None, draws: int = DRAWS, seed: int = 0
) -> Difference:
    """Paired percentile bootstrap of AP(b) − AP(a) over frames, or over groups of frames that stand or fall together.

    Args:
        a, b: the same frames, in the same order, under two conditions.
        groups: [frames] a label each (a scene, a fleet-frame); left out, every frame is its own.
        draws, seed: number of resamples and the key of their stream.

    Raises:
        InputError: a and b have unequally many frames.
    """
    if len(a) != len(b):
        raise InputError(f"a has {len(a)} frames and b has {len(b)}, must be the same")
    ranked = [rank(units, groups) for units in (a, b)]
    ap_a, ap_b = average_precision(a), average_precision(b)
    if len(ranked[0].truths) < 2:
        return Difference(ap_a, ap_b, ap_b - ap_a, math.nan, math.nan)
    weights = resamples(len(ranked[0].truths), draws, seed)
    gain = ranked[1].ap(weights) - ranked[0].ap(weights)
    return Difference(ap_a, ap_b, ap_b - ap_a, *percentile_interval(gain), p_value(gain))
