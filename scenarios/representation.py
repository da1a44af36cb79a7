"""What a payload carries: the steps of fidelity, their names in files and tables, and which of them are boxes or maps."""

from __future__ import annotations

from enum import IntEnum
from numbers import Real
from typing import Literal, get_args

RepresentationName = Literal["none", "tracks", "detections", "uncertain_boxes", "codes", "features", "raw"]
"""The names in scenarios, tables and invariants, in the order of `Representation`."""


class Representation(IntEnum):
    """The fidelity of what a link carries, lowest first; the number is the one on the wire.

    Members are ordered by fidelity, as they are listed, not by their numbers: those that came later have higher numbers
    and stand between older ones. A higher one tells a receiver more, and costs more bytes for the same things:

    - `UNCERTAIN_BOXES` are detections with the covariance of each place. What asks for detections at least has them.
    - `CODES` are features through a codebook, in 8 to 160 times fewer bytes a cell. What a receiver reads is coarser than
      features, and still a map that it can fuse, which boxes are not.

    Example:
        >>> Representation.DETECTIONS < Representation.CODES < Representation.FEATURES, int(Representation.CODES)
        (True, 6)
    """

    NONE = 0
    TRACKS = 1
    DETECTIONS = 2
    UNCERTAIN_BOXES = 5
    CODES = 6
    FEATURES = 3
    RAW = 4

    @property
    def level(self) -> float:
        """Its place in the order, as a number; of the first five it is their number."""
        return LEVELS[self]

    def __lt__(self, other: object) -> bool:
        level = _level_of(other)
        return NotImplemented if level is None else LEVELS[self] < level

    def __le__(self, other: object) -> bool:
        level = _level_of(other)
        return NotImplemented if level is None else LEVELS[self] <= level

    def __gt__(self, other: object) -> bool:
        level = _level_of(other)
        return NotImplemented if level is None else LEVELS[self] > level

    def __ge__(self, other: object) -> bool:
        level = _level_of(other)
        return NotImplemented if level is None else LEVELS[self] >= level


LEVELS: dict[int, float] = {0: 0, 1: 1, 2: 2, 5: 2.25, 6: 2.5, 3: 3, 4: 4}
"""`Representation.level` by number on the wire."""
AT_LEVEL = {level: Representation(number) for number, level in LEVELS.items()}


def _level_of(other: object) -> float | None:
    """What a representation is compared with; a plain number is a level."""
    if type(other) is Representation:
        return LEVELS[other]
    return other if isinstance(other, Real) else None  # type: ignore[return-value]


NAME_OF: dict[Representation, RepresentationName] = dict(zip(Representation, get_args(RepresentationName), strict=True))
REPRESENTATION_OF: dict[str, Representation] = {name: representation for representation, name in NAME_OF.items()}
BOXES = (Representation.TRACKS, Representation.DETECTIONS, Representation.UNCERTAIN_BOXES)
"""Small lists of objects. They are sent reliably, and a receiver joins them to its own boxes (late fusion)."""
BOX_NAMES = tuple(NAME_OF[r] for r in BOXES)
DETECTED_NAMES = ("detections", "uncertain_boxes")
"""Boxes of one look, without a history."""
CELLS = (Representation.CODES, Representation.FEATURES)
"""What a share ρ of the sender's cells is sent of."""
CELL_NAMES = tuple(NAME_OF[r] for r in CELLS)
MAPS = (*CELLS, Representation.RAW)
"""What a receiver fuses as feature maps."""
MAP_NAMES = tuple(NAME_OF[r] for r in MAPS)
