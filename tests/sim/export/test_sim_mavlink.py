"""A fleet as MAVLink vehicles: logs that pymavlink's tools read, and an endpoint that a real ground station joins."""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import socket
import subprocess
import sys
import sysconfig
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pymavlink
import pytest
from dds_domains import udp_port
from exported_flight import SECONDS, flown, in_seconds
from places import HELPERS
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink2
from sim_examples import example

from sortie.fleet.energy.cell import MEAN_CELL_V
from sortie.fleet.logs.flightlog import read_logs
from sortie.fleet.logs.geodesy import Origin, geodetic
from sortie.fleet.logs.mavlink import SIGNING_EPOCH_US, Listener, Transmitter
from sortie.fleet.logs.telemetry import KEY_BYTES
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.export.origin import ORIGIN
from sortie.sim.export.telemeter import Telemeter
from sortie.sim.export.telemetry import DATAGRAM_BYTES, MavlinkEndpoint, save_tlog
from sortie.sim.folders import RunError
from sortie.sim.results.record import SortieRecord

BEGIN_US = 1_767_225_600_000_000
POSES = ("ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT")
KEY = bytes(range(KEY_BYTES))


@pytest.fixture(scope="module")
def record() -> SortieRecord:
    return flown()[0]


@pytest.fixture(scope="module")
def log(record: SortieRecord, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tlog") / "sortie.tlog"
    save_tlog(record, path, BEGIN_US)
    return path


def read(path: Path) -> list[mavlink2.MAVLink_message]:
    reader, found = mavutil.mavlink_connection(str(path)), []
    while (m := reader.recv_match()) is not None:
        found.append(m)
    reader.close()
    return found


def of_drone(messages: list[mavlink2.MAVLink_message], drone: int, name: str) -> list[Any]:
    return [m for m in messages if m.get_srcSystem() == drone + 1 and m.get_type() == name]


# --- logs -------------------------------------------------------------------------------------------------


def test_the_log_has_every_drone_s_pose_at_10_hz_and_status_at_1_hz(log: Path, record: SortieRecord) -> None:
    read_back = read(log)
    counts = Counter((m.get_srcSystem(), m.get_type()) for m in read_back)
    for system in range(1, 6):
        assert {counts[system, name] for name in POSES} == {record.scenario.frames}
        assert {counts[system, name] for name in ("HEARTBEAT", "SYS_STATUS", "BATTERY_STATUS")} == {SECONDS}
        assert counts[system, "PARAM_VALUE"] == 2
    assert not any(name == "BAD_DATA" for _, name in counts)
    assert read_back[-1]._timestamp == pytest.approx(BEGIN_US * 1e-6 + SECONDS - 0.1)


def test_the_capacity_of_a_pack_is_read_again_by_import(log: Path, record: SortieRecord) -> None:
    pack, flight = record.scenario.fleet.battery, read_logs(log)[0]
    capacity_wh = flight.parameters["BATT_CAPACITY"] * 1e-3 * pack.cells * MEAN_CELL_V
    assert capacity_wh == pytest.approx(pack.capacity_wh, rel=1e-6)


def test_telemetry_of_a_flight_in_slices_is_that_of_the_whole(record: SortieRecord) -> None:
    """Also where GNSS goes and comes after the last frame of a slice."""
    whole, sliced = list(Telemeter(record.scenario).add(record.tables)), Telemeter(record.scenario)
    assert [each for cut in in_seconds(record) for each in sliced.add(cut)] == whole
    without = [state.time_s for drone, state in whole if drone == 1 and not state.fixed]
    assert without == pytest.approx(np.arange(20, 40) / 10)


def pymavlink_tool(name: str, *arguments: str, folder: Path) -> str:
    """What one of pymavlink's tools prints; they lie beside Python."""
    tool = Path(sysconfig.get_path("scripts")) / name
    if not tool.is_file():
        tool = Path(pymavlink.__file__).parent / "tools" / name
    command = [sys.executable, "-W", "ignore", str(tool), *arguments]
    environment = {**os.environ, "TZ": "UTC", "MPLBACKEND": "Agg"}
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder, env=environment).stdout


def test_pymavlink_s_tools_make_sense_of_a_log(record: SortieRecord, tmp_path: Path) -> None:
    """mavgpslock finds the fix and its loss, mavtogpx a track at the record's places."""
    save_tlog(record, tmp_path / "one.tlog", BEGIN_US, drone=1)
    locks = pymavlink_tool("mavgpslock.py", "one.tlog", folder=tmp_path)
    assert "Locked at Thu Jan  1 00:00:01 2026 after 1 seconds" in locks
    assert "Lost GPS lock at Thu Jan  1 00:00:02 2026" in locks
    pymavlink_tool("mavtogpx.py", "--type", "GLOBAL_POSITION_INT", "--", "one.tlog", folder=tmp_path)
    track = ElementTree.parse(tmp_path / "one.tlog.gpx").getroot().findall(".//{*}trkpt")  # noqa: S314 - our own file
    states = [s for s in record.tables["states"].to_pylist() if s["drone"] == 1]
    assert len(track) == pytest.approx(len([s for s in states if not 2.0 <= s["t_s"] < 3.95]), abs=2)
    height = track[-1].find("{*}ele")
    assert height is not None
    assert float(height.text or "") == pytest.approx(488.0 + states[-1]["z_m"], abs=0.01)
    east_m = (float(track[-1].get("lon") or "") - ORIGIN.longitude_deg) * 75_500
    assert east_m == pytest.approx(states[-1]["x_m"], rel=0.01)


def test_a_log_lies_where_the_scenario_says(record: SortieRecord, tmp_path: Path) -> None:
    """At `fleet.origin`, and at the one that is given in its place."""
    origin = "fleet.origin={latitude_deg: 52.099, longitude_deg: 13.199, altitude_m: 50}"
    there = replace(record, scenario=example(f"duration_s={SECONDS}", origin))
    row = record.tables["states"].to_pylist()[0]
    for given, wanted in ((None, (52.099, 13.199, 50.0)), (Origin(47.0, 8.0, 9.0), (47.0, 8.0, 9.0))):
        save_tlog(there, tmp_path / "there.tlog", BEGIN_US, given)
        m = of_drone(read(tmp_path / "there.tlog"), 0, "GLOBAL_POSITION_INT")[0]
        place = (row["x_m"], row["y_m"], row["z_m"])
        assert (m.lat / 1e7, m.lon / 1e7, m.alt / 1e3) == pytest.approx(geodetic(place, Origin(*wanted)), abs=1e-3)
        assert m.lat / 1e7 == pytest.approx(wanted[0], abs=1e-4)


# --- live -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_ground_station_by_mavsdk_reads_position_attitude_battery_and_mode() -> None:
    """In a flight of its own, which goes on in step with the clock."""
    pytest.importorskip("mavsdk")
    port = udp_port(__name__)
    command = [sys.executable, "-W", "ignore", str(HELPERS / "mavsdk_client.py"), str(port), "5"]
    client = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert client.stdout is not None
    try:
        lines = (line for line in client.stdout if line.startswith(("ready", "{")))
        assert next(lines) == "ready\n"
        with ThreadPoolExecutor(1) as reader:
            answer = reader.submit(next, lines)
            while not answer.done():  # again for a station that was too busy to hear all of it
                with closing(MavlinkEndpoint(f"udpout:127.0.0.1:{port}", pace=4.0)) as endpoint:
                    record = run_sortie(example("duration_s=16"), observer=endpoint)
        told = json.loads(answer.result())
    finally:
        client.kill()
        client.wait()
        client.stdout.close()
    assert sorted(told) == ["1", "2", "3", "4", "5"]
    states = record.tables["states"].to_pylist()
    for system, seen in told.items():
        own = [s for s in states if s["drone"] == int(system) - 1]
        north, east, down = seen["ned"]
        at = min(own, key=lambda s: math.dist((s["y_m"], s["x_m"], -s["z_m"]), (north, east, down)))
        assert (at["y_m"], at["x_m"], -at["z_m"]) == pytest.approx((north, east, down), abs=1e-3)
        assert seen["velocity"] == pytest.approx([at["vy_mps"], at["vx_mps"], -at["vz_mps"]], abs=1e-4)
        latitude, longitude, altitude, height = seen["position"]
        assert height == pytest.approx(at["z_m"], abs=1.0)  # another message, perhaps of the frame before
        assert altitude - height == pytest.approx(488.0, abs=0.01)
        assert (latitude, longitude) == pytest.approx((ORIGIN.latitude_deg, ORIGIN.longitude_deg), abs=0.01)
        assert abs(seen["attitude"][2] - 90.0) < 30.0  # it flies east
        voltage, current, charge = seen["battery"]
        assert min(abs(voltage - s["voltage_v"]) for s in own) < 0.01
        assert min(abs(current - s["current_a"]) for s in own) < 0.02
        assert charge == pytest.approx(100 * own[0]["soc"], abs=1.5)
        assert seen["mode"] == [True, True]


class Clock:
    """A clock that stands still but while somebody waits."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_frames_go_in_step_with_simulated_time(record: SortieRecord, monkeypatch: pytest.MonkeyPatch) -> None:
    """At twice real time, on a clock that stands still but while somebody waits."""
    clock, sent = Clock(), list[tuple[float, Any]]()
    endpoint = MavlinkEndpoint("udpout:127.0.0.1:9", pace=2.0, clock=clock)

    def wait(timeout_s: float) -> None:
        clock.now_s += timeout_s

    monkeypatch.setattr(endpoint, "_listen", wait)
    monkeypatch.setattr(endpoint, "_send", lambda drone, message: sent.append((clock.now_s - 100.0, message)))
    with closing(endpoint):
        endpoint.begin(record.scenario, None)  # type: ignore[arg-type]
        for second, new in enumerate(in_seconds(record), 1):
            endpoint.second(float(second), new)
    places = [(wall_s, m.time_boot_ms) for wall_s, m in sent if m.get_type() == "LOCAL_POSITION_NED"]
    assert len(places) == 5 * record.scenario.frames
    assert [wall_s for wall_s, _ in places] == pytest.approx([ms / 2000.0 for _, ms in places], abs=1e-9)


class Socket(socket.socket):
    """Keeps what is sent."""

    sent: list[bytes]

    def sendto(self, data: bytes, *to: object) -> int:  # type: ignore[override]
        self.sent.append(data)
        return len(data)


def frames_in(datagram: bytes) -> int:
    """How many frames follow one another, by their lengths; signed ones are longer."""
    count = 0
    while datagram:
        datagram = datagram[12 + datagram[1] + 13 * (datagram[2] & 1) :]
        count += 1
    return count


def ground_station(key: bytes | None) -> mavlink2.MAVLink:
    """Packs a ground station's messages, signed where it has a key."""
    station = mavlink2.MAVLink(None, srcSystem=255, srcComponent=190)
    if key is not None:
        station.signing.secret_key, station.signing.sign_outgoing = key, True
        station.signing.timestamp = (time.time_ns() // 1000 - SIGNING_EPOCH_US) // 10
    return station


def test_frames_stay_in_order_while_a_ground_station_asks(
    record: SortieRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    """System 1 is asked ninety times in flight, each time while a frame waits for its moment.

    The frame had its number and its signature's time before the answer, and went after it: a ground station counted
    lost frames, and refused signatures.
    """
    ticks = itertools.count()
    for key in (None, KEY):
        with monkeypatch.context() as patch:
            patch.setattr("socket.socket", Socket)
            clock = lambda: next(ticks) * 1e-3  # noqa: E731
            endpoint = MavlinkEndpoint("udpin:127.0.0.1:0", pace=3.0, key=key, clock=clock)
        sent = endpoint._socket.sent = []  # type: ignore[attr-defined]
        station = ground_station(key)
        with closing(endpoint), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            for _ in range(90):
                asking.sendto(mavlink2.MAVLink_param_request_list_message(1, 1).pack(station), endpoint.address)
            endpoint.begin(record.scenario, None)  # type: ignore[arg-type]
            endpoint.second(float(SECONDS), record.tables)
        listener = Listener(key)
        heard = [m for frame in sent for m in listener.heard(frame)]
        assert (len(heard), listener.refused) == (sum(map(frames_in, sent)), 0)
        assert len(sent) < len(heard) / 3  # several frames share a datagram
        assert max(map(len, sent)) <= DATAGRAM_BYTES
        for system in range(1, 6):
            numbers = [m.get_seq() for m in heard if m.get_srcSystem() == system]
            assert numbers == [k % 256 for k in range(len(numbers))]
        answered = [k for k, m in enumerate(heard) if m.get_type() == "PARAM_VALUE"]
        assert len(answered) == 2 * 90
        assert sum(b - a > 1 for a, b in itertools.pairwise(answered)) > 10  # among the frames of the flight


def test_a_waiting_endpoint_answers_its_ground_station_and_no_stranger_takes_the_stream_over(
    record: SortieRecord,
) -> None:
    """One byte from anybody turned the stream away from the ground station."""
    unsigned = mavlink2.MAVLink_param_request_list_message(0, 1).pack(ground_station(None))
    for key, said_by_strangers in ((None, b"?"), (KEY, b"?"), (KEY, unsigned)):
        with (
            closing(MavlinkEndpoint("udpin:127.0.0.1:0", pace=None, key=key)) as endpoint,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
        ):
            station.settimeout(10.0)
            asked = mavlink2.MAVLink_param_request_list_message(2, 1).pack(ground_station(key))
            station.sendto(asked, endpoint.address)
            endpoint.begin(record.scenario, None)  # type: ignore[arg-type]
            slices = {name: table.slice(0, 0) for name, table in record.tables.items()}
            endpoint.second(0.0, slices)
            stranger.sendto(said_by_strangers, endpoint.address)
            endpoint.second(0.0, slices)
            endpoint.second(1.0, slices | {"states": record.tables["states"].slice(0, 5)})
            listener = Listener(key)
            heard = [m for _ in range(3) for m in listener.heard(station.recv(65_535))]
            assert [(m.get_type(), m.get_srcSystem()) for m in heard[:2]] == [("PARAM_VALUE", 2)] * 2
            assert [m.param_id for m in heard[:2]] == ["SYSID_THISMAV", "BATT_CAPACITY"]
            assert {m.get_srcSystem() for m in heard if m.get_type() == "HEARTBEAT"} == {1, 2, 3, 4, 5}
            stranger.setblocking(False)
            with pytest.raises(BlockingIOError):
                stranger.recv(65_535)


def test_noise_is_passed_over() -> None:
    noise = np.random.default_rng(0).integers(0, 256, 4000, dtype=np.uint8).tobytes()
    assert [m.get_type() for m in Listener().heard(noise)] == []


def test_signed_frames_are_believed_and_altered_ones_refused() -> None:
    plain, signed = Transmitter(0), Transmitter(0, KEY, BEGIN_US)
    beat = mavlink2.MAVLink_heartbeat_message(2, 0, 0, 0, 4, 3)
    frame = signed.pack(beat)
    assert len(frame) == len(plain.pack(beat)) + 13

    def believed(data: bytes) -> bool:
        reader = mavlink2.MAVLink(None)
        reader.signing.secret_key = KEY
        reader.robust_parsing = True
        return [m.get_type() for m in reader.parse_buffer(data) or []] == ["HEARTBEAT"]

    assert believed(frame)
    assert not believed(frame[:-1] + bytes([frame[-1] ^ 1]))
    assert not believed(plain.pack(beat))
    with pytest.raises(ValueError, match=r"^the signing key has 3 B, must have 32$"):
        Transmitter(0, b"abc")


# --- addresses --------------------------------------------------------------------------------------------


def test_an_address_that_is_none_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """At once, not by a sortie that tells nobody anything. Python's resolver refuses a host before it asks anybody."""
    for address in ("14550", "udp:127.0.0.1:14550", "udpout::14550", "udpout:127.0.0.1:99999", "udpout:127.0.0.1:0"):
        with pytest.raises(RunError, match=re.escape(f"{address!r} is no MAVLink address, must be as udpout:")):
            MavlinkEndpoint(address)
    with pytest.raises(RunError, match=r"^udpout:a\.\.b:14550: no name of a host$"):
        MavlinkEndpoint("udpout:a..b:14550")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(RunError, match=rf"^udpin:127\.0\.0\.1:{port}: Address already in use$"):
            MavlinkEndpoint(f"udpin:127.0.0.1:{port}")

    def unknown(*_: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(RunError, match=r"^udpout:nowhere\.invalid:14550: Name or service not known$"):
        MavlinkEndpoint("udpout:nowhere.invalid:14550")
