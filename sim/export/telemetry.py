"""A fleet as MAVLink vehicles: a telemetry log of a run, and an endpoint that ground stations join while it flies."""

from __future__ import annotations

import heapq
import select
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from operator import itemgetter
from pathlib import Path
from typing import Any

import pyarrow as pa

from sortie.fleet.energy.battery import overridden
from sortie.fleet.energy.cell import MEAN_CELL_V
from sortie.fleet.logs.geodesy import Origin
from sortie.fleet.logs.ground_station import answers, parameter_values, status_texts
from sortie.fleet.logs.mavlink import STATUS, Listener, Transmitter, messages, write_tlog
from sortie.perception.scene.scene_model import SceneModel
from sortie.scenarios.frames import frame_at
from sortie.scenarios.schema import Scenario
from sortie.sim.export.endpoint import open_address
from sortie.sim.export.origin import origin_of
from sortie.sim.export.telemeter import Telemeter
from sortie.sim.folders import RunError
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.sentences import decision_in_words, event_in_words
from sortie.sim.results.transitions import transitions

MARK = "simulated flight, written by Sortie"
"""What each drone says first in a log."""
MOST_SYSTEMS = 255
"""System ids of MAVLink."""
DATAGRAM_BYTES = 1400
"""At most, with which a datagram passes Ethernet whole."""


def parameters_of(scenario: Scenario) -> list[dict[str, float]]:
    """Each drone's parameters, by ArduPilot's names: its system id, and its pack's capacity in mAh."""
    packs = enumerate(overridden(scenario.fleet.batteries, scenario.fleet.overrides))
    return [
        {"SYSID_THISMAV": drone + 1.0, "BATT_CAPACITY": 1000 * pack.capacity_wh / (pack.cells * MEAN_CELL_V)}
        for drone, pack in packs
    ]


class Stream:
    """The messages of the whole fleet, in order of time: parameters at first, pose at every frame of the sortie, status
    once a second, and decisions and events as texts. What happens to the whole fleet is said by drone 0.

    They are packed by `transmitters`, each when it is sent: packing numbers a frame and stamps its signature.

    Raises:
        RunError: more drones than system ids.
    """

    def __init__(
        self, scenario: Scenario, origin: Origin, key: bytes | None = None, begin_us: int | None = None
    ) -> None:
        if scenario.fleet.drones > MOST_SYSTEMS:
            bound = f"at most {MOST_SYSTEMS} for MAVLink, which has no more system ids"
            raise RunError(f"fleet.drones is {scenario.fleet.drones}, must be {bound}")
        n, signed_at = scenario.fleet.drones, {} if begin_us is None else {"signed_at_us": begin_us}
        self.transmitters = [Transmitter(i, key, **signed_at) for i in range(n)]
        self.parameters = parameters_of(scenario)
        self.latest: list[dict[int, Any]] = [{} for _ in range(n)]
        """The last message of each kind, by drone and message id."""
        self._telemeter, self._origin = Telemeter(scenario), origin
        self._second = [-1] * n
        self._carried: dict[tuple[int, int], str] = {}
        self._texts = [0] * n

    def add(self, new: Mapping[str, pa.Table]) -> Iterator[tuple[float, int, Any]]:
        """Time, drone and message of everything in new rows."""
        for at_s, drone, message in heapq.merge(self._states(new), self._said(new), key=itemgetter(0)):
            self.latest[drone][message.get_msgId()] = message
            yield at_s, drone, message

    def _states(self, new: Mapping[str, pa.Table]) -> Iterator[tuple[float, int, Any]]:
        for drone, state in self._telemeter.add(new):
            second = frame_at(state.time_s, 1.0)
            status, first = second != self._second[drone], self._second[drone] < 0
            self._second[drone] = second
            told = messages(state, self._origin)
            if first and not state.ground_station:
                told += parameter_values(self.parameters[drone])
            for message in told:
                if status or message.get_type() not in STATUS:
                    yield state.time_s, drone, message

    def _said(self, new: Mapping[str, pa.Table]) -> Iterator[tuple[float, int, Any]]:
        decisions = (
            (row["t_s"], row["drone"], decision_in_words(row), False)
            for row in transitions(new["directives"], self._carried)
        )
        events = ((row["t_s"], max(row["drone"], 0), event_in_words(row), True) for row in new["events"].to_pylist())
        for at_s, drone, text, warning in heapq.merge(decisions, events, key=itemgetter(0)):
            self._texts[drone] += 1
            for message in status_texts(text, self._texts[drone], warning=warning):
                yield at_s, drone, message


def save_tlog(
    record: SortieRecord,
    path: Path,
    begin_us: int,
    origin: Origin | None = None,
    key: bytes | None = None,
    drone: int | None = None,
) -> int:
    """Write a run as one telemetry log of all its drones, system ids 1 … N; returns the number of frames.

    Args:
        begin_us: when the sortie began, µs since 1970.
        origin: where on the globe ENU (0, 0, 0) lies; None: by `origin_of`.
        key: 32 B with which frames are signed.
        drone: this drone alone, with the system id that it has anyway.

    Raises:
        RunError: no such drone, more drones than system ids, or the file cannot be written.
        TraceError: its trace is needed for the origin and cannot be read.
    """
    if drone is not None and drone >= record.scenario.fleet.drones:
        raise RunError(f"drone is {drone}, must be below fleet.drones = {record.scenario.fleet.drones}")
    origin = origin_of(record.scenario.fleet) if origin is None else origin
    stream = Stream(record.scenario, origin, key, None if key is None else begin_us)
    said = [(0.0, i, text) for i in range(len(stream.transmitters)) for text in status_texts(MARK, 0, warning=False)]
    frames = [
        (begin_us + round(t_s * 1e6), stream.transmitters[sender].pack(message))
        for t_s, sender, message in (*said, *stream.add(record.tables))
        if drone in (None, sender)
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
        address: `udpout:HOST:PORT` sends there; `udpin:HOST:PORT` waits for a ground station's first message, and
            sends to the ground station that spoke last.
        pace: 1 is real time, 2 twice as fast, 0.001 to 1000; None sends as fast as the sortie is worked out.
        origin: where on the globe ENU (0, 0, 0) lies; None: by `origin_of`.
        key: 32 B with which frames are signed; messages to the endpoint that are not signed with it are ignored.

    Raises:
        RunError: an address that is none, is taken, or is not reached; a pace out of its bounds.
    """

    def __init__(
        self,
        address: str,
        pace: float | None = 1.0,
        origin: Origin | None = None,
        key: bytes | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if pace is not None and not 1e-3 <= pace <= 1e3:
            raise RunError(f"pace is {pace:g}, must be 0.001 to 1000, or 0 for as fast as possible")
        self._pace, self._origin, self._key, self._clock = pace, origin, key, clock
        self._stream: Stream | None = None
        self._listener = Listener(key)
        self._begin_s = 0.0
        self._datagram = b""
        self._peer: Any  # where it sends; None until a ground station has spoken
        self._socket, self._peer = open_address(address)
        self._waits = self._peer is None
        self._socket.setblocking(False)
        self.address = self._socket.getsockname()

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
                self._flush()
                self._listen(left_s)
            self._send(drone, message)  # after the answers that were sent while it waited
        self._flush()
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
        requests = self._listener.heard(data)
        if self._waits and requests:
            self._peer = sender
        assert self._stream is not None  # noqa: S101 - set in `begin`
        for request in requests:
            for drone in range(len(self._stream.transmitters)):
                known = self._stream.parameters[drone], self._stream.latest[drone]
                for message in answers(request, drone, *known):
                    self._send(drone, message)
        self._flush()

    def _send(self, drone: int, message: Any) -> None:
        """Put a frame into the next datagram: a datagram for each frame would overflow a ground station's buffer."""
        assert self._stream is not None  # noqa: S101 - set in `begin`
        if self._peer is not None:
            frame = self._stream.transmitters[drone].pack(message)
            if len(self._datagram) + len(frame) > DATAGRAM_BYTES:
                self._flush()
            self._datagram += frame

    def _flush(self) -> None:
        if self._datagram:
            with suppress(OSError):  # best effort, as on any telemetry radio
                self._socket.sendto(self._datagram, self._peer)
            self._datagram = b""
