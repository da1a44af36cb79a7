"""`sortie import`: a log becomes a trace and a scenario, and that scenario flies what was logged."""

from __future__ import annotations

import os
import struct
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

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
from sortie.sim.results.record import SortieRecord

LOGS = Path(os.environ.get("SORTIE_FLIGHT_LOGS", Path(__file__).resolve().parents[4] / "shared/flightlogs"))
needs_logs = pytest.mark.skipif(not (LOGS / "log171.bin").is_file(), reason=f"{LOGS} has no flight logs")


def said_of(folder: Path, files: dict[str, bytes], *options: str) -> str:
    """What `sortie import` of these logs prints; it writes `folder / "out"`.

    Raises:
        SortieError: it cannot be imported.
    """
    for name, data in files.items():
        (folder / name).write_bytes(data)
    command = ["import", *(str(folder / name) for name in files), "--out", str(folder / "out"), *options]
    done = CliRunner().invoke(app, command, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return " ".join(done.output.split())


@cache
def fleet_log() -> bytes:
    """The telemetry log of a fleet of three in four seconds of flight."""
    with TemporaryDirectory() as folder:
        save_tlog(fleet_flown(), Path(folder) / "fleet.tlog", 10**15)
        return (Path(folder) / "fleet.tlog").read_bytes()


@cache
def fleet_flown() -> SortieRecord:
    return run_sortie(example("duration_s=4", "fleet.drones=3"))


def test_a_log_of_each_kind_flies_as_one_drone(tmp_path: Path) -> None:
    """3, 4 and 1 m/s from 2 m up, the charge from 90 % by 1 % a second."""
    for kind, make in examples.KINDS.items():
        said_of(tmp_path, {f"My Flight.{kind}": make()})
        scenario = load(tmp_path / "out" / "scenario.yaml")
        assert (scenario.name, scenario.fleet.drones, scenario.duration_s) == ("my_flight", 1, 9.9)
        assert scenario.fleet.battery.cells == 4
        states = run_sortie(scenario).tables["states"]
        t_s = states["t_s"].to_numpy()
        wanted = np.stack([3 * t_s, 4 * t_s, 2 + t_s], axis=-1)
        flown = np.stack([states[name].to_numpy() for name in ("x_m", "y_m", "z_m")], axis=-1)
        np.testing.assert_allclose(flown, wanted, atol=0.02, err_msg=kind)
        np.testing.assert_allclose(states["vx_mps"].to_numpy(), 3.0, atol=0.006)
        np.testing.assert_allclose(states["soc"].to_numpy(), 0.9 - 0.01 * t_s, atol=0.0055)
        np.testing.assert_allclose(states["voltage_v"].to_numpy()[1:], 16 - 0.1 * t_s[1:], atol=0.002)


def test_a_stretch_of_the_log_begins_at_zero(tmp_path: Path) -> None:
    options = ("--from", "2", "--until", "5", "--rate", "20", "--lift", "50")
    said_of(tmp_path, {"a.bin": examples.dataflash()}, *options)
    trace = pq.read_table(tmp_path / "out" / "trace.parquet")
    assert trace["t_s"].to_pylist() == pytest.approx([k / 20 for k in range(61)])
    assert trace["z_m"][0].as_py() == pytest.approx(52.0, abs=1e-3)
    assert set(trace.column_names) <= set(COLUMNS)


def with_capacity(mah: float) -> bytes:
    """The log of a flight whose pack was set to this capacity."""
    return examples.dataflash().replace(struct.pack("<f", 5000.0), struct.pack("<f", mah))


def test_a_charge_that_is_told_to_be_gone_does_not_land_it(tmp_path: Path) -> None:
    """Counted over the capacity that was set: nothing left from the fourth second on, and the flight went on."""
    said_of(tmp_path, {"empty.bin": with_capacity(540.0)})
    states = run_sortie(load(tmp_path / "out/scenario.yaml")).tables["states"]
    assert min(states["soc"].to_pylist()) == pytest.approx(0.001, abs=1e-4)
    assert all(states["airborne"].to_pylist())


def test_a_capacity_that_no_pack_has_is_left_out(tmp_path: Path) -> None:
    """One damaged parameter made a scenario that does not load."""
    for capacity in (1e30, 1e-30, -1.0):
        said_of(tmp_path, {"a.bin": with_capacity(capacity)})
        assert load(tmp_path / "out/scenario.yaml").fleet.battery.capacity_wh == 130.0


def test_a_damaged_log_is_imported_and_its_damage_told(tmp_path: Path) -> None:
    data = examples.ulog()
    said = said_of(tmp_path, {"damaged.ulg": data[:5000] + b"\xff" * 60 + data[5000:-3]})
    assert "are no message" in said
    assert "cut off" in said
    assert read_traces(tmp_path / "out/trace.parquet", 1)[0].battery is not None


def test_what_cannot_be_imported_is_one_line_and_writes_nothing(tmp_path: Path) -> None:
    a, b, c, blind = (str(tmp_path / name) for name in ("a.bin", "b.tlog", "c.tlog", "blind.ulg"))
    made = {a: examples.dataflash(), b: examples.tlog(), c: examples.tlog(), blind: examples.ulog()}
    for path, data in made.items():
        Path(path).write_bytes(data)
    (tmp_path / "fleet.tlog").write_bytes(fleet_log())
    wrong = {}
    for arguments, words in (
        ([str(tmp_path / "nowhere.bin")], "nowhere.bin: cannot be read"),
        ([__file__], "is no DataFlash log"),
        ([a, "--from", "9.5"], "0.4 s from 9.5 s on, must be 1 s at least"),
        ([a, "--until", "9000"], "9000 s to fly, must be at most 7200"),
        ([a, "--until", "5", "--rate", "0.1"], "5.0 s at 0.1 rows a second are one row, must be two at least"),
        ([a, "--ground", "north"], "origin is 'north', must be latitude,longitude"),
        ([blind, "--ground", "47,8"], "blind.ulg: has no place on the globe, so that --ground cannot be placed beside"),
        ([a, "--system", "1"], "a.bin: no vehicle with system id 1, a DataFlash log has no systems"),
        ([str(tmp_path / "fleet.tlog"), "--system", "9"], "no vehicle with system id 9, it has 1, 2, 3"),
        ([b, c, "--system", "1"], "--system chooses from one log, and several are named"),
        ([b, c, b], f"{b}: is named twice"),
    ):
        error = CliRunner().invoke(app, ["import", *arguments, "--out", str(tmp_path / "out")]).exception
        if not isinstance(error, SortieError) or words not in str(error):
            wrong[words] = error
    assert wrong == {}
    assert not (tmp_path / "out").exists()


def test_a_flight_replaces_a_flight_and_no_file_that_it_did_not_write(tmp_path: Path) -> None:
    log, out, mine = {"short.bin": examples.dataflash()}, tmp_path / "out", tmp_path / "mine"
    for _ in range(2):
        said_of(tmp_path, log)
    (out / "run").mkdir()
    mine.mkdir()
    (mine / "scenario.yaml").write_text("name: mine\n")
    (out / "notes.txt").write_text("keep")
    for folder, kept, words in (
        (out, "notes.txt", r"out: holds notes\.txt, which no flight wrote"),
        (mine, "scenario.yaml", r"mine: its scenario\.yaml is none that sortie import wrote"),
    ):
        before = (folder / kept).read_text()
        with pytest.raises(RunError, match=words):
            said_of(tmp_path, log, "--out", str(folder))
        assert (folder / kept).read_text() == before


@needs_logs
@pytest.mark.slow
def test_three_real_logs_fly(tmp_path: Path) -> None:
    for name, seconds, lacks in (
        ("log171.bin", 242.5, []),
        ("fs-batt.tlog", 20.0, ["x_m"]),
        ("sample_log_small.ulg", 6.4, []),
    ):
        said_of(tmp_path, {name: (LOGS / name).read_bytes()})
        scenario = load(tmp_path / "out" / "scenario.yaml")
        assert scenario.duration_s == pytest.approx(seconds)
        names = pq.read_schema(tmp_path / "out" / "trace.parquet").names
        assert [lack for lack in ("x_m", "qw", "soc", "voltage_v") if lack not in names] == lacks
        columns, states = context_trace(read_log(LOGS / name)), run_sortie(scenario).tables["states"]
        known = ~np.isnan(columns["soc"][: states.num_rows])
        flown, logged = states["soc"].to_numpy()[known], columns["soc"][: states.num_rows][known]
        np.testing.assert_allclose(flown, logged, atol=2e-3)


def test_a_fleet_s_log_flies_as_the_fleet_that_it_was(tmp_path: Path) -> None:
    """Exported and imported again: every drone's pose and charge, each where it was beside the others."""
    said = said_of(tmp_path, {"fleet.tlog": fleet_log()})
    assert "3 vehicles: drone 0 is system 1, drone 1 is system 2, drone 2 is system 3" in said
    scenario = load(tmp_path / "out/scenario.yaml")
    assert scenario.fleet.drones == 3
    again, before = run_sortie(scenario).tables["states"], fleet_flown().tables["states"].slice(0, 3 * 39)
    assert again["drone"].to_pylist() == before["drone"].to_pylist()
    for names, precision in ((("x_m", "y_m", "z_m"), 0.05), (("qx", "qy", "qz", "qw"), 1e-3), (("soc",), 0.006)):
        places = [np.stack([each[n].to_numpy().astype(float) for n in names], axis=-1) for each in (again, before)]
        begin = places[1].min(axis=0) if names[0] == "x_m" else 0.0
        offset = places[0].min(axis=0) - begin if names[0] == "x_m" else 0.0
        np.testing.assert_allclose(places[0] - offset, places[1], atol=precision)
    said_of(tmp_path, {"fleet.tlog": fleet_log()}, "--system", "2")
    assert load(tmp_path / "out/scenario.yaml").fleet.drones == 1


# --- several logs ----------------------------------------------------------------------------------


def columns_of(folder: Path, drone: int) -> dict[str, np.ndarray]:
    """A drone's trace, as it was imported."""
    table = pq.read_table(folder / "out" / "trace.parquet")
    rows = table["drone"].to_numpy() == drone
    return {name: table[name].to_numpy()[rows] for name in table.column_names}


def test_logs_of_three_kinds_fly_together_by_their_utc(tmp_path: Path) -> None:
    """The same flight three times: by DataFlash, 2 s later by ULog, and by telemetry that began with the first."""
    files = {"a.bin": examples.dataflash(), "b.ulg": examples.ulog(late_s=2.0), "c.tlog": examples.tlog()}
    said = said_of(tmp_path, files)
    assert "DataFlash and ULog and MAVLink telemetry, 11.9 s" in said
    assert "3 vehicles: drone 0 is a.bin, drone 1 is b.ulg, drone 2 is c.tlog system 1" in said
    scenario = load(tmp_path / "out" / "scenario.yaml")
    assert (scenario.fleet.drones, scenario.duration_s) == (3, 11.9)
    states = run_sortie(scenario).tables["states"]
    t_s, drone, x = (states[name].to_numpy() for name in ("t_s", "drone", "x_m"))
    for number, late_s in ((0, 0.0), (1, 2.0), (2, 0.0)):
        own = (drone == number) & (t_s >= late_s) & (t_s <= late_s + 9.8)
        np.testing.assert_allclose(x[own], 3 * (t_s[own] - late_s), atol=0.05)


def test_a_log_without_utc_begins_with_the_first_and_that_is_told(tmp_path: Path) -> None:
    files = {"late.bin": examples.dataflash(late_s=100.0), "blind.ulg": examples.ulog()}
    said = said_of(tmp_path, files)
    assert "blind.ulg: it does not say when it began: it begins with the first log" in said
    assert "blind.ulg: it has no place on the globe, and its places are left out" in said
    assert columns_of(tmp_path, 1)["soc"][0] == pytest.approx(0.9, abs=1e-6)


def test_logs_of_different_days_fly_together_only_if_that_is_meant(tmp_path: Path) -> None:
    files = {"a.bin": examples.dataflash(), "b.bin": examples.dataflash(late_s=86_400.0)}
    apart = r"a\.bin: has no moment in common with the other logs \(86400 s away\); --together"
    with pytest.raises(SortieError, match=apart):
        said_of(tmp_path, files)
    assert not (tmp_path / "out").exists()
    assert "DataFlash, 9.9 s" in said_of(tmp_path, files, "--together")
    np.testing.assert_allclose(columns_of(tmp_path, 0)["x_m"], columns_of(tmp_path, 1)["x_m"], atol=0.01)


def test_a_ground_station_stands_where_it_is_said_to_stand(tmp_path: Path) -> None:
    """100 m north of where the flight began, and 10 m above its altitude; another one without an altitude."""
    north_deg = 100 / 111_170
    places = (f"{47 + north_deg},8,410", "47,8.001")
    said_of(tmp_path, {"a.bin": examples.dataflash()}, "--ground", places[0], "--ground", places[1])
    scenario = load(tmp_path / "out" / "scenario.yaml")
    assert (scenario.fleet.drones, [station.drone for station in scenario.fleet.ground]) == (3, [1, 2])
    first, second = columns_of(tmp_path, 1), columns_of(tmp_path, 2)
    assert (first["x_m"][0], first["y_m"][0]) == pytest.approx((0.0, 100.0), abs=0.1)
    assert first["z_m"][0] == pytest.approx(2.0 + 10.0, abs=0.05)  # the flight's lowest point is lifted to 2 m
    assert (second["x_m"][0], second["z_m"][0]) == pytest.approx((76.1, 2.0), abs=0.1)
    record = run_sortie(scenario)
    save_tlog(record, tmp_path / "again.tlog", 10**15)
    fixes = [flight.fix.values for flight in read_logs(tmp_path / "again.tlog") if flight.fix is not None]
    assert fixes[0][0] == pytest.approx([47.0, 8.0, 400.0], abs=0.05)  # at the same place on the globe
