"""A fleet as MAVLink vehicles: logs that pymavlink's tools read, and an endpoint that a real ground station joins."""

from __future__ import annotations

import hashlib
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
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyarrow.compute as pc
import pymavlink
import pytest
from dds_domains import udp_port
from places import HELPERS
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink2
from sim_examples import BASE, example
from typer.testing import CliRunner

from sortie.fleet.energy.cell import MEAN_CELL_V
from sortie.fleet.logs.flightlog import read_logs
from sortie.fleet.logs.mavlink import SIGNING_EPOCH_US, Listener, Transmitter
from sortie.fleet.logs.telemetry import KEY_BYTES
from sortie.sim.cli.app import app
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.export.endpoint import read_key
from sortie.sim.export.origin import ORIGIN, parse_origin
from sortie.sim.export.telemeter import Telemeter
from sortie.sim.export.telemetry import DATAGRAM_BYTES, MavlinkEndpoint, save_tlog
from sortie.sim.folders import RunError
from sortie.sim.results import run_folder
from sortie.sim.results.outcome import transitions
from sortie.sim.results.record import SortieRecord

BEGIN_US = 1_767_225_600_000_000


@pytest.fixture(scope="module")
def record() -> SortieRecord:
    """Four seconds, in which drone 3 is lost at 2 s."""
    return run_sortie(example("duration_s=4", "events=[{kind: drone_lost, at_s: 2, drone: 3}]"))


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


# --- logs ------------------------------------------------------------------------------------------


def test_the_log_has_every_drone_s_pose_at_10_hz_and_status_at_1_hz(log: Path, record: SortieRecord) -> None:
    read_back = read(log)
    counts = Counter((m.get_srcSystem(), m.get_type()) for m in read_back)
    for system in range(1, 6):
        for name in ("ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"):
            assert counts[system, name] == record.scenario.frames
        for name in ("HEARTBEAT", "SYS_STATUS", "BATTERY_STATUS"):
            assert counts[system, name] == 4
    assert not any(name == "BAD_DATA" for _, name in counts)
    assert read_back[-1]._timestamp == pytest.approx(BEGIN_US * 1e-6 + 3.9)


def test_values_are_the_record_s_in_mavlink_s_frames(log: Path, record: SortieRecord) -> None:
    drone, frame = 1, 17
    row = [s for s in record.tables["states"].to_pylist() if s["drone"] == drone][frame]
    of = {name: [m for m in read(log) if m.get_srcSystem() == drone + 1 and m.get_type() == name] for name in (
        "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "SYS_STATUS", "BATTERY_STATUS"
    )}  # fmt: skip
    ned, globe = of["LOCAL_POSITION_NED"][frame], of["GLOBAL_POSITION_INT"][frame]
    assert ned.time_boot_ms == globe.time_boot_ms == 1700
    assert (ned.x, ned.y, ned.z) == pytest.approx((row["y_m"], row["x_m"], -row["z_m"]), rel=1e-6)
    assert (ned.vx, ned.vy, ned.vz) == pytest.approx((row["vy_mps"], row["vx_mps"], -row["vz_mps"]), rel=1e-6)
    assert globe.relative_alt == round(1000 * row["z_m"])
    assert globe.alt == round(1000 * (488.0 + row["z_m"]))
    # a second of latitude is 30.88 m at 47.4°
    assert (globe.lat / 1e7 - ORIGIN.latitude_deg) * 3600 * 30.88 == pytest.approx(row["y_m"], abs=0.05)
    first = [s for s in record.tables["states"].to_pylist() if s["drone"] == drone][10]
    assert of["SYS_STATUS"][1].voltage_battery == round(1000 * first["voltage_v"])
    assert of["BATTERY_STATUS"][1].current_battery == round(100 * first["current_a"])
    assert of["BATTERY_STATUS"][1].energy_consumed == round(first["spent_j"] / 100) > 0
    published = [d for d in record.tables["descriptors"].to_pylist() if d["drone"] == drone and d["t_s"] < 1.05]
    assert of["SYS_STATUS"][1].load == round(1000 * (1 - published[-1]["cpu_headroom"]))


def test_the_log_of_one_drone(log: Path, record: SortieRecord, tmp_path: Path) -> None:
    """The same messages as in the log of all, and its own numbering."""
    run_folder.save(record, tmp_path / "run")
    command = ["export", str(tmp_path / "run"), "--tlog", "--replace", "--drone"]
    assert CliRunner().invoke(app, [*command, "1"]).exit_code == 0
    own = read(tmp_path / "run" / "sortie.tlog")
    assert [str(m) for m in own] == [str(m) for m in read(log) if m.get_srcSystem() == 2]
    said = CliRunner().invoke(app, [*command, "5"])
    assert str(said.exception) == "drone is 5, must be below fleet.drones = 5"
    said = CliRunner().invoke(app, ["export", str(tmp_path / "run"), "--mcap", "--drone", "1"])
    assert "--drone selects from --tlog alone" in said.output


def test_a_lost_drone_is_disarmed(log: Path) -> None:
    armed = [
        bool(m.base_mode & mavlink2.MAV_MODE_FLAG_SAFETY_ARMED)
        for m in read(log)
        if m.get_srcSystem() == 4 and m.get_type() == "HEARTBEAT"
    ]
    assert armed[:2] == [True, True]
    assert armed[-1] is False


def test_texts_say_what_was_decided_and_what_happened(log: Path, record: SortieRecord) -> None:
    """Joined as a ground station joins them; by the sender's system, at their times, in the words of the record."""
    said: dict[tuple[int, int], str] = {}
    for m in read(log):
        if m.get_type() == "STATUSTEXT":
            at_us = round(m._timestamp * 1e6) - BEGIN_US
            said[m.get_srcSystem(), at_us] = said.get((m.get_srcSystem(), at_us), "") + m.text
    changes = list(transitions(record.tables["directives"], {}))
    assert len(changes) > 20
    for change in changes:
        about = f"drone {change['drone']} -> {', '.join(map(str, change['peers']))}: "
        assert about in said[change["drone"] + 1, round(change["t_s"] * 1e6)]
    (lost,) = record.tables["events"].to_pylist()
    assert said[4, 2_000_000].startswith(f"drone 3: {lost['text']}")


def test_the_log_of_a_drone_without_gnss(tmp_path: Path) -> None:
    """Its fix ends and comes back, and it is its drone's alone; parameters come once, and are read again by import."""
    record = run_sortie(example("duration_s=5", "events=[{kind: gnss_loss, at_s: 2, until_s: 4, drone: 1}]"))
    save_tlog(record, tmp_path / "gnss.tlog", BEGIN_US)
    back = read(tmp_path / "gnss.tlog")
    fixes = {i: [m.fix_type for m in back if m.get_type() == "GPS_RAW_INT" and m.get_srcSystem() == i] for i in (1, 2)}
    assert fixes == {1: [3] * 5, 2: [3, 3, 1, 1, 3]}
    assert sum(m.get_type() == "PARAM_VALUE" for m in back) == 2 * 5
    pack, flight = record.scenario.fleet.battery, read_logs(tmp_path / "gnss.tlog")[0]
    capacity_wh = flight.parameters["BATT_CAPACITY"] * 1e-3 * pack.cells * MEAN_CELL_V
    assert capacity_wh == pytest.approx(pack.capacity_wh, rel=1e-6)


def pymavlink_tool(name: str, *arguments: str, folder: Path) -> str:
    """What one of pymavlink's tools prints; they lie beside Python."""
    tool = Path(sysconfig.get_path("scripts")) / name
    if not tool.is_file():
        tool = Path(pymavlink.__file__).parent / "tools" / name
    command = [sys.executable, "-W", "ignore", str(tool), *arguments]
    environment = {**os.environ, "TZ": "UTC", "MPLBACKEND": "Agg"}
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder, env=environment).stdout


def test_telemetry_of_a_flight_in_slices_is_that_of_the_whole() -> None:
    """Also where GNSS goes and comes after the last frame of a slice."""
    record = run_sortie(example("duration_s=4", "events=[{kind: gnss_loss, at_s: 1.95, until_s: 2.97, drone: 1}]"))
    tables = {name: record.tables[name] for name in ("states", "descriptors", "events")}
    whole, sliced = list(Telemeter(record.scenario).add(tables)), Telemeter(record.scenario)
    cuts = [
        {
            name: rows.filter((pc.field("t_s") >= second) & (pc.field("t_s") < second + 1))
            for name, rows in tables.items()
        }
        for second in range(4)
    ]
    assert [each for cut in cuts for each in sliced.add(cut)] == whole
    without = [state.time_s for drone, state in whole if drone == 1 and not state.fixed]
    assert without == pytest.approx(np.arange(20, 30) / 10)


def test_pymavlink_s_tools_make_sense_of_a_log(tmp_path: Path) -> None:
    """mavgpslock finds the fix and its loss, mavtogpx a track at the record's places, mavgraph a picture of heights."""
    settings = ("fleet.drones=1", "duration_s=6", "events=[{kind: gnss_loss, at_s: 3, until_s: 5, drone: 0}]")
    record = run_sortie(example(*settings))
    save_tlog(record, tmp_path / "one.tlog", BEGIN_US)
    locks = pymavlink_tool("mavgpslock.py", "one.tlog", folder=tmp_path)
    assert "Locked at Thu Jan  1 00:00:01 2026 after 1 seconds" in locks
    assert "Lost GPS lock at Thu Jan  1 00:00:03 2026" in locks
    pymavlink_tool("mavtogpx.py", "--type", "GLOBAL_POSITION_INT", "--", "one.tlog", folder=tmp_path)
    track = ElementTree.parse(tmp_path / "one.tlog.gpx").getroot().findall(".//{*}trkpt")  # noqa: S314 - our own file
    places = [(float(p.get("lat")), float(p.get("lon")), float(p.find("{*}ele").text)) for p in track]  # type: ignore[arg-type, union-attr]
    states = record.tables["states"].to_pylist()
    fixed = [s for s in states if not 3.0 <= s["t_s"] < 4.95]
    assert len(places) == pytest.approx(len(fixed), abs=2)
    assert places[-1][2] == pytest.approx(488.0 + states[-1]["z_m"], abs=0.01)
    assert (places[-1][1] - ORIGIN.longitude_deg) * 75_500 == pytest.approx(states[-1]["x_m"], rel=0.01)
    pytest.importorskip("matplotlib")
    # against time since take-off: its own axis of dates calls a method that matplotlib 3.11 has no more
    axis = ("--xaxis", "ATTITUDE.time_boot_ms*0.001", "--output", "heights.png")
    graph = ("one.tlog", "VFR_HUD.alt", "GPS_RAW_INT.fix_type:2", *axis)
    pymavlink_tool("mavgraph.py", *graph, folder=tmp_path)
    assert (tmp_path / "heights.png").stat().st_size > 10_000


def test_mavlogdump_reads_what_the_command_writes(record: SortieRecord, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run_folder.save(record, run)
    arguments = ["export", str(run), "--tlog", "--begin", "2026-11-21T09:00:00.25", "--origin", "52.5,13.4,30"]
    said = CliRunner().invoke(app, arguments)
    assert said.exit_code == 0, said.output
    wanted = ("--format", "json", "--types", "GLOBAL_POSITION_INT", "run/sortie.tlog")
    dumped = pymavlink_tool("mavlogdump.py", *wanted, folder=tmp_path)
    lines = [json.loads(line) for line in dumped.splitlines()]
    assert len(lines) == 5 * record.scenario.frames
    assert lines[0]["meta"]["timestamp"] == 1_795_251_600.25
    assert lines[0]["data"]["lat"] == pytest.approx(52.5e7, abs=5_000)


def test_a_log_lies_where_the_scenario_says(tmp_path: Path) -> None:
    """The trace's own latitudes and longitudes come back, with `fleet.origin` and without."""
    trace = tmp_path / "globe.csv"
    trace.write_text("t_s,drone,lat_deg,lon_deg,alt_m\n0,0,52.1,13.2,70\n2,0,52.1002,13.2004,90\n0,1,52.1,13.203,60\n")
    flies = ("duration_s=2", "fleet.drones=2", f"fleet.trace={trace}")
    origin = "fleet.origin={latitude_deg: 52.099, longitude_deg: 13.199, altitude_m: 50}"
    for settings in (flies, (*flies, origin)):
        run = tmp_path / "run"
        run_folder.save(run_sortie(example(*settings)), run, replace=True)
        assert CliRunner().invoke(app, ["export", str(run), "--tlog"]).exit_code == 0
        places = [m for m in read(run / "sortie.tlog") if m.get_type() == "GLOBAL_POSITION_INT"]
        last = {m.get_srcSystem(): (m.lat / 1e7, m.lon / 1e7, m.alt / 1e3) for m in places}
        assert last[1] == pytest.approx((52.1 + 0.0002 * 0.95, 13.2 + 0.0004 * 0.95, 89.0), abs=2e-6)
        assert last[2] == pytest.approx((52.1, 13.203, 60.0), abs=2e-6)
    trace.unlink()
    again = CliRunner().invoke(app, ["export", str(run), "--tlog", "--replace"])
    assert again.exit_code == 0  # fleet.origin is in the record


def test_a_log_is_signed_from_2015_on(record: SortieRecord, tmp_path: Path) -> None:
    run, key = tmp_path / "run", tmp_path / "key"
    run_folder.save(record, run)
    key.write_text("ab" * 32)
    command = ["export", str(run), "--tlog", "--key", str(key), "--begin"]
    said = CliRunner().invoke(app, [*command, "2014-12-31"])
    assert str(said.exception).startswith("begin is '2014-12-31', must lie from 2015 to before 2096")
    assert CliRunner().invoke(app, [*command, "2015-01-01"]).exit_code == 0


# --- live ------------------------------------------------------------------------------------------


def test_a_ground_station_by_mavsdk_reads_position_attitude_battery_and_mode() -> None:
    pytest.importorskip("mavsdk")
    port = udp_port(__name__)
    script = HELPERS / "mavsdk_client.py"
    client = subprocess.Popen(
        [sys.executable, "-W", "ignore", str(script), str(port), "5"], stdout=subprocess.PIPE, text=True
    )
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


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[MavlinkEndpoint, list[tuple[float, Any]]]]:
    """An endpoint at twice real time on a clock of its own, and what it sent when."""
    clock, sent = Clock(), []
    endpoint = MavlinkEndpoint("udpout:127.0.0.1:9", pace=2.0, clock=clock)

    def wait(timeout_s: float) -> None:
        clock.now_s += timeout_s

    monkeypatch.setattr(endpoint, "_listen", wait)
    monkeypatch.setattr(endpoint, "_send", lambda drone, message: sent.append((clock.now_s - 100.0, message)))
    yield endpoint, sent
    endpoint.close()


def test_frames_go_in_step_with_simulated_time(
    watched: tuple[MavlinkEndpoint, list[tuple[float, Any]]], record: SortieRecord
) -> None:
    endpoint, sent = watched
    again = run_sortie(record.scenario, observer=endpoint)
    assert again.fingerprint == record.fingerprint  # being watched changes nothing
    checked = 0
    for wall_s, m in sent:
        if m.get_type() == "LOCAL_POSITION_NED":
            assert wall_s == pytest.approx(m.time_boot_ms / 2000.0, abs=1e-9)
            checked += 1
    assert checked == 5 * record.scenario.frames


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


@pytest.mark.parametrize("key", [None, bytes(range(KEY_BYTES))], ids=["plain", "signed"])
def test_frames_stay_in_order_while_a_ground_station_asks(
    key: bytes | None, record: SortieRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    """System 1 is asked ninety times in flight, each time while a frame waits for its moment.

    The frame had its number and its signature's time before the answer, and went after it: a ground station counted
    lost frames, and refused signatures.
    """
    now_s = 0.0

    def clock() -> float:
        nonlocal now_s
        now_s += 1e-3
        return now_s

    monkeypatch.setattr("socket.socket", Socket)
    endpoint = MavlinkEndpoint("udpin:127.0.0.1:0", pace=3.0, key=key, clock=clock)
    monkeypatch.undo()
    sent = endpoint._socket.sent = []  # type: ignore[attr-defined]
    station = ground_station(key)
    with closing(endpoint), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _ in range(90):
            asking.sendto(mavlink2.MAVLink_param_request_list_message(1, 1).pack(station), endpoint.address)
        endpoint.begin(record.scenario, None)  # type: ignore[arg-type]
        endpoint.second(4.0, record.tables)
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


def test_a_waiting_endpoint_answers_a_ground_station_and_sends_to_it(record: SortieRecord) -> None:
    with (
        closing(MavlinkEndpoint("udpin:127.0.0.1:0", pace=None)) as endpoint,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station,
    ):
        station.settimeout(10.0)
        mav = mavlink2.MAVLink(None, srcSystem=255, srcComponent=190)
        station.sendto(mavlink2.MAVLink_param_request_list_message(2, 1).pack(mav), endpoint.address)
        endpoint.begin(record.scenario, None)  # type: ignore[arg-type]
        slices = {name: table.slice(0, 0) for name, table in record.tables.items()}
        endpoint.second(0.0, slices)
        answered = mav.parse_buffer(station.recv(65_535))
        assert [(m.get_type(), m.get_srcSystem()) for m in answered] == [("PARAM_VALUE", 2)] * 2
        assert [m.param_id for m in answered] == ["SYSID_THISMAV", "BATT_CAPACITY"]
        slices["states"] = record.tables["states"].slice(0, 5)
        endpoint.second(1.0, slices)
        heard = [m for _ in range(2) for m in mav.parse_buffer(station.recv(65_535)) or []]
        assert {m.get_srcSystem() for m in heard} == {1, 2, 3, 4, 5}


@pytest.mark.parametrize(
    ("key", "said_by_strangers"),
    [
        (None, b"?"),
        (bytes(range(KEY_BYTES)), b"?"),
        (bytes(range(KEY_BYTES)), mavlink2.MAVLink_param_request_list_message(0, 1).pack(ground_station(None))),
    ],
    ids=["noise", "noise to a signed stream", "unsigned message to a signed stream"],
)
def test_a_stranger_does_not_take_over_the_stream_of_a_waiting_endpoint(
    key: bytes | None, said_by_strangers: bytes, record: SortieRecord
) -> None:
    """One byte from anybody turned the stream away from the ground station."""
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
        slices["states"] = record.tables["states"].slice(0, 5)
        endpoint.second(1.0, slices)
        listener = Listener(key)
        heard = [m.get_type() for _ in range(3) for m in listener.heard(station.recv(65_535))]
        assert heard[:2] == ["PARAM_VALUE"] * 2
        assert "HEARTBEAT" in heard
        stranger.setblocking(False)
        with pytest.raises(BlockingIOError):
            stranger.recv(65_535)


def test_noise_is_passed_over() -> None:
    noise = np.random.default_rng(0).integers(0, 256, 4000, dtype=np.uint8).tobytes()
    listener = Listener()
    assert [m.get_type() for m in listener.heard(noise)] == []


def test_signed_frames_are_believed_and_altered_ones_refused() -> None:
    key = bytes(range(KEY_BYTES))
    plain, signed = Transmitter(0), Transmitter(0, key, BEGIN_US)
    beat = mavlink2.MAVLink_heartbeat_message(2, 0, 0, 0, 4, 3)
    frame = signed.pack(beat)
    assert len(frame) == len(plain.pack(beat)) + 13

    def believed(data: bytes) -> bool:
        reader = mavlink2.MAVLink(None)
        reader.signing.secret_key = key
        reader.robust_parsing = True
        return [m.get_type() for m in reader.parse_buffer(data) or []] == ["HEARTBEAT"]

    assert believed(frame)
    assert not believed(frame[:-1] + bytes([frame[-1] ^ 1]))
    assert not believed(plain.pack(beat))
    with pytest.raises(ValueError, match=r"^the signing key has 3 B, must have 32$"):
        Transmitter(0, b"abc")


def test_the_command_sends_while_it_flies(tmp_path: Path) -> None:
    """`sortie fly … --mavlink`: pymavlink's own connection hears every drone."""
    scenario = tmp_path / "short.yaml"
    scenario.write_text(BASE.replace("duration_s: 6", "duration_s: 3.5"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(10.0)
        to = f"udpout:127.0.0.1:{station.getsockname()[1]}"
        arguments = [
            "fly",
            str(scenario),
            "--no-recording",
            "--mavlink",
            to,
            "--pace",
            "0",
            "--out",
            str(tmp_path / "run"),
        ]
        said = CliRunner().invoke(app, arguments)
        assert said.exit_code == 0, said.output
        parser = mavlink2.MAVLink(None)
        heard = [m for _ in range(10) for m in parser.parse_buffer(station.recv(65_535)) or []]
    assert {m.get_srcSystem() for m in heard} == {1, 2, 3, 4, 5}


def signed_parser(key: bytes) -> mavlink2.MAVLink:
    """Believes frames signed with a key alone."""
    parser = mavlink2.MAVLink(None)
    parser.signing.secret_key, parser.robust_parsing = key, True
    return parser


def test_a_log_is_signed_by_the_command(record: SortieRecord, tmp_path: Path) -> None:
    run_folder.save(record, tmp_path / "run")
    key = bytes(range(KEY_BYTES))
    (tmp_path / "key").write_text(key.hex() + "\n")
    told = CliRunner().invoke(app, ["export", str(tmp_path / "run"), "--tlog", "--key", str(tmp_path / "key")])
    assert told.exit_code == 0, told.output
    frames = (tmp_path / "run" / "sortie.tlog").read_bytes()
    parser, unsigned = signed_parser(key), signed_parser(bytes(KEY_BYTES))
    heard, read_on = Counter(), 0
    while read_on < len(frames):
        size = frames[read_on + 9] + 12 + 13  # after the log's stamp: the frame's length, its head, its signature
        frame = frames[read_on + 8 : read_on + 8 + size]
        read_on += 8 + size
        heard.update(m.get_type() for m in parser.parse_buffer(frame) or [])
        assert [m.get_type() for m in unsigned.parse_buffer(frame) or []] == ["BAD_DATA"]
    assert heard["HEARTBEAT"] == 20
    assert "BAD_DATA" not in heard


def test_what_flies_is_signed_by_the_command(tmp_path: Path) -> None:
    key = hashlib.sha256(b"a ground station's passphrase").digest()
    (tmp_path / "key").write_bytes(key)
    scenario = tmp_path / "short.yaml"
    scenario.write_text(BASE.replace("duration_s: 6", "duration_s: 2"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(10.0)
        to = f"udpout:127.0.0.1:{station.getsockname()[1]}"
        arguments = ["fly", str(scenario), "--no-recording", "--mavlink", to, "--pace", "0"]
        arguments += ["--mavlink-key", str(tmp_path / "key"), "--out", str(tmp_path / "run")]
        said = CliRunner().invoke(app, arguments)
        assert said.exit_code == 0, said.output
        parser = signed_parser(key)
        heard = [m for _ in range(10) for m in parser.parse_buffer(station.recv(65_535)) or []]
    assert {m.get_srcSystem() for m in heard if m.get_type() != "BAD_DATA"} == {1, 2, 3, 4, 5}
    assert "BAD_DATA" not in {m.get_type() for m in heard}


@pytest.mark.parametrize("content", [b"", b"secret", b"00" * 31, b"zz" * 32, bytes(33), "ä".encode() * 20])
def test_a_key_that_is_none_is_named_and_not_told(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_bytes(content)
    with pytest.raises(RunError) as error:
        read_key(path)
    assert str(error.value) == f"{path}: no signing key, must hold 64 hexadecimal digits or 32 bytes"
    with pytest.raises(RunError, match=r"gone: No such file or directory$"):
        read_key(tmp_path / "gone")


def test_a_key_with_nothing_to_sign_is_named(tmp_path: Path) -> None:
    said = CliRunner().invoke(app, ["fly", "track_target", "--mavlink-key", str(tmp_path / "key")])
    assert str(said.exception) == "--mavlink-key goes with --mavlink"
    said = CliRunner().invoke(app, ["export", str(tmp_path), "--mcap", "--key", str(tmp_path / "key")])
    assert said.exit_code == 2
    assert "--key signs --tlog alone" in said.output
    said = CliRunner().invoke(app, ["export", str(tmp_path), "--pcap", "--origin", "47,8"])
    assert said.exit_code == 2
    assert "--origin places --tlog and --mcap alone" in said.output


# --- what can go wrong -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "address", ["14550", "udp:127.0.0.1:14550", "udpout::14550", "udpout:127.0.0.1:99999", "udpout:127.0.0.1:0"]
)
def test_an_address_that_is_none_is_named(address: str) -> None:
    with pytest.raises(RunError, match=re.escape(f"{address!r} is no MAVLink address, must be as udpout:")):
        MavlinkEndpoint(address)


def test_a_host_that_is_none_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """At once, not by a sortie that tells nobody anything."""

    def unknown(*_: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(RunError, match=r"^udpout:nowhere\.invalid:14550: Name or service not known$"):
        MavlinkEndpoint("udpout:nowhere.invalid:14550")


def test_a_host_that_none_can_be_is_named() -> None:
    """Python's resolver says so in words of its own before it asks anybody."""
    with pytest.raises(RunError, match=r"^udpout:a\.\.b:14550: no name of a host$"):
        MavlinkEndpoint("udpout:a..b:14550")


def test_a_port_that_is_taken_is_named() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(RunError, match=rf"^udpin:127\.0\.0\.1:{port}: Address already in use$"):
            MavlinkEndpoint(f"udpin:127.0.0.1:{port}")


@pytest.mark.parametrize("text", ["here", "47", "1,2,3,4", "89,0", "47,8,nan", "47,8,1e9"])
def test_an_origin_that_is_none_is_named(text: str) -> None:
    with pytest.raises(RunError, match=rf"^origin is '{text}', must be latitude,longitude or"):
        parse_origin(text)
