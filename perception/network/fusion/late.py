"""Late fusion: every drone detects alone, and boxes are joined in the world (`sortie.perception.joining`)."""

from __future__ import annotations

from sortie.perception.joining import LATE_MIN_SCORE
from sortie.perception.network.fusion.none import Alone
from sortie.perception.network.fusion.traffic import LinkBytes, boxes_of


class Late(Alone):
    """Features are left alone; `joining` does the work. It has no parameters."""

    name = "late"
    about = f"boxes above {LATE_MIN_SCORE}, joined as perception.join says"
    shares = "boxes"

    @classmethod
    def link_bytes(cls, cells: int = 0, boxes: int = 0) -> LinkBytes:
        return boxes_of(boxes)
