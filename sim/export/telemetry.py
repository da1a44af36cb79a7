"""A fleet as MAVLink vehicles: a telemetry log of a run, and an endpoint that ground stations join while it flies."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from sortie.fleet.logs.geodesy import Origin
from sortie.fleet.logs.mavlink import KEY_BYTES, STATUS, Listener, Telemetry, Transmitter, answers, messages, write_tlog
from sortie.fleet.traces import flown_at
from sortie.perception.scene.scene_model import SceneModel
from sortie.scenarios.schema import Fleet, Scenario
from sortie.sim.folders import RunError
from sortie.sim.results.record import SortieRecord

ORIGIN = Origin(47.397742, 8.545594, 488.0)
"""Where ENU (0, 0, 0) lies where nobody says otherwise: the field in Zurich at which PX4's simulators start."""


def origin_of(fleet: Fleet) -> Origin:
    """Where a fleet flies: at `fleet.origin`, else where its trace in latitude and longitude begins, else at `ORIGIN`.

    Raises:
        TraceError: its trace cannot be read.
    """
    at = flown_at(fleet)
    return ORIGIN if at is None else Origin(**at.model_dump())


def given_origin(fleet: Fleet) -> Origin | None:
    """`fleet.origin`, if there is one."""
    return None if fleet.origin is None else Origin(**fleet.origin.model_dump())


class Telemeter:
    """Turns rows of the record into telemetry; load is kept from slice to slice."""

    def __init__(self, scenario: Scenario) -> None:
        self._frame_s = scenario.frame_s
        self._load = np.zeros(scenario.fleet.drones)
        self._stations = {station.drone for station in scenario.fleet.ground}

    def add(self, new: Mapping[str, pa.Table]) -> Iterator[tuple[int, Telemetry]]:
        """Each drone's state in each frame of the tables `states` and `descriptors`, in order of time."""
        descriptors = new["descriptors"]
        published = iter(zip(*(descriptors[k].to_pylist() for k in ("t_s", "drone", "cpu_headroom")), strict=True))
        said = next(published, None)
        for row in new["states"].to_pylist():
            while said is not None and said[0] <= row["t_s"] + self._frame_s / 2:
                self._load[said[1]] = 1.0 - said[2]
                said = next(published, None)
            yield row["drone"], self._telemetry(row)
        while said is not None:
            self._load[said[1]] = 1.0 - said[2]
            said = next(published, None)

    def _telemetry(self, row: dict[str, Any]) -> Telemetry:
        drone, landed = row["drone"], not row["airborne"]
        still = (0.0, 0.0, 0.0)
        return Telemetry(
            time_s=row["t_s"],
            position_m=(row["x_m"], row["y_m"], row["z_m"]),
            orientation_xyzw=(row["qx"], row["qy"], row["qz"], row["qw"]),
            velocity_mps=still if landed else (row["vx_mps"], row["vy_mps"], row["vz_mps"]),
            body_rates_radps=still if landed else (row["p_radps"], row["q_radps"], row["r_radps"]),
            soc=row["soc"],
            voltage_v=row["voltage_v"],
            current_a=row["current_a"],
            energy_used_j=row["spent_j"],
            cpu_load=float(np.clip(self._load[drone], 0.0, 1.0)),
            landed=landed,
            ground_station=drone in self._stations,
        )


class Stream:
    """The messages of the whole fleet, in order of time: pose at every frame of the sortie, status once a second.

    They are packed by `transmitters`, each when it is sent: packing numbers a frame and stamps its signature.
    """

    def __init__(
        self, scenario: Scenario, origin: Origin, key: bytes | None = None, begin_us: int | None = None
    ) -> None:
        n, signed_at = scenario.fleet.drones, {} if begin_us is None else {"signed_at_us": begin_us}
        self.transmitters = [Transmitter(i, key, **signed_at) for i in range(n)]
        self._telemeter, self._origin = Telemeter(scenario), origin
        self._second = [-1] * n

    def add(self, new: Mapping[str, pa.Table]) -> Iterator[tuple[float, int, Any]]:
        """Time, drone and message of everything that new rows have to tell."""
        for drone, state in self._telemeter.add(new):
            second = int(state.time_s + 1e-6)
            status = second != self._second[drone]
            self._second[drone] = second
            for message in messages(state, self._origin):
                if status or message.get_type() not in STATUS:
                    yield state.time_s, drone, message


def save_tlog(
    record: SortieRecord, path: Path, begin_us: int, origin: Origin | None = None, key: bytes | None = None
) -> int:
    """Write a run as one telemetry log of all its drones, system ids 1 … N; returns the number of frames.

    Args:
        begin_us: when the sortie began, µs since 1970.
        origin: where on the globe ENU (0, 0, 0) lies; None: by `origin_of`.
        key: 32 B with which frames are signed.

    Raises:
        RunError: the file cannot be written.
        TraceError: its trace is needed for the origin and cannot be read.
    """
    origin = origin_of(record.scenario.fleet) if origin is None else origin
    stream = Stream(record.scenario, origin, key, None if key is None else begin_us)
    frames = [
        (begin_us + round(t_s * 1e6), stream.transmitters[drone].pack(message))
        for t_s, drone, message in stream.add(record.tables)
    ]
    try:
        write_tlog(path, frames)
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror}") from error
    return len(frames)


class MavlinkEndpoint:
    """Sends a sortie's telemetry as it flies (sortie.sim.engine.sortie.Observer) and answers ground stations.

    The record comes a simulated second at a time; each second is sent in step with the clock, `pace` simulated seconds
    to one of the wall's, so that a ground station sees the fleet a second late and otherwise as if it flew.

    Args:
        address: `udpout:HOST:PORT` sends there; `udpin:HOST:PORT` waits for a ground station and sends to it.
        pace: 1 is real time, 2 twice as fast; None sends as fast as the sortie is worked out.
        origin: where on the globe ENU (0, 0, 0) lies; None: by `origin_of`.
        key: 32 B with which frames are signed.

    Raises:
        RunError: an address that is none, or one that is taken.
    """

    def __init__(
        self, address: str, pace: float | None = 1.0, origin: Origin | None = None, key: bytes | None = None,
        *, clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self._waits, host, port = parse_address(address)
        self._pace, self._origin, self._key, self._clock = pace, origin, key, clock
        self._stream: Stream | None = None
        self._listener = Listener()
        self._begin_s = 0.0
        self._peer: Any = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            if self._waits:
                self._socket.bind((host, port))
            else:  # a name is looked up once, not for every frame
                self._peer = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4][:2]
            self._socket.setblocking(False)
            self.address = self._socket.getsockname()
        except (OSError, UnicodeError) as error:  # the latter of a name that none can be, as a..b
            self._socket.close()
            why = error.strerror if isinstance(error, OSError) else "no name of a host"
            raise RunError(f"{address}: {why}") from error

    def begin(self, scenario: Scenario, scene: SceneModel) -> None:
        """Start the clock."""
        now_us = time.time_ns() // 1000  # signed frames must be newer than any before them
        origin = origin_of(scenario.fleet) if self._origin is None else self._origin
        self._stream = Stream(scenario, origin, self._key, now_us)
        self._begin_s = self._clock()

    def second(self, t_s: float, new: dict[str, pa.Table]) -> None:
        """Send what is new, each frame at its time."""
        if self._stream is None:
            return
        for at_s, drone, message in self._stream.add(new):
            while self._pace is not None and (left_s := self._begin_s + at_s / self._pace - self._clock()) > 0:
                self._listen(left_s)
            self._send(drone, message)  # after the answers that were sent while it waited
        self._listen(0.0)

    def close(self) -> None:
        """Let go of the socket."""
        self._socket.close()

    def _listen(self, timeout_s: float) -> None:
        """Wait so long for a ground station, and answer what it asks."""
        if not select.select([self._socket], [], [], timeout_s)[0]:
            return
        try:
            data, sender = self._socket.recvfrom(65_535)
        except OSError:  # nobody listens there yet
            return
        if self._waits:
            self._peer = sender
        assert self._stream is not None  # noqa: S101 - set in `begin`
        for request in self._listener.heard(data):
            for drone in range(len(self._stream.transmitters)):
                for message in answers(request, drone):
                    self._send(drone, message)

    def _send(self, drone: int, message: Any) -> None:
        assert self._stream is not None  # noqa: S101 - set in `begin`
        if self._peer is not None:
            frame = self._stream.transmitters[drone].pack(message)
            with suppress(OSError):  # best effort, as on any telemetry radio
                self._socket.sendto(frame, self._peer)


def parse_address(address: str) -> tuple[bool, str, int]:
    """Whether to wait for a peer, and host and port."""
    kind, _, rest = address.partition(":")
    host, _, port = rest.rpartition(":")
    least = int(kind == "udpout")  # any free port may be waited at, none sent to
    if kind not in ("udpout", "udpin") or not host or not port.isdecimal() or not least <= int(port) <= 65_535:
        raise RunError(f"{address!r} is no MAVLink address, must be as udpout:127.0.0.1:14550 or udpin:127.0.0.1:14550")
    return kind == "udpin", host, int(port)


def parse_origin(text: str) -> Origin:
    """`latitude,longitude[,altitude]` in degrees and metres.

    Raises:
        RunError: it is none, naming it.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
        if len(numbers) not in (2, 3):
            raise ValueError(f"{len(numbers)} numbers")
        return Origin(*numbers)
    except ValueError as error:
        raise RunError(
            f"origin is {text!r}, must be latitude,longitude or latitude,longitude,altitude: {error}"
        ) from error


def read_key(path: Path) -> bytes:
    """A signing key out of a file: 64 hexadecimal digits, or 32 B as they are. It is told to nobody.

    Raises:
        RunError: the file cannot be read or holds neither.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}") from error
    if len(content) == KEY_BYTES:
        return content
    try:
        key = bytes.fromhex(content.decode("ascii"))
    except ValueError:  # includes what is no ASCII
        key = b""
    if len(key) != KEY_BYTES:
        raise RunError(f"{path}: no signing key, must hold {2 * KEY_BYTES} hexadecimal digits or {KEY_BYTES} bytes")
    return key
