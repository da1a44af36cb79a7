"""What claims the air: samples as jobs, descriptors as group frames, and how a job ends. `medium` serves them."""

from __future__ import annotations

from enum import Enum
from math import nan
from typing import Final

import numpy as np


class End(Enum):
    """How a job left the medium."""

    ARRIVED = "arrived"
    """All of it is at the receiver."""
    OVER = "over"
    """Every fragment has arrived or has used up its tries."""
    UNREACHABLE = "unreachable"
    """Nobody answered its first frame."""
    DEADLINE_QUEUED = "deadline_queued"
    DEADLINE_IN_SERVICE = "deadline_in_service"


NO_FRAMES: Final = np.arange(0)
NONE_DROPPED: Final[frozenset[int]] = frozenset()


class AirJob:
    """One sample's claim on the air; subclassed by what knows the sample.

    `row` is its place in the medium's tables while it is there, else −1; `frames`, `full_bytes` and `last_bytes` are the
    number of its frames (MPDUs) and the length of each and of the last; `t_start_s` is when it came to the head of its
    sender's queue.
    """

    __slots__ = (
        "arrived_frames",
        "deadline_s",
        "dropped",
        "flow",
        "frames",
        "full_bytes",
        "granted_s",
        "here",
        "keeps_frames",
        "last_bytes",
        "live",
        "number",
        "pass_granted_s",
        "row",
        "sender",
        "sent_frames",
        "t_start_s",
    )

    def __init__(self, number: int, sender: int, deadline_s: float) -> None:
        self.number = number
        self.sender = sender
        self.deadline_s = deadline_s
        self.live = True
        self.row = self.flow = -1
        self.frames = self.full_bytes = self.last_bytes = 0
        self.arrived_frames = self.sent_frames = 0  # of this pass, as the medium told last
        self.dropped: set[int] | frozenset[int] = NONE_DROPPED  # frames of this pass that used up their tries, by index
        self.keeps_frames = False  # whether `here` is kept: which frames of this pass are at the receiver
        self.here = NO_FRAMES
        self.granted_s = self.pass_granted_s = 0.0
        self.t_start_s = nan


class GroupFrame:
    """One group-addressed frame; subclassed by what knows its content."""

    __slots__ = ("airtime_s", "row", "sender", "wire_bytes")

    def __init__(self, sender: int, airtime_s: float, wire_bytes: int) -> None:
        self.sender = sender
        self.airtime_s = airtime_s
        self.wire_bytes = wire_bytes
        self.row = -1
