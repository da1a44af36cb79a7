"""Percentiles of more numbers than memory has room for, equal to numpy's to the last bit."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

IN_MEMORY = 1 << 19
"""So many numbers are sorted in memory; of more, the ranks that are wanted are found in passes."""
_SIGN = np.uint64(1 << 63)
_DIGIT_BITS = 16

Pieces = Callable[[], Iterable[NDArray[np.float64]]]
"""All numbers, piece after piece; each call begins anew."""


def percentiles(pieces: Pieces, of: tuple[float, ...]) -> list[float] | None:
    """Percentiles as `numpy.percentile` interpolates them; None of nothing."""
    count = sum(map(len, pieces()))
    if count == 0:
        return None
    if count <= IN_MEMORY:
        return [float(v) for v in np.percentile(np.concatenate(list(pieces())), of)]
    places = [(count - 1) * (q / 100) for q in of]
    wanted = {rank for place in places for rank in (int(place), min(int(place) + 1, count - 1))}
    at = _of_rank(pieces, wanted)
    return [_between(at[int(p)], at[min(int(p) + 1, count - 1)], p - int(p)) for p in places]


def _between(low: float, high: float, share: float) -> float:
    return high - (high - low) * (1 - share) if share >= 0.5 else low + (high - low) * share


def _of_rank(pieces: Pieces, ranks: Iterable[int]) -> dict[int, float]:
    """The numbers of these ranks from below, 0 the least: digit after digit of 16 bits, as in a radix sort."""
    digits = 1 << _DIGIT_BITS
    begin = dict.fromkeys(
        ranks, (0, 0)
    )  # by rank: the digits that are known, and how many numbers lie below all of those
    for shift in range(64 - _DIGIT_BITS, -1, -_DIGIT_BITS):
        counts = {known: np.zeros(digits, np.int64) for known, _ in begin.values()}
        for piece in pieces():
            keys = _ordered(piece)
            for known, count in counts.items():
                own = keys if shift + _DIGIT_BITS == 64 else keys[keys >> np.uint64(shift + _DIGIT_BITS) == known]
                digit = (own >> np.uint64(shift)) & np.uint64(digits - 1)
                count += np.bincount(digit.astype(np.int64), minlength=digits)
        for rank, (known, below) in begin.items():
            up_to = np.cumsum(counts[known])
            digit = int(np.searchsorted(up_to, rank - below, side="right"))
            begin[rank] = known << _DIGIT_BITS | digit, below + int(up_to[digit - 1] if digit else 0)
    return {rank: _number(known) for rank, (known, _) in begin.items()}


def _ordered(values: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Whole numbers that are in the order of these."""
    bits = np.ascontiguousarray(values, np.float64).view(np.uint64)
    return np.where(bits & _SIGN, ~bits, bits | _SIGN)


def _number(key: int) -> float:
    bits = np.uint64(key)
    return float((bits ^ _SIGN if bits & _SIGN else ~bits).view(np.float64))
