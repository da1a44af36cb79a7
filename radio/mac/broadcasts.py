"""Group-addressed frames: one frame on the air, heard by whom it reaches; no ack, no retry, basic rate."""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set
from math import inf

from sortie.radio.channel.snr import Channel
from sortie.radio.counters import Counters
from sortie.radio.mac.airtime import frame_bytes, group_frame_s
from sortie.radio.mac.jobs import GroupFrame
from sortie.radio.mac.medium import CW_CONTEXT
from sortie.radio.overrides import Overrides
from sortie.radio.settings import AirSettings
from sortie.scenarios.streams import stream

MAX_GROUP_PAYLOAD_BYTES = 2200
"""A group-addressed sample is one 802.11 frame."""

_GROUP_OVERHEAD_BYTES = frame_bytes(0, unicast=False)

OnHeard = Callable[[Sequence[int]], None]


class Broadcast(GroupFrame):
    """A context frame with its length and who wants to know."""

    __slots__ = ("mpdu_bytes", "on_heard", "residual")

    def __init__(
        self, sender: int, airtime_s: float, slots: int, residual: float, mpdu_bytes: int, on_heard: OnHeard
    ) -> None:
        self.sender, self.airtime_s, self.slots = sender, airtime_s, slots  # as GroupFrame, in one go
        self.fire_s = inf
        self.residual = residual
        self.mpdu_bytes = mpdu_bytes
        self.on_heard = on_heard


class Broadcasts:
    """The group-addressed half of the air; `Air` documents the arguments.

    `gone` is the air's own set of silenced drones;
    `overrides` None is none. `phase_s` is how long after the call each drone's frames reach
    its radio.
    """

    def __init__(
        self,
        settings: AirSettings,
        channel: Channel,
        counters: Counters,
        gone: Set[int],
        overrides: Overrides | None,
        *,
        seed: int,
        replication: int,
        frame_s: float,
        publish_spread: float,
    ) -> None:
        self._rate_mbps = settings.group_rate_mbps
        self._channel = channel
        self._counters = counters
        self._gone = gone
        self._overrides = overrides
        self._n = n = channel.n
        self._access_streams = [stream(seed, replication, i, "access") for i in range(n)]
        self._access: list[list[tuple[int, float]]] = [[] for _ in range(n)]  # backoff slots and residual
        self._airtime_s: dict[int, float] = {}  # by payload, bytes
        self.phase_s = [
            float(stream(seed, replication, i, "publish phase").random()) * publish_spread * frame_s for i in range(n)
        ]
        self._heard_in = [-1] * n  # the last frame in which each drone was on the air
        self._heard_times = [0] * n  # how often in that frame before

    def frame(self, sender: int, payload_bytes: int, on_heard: OnHeard) -> Broadcast:
        """One more frame of a drone, with its own random draws; arguments and errors as for `Air.broadcast`."""
        if not 0 <= sender < self._n:
            raise ValueError(f"sender is {sender}, must be in [0, {self._n - 1}]")
        if not 1 <= payload_bytes <= MAX_GROUP_PAYLOAD_BYTES:
            raise ValueError(f"payload_bytes is {payload_bytes}, must be in [1, {MAX_GROUP_PAYLOAD_BYTES}]")
        ready = self._access[sender]
        if not ready:
            drawn = self._access_streams[sender].random((256, 2)).tolist()[::-1]
            ready.extend([(int(slot_u * (CW_CONTEXT + 1)), residual) for slot_u, residual in drawn])
        slots, residual = ready.pop()
        airtime_s = self._airtime_s.get(payload_bytes)
        if airtime_s is None:
            airtime_s = self._airtime_s[payload_bytes] = group_frame_s(payload_bytes, self._rate_mbps)
        counters = self._counters
        counters.broadcasts += 1
        counters.context_sent_bytes += payload_bytes
        return Broadcast(sender, airtime_s, slots, residual, payload_bytes + _GROUP_OVERHEAD_BYTES, on_heard)

    def end(self, frame: Broadcast, collided: bool) -> None:
        """The medium is through with a frame."""
        counters, sender, gone = self._counters, frame.sender, self._gone
        counters.context_wire_bytes += frame.mpdu_bytes
        living = self._n - 1 - (len(gone - {sender}) if gone else 0)
        if collided:
            counters.collided += 1
            counters.missed += living
            counters.lost_to["collision_context"] += living
            frame.on_heard([])
            return
        index, times = self._channel.frame, 0
        if self._heard_in[sender] == index:
            times = self._heard_times[sender] = self._heard_times[sender] + 1
        else:
            self._heard_in[sender], self._heard_times[sender] = index, 0
        heard = self._channel.heard(sender, frame.mpdu_bytes, times)
        if self._overrides is not None:
            heard = self._overrides.heard(sender, heard, frame.mpdu_bytes, times)
        if gone:
            heard = [i for i in heard if i not in gone]
        count = len(heard)
        counters.receptions += count
        counters.missed += living - count
        counters.lost_to["weak_signal"] += living - count
        frame.on_heard(heard)
