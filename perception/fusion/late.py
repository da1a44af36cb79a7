"""Late fusion: every drone detects alone, and boxes are joined in the world (`perception.joining`)."""

from __future__ import annotations

from perception.fusion.none import Alone
from perception.fusion.traffic import LinkBytes, boxes_of
from perception.types import Boxes

SCORE_ABOVE = 0.2
"""What peers send: boxes with a score above this."""


class Late(Alone):
    """Features are left alone; `joining` does the work. It has no parameters."""

    name = "late"
    about = f"boxes above {SCORE_ABOVE}, joined as perception.join says"
    shares = "boxes"

    @classmethod
    def link_bytes(cls, cells: int = 0, boxes: int = 0) -> LinkBytes:
        return boxes_of(boxes)


def sendable(boxes: Boxes) -> Boxes:
    """What of a peer's boxes late fusion sends."""
    return boxes.take(boxes.score > SCORE_ABOVE)
