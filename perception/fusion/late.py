"""Late fusion: every drone detects alone, and boxes are joined in the world by rotated suppression."""

from __future__ import annotations

from collections.abc import Sequence

from perception.ap import suppress
from perception.fusion.none import Alone
from perception.fusion.traffic import LinkBytes, boxes_of
from perception.types import Boxes

NMS_IOU = 0.15
SCORE_ABOVE = 0.2
"""What peers send: boxes with a score above this."""


class Late(Alone):
    """Features are left alone; `join_boxes` does the work. It has no parameters."""

    name = "late"
    about = f"boxes above {SCORE_ABOVE}, joined by rotated suppression at IoU {NMS_IOU}"
    shares = "boxes"

    @classmethod
    def link_bytes(cls, cells: int = 0, boxes: int = 0) -> LinkBytes:
        return boxes_of(boxes)


def sendable(boxes: Boxes) -> Boxes:
    """What of a peer's boxes late fusion sends."""
    return boxes.take(boxes.score > SCORE_ABOVE)


def join_boxes(own: Boxes, peers: Sequence[Boxes]) -> Boxes:
    """The ego's boxes and its peers', in the world, best first; of two that overlap by more than `NMS_IOU` the better."""
    return suppress(Boxes.join([own, *peers]), NMS_IOU)
