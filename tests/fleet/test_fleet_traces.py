"""Traces: read with their errors, flown in place of the models, and a run's own states flown again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from sortie.fleet.flight.motion import fly
from sortie.fleet.traces import COLUMNS, TraceError, follow, read_traces
from sortie.scenarios.schema import Fleet, Route

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
    battery = read_traces(written(tmp_path, "t_s,soc\n0,0.9\n1,0.900005\n2,0.8\n"), 1)[0].battery
    assert battery is not None
    assert battery.soc == [0.9, 0.9, 0.8]


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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("drone,soc\n0,1\n", "no column t_s, a trace needs t_s"),
        ("t_s,soc\n", "0 rows, must be 1 to 5000000"),
        ("t_s,soc\n0,0.9\n1,1.2\n", "soc in row 2 is 1.2, must be within 0 … 1"),
        ("t_s,soc\n,0.9\n", "t_s in row 1 is nan, must be within 0 … 86400"),
        ("t_s,soc\n0,full\n", "column soc does not hold numbers"),
        ("t_s,drone,soc\n0,0.5,1\n", "drone in row 1, must be a whole number"),
        ("t_s,drone,soc\n0,5,1\n", "drone 5, must be below fleet.drones = 5"),
        ("t_s,drone,soc\n0,0,1\n0,1,1\n0,1,0.9\n", "t_s in row 3 of drone 1 is 0, must increase"),
        ("t_s,soc\n0,0.9\n1,0.8\n2,0.85\n", "drone 0: soc rises from 0.8 to 0.85 at 2 s, must not rise in flight"),
        ("t_s,x_m,y_m\n0,1,1\n", "a pose needs all of x_m, y_m, z_m"),
        ("t_s,qx,qy,qz\n0,0,0,0\n", "an attitude needs all of qx, qy, qz, qw"),
        ("t_s,vx_mps,vy_mps\n0,1,1\n", "a velocity needs all of vx_mps, vy_mps, vz_mps"),
    ],
)
def test_a_broken_trace_gives_its_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(TraceError) as caught:
        read_traces(path, 5)
    assert str(caught.value) == f"{path}: {message}"


def test_no_file_and_no_table(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match=r"missing\.csv: no such trace"):
        read_traces(tmp_path / "missing.csv", 1)
    (tmp_path / "trace.parquet").write_text("t_s,soc\n0,1\n")
    with pytest.raises(TraceError, match=r"trace\.parquet: is not a \.parquet table"):
        read_traces(tmp_path / "trace.parquet", 1)


def test_the_columns_are_told_in_the_modules_words() -> None:
    import sortie.fleet.traces

    assert all(name in (sortie.fleet.traces.__doc__ or "") for name in COLUMNS)
