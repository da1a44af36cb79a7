"""Playback while a sortie flies, block by block, of two policies side by side; and what can go wrong."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pyarrow.compute as pc
import pytest
import rerun as rr
from played_flight import Rows, drawn, flown, read
from record_by_hand import record as by_hand
from rerun.chunk import RrdReader
from sim_examples import example

from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError
from sortie.sim.playback import recording
from sortie.sim.playback.recording import save_comparison, save_rrd, scene_of
from sortie.sim.playback.viewer import LiveViewer, open_viewer, to_file, to_new_viewer
from sortie.sim.results.record import SortieRecord


@pytest.fixture(scope="module")
def record() -> SortieRecord:
    return flown()


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> Rows:
    return drawn(flown(), tmp_path_factory.mktemp("rrd"))


def test_a_long_sortie_is_drawn_in_blocks(
    rows: Rows, record: SortieRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "BLOCK_DRONE_S", 15.0)
    save_rrd(record, tmp_path / "blocks.rrd")
    assert_same(read(tmp_path / "blocks.rrd"), rows)


def test_each_block_is_on_disk_before_the_next_and_blocks_of_large_fleets_are_short(
    record: SortieRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a large fleet's recording fills the memory."""
    steps: list[object] = []
    monkeypatch.setattr(recording, "BLOCK_DRONE_S", 3.0 * record.scenario.fleet.drones)
    monkeypatch.setattr(recording.Playback, "add", lambda self, known_s, new: steps.append(known_s))
    flush = rr.RecordingStream.flush
    monkeypatch.setattr(rr.RecordingStream, "flush", lambda self: (steps.append("flush"), flush(self)))
    save_rrd(record, tmp_path / "blocks.rrd")
    assert steps == [3.0, "flush", 6.0, "flush", record.scenario.duration_s, "flush", "flush"]


def assert_same(live: Rows, rows: Rows) -> None:
    assert set(live) == set(rows)
    for entity, components in rows.items():
        assert set(live[entity]) == set(components), entity
        for name, values in components.items():
            if entity.startswith("/__properties"):
                continue
            if name.startswith("StateConfiguration"):  # told anew with every state that comes up
                assert live[entity][name][-1][2] == values[-1][2]
                continue
            got = live[entity][name]
            assert [(t, f) for t, f, _ in got if t == t] == [(t, f) for t, f, _ in values if t == t], (entity, name)
            for (t_s, _, a), (_, _, b) in zip(got, values, strict=True):
                assert same(a, b), (entity, name, t_s)


def same(a: Any, b: Any) -> bool:
    """Equal, up to rounding of sums."""
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=1e-5, abs_tol=1e-6) or (a != a and b != b)
    return bool(a == b)


def test_a_flight_that_is_watched_is_the_same_flight_and_drawn_as_it_is_saved(tmp_path: Path) -> None:
    """In flights of their own: at 0.5 Hz every other second has no frame, and a drone is down."""
    lost = "events=[{kind: drone_lost, at_s: 2, drone: 1}]"
    slow = example("duration_s=4", "fleet.drones=2", "context.rate_hz=0.5", lost)
    viewer = LiveViewer(to_file(tmp_path / "live.rrd"))
    flown = run_sortie(slow, observer=viewer)
    viewer.close()
    assert flown.fingerprint == run_sortie(slow).fingerprint
    live = read(tmp_path / "live.rrd")
    assert_same(live, drawn(flown, tmp_path))
    names = [label for _, _, (label,) in live["/world/drones/1/name"]["Points3D:labels"]]
    assert [name.endswith("down") for name in names] == [False, True]


def test_saving_changes_nothing_and_says_nothing(
    record: SortieRecord, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = record.fingerprint
    save_rrd(record, tmp_path / "sortie.rrd")
    assert record.fingerprint == before
    assert capfd.readouterr() == ("", "")  # Rerun tells of bad paths and values in log lines


def small(drones: int = 2, **changes: Any) -> SortieRecord:
    """The record by hand, of its first drones, near to each other."""
    made = by_hand(**changes)
    fleet = made.scenario.fleet.model_copy(update={"drones": drones})
    tables = {
        name: table.filter(pc.less(table["drone"], drones)) if "drone" in table.column_names else table
        for name, table in made.tables.items()
    }
    tables["transmissions"] = tables["transmissions"].filter(pc.less(tables["transmissions"]["peer"], drones))
    tables["descriptors"] = tables["descriptors"].slice(0, 0)
    near = pc.min_element_wise(tables["states"]["x_m"], 100.0)
    tables["states"] = tables["states"].set_column(tables["states"].schema.get_field_index("x_m"), "x_m", near)
    scenario = made.scenario.model_copy(update={"fleet": fleet})
    return dataclasses.replace(made, scenario=scenario, tables=tables)


def test_a_single_drone_is_drawn_without_links(tmp_path: Path) -> None:
    rows = drawn(small(1), tmp_path)
    assert sum(e.startswith("/plots/battery/") and "marks" not in e for e in rows) == 1
    assert "/world/links" not in rows


def test_a_recording_is_named_after_the_policy_that_flew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not after the scenario's own, which another one replaced."""
    named: list[str] = []
    monkeypatch.setattr(rr.RecordingStream, "send_recording_name", lambda self, name: named.append(name))
    save_rrd(small(policy="silence", seed=4), tmp_path / "a.rrd")
    assert named == ["by_hand · silence · seed 4"]


def test_a_ground_station_is_drawn_as_a_mast_that_leaves_no_trail(tmp_path: Path) -> None:
    made = small()
    station = example("fleet.drones=2", "fleet.ground=[{drone: 1, position_m: [0, 0, 6]}]").fleet
    rows = drawn(dataclasses.replace(made, scenario=made.scenario.model_copy(update={"fleet": station})), tmp_path)
    parts = {path for path in rows if path.startswith("/world/drones/1/")}
    assert {"/world/drones/1/mast", "/world/drones/1/antenna"} <= parts
    assert not parts & {"/world/drones/1/rotors", "/world/drones/1/body"}
    assert "/world/trails/1" not in rows
    assert "/world/footprints/1" not in rows or not any("Strips" in name for name in rows["/world/footprints/1"])
    assert "/world/drones/0/rotors" in rows


# --- two policies in one recording ------------------------------------------------------------------------


def test_each_policy_is_drawn_below_its_root_as_it_is_alone(tmp_path: Path) -> None:
    """And the plots that they share have a line for each."""
    other = small(policy="all-4")
    tables = {**other.tables, "states": other.tables["states"].slice(0, 6), "ages": other.tables["ages"].slice(0, 2)}
    flown = [("worked", small()), ("all-4(received_budget=0.1)", dataclasses.replace(other, tables=tables))]
    both_roots = ("worked", "all-4_received_budget_0_1")
    save_comparison(flown, tmp_path / "both.rrd")
    both = read(tmp_path / "both.rrd")
    for root, (_, record) in zip(both_roots, flown, strict=True):
        alone = {(e, c): v for e, each in drawn(record, tmp_path).items() for c, v in each.items() if e[:3] != "/__"}
        below = {
            (e.removeprefix(f"/{root}") or "/", c): v
            for e, each in both.items()
            for c, v in each.items()
            if e.startswith(f"/{root}")
        }
        assert repr(sorted(below.items())) == repr(sorted(alone.items()))  # by what is written: NaN is not itself
    reader = RrdReader(tmp_path / "both.rrd")
    assert len(reader.recordings()) == 1
    batches = [k.to_record_batch() for k in reader.stream(store=reader.blueprints()[0]).to_chunks()]

    def all_of(name: str) -> list[str]:
        return [v for b in batches if name in b.schema.names for row in b[name].to_pylist() for v in row or ()]

    kinds = Counter(all_of("ViewBlueprint:class_identifier"))
    assert (kinds["3D"], kinds["StateTimeline"], kinds["TextLog"]) == (2, 2, 2)
    shown = all_of("ViewContents:query")
    for entity in ("features_delivered", "p99_ms", "lost/percent", "busy_percent"):
        assert [q.split("/")[1] for q in shown if q.rstrip().endswith(entity)] == list(both_roots)


# --- what can go wrong ------------------------------------------------------------------------------------


def test_a_path_that_cannot_be_written_is_one_clear_error(record: SortieRecord, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    path = tmp_path / "file" / "sortie.rrd"
    with pytest.raises(RunError, match=r"file/sortie\.rrd: cannot be written: File exists$"):
        save_rrd(record, path)


def test_a_failed_save_leaves_nothing(record: SortieRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    (tmp_path / "sortie.rrd").write_text("an older one")
    monkeypatch.setattr(recording.Playback, "add", fail)
    with pytest.raises(RunError, match=r"sortie\.rrd: cannot be written: No space left on device$"):
        save_rrd(record, tmp_path / "sortie.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["sortie.rrd"]
    assert (tmp_path / "sortie.rrd").read_text() == "an older one"


def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def test_without_a_display_there_is_no_viewer(
    tmp_path: Path, record: SortieRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    no_display(monkeypatch)
    (tmp_path / "a.rrd").touch()
    elsewhere = r"^no display to show a viewer on; open .*a\.rrd elsewhere, .* --web-viewer --bind 127\.0\.0\.1 "
    with pytest.raises(RunError, match=elsewhere):
        open_viewer(tmp_path / "a.rrd")
    with pytest.raises(RunError, match=r"^no display to show a viewer on; --live needs one"):
        LiveViewer().begin(record.scenario, scene_of(record))


def test_a_missing_recording_and_a_missing_viewer_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"gone\.rrd: no recording there$"):
        open_viewer(tmp_path / "gone.rrd")
    (tmp_path / "there.rrd").touch()
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RunError, match=r"^no viewer: there is no rerun command beside"):
        open_viewer(tmp_path / "there.rrd")


def test_a_viewer_that_fails_is_quoted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    fake = tmp_path / "rerun"
    fake.write_text("#!/bin/sh\necho 'winit: no window for you' >&2\nexit 3\n")
    fake.chmod(0o755)
    (tmp_path / "there.rrd").touch()
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("DISPLAY", ":99")
    with pytest.raises(RunError, match=r"the viewer failed: winit: no window for you$"):
        open_viewer(tmp_path / "there.rrd")
    with pytest.raises(RunError, match=r"the viewer does not come up: winit: no window for you$"):
        to_new_viewer(rr.RecordingStream("test"), example())
