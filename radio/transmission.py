"""One sample's fate: the row of the record."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class Status(StrEnum):
    """Outcome of a sample."""

    DELIVERED = "delivered"
    LOST = "lost"
    EXPIRED = "expired"
    PARTIAL = "partial"
    """Pieces of it arrived, not all."""
    IN_FLIGHT = "in_flight"


class Transmission(NamedTuple):
    """A unicast sample from its writing to its end.

    | field | meaning |
    |---|---|
    | number | running number of `Air.send` |
    | sender, receiver | who wrote it and for whom, also where it went over others |
    | kind | the caller's word for what it is; samples of one sender, receiver and kind replace one another |
    | payload_bytes | what was handed over |
    | wire_bytes | bytes of the 802.11 frames put on the air, MAC retries not counted, repairs counted |
    | t_sent_s, deadline_s | when it was written and by when it must be through, on the clock |
    | t_start_s | when it first came to be served, on its first hop; NaN if never |
    | t_done_s | when its fate was settled; NaN while in flight |
    | reason | '' if delivered or in flight; else why it, or its rest, did not come: fragment_lost, no_link, sender_gone, receiver_gone (lost); deadline_queued, deadline_in_service, replaced (expired) |
    | fragments, fragments_lost | DDS fragments, and how often one was lost in all passes |
    | repairs | repair rounds |
    | mcs, snr_db | of its latest service, or −1 and the mean SNR at its sending |
    | airtime_s | channel time of its frames and their answers, retries included, on all hops; without the backoff before them |
    | hops | links it went over, or the one it was on |
    | arrived_bytes | payload at the receiver: all, none, or that of the pieces that came |
    | missing | pieces that did not come, ascending, where it arrived in part |
    """

    number: int
    sender: int
    receiver: int
    kind: str
    payload_bytes: int
    wire_bytes: int
    t_sent_s: float
    deadline_s: float
    t_start_s: float
    t_done_s: float
    status: Status
    reason: str
    fragments: int
    fragments_lost: int
    repairs: int
    mcs: int
    snr_db: float
    airtime_s: float
    hops: int = 1
    arrived_bytes: int = 0
    missing: tuple[int, ...] = ()
