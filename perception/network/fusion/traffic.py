"""The bytes that each fusion method sends. Free of torch.

A link is one sender and one receiver in one frame. Counted is content: features (80 channels × 2 B a cell), which
cells they are, boxes, and what a method asks for first. Descriptors, headers and fragments are the radio's.
"""

from __future__ import annotations

from dataclasses import dataclass

from sortie.perception.budget import CELLS, DETECTION_BYTES, index_bytes, payload_bytes

REQUEST_BYTES = CELLS * 2
"""A request map R = 1 − C for one receiver: one float16 a cell."""


@dataclass(frozen=True, slots=True)
class LinkBytes:
    """Bytes of one link in one frame."""

    payload: int = 0
    """Features or boxes."""
    index: int = 0
    """Which cells they are: 12 bits a cell or a 512 B bitmap, the smaller; nothing when all are sent."""
    handshake: int = 0
    """Sent by the receiver beforehand."""

    @property
    def total(self) -> int:
        """Payload, index and handshake together."""
        return self.payload + self.index + self.handshake


def features_of(cells: int, requests: int = 0) -> LinkBytes:
    """Bytes of `cells` of a map, preceded by `requests` request maps.

    Raises:
        ValueError: more cells than a map has, or fewer than none.
    """
    if not 0 <= cells <= CELLS:
        raise ValueError(f"cells is {cells}, must be 0 to {CELLS}")
    return LinkBytes(payload_bytes(cells), index_bytes(cells), requests * REQUEST_BYTES)


def boxes_of(boxes: int) -> LinkBytes:
    """Detections of 24 B each."""
    if boxes < 0:
        raise ValueError(f"boxes is {boxes}, must be at least 0")
    return LinkBytes(boxes * DETECTION_BYTES)
