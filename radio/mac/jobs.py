"""What claims the air: samples as jobs, descriptors as group frames, and how a job ends. `medium` serves them."""

from __future__ import annotations

from enum import Enum
from math import inf, nan

from sortie.radio.mac.airtime import Exchanges
from sortie.radio.mac.contention import DIFS_S, contention

_IDLE_ALONE_S = contention(1).idle_s


class End(Enum):
    """How a job left the medium."""

    SERVED = "served"
    DEADLINE_QUEUED = "deadline_queued"
    DEADLINE_IN_SERVICE = "deadline_in_service"


class AirJob:
    """One sample's claim on the air; subclassed by what knows the sample.

    `remaining` runs from 1 to 0 while it is served. `granted_s` is the channel time that it was given
    (shares of contention included), `alone_s` the channel time that it needs alone, `need_s` beside the senders
    that are backlogged now.
    """

    __slots__ = (
        "alone_s",
        "clean_s",
        "collided_s",
        "count",
        "deadline_s",
        "granted_s",
        "live",
        "need_s",
        "number",
        "ppdu_s",
        "remaining",
        "sender",
        "t_start_s",
    )

    def __init__(self, number: int, sender: int, deadline_s: float) -> None:
        self.number = number
        self.sender = sender
        self.deadline_s = deadline_s
        self.remaining = 1.0
        self.granted_s = 0.0
        self.t_start_s = nan
        self.live = True
        self.count = self.ppdu_s = self.clean_s = self.collided_s = self.alone_s = self.need_s = 0.0

    def demand(self, exchanges: Exchanges, tries: float = 1.0) -> None:
        """Set the load that the whole job puts on the medium, each frame sent `tries` times; `remaining` stays."""
        self.count = count = exchanges.count * tries
        self.ppdu_s = ppdu_s = exchanges.ppdu_s * tries
        self.clean_s = clean_s = exchanges.clean_s * tries
        self.collided_s = ppdu_s + count * DIFS_S
        self.alone_s = clean_s + count * _IDLE_ALONE_S


class GroupFrame:
    """One group-addressed frame; subclassed by what knows its content."""

    __slots__ = ("airtime_s", "fire_s", "sender", "slots")

    def __init__(self, sender: int, airtime_s: float, slots: int) -> None:
        self.sender = sender
        self.airtime_s = airtime_s
        self.slots = slots
        self.fire_s = inf
