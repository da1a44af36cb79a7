"""Traces: read with their errors, flown in place of the models, and a run's own states flown again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from sortie.fleet.energy.recorded import BatteryTrace
from sortie.fleet.flight.frames import tangent_plane_m
from sortie.fleet.flight.motion import fly
from sortie.fleet.traces import PoseTrace, TraceError, flown_at, flown_motion, follow, read_traces
from sortie.scenarios.schema import Fleet, Origin, Route

FLEET = Fleet(route=Route(waypoints_m=((0, 0), (200, 0))))
POSE, GLOBE = "t_s,x_m,y_m,z_m", "t_s,lat_deg,lon_deg,alt_m"


def written(folder: Path, *rows: str) -> Path:
    path = folder / "trace.csv"
    path.write_text("".join(f"{row}\n" for row in rows))
    return path


def pose_of(path: Path, drone: int = 0) -> PoseTrace:
    pose = read_traces(path, drone + 1)[drone].pose
    assert pose is not None
    return pose


def charge_of(path: Path, drone: int = 0) -> BatteryTrace:
    battery = read_traces(path, drone + 1)[drone].battery
    assert battery is not None
    return battery


# --- charges ----------------------------------------------------------------------------------------------


def test_charge_runs_linearly_and_holds_at_both_ends(tmp_path: Path) -> None:
    battery = charge_of(written(tmp_path, "t_s,drone,soc,voltage_v", "2,1,0.9,16", "4,1,0.7,", "6,1,0.6,15"), 1)
    assert [battery.soc_at(t) for t in (0, 2, 3, 4, 99)] == [0.9, 0.9, pytest.approx(0.8), 0.7, 0.6]
    assert battery.voltage_at(4.0) == pytest.approx(15.5)  # the gap is bridged
    assert battery.current_at(4.0) is None


def test_a_charge_that_rises_by_rounding_is_held(tmp_path: Path) -> None:
    path = written(tmp_path, "t_s,soc", "0,0.9", "1,0.900005", "2,0.8", "3,0.800005", "4,0.7")
    assert charge_of(path).soc == [0.9, 0.9, 0.8, 0.8, 0.7]


def test_without_a_drone_column_everything_is_drone_0s_and_columns_of_others_are_left_unread(tmp_path: Path) -> None:
    traces = read_traces(written(tmp_path, "t_s,note,soc", "0,windy,0.9"), 1)
    assert list(traces) == [0]
    assert traces[0].pose is None


# --- places -----------------------------------------------------------------------------------------------


def test_a_pose_flies_where_the_trace_says(tmp_path: Path) -> None:
    motion = fly(FLEET, 10.0, 0.1, 1)
    rows = (f"{t},2,{3 * t},{4 * t},50" for t in range(11))
    flown = follow(motion, read_traces(written(tmp_path, "t_s,drone,x_m,y_m,z_m", *rows), 5), 0.1)
    np.testing.assert_allclose(flown.position_m[:, 2], [[0.3 * k, 0.4 * k, 50] for k in range(100)], atol=1e-9)
    np.testing.assert_allclose(flown.velocity_mps[:, 2], [[3, 4, 0]] * 100, atol=1e-9)
    np.testing.assert_allclose(flown.yaw_rad[:, 2], np.arctan2(4, 3))  # along the track
    np.testing.assert_allclose(flown.acceleration_mps2[:, 2], 0, atol=1e-6)
    for i in (0, 1, 3, 4):
        np.testing.assert_array_equal(flown.position_m[:, i], motion.position_m[:, i])
    assert not flown.position_m.flags.writeable


def test_a_traced_drone_believes_with_the_errors_of_its_model(tmp_path: Path) -> None:
    """Of its place and of its heading; the others keep theirs."""
    fleet = Fleet.model_validate({"drones": 2, "motion": {"pose_error_m": 3.0, "heading_error_deg": 10.0}})
    path = written(tmp_path, "t_s,drone,x_m,y_m,z_m,yaw_deg", "0,1,100,0,40,170", "5,1,100,50,40,-170")
    base = fly(fleet, 5.0, 0.1, 1)
    flown = follow(base, read_traces(path, 2), 0.1)
    track = np.stack([np.full(50, 100.0), base.time_s * 10, np.full(50, 40.0)], -1)
    np.testing.assert_allclose(flown.position_m[:, 1], track)
    off = [m.est_position_m - m.position_m for m in (base, flown)]
    np.testing.assert_allclose(off[1], off[0], atol=1e-9)
    turn = [np.mod(m.est_yaw_rad - m.yaw_rad + np.pi, 2 * np.pi) for m in (base, flown)]
    np.testing.assert_allclose(turn[1], turn[0], atol=1e-9)
    assert np.abs(flown.est_yaw_rad).max() <= np.pi
    assert np.ptp(turn[0]) > 0.1


def test_before_the_first_and_after_the_last_place_a_drone_stands(tmp_path: Path) -> None:
    """5 m/s north from 2 s to 6 s, with and without velocities: none where the place is held, and the same heading; nor
    is the begin or the end a manoeuvre, for which no pack would have the thrust."""
    for names, told in ((",vx_mps,vy_mps,vz_mps", ",0,5,0"), ("", "")):
        rows = (f"{t},0,{5 * t},60{told}" for t in (2.0, 4.0, 6.0 - 1e-9))
        flown = follow(fly(FLEET, 10.0, 0.1, 1), read_traces(written(tmp_path, POSE + names, *rows), 5), 0.1)
        moves = flown.velocity_mps[:, 0, 1] != 0
        assert flown.time_s[moves].tolist() == pytest.approx([k / 10 for k in range(20, 61)])
        np.testing.assert_allclose(flown.velocity_mps[moves, 0], [[0, 5, 0]] * 41)
        np.testing.assert_allclose(flown.acceleration_mps2[:, 0], 0.0, atol=1e-6)
        np.testing.assert_allclose(flown.yaw_rad[:, 0], np.pi / 2)
        held_m = np.where(flown.time_s[~moves] < 4, 10.0, 30.0 - 5e-9)
        assert (flown.position_m[~moves, 0, 1] == held_m).all()


def test_a_flight_written_as_states_flies_again(tmp_path: Path) -> None:
    """Every state of the motion comes back through a file with the record's columns."""
    motion = fly(FLEET, 20.0, 0.1, 7)
    table = {"t_s": motion.time_s.repeat(5), "drone": np.tile(np.arange(5), 200)}
    for names, states in (
        (("x_m", "y_m", "z_m"), motion.position_m),
        (("qx", "qy", "qz", "qw"), motion.orientation_xyzw),
        (("vx_mps", "vy_mps", "vz_mps"), motion.velocity_mps),
    ):
        table |= {name: states[..., k].ravel() for k, name in enumerate(names)}
    pq.write_table(pa.table(table), tmp_path / "states.parquet")
    again = follow(fly(FLEET, 20.0, 0.1, 8), read_traces(tmp_path / "states.parquet", 5), 0.1)
    np.testing.assert_allclose(again.position_m, motion.position_m, atol=1e-9)
    np.testing.assert_allclose(again.velocity_mps, motion.velocity_mps, atol=1e-9)
    np.testing.assert_allclose(again.orientation_xyzw, motion.orientation_xyzw, atol=1e-9)
    np.testing.assert_allclose(again.body_rates_radps, motion.body_rates_radps, atol=1e-6)
    np.testing.assert_allclose(again.acceleration_mps2[1:-1], motion.acceleration_mps2[1:-1], atol=0.05)


# --- attitudes --------------------------------------------------------------------------------------------


def test_heading_and_attitude_are_taken_where_given(tmp_path: Path) -> None:
    """Both signs of a quaternion are the same rotation."""
    motion = fly(FLEET, 1.0, 0.1, 1)
    path = written(tmp_path, f"{POSE},yaw_deg", "0,0,0,60,90", "1,1,0,60,90")
    np.testing.assert_allclose(follow(motion, read_traces(path, 5), 0.1).yaw_rad[:, 0], np.pi / 2)
    tilt = Rotation.from_euler("ZYX", [30, 10, 5], degrees=True).as_quat()
    rows = (f"{t},0,0,60," + ",".join(f"{sign * q:.9f}" for q in tilt) for t, sign in ((0, 1), (0.5, -1), (1, 1)))
    tilted = follow(motion, read_traces(written(tmp_path, f"{POSE},qx,qy,qz,qw", *rows), 5), 0.1)
    np.testing.assert_allclose(tilted.orientation_xyzw[:, 0], [tilt] * 10, atol=1e-7)
    np.testing.assert_allclose(tilted.body_rates_radps[:, 0], 0, atol=1e-6)


def test_compass_attitudes_become_ours(tmp_path: Path) -> None:
    """Roll, pitch and heading of an aircraft; an empty cell is level."""
    half, root = 0.5, np.cos(np.pi / 6)
    rows: list[tuple[str, tuple[float, ...], tuple[float, ...]]] = [  # where the nose and the left side point
        ("0,0,0", (0, 1, 0), (-1, 0, 0)),  # to the north
        ("0,0,90", (1, 0, 0), (0, 1, 0)),
        (",,90", (1, 0, 0), (0, 1, 0)),
        ("0,30,90", (root, 0, half), (0, 1, 0)),  # nose up
        ("30,0,0", (0, 1, 0), (-root, 0, half)),  # right side down
        ("30,30,90", (root, 0, half), (-half * half, root, half * root)),
    ]
    path = written(
        tmp_path, f"{POSE},roll_deg,pitch_deg,heading_deg", *(f"{k},0,0,9,{r[0]}" for k, r in enumerate(rows))
    )
    pose = pose_of(path)
    assert pose.orientation_xyzw is not None
    for (said, nose, left), q in zip(rows, pose.orientation_xyzw, strict=True):
        body = Rotation.from_quat(q)
        np.testing.assert_allclose(body.apply([[1, 0, 0], [0, 1, 0]]), [nose, left], atol=1e-12, err_msg=said)


def test_an_attitude_that_is_missing_is_the_nearest_in_time(tmp_path: Path) -> None:
    rows = (f"{t},{t},0,50,{yaw}" for t, yaw in ((0, 10), (1, ""), (2, ""), (3, ""), (4, 50)))
    pose = pose_of(written(tmp_path, f"{POSE},yaw_deg", *rows))
    assert pose.orientation_xyzw is not None
    yaw = np.degrees(2 * np.arcsin(pose.orientation_xyzw[:, 2]))
    assert yaw[[0, 1, 3, 4]] == pytest.approx([10, 10, 50, 50])


# --- the globe --------------------------------------------------------------------------------------------


def test_the_tangent_plane_has_published_values_and_keeps_distances() -> None:
    """MATLAB's and pymap3d's example of geodetic2enu: azimuth 33°, elevation 70°, 1,000 m away. And degrees of the
    meridian and of the equator, by tables."""
    away = tangent_plane_m([(42.002581974253744, -81.99775196006746, 1139.701799575106)], (42, -82, 200))[0]
    az, el = np.radians((33, 70))
    np.testing.assert_allclose(
        away, 1000 * np.array([np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)]), atol=1e-6
    )
    metre = tangent_plane_m([(1e-4, 0, 0), (0, 1e-4, 0)], (0, 0, 0))
    np.testing.assert_allclose(metre[:, :2] * 1e4, [(0, 110_574.3), (111_319.5, 0)], atol=0.1)
    north = tangent_plane_m([(45 + 1e-4, 0, 0)], (45, 0, 0))[0, 1]
    assert north * 1e4 == pytest.approx(111_131.8, abs=0.6)


def test_a_flight_in_latitude_and_longitude_flies_in_metres(tmp_path: Path) -> None:
    rows = (f"{t},1,{47 + 1e-5 * t},{8 + 2e-5 * t},{500 + t}" for t in range(11))
    path = written(tmp_path, "t_s,drone,lat_deg,lon_deg,alt_m", "0,0,47,8,499", *rows)
    traces = read_traces(path, 3)
    motion = follow(fly(FLEET, 10.0, 0.1, 1), traces, 0.1)
    np.testing.assert_allclose(motion.position_m[0, 1], (0, 0, 1), atol=1e-9)  # above the lowest of all
    north_m, east_m = 111_178.4 * 1e-4, 76_062.0 * 2e-4  # a degree of the ellipsoid at 47° and 499 m
    np.testing.assert_allclose(motion.position_m[-1, 1, :2], np.array((east_m, north_m)) * 0.99, rtol=1e-4)
    assert motion.position_m[-1, 1, 2] == pytest.approx(10.9)
    np.testing.assert_array_equal(motion.position_m[:, 0], np.zeros((100, 3)))  # one row stands for a station
    placed = read_traces(path, 3, Origin(latitude_deg=47, longitude_deg=8.001, altitude_m=400))[1].pose
    assert placed is not None
    np.testing.assert_allclose(placed.position_m[0], (-76.06, 0, 100), atol=0.01)


def test_a_trace_on_the_globe_is_placed_at_its_first_place_and_lowest_altitude(tmp_path: Path) -> None:
    """Of all drones; an origin stands in its place. Heights are those above the origin, however far it flies."""
    rows = ("0,0,47,8,450", "10,0,47.09,8,450", "0,1,47,8.01,420", "10,1,47,8.01,500")
    path = written(tmp_path, "t_s,drone,lat_deg,lon_deg,alt_m", *rows)
    first, second = (read_traces(path, 2)[i].pose for i in (0, 1))
    assert first is not None
    assert second is not None
    assert first.position_m[0] == pytest.approx((0.0, 0.0, 30.0), abs=1e-6)
    assert first.position_m[1, 2] == pytest.approx(30.0, abs=1e-9)  # ten kilometres off
    assert second.position_m[:, 2] == pytest.approx((0.0, 80.0))
    fleet = Fleet(drones=2, trace=str(path))
    assert flown_at(fleet) == Origin(latitude_deg=47.0, longitude_deg=8.0, altitude_m=420.0)
    origin = Origin(latitude_deg=47.0, longitude_deg=8.0, altitude_m=400.0)
    own = fleet.model_copy(update={"origin": origin})
    assert flown_at(own) == flown_at(own.model_copy(update={"trace": None})) == origin
    motion, _ = flown_motion(own, 1.0, 0.1, 1)
    assert motion.position_m[0, :, 2] == pytest.approx((50.0, 20.0))


def test_a_flight_across_the_180th_meridian_is_short(tmp_path: Path) -> None:
    pose = pose_of(written(tmp_path, GLOBE, "0,0,179.9999,0", "1,0,-179.9999,0"))
    np.testing.assert_allclose(pose.position_m[1], (22.26, 0, 0), atol=0.01)


# --- what is refused --------------------------------------------------------------------------------------


NOTHING = (
    "no row has a place (x_m, y_m, z_m or lat_deg, lon_deg, alt_m) or a charge (soc), "
    "so nothing of the trace would be flown"
)
BROKEN = [
    (("drone,soc", "0,1"), "no column t_s, a trace needs t_s; it has drone, soc"),
    (("t_s,soc",), "0 rows, must be 1 to 5000000"),
    (("t_s,soc", "0,0.9", "1,1.2"), "soc in row 2 is 1.2, must be within 0 … 1"),
    (("t_s,soc", ",0.9"), "t_s in row 1 is nan, must be within 0 … 86400"),
    (("t_s,soc", "0,full"), "soc in row 1 is 'full', must be a number"),
    (("t_s,drone,soc", "0,0.5,1"), "drone in row 1 is 0.5, must be a whole number"),
    (("t_s,drone,soc", "0,5,1"), "drone in row 1 is 5, must be below fleet.drones = 5"),
    (("t_s,drone,soc", "0,0,1", "0,1,1", "0,1,0.9"), "t_s in row 3 of drone 1 is 0, must increase"),
    (
        ("t_s,soc", "0,0.9", "1,0.8", "2,0.85"),
        "soc in row 3 of drone 0 rises from 0.8 to 0.85, must not rise in flight",
    ),
    (("t_s,x_m,y_m", "0,1,1"), "a pose needs all of x_m, y_m, z_m"),
    (("t_s,qx,qy,qz", "0,0,0,0"), "an attitude needs all of qx, qy, qz, qw"),
    (("t_s,vx_mps,vy_mps", "0,1,1"), "a velocity needs all of vx_mps, vy_mps, vz_mps"),
    (("t_s,x", "0,1"), NOTHING),
    (("t_s,drone,rssi_dbm", "0,0,-60"), NOTHING),
    (("t_s,voltage_v", "0,12"), NOTHING),
    ((POSE, "0,1,,3"), NOTHING),
    (("t_s,qx,qy,qz,qw", "0,0,0,0,1"), NOTHING),
    (("t_s,lat_deg,lon_deg", "0,47,8"), "a place on the globe needs all of lat_deg, lon_deg, alt_m"),
    ((GLOBE, "0,86,8,0"), "lat_deg in row 1 is 86, must be within -85 … 85"),
    (
        (f"{POSE},lat_deg,lon_deg,alt_m", "0,0,0,9,47,8,9"),
        "columns x_m and lat_deg say the same, must be one of them",
    ),
    (("t_s,yaw_deg,heading_deg", "0,1,1"), "columns yaw_deg and heading_deg say the same, must be one of them"),
]


def refused(path: Path, origin: Origin | None = None) -> str:
    with pytest.raises(TraceError) as caught:
        read_traces(path, 5, origin)
    return str(caught.value)


def test_a_broken_trace_gives_its_one_line(tmp_path: Path) -> None:
    said = {rows: refused(written(tmp_path, *rows)) for rows, _ in BROKEN}
    assert said == {rows: f"{tmp_path / 'trace.csv'}: {message}" for rows, message in BROKEN}
    assert refused(tmp_path / "missing.csv").endswith("missing.csv: no such file")
    (tmp_path / "trace.parquet").write_text("t_s,soc\n0,1\n")
    assert "trace.parquet: is not a .parquet table" in refused(tmp_path / "trace.parquet")


FIX, ZERO = "47.0,8.0,450", "0,0,0"
HINT = "; leave cells empty where a receiver had no fix"
FAR = "are 0 and 0, 5,116 km from another place, must be within 20 km" + HINT
DISTANT: list[tuple[list[str], tuple[float, float] | None, str]] = [
    ([ZERO, FIX, FIX, FIX], None, f"row 1 {FAR}"),
    ([FIX, ZERO, FIX], None, f"row 2 {FAR}"),
    ([ZERO, ZERO, ZERO, FIX], None, f"row 1 {FAR}"),
    ([FIX, FIX, "47.0,9.0,450"], None, "row 3 are 47 and 9, 76 km from another place, must be within 20 km"),
    ([FIX, FIX, "-47,-172,450"], None, "row 3 are -47 and -172, 12,734 km from another place, must be within 20 km"),
    ([FIX, ",,", FIX], (46.0, 8.0), "row 1 are 47 and 8, 111 km from fleet.origin, must be within 20 km"),
    ([ZERO, FIX], (47.0, 8.0), f"row 1 are 0 and 0, 5,116 km from fleet.origin, must be within 20 km{HINT}"),
]


def test_places_in_degrees_have_the_bound_of_metres(tmp_path: Path) -> None:
    wrong = {}
    for rows, origin, message in DISTANT:
        path = written(tmp_path, GLOBE, *(f"{k},{row}" for k, row in enumerate(rows)))
        at = None if origin is None else Origin(latitude_deg=origin[0], longitude_deg=origin[1], altitude_m=0)
        said = refused(path, at)
        if said != f"{path}: lat_deg and lon_deg in {message}":
            wrong[tuple(rows)] = said
    assert wrong == {}
