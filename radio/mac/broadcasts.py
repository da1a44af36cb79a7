"""Group-addressed frames: one frame on the air, heard by whom it reaches; no ack, no retry, basic rate."""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set

import numpy as np
from numpy.typing import NDArray

from sortie.radio.counters import CAUSES, Counters
from sortie.radio.mac.airtime import frame_bytes, group_frame_s
from sortie.radio.mac.jobs import GroupFrame
from sortie.scenarios.streams import stream

MAX_GROUP_PAYLOAD_BYTES = 2200
"""A group-addressed sample is one 802.11 frame."""

_GROUP_OVERHEAD_BYTES = frame_bytes(0, unicast=False)
_HEARD = len(CAUSES) + 1
"""As `sortie.radio.mac.edca` numbers fates: 1 and on are the causes, then that it was heard."""
_COLLISIONS = 3

OnHeard = Callable[[Sequence[int]], None]


class Broadcast(GroupFrame):
    """A context frame and who wants to know."""

    __slots__ = ("on_heard",)

    def __init__(self, sender: int, airtime_s: float, wire_bytes: int, on_heard: OnHeard) -> None:
        GroupFrame.__init__(self, sender, airtime_s, wire_bytes)
        self.on_heard = on_heard


class Broadcasts:
    """The group-addressed half of the air; `Air` documents the arguments.

    `gone` is the air's own set of silenced drones; `phase_s` is how long after the call each drone's frames reach
    its radio.
    """

    def __init__(
        self,
        rate_mbps: float,
        n: int,
        counters: Counters,
        gone: Set[int],
        *,
        seed: int,
        replication: int,
        frame_s: float,
        publish_spread: float,
        as_lists: bool,
    ) -> None:
        self._rate_mbps, self._n, self._counters, self._gone, self._as_lists = rate_mbps, n, counters, gone, as_lists
        self._airtime_s: dict[int, float] = {}  # by payload, bytes
        self._others = [(*range(i), *range(i + 1, n)) for i in range(n)] if as_lists else []
        self.phase_s = [0.0] * n
        if publish_spread:
            at = [float(stream(seed, replication, i, "publish phase").random()) for i in range(n)]
            self.phase_s = [x * publish_spread * frame_s for x in at]

    def frame(self, sender: int, payload_bytes: int, on_heard: OnHeard) -> Broadcast:
        """One more frame of a drone; arguments and errors as for `Air.broadcast`."""
        if not 0 <= sender < self._n:
            raise ValueError(f"sender is {sender}, must be in [0, {self._n - 1}]")
        if not 1 <= payload_bytes <= MAX_GROUP_PAYLOAD_BYTES:
            raise ValueError(f"payload_bytes is {payload_bytes}, must be in [1, {MAX_GROUP_PAYLOAD_BYTES}]")
        airtime_s = self._airtime_s.get(payload_bytes)
        if airtime_s is None:
            airtime_s = self._airtime_s[payload_bytes] = group_frame_s(payload_bytes, self._rate_mbps)
        self._counters.broadcasts += 1
        return Broadcast(sender, airtime_s, payload_bytes + _GROUP_OVERHEAD_BYTES, on_heard)

    def end(self, frame: Broadcast, receivers: NDArray[np.int64], fates: bytes) -> None:
        """The medium is through with a frame; receivers that it does not name are out of its reach."""
        counters, sender, gone = self._counters, frame.sender, self._gone
        living = self._n - 1 - (len(gone - {sender}) if gone else 0)
        if gone:  # receptions at drones that are gone do not count
            of_all = np.frombuffer(fates, np.uint8).copy()
            of_all[np.isin(receivers, list(gone))] = 0
            fates = of_all.tobytes()
        heard: Sequence[int]
        if not self._as_lists:
            heard = receivers[np.frombuffer(fates, np.uint8) == _HEARD].tolist()
        elif gone or fates.count(_HEARD) < living:
            heard = [j for j, fate in zip(receivers.tolist(), fates, strict=True) if fate == _HEARD]
        else:
            heard = self._others[sender]
        if len(heard) < living:
            self._miss(fates, living - len(heard))
        counters.receptions += len(heard)
        frame.on_heard(heard)

    def _miss(self, fates: bytes, missed: int) -> None:
        counters = self._counters
        counters.missed += missed
        by_cause = [fates.count(cause) for cause in range(1, _HEARD)]
        for name, count in zip(CAUSES, by_cause, strict=True):
            counters.lost_to[name] += count
        counters.lost_to["weak_signal"] += missed - sum(by_cause)
        counters.collided += any(by_cause[:_COLLISIONS])
