"""Drones whose state comes from a flying MAVLink vehicle: frames of reference, charge, stale telemetry, a live flight."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from dds_domains import domain, udp_port
from live_flights import Seen, fly_until
from scipy.spatial.transform import Rotation
from sim_examples import example
from typer.testing import CliRunner

from sortie.fleet.logs.geodesy import Origin, geodetic, local_enu
from sortie.fleet.logs.mavlink import Companion, Listener, Transmitter, messages
from sortie.fleet.logs.vehicle import WANTED_HZ, VehicleState, after
from sortie.policies.contract import TaskPhase
from sortie.policies.staleness import LinkHealth
from sortie.sim.cli.app import app
from sortie.sim.export.origin import ORIGIN
from sortie.sim.folders import RunError
from sortie.sim.live import platform
from sortie.sim.live.context import ReplaySenses, traces
from sortie.sim.live.platform import MavlinkLink, MavlinkSenses
from sortie.sim.live.rules import rules_of
from sortie.sim.live.session import fly_live
from sortie.sim.live.vehicle import CirclingVehicle, circle


def heard(t_s: float = 3.0, origin: Origin | None = None, system: int = 1) -> VehicleState:
    """The state after one round of the circling vehicle's messages."""
    transmitter, listener, state = Transmitter(system - 1), Listener(), VehicleState()
    for message in messages(circle(t_s), ORIGIN):
        for read in listener.heard(transmitter.pack(message)):
            state = after(state, read, 7.0, origin)
    return state


@pytest.mark.parametrize("origin", [None, ORIGIN])
def test_the_state_is_the_vehicle_s_own(origin: Origin | None) -> None:
    flown, state = circle(3.0), heard(3.0, origin)
    assert (state.system, state.armed, state.landed) == (1, True, False)
    assert state.position_m == pytest.approx(flown.position_m, abs=0.02)  # 1e-7 degrees are a centimetre
    assert state.velocity_mps == pytest.approx(flown.velocity_mps, abs=0.01)
    sign = math.copysign(1.0, state.orientation_xyzw[3] * flown.orientation_xyzw[3])
    assert [sign * v for v in state.orientation_xyzw] == pytest.approx(flown.orientation_xyzw, abs=1e-6)
    assert state.soc == pytest.approx(flown.soc, abs=0.006)
    assert (state.heartbeat_s, state.pose_s) == (7.0, 7.0)


def test_roll_pitch_yaw_and_the_quaternion_are_one_attitude() -> None:
    tilted = tuple(Rotation.from_euler("ZYX", [1.0, 0.2, -0.3]).as_quat(canonical=True).tolist())
    for name in ("ATTITUDE", "ATTITUDE_QUATERNION"):
        state = VehicleState(system=1)
        for message in messages(replace(circle(0.0), orientation_xyzw=tilted), ORIGIN):
            for read in Listener().heard(Transmitter(0).pack(message)):
                if read.get_type() == name:
                    state = after(state, read, 1.0, None)
        assert state.orientation_xyzw == pytest.approx(tilted, abs=1e-6)


def test_another_system_moves_nothing() -> None:
    state, listener = heard(), Listener()
    other = Transmitter(6)
    for message in messages(circle(20.0), ORIGIN):
        for read in listener.heard(other.pack(message)):
            state = after(state, read, 9.0, None)
    assert state == heard()._replace(others=len(messages(circle(20.0), ORIGIN)))


def test_the_globe_and_the_plane_are_inverse() -> None:
    for origin in (ORIGIN, Origin(-33.9, 179.9999, 12.0)):
        assert local_enu(*geodetic((123.0, -456.0, 78.0), origin), origin) == pytest.approx((123.0, -456.0, 78.0))


def test_a_companion_asks_for_messages_at_their_rates() -> None:
    said = Listener().heard(Companion().ask(3, WANTED_HZ))
    assert [m.get_type() for m in said] == ["HEARTBEAT"] + ["COMMAND_LONG"] * len(WANTED_HZ)
    assert {(m.target_system, m.command) for m in said[1:]} == {(3, 511)}
    assert {int(m.param1): 1e6 / m.param2 for m in said[1:]} == pytest.approx(WANTED_HZ)
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in said} == {(3, 191)}


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
    with pytest.raises(RunError, match=r"^there are 6 MAVLink addresses, must be at most 5, one for each drone$"):
        fly_live(example(), mavlink=["udpin:127.0.0.1:0"] * 6)
    with pytest.raises(RunError, match="Address already in use"):
        MavlinkLink(f"udpin:127.0.0.1:{link.port}", None)


def test_what_a_drone_publishes_follows_its_vehicle_until_telemetry_stops(
    link: MavlinkLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario, began_s = example("fleet.drones=1"), time.monotonic()
    vehicle, notes = CirclingVehicle(f"udpout:127.0.0.1:{link.port}"), []
    try:
        link.wait_until_found(600.0)
        senses = MavlinkSenses(link, ReplaySenses(scenario, 0, traces(scenario)[0], 0.0), 0, notes.append)
        senses.begin(100.0, rules_of(scenario, 0.0, 6.0))
        before_s = link.state.pose_s
        first = senses.sense(0)
        assert 100.0 + before_s <= first.capture.t_s <= 100.0 + link.state.pose_s
        assert math.hypot(*first.capture.position_m[:2]) == pytest.approx(30.0, abs=1e-3)
        assert first.footprint_radius_m == pytest.approx(42.0, abs=0.1)
        assert any(first.view.grid)
        end_s = time.monotonic() + 600
        while math.dist(senses.sense(1).capture.position_m, first.capture.position_m) < 2.0:
            assert time.monotonic() < end_s
            time.sleep(0.02)
        assert circle(time.monotonic() - began_s).soc - 0.01 < senses.platform().soc <= 0.8
        assert senses.task().phase != TaskPhase.LANDING
        link.state = link.state._replace(landed=True)
        assert senses.task().phase == TaskPhase.LANDING
    finally:
        vehicle.close()
    link.close()  # no datagram is read any more
    link.state = link.state._replace(landed=False)
    heard_s, ages = link.state.pose_s, (0.2, 0.35, 0.9, 1.1, 1.5, 0.1)
    stamps = []
    for age_s in ages:
        monkeypatch.setattr(platform.time, "monotonic", lambda age_s=age_s: heard_s + age_s)
        stamps.append((round(senses.sense(2).capture.t_s, 6), senses.muted))
    assert len({stamp for stamp, _ in stamps}) == 1  # the stamp stays behind: peers see its age
    assert [muted for _, muted in stamps] == [False, False, False, True, True, False]
    assert notes == [
        "telemetry is stale: the vehicle's last pose is 0.35 s old",
        "publishes nothing: the vehicle's last pose is 1.10 s old",
        "telemetry is back",
    ]


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
        result = fly_until(
            ten_frames_after_its_silence,
            "fleet.drones=2", domain=domain(__name__), mavlink=[f"udpin:127.0.0.1:{port}"],
        )  # fmt: skip
    finally:
        vehicle.close()
    assert result.each[0].published == silent[0]
    seen = [c.health for c in result.health if (c.drone, c.peer) == (1, 0)]
    assert (seen[0], seen[-1]) == (LinkHealth.FRESH, LinkHealth.DETACHED)
    text = "\n".join(n.text for n in result.notices if n.drone == 0)
    assert "telemetry is stale: the vehicle's last pose is " in text
    assert "publishes nothing: the vehicle's last pose is " in text


# --- signed telemetry ------------------------------------------------------------------------------------

KEY = bytes(range(32))


def signed(key: bytes | None = KEY, ahead_us: int = 0) -> Transmitter:
    """A vehicle that signs from now on."""
    return Transmitter(0, key, time.time_ns() // 1000 + ahead_us)


def frames(transmitter: Transmitter, t_s: float = 3.0) -> list[bytes]:
    """One round of the circling vehicle's messages."""
    return [transmitter.pack(message) for message in messages(circle(t_s), ORIGIN)]


@pytest.mark.parametrize("key", [None, bytes(32)], ids=["unsigned", "another key"])
def test_telemetry_without_a_valid_signature_is_refused_and_counted(key: bytes | None) -> None:
    listener = Listener(KEY)
    wrong = frames(signed(key))
    assert [m for frame in wrong for m in listener.heard(frame)] == []
    assert listener.refused == len(wrong)
    good = frames(signed())
    assert len([m for frame in good for m in listener.heard(frame)]) == len(good)
    assert [m for frame in good for m in listener.heard(frame)] == []  # a repetition
    assert listener.refused == len(wrong) + len(good)
    old = frames(signed(ahead_us=-3_600_000_000))  # recorded an hour ago
    assert [m for frame in old for m in Listener(KEY).heard(frame)] == []


def test_a_stranger_s_frame_from_the_future_locks_no_vehicle_out() -> None:
    """pymavlink keeps the time of a frame before it looks at its signature."""
    listener, vehicle = Listener(KEY), signed()
    listener.heard(frames(vehicle)[0])
    (forged, *_) = frames(signed(bytes(32), 10**12))
    assert listener.heard(forged) == []
    assert len(listener.heard(frames(vehicle)[0])) == 1


def test_without_a_key_signatures_are_not_checked() -> None:
    listener = Listener()
    good = frames(signed())
    assert len([m for frame in good for m in listener.heard(frame)]) == len(good)
    assert listener.refused == 0


def test_a_companion_signs_what_it_asks() -> None:
    asked = Companion(KEY).ask(1, WANTED_HZ)
    assert len(Listener(KEY).heard(asked)) == 1 + len(WANTED_HZ)
    unsigned = Listener(KEY)
    assert unsigned.heard(Companion().ask(1, WANTED_HZ)) == []
    assert unsigned.refused == 1 + len(WANTED_HZ)


def test_a_drone_believes_signed_telemetry_alone() -> None:
    scenario = example("fleet.drones=1")
    link = MavlinkLink("udpin:127.0.0.1:0", None, KEY)
    stranger = CirclingVehicle(f"udpout:127.0.0.1:{link.port}")
    try:
        end_s = time.monotonic() + 600
        while link.refused == 0:
            assert time.monotonic() < end_s
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
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:  # fmt: skip
        for frame in frames(Transmitter(0)):
            vehicle.sendto(frame, ("127.0.0.1", link.port))
        link.wait_until_found(600.0)
        known = link._peer
        assert known is not None
        assert known[1] == vehicle.getsockname()[1]
        stranger.sendto(b"junk", ("127.0.0.1", link.port))
        stranger.sendto(Transmitter(6).pack(messages(circle(1.0), ORIGIN)[0]), ("127.0.0.1", link.port))
        end_s = time.monotonic() + 600
        while link.state.others == 0:
            assert time.monotonic() < end_s
            time.sleep(0.01)
        assert link._peer == known


def test_a_key_needs_telemetry_and_an_owner(tmp_path: Path) -> None:
    path = tmp_path / "link.key"
    path.write_text(KEY.hex())
    done = CliRunner().invoke(app, ["live", "--mavlink-key", str(path)])
    assert str(done.exception) == "--mavlink-key goes with --mavlink"
    path.chmod(0o644)
    done = CliRunner().invoke(app, ["live", "--mavlink", "udpin:127.0.0.1:0", "--mavlink-key", str(path)])
    assert "its mode is 644, must be 600" in str(done.exception)


@pytest.mark.parametrize("every", [1, 3])
def test_telemetry_ages_in_periods_of_a_descriptor(every: int, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = example("fleet.drones=2", f"context.publish_every={every}")
    link = MavlinkLink("udpin:127.0.0.1:0", None)
    link.close()
    senses = MavlinkSenses(link, ReplaySenses(scenario, 0, traces(scenario)[0], 0.0), 0, lambda text: None)
    senses.begin(0.0, rules_of(scenario, 0.0, 6.0))
    link.state = link.state._replace(position_s=100.0, attitude_s=100.0)
    muted = []
    for periods in (9.5, 10.5):
        monkeypatch.setattr(platform.time, "monotonic", lambda p=periods: 100.0 + p * 0.1 * every)
        senses.sense(0)
        muted.append(senses.muted)
    assert muted == [False, True]
