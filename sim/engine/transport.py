"""Between the drones and the air: which drone receives which bytes, and the fate of each payload.

The radio handles bytes and positions only. This module opens each datagram and hands it to its receivers. It also finds
the payload that belongs to a transmission number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import simpy

from sortie.fleet.gate import Payload
from sortie.fleet.memory import PeerMemory, Received, hear
from sortie.fleet.messages.auth import Dropped, Opened, open_datagram
from sortie.fleet.tiles import cells_of
from sortie.perception.types import Capture
from sortie.policies.contract import Representation
from sortie.radio import Air, Transmission
from sortie.radio.transmission import Status
from sortie.scenarios.representation import NAME_OF
from sortie.sim.results.links import LinkLog
from sortie.sim.results.record import HANDSHAKE, Recorder

OTHER_SPACE = "other_feature_space"
"""The reason of delivered feature maps and codes that their receiver refused: they are of another network or codebook."""


class Transport:
    """Joins every drone's modem and memory to the one air."""

    def __init__(
        self,
        env: simpy.Environment,
        air: Air,
        receivers: Sequence[PeerMemory],
        recorder: Recorder,
        *,
        keys: dict[int, bytes] | None,
        rates_mbps: Sequence[float],
        links: LinkLog | None = None,
    ) -> None:
        """Put the transport on the air.

        Args:
            env: the clock.
            air: carries bytes.
            receivers: takes in what arrives, by drone.
            recorder: gets each payload's fate, and each descriptor that is refused.
            keys: by key id; None where descriptors are unauthenticated.
            rates_mbps: the channel's data rates by MCS; empty where links are traced, which have no known data rate.
            links: counts the descriptors that came over each link.
        """
        self._env = env
        self._rates_mbps, self._links = rates_mbps, links
        self._receivers = receivers
        self.air = air
        self.last_datagram: dict[int, bytes] = {}
        """The latest genuine datagram of each drone, for whoever listens."""
        self._recorder = recorder
        self._keys = keys
        self._pending: dict[int, tuple[Payload, Capture, float]] = {}
        recorder.unfold["transmissions"] = _unfold_transmissions

    def modem(self, drone: int) -> _Modem:
        """The drone's end of the air."""
        return _Modem(self, drone)

    def publish(self, drone: int, datagram: bytes) -> None:
        """Broadcast a descriptor; its bytes are opened once, and checked for replay by each that hears it."""
        self.last_datagram[drone] = datagram
        opened = open_datagram(datagram, self._keys)
        self.air.broadcast(drone, len(datagram), partial(self._heard, drone, opened))

    def _heard(self, drone: int, opened: Opened | Dropped, heard: Sequence[int]) -> None:
        if self._links is not None:
            self._links.heard(drone, heard)
        self.hand_over(opened, heard)

    def inject(self, datagram: bytes, listeners: Sequence[int]) -> None:
        """Put foreign bytes before the listeners (an attacker in range of all; its airtime is not modelled)."""
        self.hand_over(open_datagram(datagram, self._keys), listeners)

    def hand_over(self, opened: Opened | Dropped, heard: Sequence[int]) -> None:
        """Give an opened datagram to those that heard it; a refused one is counted and changes nothing."""
        now_s, each = self._env.now, self._receivers
        memories = [memory for receiver in heard if (memory := each[receiver]).status.airborne]
        for receiver, reason in hear(memories, opened, now_s):
            self._recorder.rows["drops"].append((now_s, receiver, reason.value))

    def send(self, drone: int, peer: int, payload: Payload, capture: Capture, deadline_s: float) -> None:
        """Hand a payload to the radio."""
        number = self.air.send(
            drone,
            peer,
            payload.size_bytes,
            kind=NAME_OF[payload.representation],
            reliable=payload.reliable,
            deadline_s=deadline_s,
            on_done=self._done,
            piece_bytes=payload.tile_bytes,
        )
        self._pending[number] = (payload, capture, self._stamp_s(drone, capture))

    def _stamp_s(self, drone: int, capture: Capture) -> float:
        """When the capture was taken, by the drone's own clock."""
        return capture.t_s + self._receivers[drone].status.clock_skew_s

    def handshake(self, drone: int, peer: int, size_bytes: int, capture: Capture, deadline_s: float) -> None:
        """Hand a method's request or answer to the radio; it takes airtime, and nothing waits for it."""
        number = self.air.send(
            drone, peer, size_bytes, kind=HANDSHAKE, reliable=False, deadline_s=deadline_s, on_done=self._done
        )
        self._pending[number] = (
            Payload(Representation.NONE, 0.0, None, 0.0, 0, 0, 0, size_bytes),
            capture,
            capture.t_s,
        )

    def finish(self) -> None:
        """Write down what is still in flight."""
        for transmission in self.air.finish():
            self._write(transmission, *self._pending.pop(transmission.number)[:2])

    def _done(self, transmission: Transmission) -> None:
        payload, capture, stamp_s = self._pending.pop(transmission.number)
        if transmission.status == Status.DELIVERED and not self._receivers[transmission.receiver].can_fuse(payload):
            transmission = transmission._replace(reason=OTHER_SPACE)  # it took the air all the same
        self._write(transmission, payload, capture)
        if transmission.kind == HANDSHAKE:
            self._receivers[transmission.receiver].status.work.payload_bytes += transmission.arrived_bytes
        elif transmission.arrived_bytes:
            missing, mcs, rates_mbps = transmission.missing, transmission.mcs, self._rates_mbps
            if missing:
                missing = cells_of(missing, payload.cells, payload.tile_cells)
            phy_mbps = rates_mbps[mcs] if 0 <= mcs < len(rates_mbps) else math.inf
            self._receivers[transmission.receiver].receive(
                Received(capture, payload, transmission.t_done_s, stamp_s, missing, phy_mbps)
            )

    def _write(self, transmission: Transmission, payload: Payload, capture: Capture) -> None:
        self._recorder.rows["transmissions"].append((transmission, payload, capture.t_s))


def _unfold_transmissions(rows: Sequence[tuple[Any, ...]]) -> Sequence[Any]:
    """What the radio, the gate and the sensors each know of a transmission, side by side."""
    transmissions, payloads, captured_s = zip(*rows, strict=True)
    t = dict(zip(Transmission._fields, zip(*transmissions, strict=True), strict=True))
    p = dict(zip(Payload._fields, zip(*payloads, strict=True), strict=True))
    return [
        t["t_sent_s"],
        t["sender"],
        t["receiver"],
        t["kind"],
        captured_s,
        p["rho"],
        p["cells"],
        p["boxes"],
        p["index_bytes"],
        t["payload_bytes"],
        t["wire_bytes"],
        t["deadline_s"],
        t["t_start_s"],
        t["t_done_s"],
        t["status"],
        t["reason"],
        t["fragments"],
        t["fragments_lost"],
        t["repairs"],
        t["mcs"],
        t["snr_db"],
        t["airtime_s"],
        t["hops"],
        t["arrived_bytes"],
    ]


class _Modem:
    """One drone's end of the air (sortie.fleet.agent.Modem)."""

    def __init__(self, transport: Transport, drone: int) -> None:
        self.broadcast = partial(transport.publish, drone)
        self.send = partial(transport.send, drone)
        self.handshake = partial(transport.handshake, drone)
        self.goodput_mbps = partial(transport.air.goodput_mbps, drone)
