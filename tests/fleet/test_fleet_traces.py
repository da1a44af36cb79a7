"""Traces: read with their errors, flown in place of the models, and a run's own states flown again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from sortie.fleet.flight.frames import tangent_plane_m
from sortie.fleet.flight.motion import fly
from sortie.fleet.traces import COLUMNS, TraceError, follow, read_traces
from sortie.scenarios.schema import Fleet, Origin, Route

FLEET = Fleet(route=Route(waypoints_m=((0, 0), (200, 0))))


def written(folder: Path, text: str) -> Path:
    path = folder / "trace.csv"
    path.write_text(text)
    return path


def test_charge_runs_linearly_and_holds_at_both_ends(tmp_path: Path) -> None:
    path = written(tmp_path, "t_s,drone,soc,voltage_v\n2,1,0.9,16\n4,1,0.7,\n6,1,0.6,15\n")
    battery = read_traces(path, 3)[1].battery
    assert battery is not None
    assert [battery.soc_at(t) for t in (0, 2, 3, 4, 99)] == [0.9, 0.9, pytest.approx(0.8), 0.7, 0.6]
    assert battery.voltage_at(4.0) == pytest.approx(15.5)  # the gap is bridged
    assert battery.current_at(4.0) is None


def test_a_charge_that_rises_by_rounding_is_held(tmp_path: Path) -> None:
    battery = read_traces(written(tmp_path, "t_s,soc\n0,0.9\n1,0.900005\n2,0.8\n3,0.800005\n4,0.7\n"), 1)[0].battery
    assert battery is not None
    assert battery.soc == [0.9, 0.9, 0.8, 0.8, 0.7]


def test_without_a_drone_column_everything_is_drone_0s(tmp_path: Path) -> None:
    assert list(read_traces(written(tmp_path, "t_s,soc\n0,0.9\n"), 1)) == [0]


def test_columns_of_others_are_left_unread(tmp_path: Path) -> None:
    traces = read_traces(written(tmp_path, "t_s,note,soc\n0,windy,0.9\n"), 1)
    assert traces[0].pose is None


def test_a_pose_flies_where_the_trace_says(tmp_path: Path) -> None:
    rows = "".join(f"{t},2,{3 * t},{4 * t},50\n" for t in range(11))
    motion = fly(FLEET, 10.0, 0.1, 1)
    flown = follow(motion, read_traces(written(tmp_path, "t_s,drone,x_m,y_m,z_m\n" + rows), 5), 0.1)
    np.testing.assert_allclose(flown.position_m[:, 2], [[0.3 * k, 0.4 * k, 50] for k in range(100)], atol=1e-9)
    np.testing.assert_allclose(flown.velocity_mps[:, 2], [[3, 4, 0]] * 100, atol=1e-9)
    np.testing.assert_allclose(flown.yaw_rad[:, 2], np.arctan2(4, 3))  # along the track
    np.testing.assert_allclose(flown.acceleration_mps2[:, 2], 0, atol=1e-6)
    np.testing.assert_allclose(
        flown.est_position_m[:, 2] - flown.position_m[:, 2],
        motion.est_position_m[:, 2] - motion.position_m[:, 2],
        atol=1e-9,
    )
    for i in (0, 1, 3, 4):
        np.testing.assert_array_equal(flown.position_m[:, i], motion.position_m[:, i])
    assert not flown.position_m.flags.writeable


def test_heading_and_attitude_are_taken_where_given(tmp_path: Path) -> None:
    motion = fly(FLEET, 1.0, 0.1, 1)
    north = follow(
        motion, read_traces(written(tmp_path, "t_s,x_m,y_m,z_m,yaw_deg\n0,0,0,60,90\n1,1,0,60,90\n"), 5), 0.1
    )
    np.testing.assert_allclose(north.yaw_rad[:, 0], np.pi / 2)
    tilt = Rotation.from_euler("ZYX", [30, 10, 5], degrees=True).as_quat()
    text = "t_s,x_m,y_m,z_m,qx,qy,qz,qw\n" + "".join(
        f"{t},0,0,60," + ",".join(f"{sign * q:.9f}" for q in tilt) + "\n" for t, sign in ((0, 1), (0.5, -1), (1, 1))
    )
    tilted = follow(motion, read_traces(written(tmp_path, text), 5), 0.1)
    np.testing.assert_allclose(tilted.orientation_xyzw[:, 0], [tilt] * 10, atol=1e-7)  # signs are the same rotation
    np.testing.assert_allclose(tilted.body_rates_radps[:, 0], 0, atol=1e-6)


@pytest.mark.parametrize(("names", "told"), [(",vx_mps,vy_mps,vz_mps", ",0,5,0"), ("", "")])
def test_before_the_first_and_after_the_last_place_a_drone_stands(names: str, told: str, tmp_path: Path) -> None:
    """5 m/s north in every row, told from 2 s to 6 s: no velocity where the place is held, and the same heading; nor is
    the begin or the end a manoeuvre, whose thrust no pack could give."""
    rows = "".join(f"{t},0,{5 * t},60{told}\n" for t in (2.0, 4.0, 6.0 - 1e-9))
    path = written(tmp_path, f"t_s,x_m,y_m,z_m{names}\n" + rows)
    flown = follow(fly(FLEET, 10.0, 0.1, 1), read_traces(path, 5), 0.1)
    moves = flown.velocity_mps[:, 0, 1] != 0
    assert flown.time_s[moves].tolist() == pytest.approx([k / 10 for k in range(20, 61)])
    np.testing.assert_allclose(flown.velocity_mps[moves, 0], [[0, 5, 0]] * 41)
    np.testing.assert_allclose(flown.acceleration_mps2[:, 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(flown.yaw_rad[:, 0], np.pi / 2)
    assert (flown.position_m[~moves, 0, 1] == np.where(flown.time_s[~moves] < 4, 10.0, 30.0 - 5e-9)).all()


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


NOTHING = "no row has a place (x_m, y_m, z_m or lat_deg, lon_deg, alt_m) or a charge (soc), so nothing of the trace would be flown"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("drone,soc\n0,1\n", "no column t_s, a trace needs t_s; it has drone, soc"),
        ("t_s,soc\n", "0 rows, must be 1 to 5000000"),
        ("t_s,soc\n0,0.9\n1,1.2\n", "soc in row 2 is 1.2, must be within 0 … 1"),
        ("t_s,soc\n,0.9\n", "t_s in row 1 is nan, must be within 0 … 86400"),
        ("t_s,soc\n0,full\n", "soc in row 1 is 'full', must be a number"),
        ("t_s,drone,soc\n0,0.5,1\n", "drone in row 1 is 0.5, must be a whole number"),
        ("t_s,drone,soc\n0,5,1\n", "drone in row 1 is 5, must be below fleet.drones = 5"),
        ("t_s,drone,soc\n0,0,1\n0,1,1\n0,1,0.9\n", "t_s in row 3 of drone 1 is 0, must increase"),
        ("t_s,soc\n0,0.9\n1,0.8\n2,0.85\n", "soc in row 3 of drone 0 rises from 0.8 to 0.85, must not rise in flight"),
        ("t_s,x_m,y_m\n0,1,1\n", "a pose needs all of x_m, y_m, z_m"),
        ("t_s,qx,qy,qz\n0,0,0,0\n", "an attitude needs all of qx, qy, qz, qw"),
        ("t_s,vx_mps,vy_mps\n0,1,1\n", "a velocity needs all of vx_mps, vy_mps, vz_mps"),
        *(
            (text, NOTHING)
            for text in (
                "t_s,x\n0,1\n",
                "t_s,drone,rssi_dbm\n0,0,-60\n",
                "t_s,voltage_v\n0,12\n",
                "t_s,x_m,y_m,z_m\n0,1,,3\n",
                "t_s,qx,qy,qz,qw\n0,0,0,0,1\n",
            )
        ),
    ],
)
def test_a_broken_trace_gives_its_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(TraceError) as caught:
        read_traces(path, 5)
    assert str(caught.value) == f"{path}: {message}"


def test_no_file_and_no_table(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match=r"missing\.csv: no such file"):
        read_traces(tmp_path / "missing.csv", 1)
    (tmp_path / "trace.parquet").write_text("t_s,soc\n0,1\n")
    with pytest.raises(TraceError, match=r"trace\.parquet: is not a \.parquet table"):
        read_traces(tmp_path / "trace.parquet", 1)


def test_the_columns_are_told_in_the_modules_words() -> None:
    import sortie.fleet.traces

    assert all(name in (sortie.fleet.traces.__doc__ or "") for name in COLUMNS)


def test_the_tangent_plane_has_published_values_and_keeps_distances() -> None:
    """Azimuth 33°, elevation 70°, 1,000 m away: the example of MATLAB's and pymap3d's geodetic2enu; and a degree of the
    meridian and of the equator, whose lengths are tabled."""
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
    rows = "".join(f"{t},1,{47 + 1e-5 * t},{8 + 2e-5 * t},{500 + t}\n" for t in range(11))
    path = written(tmp_path, "t_s,drone,lat_deg,lon_deg,alt_m\n0,0,47,8,499\n" + rows)
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


FIX, HINT = "47.0,8.0,450", "; leave cells empty where a receiver had no fix"


@pytest.mark.parametrize(
    ("rows", "origin", "message"),
    [
        (["0,0,0", FIX, FIX, FIX], None, f"row 1 are 0 and 0, 5,116 km from another place, must be within 20 km{HINT}"),
        ([FIX, "0,0,0", FIX], None, f"row 2 are 0 and 0, 5,116 km from another place, must be within 20 km{HINT}"),
        (["0,0,0"] * 3 + [FIX], None, f"row 1 are 0 and 0, 5,116 km from another place, must be within 20 km{HINT}"),
        ([FIX, FIX, "47.0,9.0,450"], None, "row 3 are 47 and 9, 76 km from another place, must be within 20 km"),
        (
            [FIX, FIX, "-47.0,-172.0,450"],
            None,
            "row 3 are -47 and -172, 12,734 km from another place, must be within 20 km",
        ),
        ([FIX, ",,", FIX], (46.0, 8.0), "row 1 are 47 and 8, 111 km from fleet.origin, must be within 20 km"),
        (["0,0,0", FIX], (47.0, 8.0), f"row 1 are 0 and 0, 5,116 km from fleet.origin, must be within 20 km{HINT}"),
    ],
)
def test_places_in_degrees_have_the_bound_of_metres(
    rows: list[str], origin: tuple[float, float] | None, message: str, tmp_path: Path
) -> None:
    path = written(tmp_path, "t_s,lat_deg,lon_deg,alt_m\n" + "".join(f"{k},{row}\n" for k, row in enumerate(rows)))
    at = None if origin is None else Origin(latitude_deg=origin[0], longitude_deg=origin[1], altitude_m=0)
    with pytest.raises(TraceError) as refused:
        read_traces(path, 1, at)
    assert str(refused.value) == f"{path}: lat_deg and lon_deg in {message}"


def test_a_flight_across_the_180th_meridian_is_short(tmp_path: Path) -> None:
    path = written(tmp_path, "t_s,lat_deg,lon_deg,alt_m\n0,0,179.9999,0\n1,0,-179.9999,0\n")
    pose = read_traces(path, 1)[0].pose
    assert pose is not None
    np.testing.assert_allclose(pose.position_m[1], (22.26, 0, 0), atol=0.01)


@pytest.mark.parametrize(
    ("roll", "pitch", "heading", "forward", "left"),
    [
        (0, 0, 0, (0, 1, 0), (-1, 0, 0)),  # to the north
        (0, 0, 90, (1, 0, 0), (0, 1, 0)),
        (0, 30, 90, (np.cos(np.pi / 6), 0, 0.5), (0, 1, 0)),  # nose up
        (30, 0, 0, (0, 1, 0), (-np.cos(np.pi / 6), 0, 0.5)),  # right side down
    ],
)
def test_compass_attitudes_become_ours(
    tmp_path: Path, roll: float, pitch: float, heading: float, forward: tuple[float, ...], left: tuple[float, ...]
) -> None:
    text = f"t_s,x_m,y_m,z_m,roll_deg,pitch_deg,heading_deg\n0,0,0,9,{roll},{pitch},{heading}\n"
    pose = read_traces(written(tmp_path, text), 1)[0].pose
    assert pose is not None
    assert pose.orientation_xyzw is not None
    body = Rotation.from_quat(pose.orientation_xyzw[0])
    np.testing.assert_allclose(body.apply([1, 0, 0]), forward, atol=1e-12)
    np.testing.assert_allclose(body.apply([0, 1, 0]), left, atol=1e-12)


@pytest.mark.parametrize(
    ("header", "row", "said"),
    [
        ("t_s,lat_deg,lon_deg", "0,47,8", "a place on the globe needs all of lat_deg, lon_deg, alt_m"),
        ("t_s,lat_deg,lon_deg,alt_m", "0,86,8,0", "lat_deg in row 1 is 86, must be within -85 … 85"),
        (
            "t_s,x_m,y_m,z_m,lat_deg,lon_deg,alt_m",
            "0,0,0,9,47,8,9",
            "columns x_m and lat_deg say the same, must be one of them",
        ),
        ("t_s,yaw_deg,heading_deg", "0,1,1", "columns yaw_deg and heading_deg say the same, must be one of them"),
    ],
)
def test_a_globe_that_does_not_fit_is_refused(tmp_path: Path, header: str, row: str, said: str) -> None:
    path = written(tmp_path, f"{header}\n{row}\n")
    with pytest.raises(TraceError) as refused:
        read_traces(path, 1)
    assert str(refused.value) == f"{path}: {said}"
