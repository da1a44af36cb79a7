"""A live drone's own state from the vehicle that flies: a MAVLink port instead of the replayed poses and charge."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Sequence

import numpy as np

from sortie.fleet.agent import Platform, Task
from sortie.fleet.coverage import Poses, footprint_radius_m, views
from sortie.fleet.flight.frames import yaw_rad
from sortie.fleet.logs.geodesy import Origin
from sortie.fleet.logs.vehicle import WANTED_HZ, VehicleState, after
from sortie.fleet.plane import FleetRules
from sortie.fleet.senses import Sensed
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Disc, TaskPhase
from sortie.sim.export.endpoint import open_address
from sortie.sim.folders import RunError
from sortie.sim.live.context import ReplaySenses

FOUND_S = 30.0
"""The longest time for a vehicle to be heard before the flight."""
ASK_S = 1.0
"""How often a drone sends its heartbeat and asks for messages: a vehicle that restarted has forgotten."""
_DATAGRAM = 65_535


class MavlinkLink:
    """The socket to a vehicle, and a thread that reads it: a message is timed as it comes in."""

    def __init__(self, address: str, origin: Origin | None, key: bytes | None = None) -> None:
        """Args:
            address: `udpin:HOST:PORT`, where the vehicle sends to, or `udpout:HOST:PORT`, where it waits.
            origin: where ENU (0, 0, 0) lies; None: at the vehicle's own origin.
            key: the link's signing key. With it, frames without a valid signature are refused, and what goes to the
                vehicle is signed.

        Raises:
            RunError: an address that is none, is taken, or is not reached.
        """
        # pymavlink is loaded for a drone with a vehicle alone
        from sortie.fleet.logs.mavlink import Companion, Listener

        self.address, self._origin = address, origin
        self.state = VehicleState()
        self._listener, self._companion = Listener(key), Companion(key)
        self._socket, self._peer = open_address(address)
        self._socket.settimeout(0.2)
        self.port = self._socket.getsockname()[1]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def wait_until_found(self, wait_s: float = FOUND_S) -> None:
        """Wait for a vehicle's pose.

        Raises:
            RunError: none came, or no position in the frame that was asked for.
        """
        until_s = time.monotonic() + wait_s
        while math.isinf(self.state.pose_s):
            if time.monotonic() > until_s:
                missing = "vehicle" if self.state.system is None else "position and attitude"
                bad = f"; {self.refused} messages had no valid signature" if self.refused else ""
                raise RunError(f"{self.address}: no {missing} heard within {wait_s:g} s{bad}")
            time.sleep(0.02)

    @property
    def refused(self) -> int:
        """Messages without a valid signature."""
        return self._listener.refused

    def close(self) -> None:
        """End the thread and let go of the socket."""
        self._stop.set()
        self._thread.join()
        self._socket.close()

    def _read(self) -> None:
        asked_s = -math.inf
        while not self._stop.is_set():
            if self._peer is not None and time.monotonic() - asked_s > ASK_S:
                asked_s = time.monotonic()
                with contextlib.suppress(OSError):  # best effort, as on any telemetry radio
                    self._socket.sendto(self._companion.ask(self.state.system or 1, WANTED_HZ), self._peer)
            try:
                data, sender = self._socket.recvfrom(_DATAGRAM)
            except TimeoutError:
                continue
            except OSError:  # nobody waits at the address yet
                time.sleep(0.05)
                continue
            state, now_s = self.state, time.monotonic()
            for message in self._listener.heard(data):
                state = after(state, message, now_s, self._origin)
                if (message.get_srcSystem(), message.get_srcComponent()) == (state.system, state.component):
                    self._peer = sender
            self.state = state


class MavlinkSenses:
    """One drone's own sensors (sortie.fleet.agent.Senses): pose and charge of a flying vehicle, the rest replayed.

    A capture's time is when its pose came in. When telemetry stops, the stamps of descriptors and payloads therefore stay
    behind, and the staleness rules degrade and detach the drone at its peers. When peers would detach it, it says nothing.
    """

    def __init__(
        self,
        link: MavlinkLink,
        replay: ReplaySenses,
        drone: int,
        note: Callable[[str], None],
        hysteresis: float = 0.0,
    ) -> None:
        """Args: `hysteresis` is the band of the vehicle's charge (`sortie.policies.damping`)."""
        self._link, self._replay, self._drone, self._note = link, replay, drone, note
        self._hysteresis, self._soc = hysteresis, math.inf
        self._offset_s = 0.0
        self._rules: FleetRules | None = None
        self._stale = self._doubted = False
        self.muted = False
        """Whether telemetry is so old that the drone publishes and sends nothing."""

    def begin(self, offset_s: float, rules: FleetRules) -> None:
        """Args: `offset_s` from the host's monotonic clock to the flight's clock."""
        self._offset_s, self._rules = offset_s, rules

    def sense(self, frame: int) -> Sensed:
        """The drone as its vehicle last described it."""
        self._replay.sense(frame)
        state = self._link.state
        if self.refused and not self._doubted:
            self._doubted = True
            self._note("refused telemetry: a message had no valid signature")
        self._judge_age(time.monotonic() - state.pose_s)
        cameras = self._replay.cameras
        radius_m = float(footprint_radius_m(state.position_m[2], cameras))
        yaw = yaw_rad(state.orientation_xyzw)
        position, attitude, heading = (np.asarray([[v]]) for v in (state.position_m, state.orientation_xyzw, yaw))
        ((view,),) = views(Poses(position, attitude, heading, position, heading), self._replay.height_field, [cameras])
        capture = Capture(
            self._drone,
            state.pose_s + self._offset_s,
            state.position_m,
            state.orientation_xyzw,
            state.position_m,
            float(yaw),
            cameras=cameras,
        )
        return Sensed(capture, state.velocity_mps, radius_m, view, capture.orientation_xyzw)

    @property
    def refused(self) -> dict[str, int]:
        """Messages of telemetry that were refused, by reason."""
        return {"telemetry unsigned or forged": self._link.refused} if self._link.refused else {}

    def platform(self) -> Platform:
        """The vehicle's charge, where it knows it, with a hysteresis band; headrooms are replayed."""
        replayed, soc = self._replay.platform(), self._link.state.soc
        if soc is None:
            return replayed
        self._soc = min(soc, max(self._soc, soc / (1.0 + self._hysteresis)))
        return replayed._replace(soc=self._soc)

    def task(self) -> Task:
        """The scenario's mission; a vehicle on the ground is landing."""
        task = self._replay.task()
        return task._replace(phase=TaskPhase.LANDING) if self._link.state.landed else task

    def goodput_mbps(self, to: Sequence[int] | None = None) -> tuple[float, ...]:
        """As `sortie.fleet.agent.Modem` wants it; replayed."""
        return self._replay.goodput_mbps(to)

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        """Cars of the scene in range of the vehicle."""
        return self._replay.count_boxes(capture, roi)

    def perceived(self, capture: Capture) -> None:
        """The drone looked from where its vehicle is."""
        self._replay.perceived(capture)

    def people_in(self, capture: Capture, roi: Disc | None) -> Boxes:
        """Nobody: no thermal camera runs here."""
        return Boxes.empty()

    def tracks_in(self, capture: Capture, roi: Disc | None) -> None:
        """No tracks: no detector runs here."""

    def _judge_age(self, age_s: float) -> None:
        """Say when telemetry becomes old, and when it is back."""
        rules = self._rules
        assert rules is not None  # noqa: S101 - set in `begin`
        stale = age_s > rules.fresh_s
        muted = age_s > rules.descriptor_period_s * rules.detached_after_periods
        if muted and not self.muted:
            self._note(f"publishes nothing: the vehicle's last pose is {age_s:.2f} s old")
        elif stale and not self._stale:
            self._note(f"telemetry is stale: the vehicle's last pose is {age_s:.2f} s old")
        elif self._stale and not stale:
            self._note("telemetry is back")
        self._stale, self.muted = stale, muted
