"""Drones whose state comes from a flying MAVLink vehicle: its state, charge, stale telemetry, a live flight."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from dds_domains import domain, udp_port
from live_flights import Seen, fly_until, refusal_of
from scipy.spatial.transform import Rotation
from sim_examples import example

from sortie.fleet.agent import Platform, Task
from sortie.fleet.coverage import View
from sortie.fleet.logs.geodesy import Origin
from sortie.fleet.logs.mavlink import Companion, Listener, Transmitter, messages
from sortie.fleet.logs.vehicle import WANTED_HZ, VehicleState, after
from sortie.perception.geometry import USUAL
from sortie.policies.contract import Disc, TaskPhase
from sortie.policies.staleness import LinkHealth
from sortie.sim.export.origin import ORIGIN
from sortie.sim.folders import RunError
from sortie.sim.live import platform
from sortie.sim.live.context import ReplaySenses, traces
from sortie.sim.live.platform import MavlinkLink, MavlinkSenses
from sortie.sim.live.rules import rules_of
from sortie.sim.live.session import fly_live
from sortie.sim.live.vehicle import CirclingVehicle, circle

KEY = bytes(range(32))


def signed(key: bytes | None = KEY, ahead_us: int = 0) -> Transmitter:
    """A vehicle that signs from now on."""
    return Transmitter(0, key, time.time_ns() // 1000 + ahead_us)


def frames(transmitter: Transmitter, t_s: float = 3.0) -> list[bytes]:
    """One round of the circling vehicle's messages."""
    return [transmitter.pack(message) for message in messages(circle(t_s), ORIGIN)]


def heard(t_s: float = 3.0, origin: Origin | None = None) -> VehicleState:
    """The state after one round of the circling vehicle's messages."""
    listener, state = Listener(), VehicleState()
    for read in (message for frame in frames(Transmitter(0), t_s) for message in listener.heard(frame)):
        state = after(state, read, 7.0, origin)
    return state


def test_the_state_is_the_vehicle_s_own_and_another_system_moves_nothing() -> None:
    for origin in (None, ORIGIN):
        flown, state = circle(3.0), heard(3.0, origin)
        assert (state.system, state.armed, state.landed) == (1, True, False)
        assert state.position_m == pytest.approx(flown.position_m, abs=0.02)  # 1e-7 degrees are a centimetre
        assert state.velocity_mps == pytest.approx(flown.velocity_mps, abs=0.01)
        sign = math.copysign(1.0, state.orientation_xyzw[3] * flown.orientation_xyzw[3])
        assert [sign * v for v in state.orientation_xyzw] == pytest.approx(flown.orientation_xyzw, abs=1e-6)
        assert state.soc == pytest.approx(flown.soc, abs=0.006)
        assert (state.heartbeat_s, state.pose_s) == (7.0, 7.0)
    state, listener = heard(), Listener()
    strangers = frames(Transmitter(6), 20.0)
    for read in (message for frame in strangers for message in listener.heard(frame)):
        state = after(state, read, 9.0, None)
    assert state == heard()._replace(others=len(strangers))


def test_roll_pitch_yaw_and_the_quaternion_are_one_attitude() -> None:
    tilted = tuple(Rotation.from_euler("ZYX", [1.0, 0.2, -0.3]).as_quat(canonical=True).tolist())
    for name in ("ATTITUDE", "ATTITUDE_QUATERNION"):
        state = VehicleState(system=1)
        for message in messages(replace(circle(0.0), orientation_xyzw=tilted), ORIGIN):
            for read in Listener().heard(Transmitter(0).pack(message)):
                if read.get_type() == name:
                    state = after(state, read, 1.0, None)
        assert state.orientation_xyzw == pytest.approx(tilted, abs=1e-6)


def test_a_companion_asks_for_messages_at_their_rates_and_signs_what_it_asks() -> None:
    said = Listener().heard(Companion().ask(3, WANTED_HZ))
    assert [m.get_type() for m in said] == ["HEARTBEAT"] + ["COMMAND_LONG"] * len(WANTED_HZ)
    assert {(m.target_system, m.command) for m in said[1:]} == {(3, 511)}
    assert {int(m.param1): 1e6 / m.param2 for m in said[1:]} == pytest.approx(WANTED_HZ)
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in said} == {(3, 191)}
    asked = Companion(KEY).ask(1, WANTED_HZ)
    assert len(Listener(KEY).heard(asked)) == 1 + len(WANTED_HZ)
    unsigned = Listener(KEY)
    assert unsigned.heard(Companion().ask(1, WANTED_HZ)) == []
    assert unsigned.refused == 1 + len(WANTED_HZ)


# --- a port --------------------------------------------------------------------------------------------


@pytest.fixture
def link() -> Iterator[MavlinkLink]:
    """A port that waits for a vehicle."""
    found = MavlinkLink("udpin:127.0.0.1:0", None)
    yield found
    found.close()


def test_a_silent_port_and_a_bad_address_are_errors(link: MavlinkLink) -> None:
    with pytest.raises(RunError, match=r"^udpin:127.0.0.1:0: no vehicle heard within 0.05 s$"):
        link.wait_until_found(0.05)
    with pytest.raises(RunError, match="is no MAVLink address"):
        fly_live(example(), mavlink=["tcp:1"])
    with pytest.raises(RunError, match="Address already in use"):
        MavlinkLink(f"udpin:127.0.0.1:{link.port}", None)


def test_a_fleet_flies_with_a_vehicle_and_notices_that_it_falls_silent() -> None:
    port = udp_port(__name__)
    vehicle = CirclingVehicle(f"udpout:127.0.0.1:{port}")
    silent: dict[int, int] = {}

    def ten_frames_after_its_silence(seen: Seen) -> bool:
        """Whether drone 1 has published ten descriptors since drone 0, with its vehicle paused, fell silent."""
        if seen.healths(1, 0) and not paused.is_set():
            vehicle.pause()
            paused.set()
        published = {drone: report.published for (drone, _), report in seen.fleet.last.items()}
        if not silent and any("publishes nothing" in text for text in seen.notices(0)[-1:]):
            silent.update(published)
        gone = seen.healths(1, 0)[-1:] == [LinkHealth.DETACHED]
        return bool(silent) and gone and published[1] >= silent[1] + 10

    paused = threading.Event()
    try:
        vehicles = [f"udpin:127.0.0.1:{port}"]
        result = fly_until(ten_frames_after_its_silence, "fleet.drones=2", domain=domain(__name__), mavlink=vehicles)
    finally:
        vehicle.close()
    assert result.each[0].published == silent[0]
    seen = [c.health for c in result.health if (c.drone, c.peer) == (1, 0)]
    assert (seen[0], seen[-1]) == (LinkHealth.FRESH, LinkHealth.DETACHED)
    text = "\n".join(n.text for n in result.notices if n.drone == 0)
    assert "telemetry is stale: the vehicle's last pose is " in text
    assert "publishes nothing: the vehicle's last pose is " in text


# --- what a drone senses ---------------------------------------------------------------------------------


def senses(
    monkeypatch: pytest.MonkeyPatch, hysteresis: float = 0.0, **state: Any
) -> tuple[MavlinkSenses, dict[str, Any], list[str]]:
    """Drone 2's, which publishes in every second frame of a tenth of a second."""
    seen: dict[str, Any] = {"sensed": [], "perceived": []}

    def views(poses: Any, field: Any, cameras: Any) -> list[list[View]]:
        seen["poses"], seen["field"], seen["cameras"] = poses, field, cameras
        return [[View(1, 2, b"cells")]]

    monkeypatch.setattr(platform, "views", views)
    replay: Any = SimpleNamespace(
        sense=seen["sensed"].append, perceived=seen["perceived"].append, cameras=USUAL, height_field="field"
    )
    replay.platform = lambda: Platform(0.9, 0.8, 0.7)
    replay.task = lambda: Task(TaskPhase.TRACK, Disc(1.0, 2.0, 3.0))
    link: Any = SimpleNamespace(state=VehicleState(**state), refused=0)
    notes: list[str] = []
    made = MavlinkSenses(link, replay, 2, notes.append, hysteresis=hysteresis)
    every_second = example("context={rate_hz: 10, publish_every: 2, detached_after_periods: 10}")
    made.begin(500.0, rules_of(every_second, 0.0, 6.0))
    return made, seen, notes


def test_what_a_vehicle_says_is_what_its_drone_senses(monkeypatch: pytest.MonkeyPatch) -> None:
    heard_s = time.monotonic()
    half = 0.35
    turned = (0.0, 0.0, math.sin(half), math.cos(half))
    times = {"position_s": heard_s, "attitude_s": heard_s + 3.0}
    place = {"position_m": (1.0, 2.0, 30.0), "velocity_mps": (4.0, 5.0, 6.0)}
    made, seen, _ = senses(monkeypatch, **place, soc=0.25, orientation_xyzw=turned, **times)
    sensed = made.sense(7)
    capture = sensed.capture
    assert (capture.drone, capture.t_s) == (2, heard_s + 500.0), "when the older of position and attitude came in"
    assert capture.position_m == capture.est_position_m == (1.0, 2.0, 30.0)
    assert capture.est_yaw_rad == pytest.approx(2 * half)
    assert (sensed.velocity_mps, sensed.view) == ((4.0, 5.0, 6.0), View(1, 2, b"cells"))
    made.sense(8)
    assert (seen["sensed"], seen["field"]) == ([7, 8], "field")
    for heading in (seen["poses"].yaw_rad, seen["poses"].est_yaw_rad):
        assert heading.tolist() == [[pytest.approx(2 * half)]]
    assert seen["poses"].position_m.tolist() == seen["poses"].est_position_m.tolist() == [[[1.0, 2.0, 30.0]]]
    higher = senses(monkeypatch, position_m=(1.0, 2.0, 60.0))[0].sense(0)
    assert higher.footprint_radius_m == pytest.approx(2 * sensed.footprint_radius_m)
    made.perceived(capture)
    assert seen["perceived"] == [capture]


def test_charge_and_phase_are_the_vehicle_s_where_it_knows_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its charge rises only by more than the band."""
    for soc, wanted in ((None, 0.9), (0.25, 0.25), (0.0, 0.0)):
        assert senses(monkeypatch, soc=soc)[0].platform() == Platform(wanted, 0.8, 0.7)
    made, _, _ = senses(monkeypatch, hysteresis=0.2)
    told = []
    for soc in (None, 0.5, 0.4, 0.44, 0.6):
        made._link.state = VehicleState(soc=soc)
        told.append(made.platform().soc)
    assert told == pytest.approx([0.9, 0.5, 0.4, 0.4, 0.5])
    for landed, phase in ((False, TaskPhase.TRACK), (True, TaskPhase.LANDING)):
        task = senses(monkeypatch, landed=landed)[0].task()
        assert (task.phase, task.region) == (phase, Disc(1.0, 2.0, 3.0))


def test_old_telemetry_is_told_once_and_mutes_when_peers_would_detach(monkeypatch: pytest.MonkeyPatch) -> None:
    """Descriptors come every 0.2 s: after ten of them peers would detach, so that 2 s are the limit."""
    made, _, notes = senses(monkeypatch)
    rules = made._rules
    assert rules is not None
    for age_s, stale, muted in (
        (rules.fresh_s - 0.01, False, False),
        (rules.fresh_s + 0.01, True, False),
        (1.99, True, False),
        (2.01, True, True),
        (1.0, True, False),
        (0.05, False, False),
        (0.05, False, False),
    ):
        made._judge_age(age_s)
        assert (made._stale, made.muted) == (stale, muted), age_s
    said = ["telemetry is stale", "publishes nothing", "telemetry is back"]
    assert [note.partition(":")[0] for note in notes] == said


def test_telemetry_without_a_valid_signature_is_refused_and_counted() -> None:
    """Unsigned, signed with another key, repeated, and recorded an hour ago; without a key nothing is checked."""
    for key in (None, bytes(32)):
        listener, wrong, good = Listener(KEY), frames(signed(key)), frames(signed())
        assert [m for frame in wrong for m in listener.heard(frame)] == []
        assert listener.refused == len(wrong)
        assert len([m for frame in good for m in listener.heard(frame)]) == len(good)
        assert [m for frame in good for m in listener.heard(frame)] == []
        assert listener.refused == len(wrong) + len(good)
    old = frames(signed(ahead_us=-3_600_000_000))
    assert [m for frame in old for m in Listener(KEY).heard(frame)] == []
    unkeyed = Listener()
    assert len([m for frame in old for m in unkeyed.heard(frame)]) == len(old)
    assert unkeyed.refused == 0


def test_a_stranger_s_frame_from_the_future_locks_no_vehicle_out() -> None:
    """pymavlink keeps the time of a frame before it looks at its signature."""
    listener, vehicle = Listener(KEY), signed()
    listener.heard(frames(vehicle)[0])
    (forged, *_) = frames(signed(bytes(32), 10**12))
    assert listener.heard(forged) == []
    assert len(listener.heard(frames(vehicle)[0])) == 1


def test_a_drone_believes_signed_telemetry_alone() -> None:
    scenario = example("fleet.drones=1")
    link = MavlinkLink("udpin:127.0.0.1:0", None, KEY)
    stranger = CirclingVehicle(f"udpout:127.0.0.1:{link.port}")
    try:
        while link.refused == 0:
            time.sleep(0.01)
        with pytest.raises(RunError, match=r"no vehicle heard within 0.05 s; \d+ messages had no valid signature$"):
            link.wait_until_found(0.05)
        vehicle, notes = CirclingVehicle(f"udpout:127.0.0.1:{link.port}", key=KEY), []
        try:
            link.wait_until_found(600.0)
            senses = MavlinkSenses(link, ReplaySenses(scenario, 0, traces(scenario)[0], 0.0), 0, notes.append)
            senses.begin(0.0, rules_of(scenario, 0.0, 6.0))
            senses.sense(0)
            senses.sense(1)
            assert notes.count("refused telemetry: a message had no valid signature") == 1
            assert senses.refused["telemetry unsigned or forged"] > 0
        finally:
            vehicle.close()
    finally:
        stranger.close()
        link.close()


def test_junk_does_not_turn_the_drone_s_requests_to_a_stranger(link: MavlinkLink) -> None:
    udp = socket.AF_INET, socket.SOCK_DGRAM
    with socket.socket(*udp) as vehicle, socket.socket(*udp) as stranger:
        for frame in frames(Transmitter(0)):
            vehicle.sendto(frame, ("127.0.0.1", link.port))
        link.wait_until_found(600.0)
        known = link._peer
        assert known is not None
        assert known[1] == vehicle.getsockname()[1]
        stranger.sendto(b"junk", ("127.0.0.1", link.port))
        stranger.sendto(Transmitter(6).pack(messages(circle(1.0), ORIGIN)[0]), ("127.0.0.1", link.port))
        while link.state.others == 0:
            time.sleep(0.01)
        assert link._peer == known


def test_a_key_needs_telemetry_and_an_owner(tmp_path: Path) -> None:
    path = tmp_path / "link.key"
    path.write_text(KEY.hex())
    assert refusal_of("--mavlink-key", str(path)) == "--mavlink-key goes with --mavlink"
    path.chmod(0o644)
    said = refusal_of("--mavlink", "udpin:127.0.0.1:0", "--mavlink-key", str(path))
    assert "its mode is 644, must be 600" in said
