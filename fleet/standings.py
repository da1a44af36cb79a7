"""What one drone thinks of the others, in one array: a judgement is a compiled loop over it (`sortie.fleet.trust_loops`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

STRIKES_TO_DOUBT, MOST_STRIKES = 2, 6


class Standing(NamedTuple):
    """What one drone thinks of another."""

    strikes: int = 0
    reason: str = ""
    """The latest doubt."""
    seconds: int = 0
    """Judgements since it was first judged, those included at which nothing was heard of it."""
    first_soc: float = 0.0
    """Its charge when it was first judged."""
    least_soc: float = 1.0
    fine: bool = False
    """Whether it ever told its charge more finely than in whole percents."""
    unheard: int = 0
    """Judgements since the last at which it was heard."""

    @property
    def trust(self) -> float:
        """1 until a doubt was found twice in a row, then halved by each further one; 0 from the sixth."""
        if self.strikes < STRIKES_TO_DOUBT:
            return 1.0
        return 0.0 if self.strikes >= MOST_STRIKES else 0.5 ** (self.strikes - STRIKES_TO_DOUBT + 1)


UNJUDGED = Standing()
ROW = np.dtype(
    [
        ("is_there", "?"),
        ("fine", "?"),
        ("strikes", "u1"),
        ("seconds", "i4"),
        ("unheard", "i4"),
        ("first_soc", "f8"),
        ("least_soc", "f8"),
    ]
)


class Standings(Mapping[int, Standing]):
    """Standings by id, ascending."""

    __slots__ = ("reasons", "rows")
    rows: NDArray[np.void]
    """[ids], all values but the reasons."""
    reasons: dict[int, str]
    """Of those who were ever doubted."""

    def __init__(self, of: Mapping[int, Standing], room: int = 0) -> None:
        """A copy of others, with room for ids below `room` at least."""
        if isinstance(of, Standings):
            self.rows = np.zeros(max(room, len(of.rows)), ROW)
            self.rows[: len(of.rows)] = of.rows
            self.rows["least_soc"][len(of.rows) :] = UNJUDGED.least_soc
            self.reasons = of.reasons.copy()
        else:
            self.rows = np.zeros(max([room, *[i + 1 for i in of]]), ROW)
            self.rows["least_soc"] = UNJUDGED.least_soc
            self.reasons = {i: s.reason for i, s in of.items()}
            for i, s in of.items():
                self.rows[i] = (True, s.fine, s.strikes, s.seconds, s.unheard, s.first_soc, s.least_soc)

    def __getitem__(self, drone: int) -> Standing:
        if not 0 <= drone < len(self.rows) or not self.rows["is_there"][drone]:
            raise KeyError(drone)
        _, fine, strikes, seconds, unheard, first_soc, least_soc = self.rows[drone].item()
        return Standing(strikes, self.reasons.get(drone, ""), seconds, first_soc, least_soc, fine, unheard)

    def __iter__(self) -> Iterator[int]:
        return iter(np.flatnonzero(self.rows["is_there"]).tolist())

    def __len__(self) -> int:
        return int(np.count_nonzero(self.rows["is_there"]))
