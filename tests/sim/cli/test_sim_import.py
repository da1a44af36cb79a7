"""`sortie import`: a log becomes a trace and a scenario, and that scenario flies what was logged."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import log_examples as examples
import numpy as np
import pyarrow.parquet as pq
import pytest
from sim_examples import example
from typer.testing import CliRunner

from sortie.fleet.logs.flightlog import read_log, read_logs
from sortie.fleet.logs.logtrace import context_trace
from sortie.fleet.traces import COLUMNS, read_traces
from sortie.scenarios.errors import SortieError
from sortie.scenarios.reading.load import load
from sortie.sim.cli.app import app
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.export.telemetry import save_tlog
from sortie.sim.folders import RunError

LOGS = Path(os.environ.get("SORTIE_FLIGHT_LOGS", Path(__file__).resolve().parents[4] / "shared/flightlogs"))
needs_logs = pytest.mark.skipif(not (LOGS / "log171.bin").is_file(), reason=f"{LOGS} has no flight logs")


def imported(folder: Path, kind: str, *more: str) -> Path:
    """The folder that `sortie import` makes of the example of a kind."""
    log = folder / f"My Flight.{kind}"
    log.write_bytes(examples.KINDS[kind]())
    done = CliRunner().invoke(app, ["import", str(log), "--out", str(folder / "out"), *more], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return folder / "out"


@pytest.mark.parametrize("kind", examples.KINDS)
def test_a_log_flies_as_one_drone(kind: str, tmp_path: Path) -> None:
    """3, 4 and 1 m/s from 2 m up, the charge from 90 % by 1 % a second."""
    scenario = load(imported(tmp_path, kind) / "scenario.yaml")
    assert (scenario.name, scenario.fleet.drones, scenario.duration_s) == ("my_flight", 1, 9.9)
    assert scenario.fleet.battery.cells == 4
    states = run_sortie(scenario).tables["states"]
    t_s = states["t_s"].to_numpy()
    wanted = np.stack([3 * t_s, 4 * t_s, 2 + t_s], axis=-1)
    flown = np.stack([states[name].to_numpy() for name in ("x_m", "y_m", "z_m")], axis=-1)
    np.testing.assert_allclose(flown, wanted, atol=0.02)
    np.testing.assert_allclose(states["vx_mps"].to_numpy(), 3.0, atol=0.006)
    np.testing.assert_allclose(states["soc"].to_numpy(), 0.9 - 0.01 * t_s, atol=0.0055)
    np.testing.assert_allclose(states["voltage_v"].to_numpy()[1:], 16 - 0.1 * t_s[1:], atol=0.002)


def test_a_stretch_of_the_log_begins_at_zero(tmp_path: Path) -> None:
    folder = imported(tmp_path, "bin", "--from", "2", "--until", "5", "--rate", "20", "--lift", "50")
    trace = pq.read_table(folder / "trace.parquet")
    assert trace["t_s"].to_pylist() == pytest.approx([k / 20 for k in range(61)])
    assert trace["z_m"][0].as_py() == pytest.approx(52.0, abs=1e-3)
    assert set(trace.column_names) <= set(COLUMNS)


def test_a_charge_that_is_told_to_be_gone_does_not_land_it(tmp_path: Path) -> None:
    """Counted over the capacity that was set: nothing left from the fourth second on, and the flight went on."""
    log = tmp_path / "empty.bin"
    log.write_bytes(examples.dataflash().replace(struct.pack("<f", 5000.0), struct.pack("<f", 540.0)))
    done = CliRunner().invoke(app, ["import", str(log), "--out", str(tmp_path / "out")], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    states = run_sortie(load(tmp_path / "out/scenario.yaml")).tables["states"]
    assert min(states["soc"].to_pylist()) == pytest.approx(0.001, abs=1e-4)
    assert all(states["airborne"].to_pylist())


def test_gaps_are_empty_cells(tmp_path: Path) -> None:
    data = examples.dataflash()
    begin, step = len(examples.dataflash_begin()), len(examples.dataflash_step(0))
    (tmp_path / "gap.bin").write_bytes(data[: begin + 30 * step] + data[begin + 60 * step :])
    columns = context_trace(read_log(tmp_path / "gap.bin"))
    empty = np.isnan(columns["soc"])
    assert columns["t_s"][empty].tolist() == pytest.approx([3 + k / 10 for k in range(30)])
    assert empty.tolist() == np.isnan(columns["x_m"]).tolist() == np.isnan(columns["qw"]).tolist()


def test_a_damaged_log_is_imported_and_its_damage_told(tmp_path: Path) -> None:
    log = tmp_path / "damaged.ulg"
    data = examples.ulog()
    log.write_bytes(data[:5000] + b"\xff" * 60 + data[5000:-3])
    done = CliRunner().invoke(app, ["import", str(log), "--out", str(tmp_path / "out")], catch_exceptions=False)
    assert done.exit_code == 0
    assert "are no message" in done.output
    assert "cut off" in done.output
    assert read_traces(tmp_path / "out/trace.parquet", 1)[0].battery is not None


def test_what_cannot_be_imported_is_one_line_and_writes_nothing(tmp_path: Path) -> None:
    log = tmp_path / "short.bin"
    log.write_bytes(examples.dataflash())
    for arguments, said in (
        ([str(tmp_path / "nowhere.bin")], "nowhere.bin: cannot be read"),
        ([__file__], "is no DataFlash log"),
        ([str(log), "--from", "9.5"], "0.4 s from 9.5 s on, must be 1 s at least"),
        ([str(log), "--until", "9000"], "9000 s to fly, must be at most 7200"),
        ([str(log), "--until", "5", "--rate", "0.1"], "5.0 s at 0.1 rows a second are one row, must be two at least"),
    ):
        with pytest.raises(SortieError, match=said):
            CliRunner().invoke(app, ["import", *arguments, "--out", str(tmp_path / "out")], catch_exceptions=False)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("keep")
    with pytest.raises(RunError, match=r"mine: holds notes\.txt, which no flight wrote"):
        CliRunner().invoke(app, ["import", str(log), "--out", str(tmp_path / "mine")], catch_exceptions=False)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine", "short.bin"]


@pytest.mark.parametrize("option", ["--lift", "--until", "--from"])
@pytest.mark.parametrize("value", ["nan", "-inf", "-1e5"])
def test_an_option_that_is_no_figure_writes_nothing(option: str, value: str, tmp_path: Path) -> None:
    """`--lift nan` left the trace without heights, and the scenario flew its own route."""
    log = tmp_path / "short.bin"
    log.write_bytes(examples.dataflash())
    done = CliRunner().invoke(app, ["import", str(log), "--out", str(tmp_path / "out"), f"{option}={value}"])
    assert done.exit_code == 2
    assert f"Invalid value for '{option}'" in done.output
    assert not (tmp_path / "out").exists()


def test_a_flight_replaces_a_flight_and_no_file_that_it_did_not_write(tmp_path: Path) -> None:
    log, out = tmp_path / "short.bin", tmp_path / "out"
    log.write_bytes(examples.dataflash())
    command = ["import", str(log), "--out", str(out)]
    for _ in range(2):
        assert CliRunner().invoke(app, command, catch_exceptions=False).exit_code == 0
    (out / "run").mkdir()
    (out / "notes.txt").write_text("keep")
    with pytest.raises(RunError, match=r"out: holds notes\.txt, which no flight wrote"):
        CliRunner().invoke(app, command, catch_exceptions=False)
    assert (out / "notes.txt").read_text() == "keep"
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "scenario.yaml").write_text("name: mine\n")
    with pytest.raises(RunError, match=r"mine: its scenario\.yaml is none that sortie import wrote"):
        CliRunner().invoke(app, ["import", str(log), "--out", str(mine)], catch_exceptions=False)
    assert (mine / "scenario.yaml").read_text() == "name: mine\n"


@needs_logs
@pytest.mark.parametrize(
    ("name", "seconds", "lacks"),
    [("log171.bin", 242.5, []), ("fs-batt.tlog", 20.0, ["x_m"]), ("sample_log_small.ulg", 6.4, [])],
)
def test_three_real_logs_fly(name: str, seconds: float, lacks: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["import", str(LOGS / name), "--out", str(out)], catch_exceptions=False)
    assert done.exit_code == 0
    scenario = load(out / "scenario.yaml")
    assert scenario.duration_s == pytest.approx(seconds)
    names = pq.read_schema(out / "trace.parquet").names
    assert [lack for lack in ("x_m", "qw", "soc", "voltage_v") if lack not in names] == lacks
    record = run_sortie(scenario)
    columns = context_trace(read_log(LOGS / name))
    states = record.tables["states"]
    known = ~np.isnan(columns["soc"][: states.num_rows])
    flown, logged = states["soc"].to_numpy()[known], columns["soc"][: states.num_rows][known]
    np.testing.assert_allclose(flown, logged, atol=2e-3)


def test_a_fleet_s_log_flies_as_the_fleet_that_it_was(tmp_path: Path) -> None:
    """Exported and imported again: every drone's pose and charge, each where it was beside the others."""
    record = run_sortie(example("duration_s=4", "fleet.drones=3"))
    save_tlog(record, tmp_path / "fleet.tlog", 10**15)
    command = ["import", str(tmp_path / "fleet.tlog"), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, command, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "3 vehicles: drone 0 is system 1, drone 1 is system 2, drone 2 is system 3" in done.output
    scenario = load(tmp_path / "out/scenario.yaml")
    assert scenario.fleet.drones == 3
    again, before = run_sortie(scenario).tables["states"], record.tables["states"].slice(0, 3 * 39)
    assert again["drone"].to_pylist() == before["drone"].to_pylist()
    for names, precision in ((("x_m", "y_m", "z_m"), 0.05), (("qx", "qy", "qz", "qw"), 1e-3), (("soc",), 0.006)):
        places = [np.stack([each[n].to_numpy().astype(float) for n in names], axis=-1) for each in (again, before)]
        begin = places[1].min(axis=0) if names[0] == "x_m" else 0.0
        offset = places[0].min(axis=0) - begin if names[0] == "x_m" else 0.0
        np.testing.assert_allclose(places[0] - offset, places[1], atol=precision)


def test_one_vehicle_of_several_is_chosen_by_its_system(tmp_path: Path) -> None:
    save_tlog(run_sortie(example("duration_s=3", "fleet.drones=3")), tmp_path / "fleet.tlog", 10**15)
    command = ["import", str(tmp_path / "fleet.tlog"), "--out", str(tmp_path / "out"), "--system"]
    assert CliRunner().invoke(app, [*command, "2"], catch_exceptions=False).exit_code == 0
    assert load(tmp_path / "out/scenario.yaml").fleet.drones == 1
    with pytest.raises(RunError, match=r"fleet\.tlog: no vehicle with system id 9, it has 1, 2, 3$"):
        CliRunner().invoke(app, [*command, "9"], catch_exceptions=False)
    (tmp_path / "a.bin").write_bytes(examples.dataflash())
    with pytest.raises(RunError, match=r"a\.bin: no vehicle with system id 1, a DataFlash log has no systems$"):
        CliRunner().invoke(app, ["import", str(tmp_path / "a.bin"), "--system", "1"], catch_exceptions=False)


@pytest.mark.parametrize("capacity", [1e30, 1e-30, -1.0])
def test_a_capacity_that_no_pack_has_is_left_out(capacity: float, tmp_path: Path) -> None:
    """One damaged parameter made a scenario that does not load."""
    log = tmp_path / "a.bin"
    log.write_bytes(examples.dataflash().replace(struct.pack("<f", 5000.0), struct.pack("<f", capacity)))
    done = CliRunner().invoke(app, ["import", str(log), "--out", str(tmp_path / "out")], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert load(tmp_path / "out/scenario.yaml").fleet.battery.capacity_wh == 130.0


# --- several logs ----------------------------------------------------------------------------------


def gathered(folder: Path, files: dict[str, bytes], *more: str) -> tuple[Path, str]:
    """The folder that `sortie import` makes of several logs, and what it says."""
    for name, data in files.items():
        (folder / name).write_bytes(data)
    named = [str(folder / name) for name in files]
    done = CliRunner().invoke(app, ["import", *named, "--out", str(folder / "out"), *more], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return folder / "out", " ".join(done.output.split())


def columns_of(folder: Path, drone: int) -> dict[str, np.ndarray]:
    table = pq.read_table(folder / "trace.parquet")
    rows = table["drone"].to_numpy() == drone
    return {name: table[name].to_numpy()[rows] for name in table.column_names}


def test_logs_of_three_kinds_fly_together_by_their_utc(tmp_path: Path) -> None:
    """The same flight three times: by DataFlash, 2 s later by ULog, and by telemetry that began with the first."""
    files = {"a.bin": examples.dataflash(), "b.ulg": examples.ulog(late_s=2.0), "c.tlog": examples.tlog()}
    folder, said = gathered(tmp_path, files)
    assert "DataFlash and ULog and MAVLink telemetry, 11.9 s" in said
    assert "3 vehicles: drone 0 is a.bin, drone 1 is b.ulg, drone 2 is c.tlog system 1" in said
    scenario = load(folder / "scenario.yaml")
    assert (scenario.fleet.drones, scenario.duration_s) == (3, 11.9)
    states = run_sortie(scenario).tables["states"]
    t_s, drone, x = (states[name].to_numpy() for name in ("t_s", "drone", "x_m"))
    for number, late_s in ((0, 0.0), (1, 2.0), (2, 0.0)):
        own = (drone == number) & (t_s >= late_s) & (t_s <= late_s + 9.8)
        np.testing.assert_allclose(x[own], 3 * (t_s[own] - late_s), atol=0.05)


def test_a_log_without_utc_begins_with_the_first_and_that_is_told(tmp_path: Path) -> None:
    files = {"late.bin": examples.dataflash(late_s=100.0), "blind.ulg": examples.ulog()}
    folder, said = gathered(tmp_path, files)
    assert "blind.ulg: it does not say when it began: it begins with the first log" in said
    assert "blind.ulg: it has no place on the globe, and its places are left out" in said
    assert columns_of(folder, 1)["soc"][0] == pytest.approx(0.9, abs=1e-6)


def test_logs_of_different_days_fly_together_only_if_that_is_meant(tmp_path: Path) -> None:
    files = {"a.bin": examples.dataflash(), "b.bin": examples.dataflash(late_s=86_400.0)}
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    command = ["import", str(tmp_path / "a.bin"), str(tmp_path / "b.bin"), "--out", str(tmp_path / "out")]
    with pytest.raises(
        SortieError, match=r"a\.bin: has no moment in common with the other logs \(86400 s away\); --together"
    ):
        CliRunner().invoke(app, command, catch_exceptions=False)
    assert not (tmp_path / "out").exists()
    folder, said = gathered(tmp_path, files, "--together")
    assert "DataFlash, 9.9 s" in said
    np.testing.assert_allclose(columns_of(folder, 0)["x_m"], columns_of(folder, 1)["x_m"], atol=0.01)


def test_a_ground_station_stands_where_it_is_said_to_stand(tmp_path: Path) -> None:
    """100 m north of where the flight began, and 10 m above its altitude; another one without an altitude."""
    north_deg = 100 / 111_170
    places = (f"{47 + north_deg},8,410", "47,8.001")
    folder, _ = gathered(tmp_path, {"a.bin": examples.dataflash()}, "--ground", places[0], "--ground", places[1])
    scenario = load(folder / "scenario.yaml")
    assert (scenario.fleet.drones, [station.drone for station in scenario.fleet.ground]) == (3, [1, 2])
    first, second = columns_of(folder, 1), columns_of(folder, 2)
    assert (first["x_m"][0], first["y_m"][0]) == pytest.approx((0.0, 100.0), abs=0.1)
    assert first["z_m"][0] == pytest.approx(2.0 + 10.0, abs=0.05)  # the flight's lowest point is lifted to 2 m
    assert (second["x_m"][0], second["z_m"][0]) == pytest.approx((76.1, 2.0), abs=0.1)
    record = run_sortie(scenario)
    save_tlog(record, tmp_path / "again.tlog", 10**15)
    fixes = [flight.fix.values for flight in read_logs(tmp_path / "again.tlog") if flight.fix is not None]
    assert fixes[0][0] == pytest.approx([47.0, 8.0, 400.0], abs=0.05)  # at the same place on the globe
    said = CliRunner().invoke(app, ["import", str(tmp_path / "a.bin"), "--ground", "north"])
    assert "origin is 'north', must be latitude,longitude" in str(said.exception)
    (tmp_path / "blind.ulg").write_bytes(examples.ulog())
    said = CliRunner().invoke(app, ["import", str(tmp_path / "blind.ulg"), "--ground", "47,8"])
    assert str(said.exception).endswith(
        "blind.ulg: has no place on the globe, so that --ground cannot be placed beside it"
    )


def test_what_goes_with_one_log_alone_is_named(tmp_path: Path) -> None:
    for name in ("a.tlog", "b.tlog"):
        (tmp_path / name).write_bytes(examples.tlog())
    a, b = (str(tmp_path / name) for name in ("a.tlog", "b.tlog"))
    for arguments, message in (
        ([a, b, "--system", "1"], "--system chooses from one log, and several are named"),
        ([a, b, a], f"{a}: is named twice"),
    ):
        said = CliRunner().invoke(app, ["import", *arguments, "--out", str(tmp_path / "out")])
        assert str(said.exception) == message
