"""What a payload carries: the steps of fidelity, their names in files and tables, and which of them are boxes or maps."""

from __future__ import annotations

from enum import IntEnum
from typing import Literal, get_args

RepresentationName = Literal["none", "tracks", "detections", "features", "raw"]
"""The names in scenarios, tables and invariants, in the order of `Representation`."""


class Representation(IntEnum):
    """The fidelity of what a link carries, lowest first; the number is the one on the wire."""

    NONE = 0
    TRACKS = 1
    DETECTIONS = 2
    FEATURES = 3
    RAW = 4


NAME_OF: dict[Representation, RepresentationName] = dict(zip(Representation, get_args(RepresentationName), strict=True))
REPRESENTATION_OF: dict[str, Representation] = {name: representation for representation, name in NAME_OF.items()}
BOXES = (Representation.TRACKS, Representation.DETECTIONS)
"""Small lists of objects. They are sent reliably, and a receiver joins them to its own boxes (late fusion)."""
BOX_NAMES = tuple(NAME_OF[r] for r in BOXES)
MAPS = (Representation.FEATURES, Representation.RAW)
"""What a receiver fuses as feature maps."""
MAP_NAMES = tuple(NAME_OF[r] for r in MAPS)
