"""The record leaves memory while a sortie flies, and is the same record."""

from __future__ import annotations

import dataclasses
import os
import pickle
import signal
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from sortie.scenarios import scratch
from sortie.scenarios.reading.load import load
from sortie.sim.engine import scoring
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results import box_rows, mission_outcome, record, run_folder, selection, spool
from sortie.sim.results.outcome import outcome
from sortie.sim.results.outcome_fields import WALL
from sortie.sim.results.record import TABLES, SortieRecord

SURROGATE = ("fleet.drones=3", "perception.detector=surrogate")
ALL_LAND = ", ".join(f"{{kind: drone_lost, at_s: {at_s}, drone: {i}}}" for i, at_s in enumerate((1, 2, 2)))
SCENARIOS = {
    "boxes until all land": ("track_target", *SURROGATE, "duration_s=3", f"events=[{ALL_LAND}]"),
    "people": ("person_crossing", "duration_s=7", "events=[]"),
    "views": ("track_target", "fleet.drones=3", "duration_s=2", "record.views=true", "context.roster=true"),
}


def flown(name: str) -> SortieRecord:
    scenario, *overrides = SCENARIOS[name]
    return run_sortie(load(scenario, ["perception.detector=surrogate", *overrides]))


@cache
def usual(name: str) -> tuple[SortieRecord, dict[str, Any]]:
    this = flown(name)
    return this, without_wall(outcome(this))


def without_wall(result: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in result.items() if k not in WALL}


TINY = {
    scratch: {"IN_MEMORY_BYTES": 0, "TAPE_IN_MEMORY_BYTES": 0, "BLOCK_BYTES": 1},
    record: {"BATCH_BYTES": 1, "FIRST_ROWS": 1},
    spool: {"_READ_BYTES": 1, "_ROW_GROUP_BYTES": 1},
    selection: {"IN_MEMORY": 0},
    box_rows: {"BLOCK_FUSIONS": 3, "REST_S": 0.25},
    mission_outcome: {"BLOCK_FRAMES": 2},
    scoring: {"WAITING_EGOS": 1},
}


def make_tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every block, batch and pool is as small as it can be, and on disk."""
    for module, constants in TINY.items():
        for name, value in constants.items():
            monkeypatch.setattr(module, name, value)


@pytest.mark.parametrize("name", SCENARIOS)
def test_small_pieces_on_disk_make_the_same_record_and_outcome(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, expected = usual(name)
    make_tiny(monkeypatch)
    pieces = flown(name)
    assert pieces.fingerprint == whole.fingerprint
    assert without_wall(outcome(pieces)) == expected
    assert pieces.tables.keys() == whole.tables.keys()
    for table in whole.tables:
        assert pieces.tables[table].schema == whole.tables[table].schema
        assert repr(pieces.tables[table].to_pydict()) == repr(whole.tables[table].to_pydict()), table
    run_folder.save(pieces, tmp_path / "run")
    kept = run_folder.load(tmp_path / "run")
    assert kept.fingerprint == whole.fingerprint
    assert without_wall(outcome(kept)) == expected


def test_the_same_record_from_plain_tables_in_few_row_groups(tmp_path: Path) -> None:
    whole, expected = usual("people")
    plain = dataclasses.replace(whole, tables=dict(whole.tables))
    assert plain.fingerprint == whole.fingerprint
    assert without_wall(outcome(plain)) == expected
    assert pickle.loads(pickle.dumps(whole)).fingerprint == whole.fingerprint  # noqa: S301 (just made)
    run_folder.save(whole, tmp_path / "run")
    assert pq.ParquetFile(tmp_path / "run/states.parquet").num_row_groups == 1


def test_an_observer_gets_every_row_once(monkeypatch: pytest.MonkeyPatch) -> None:
    make_tiny(monkeypatch)
    seen: dict[str, list[Any]] = {name: [] for name in (*TABLES, "links")}

    class Watcher:
        def begin(self, scenario: object, scene: object) -> None: ...

        def second(self, t_s: float, new: dict[str, Any]) -> None:
            for name, table in new.items():
                seen[name] += table.to_pylist()

    run = run_sortie(
        load("track_target", ["perception.detector=none", "fleet.drones=2", "duration_s=2"]), observer=Watcher()
    )
    for name, rows in seen.items():
        assert repr(rows) == repr(run.tables[name].to_pylist()), name  # NaN equals itself as text


def test_whether_there_is_a_table_is_known_without_reading_it(monkeypatch: pytest.MonkeyPatch) -> None:
    tables = usual("views")[0].tables
    monkeypatch.setattr(spool.SpooledTables, "batches", lambda *_: pytest.fail("read"))
    assert "states" in tables
    assert "nothing" not in tables
    assert set(TABLES) <= set(tables)


def test_a_flight_that_is_killed_leaves_nothing(tmp_path: Path) -> None:
    """Neither a run nor a temporary file."""
    made = tmp_path / "tmp"
    made.mkdir()
    flight = (
        "import sortie\n"
        "from sortie.scenarios import scratch\n"
        "scratch.IN_MEMORY_BYTES = scratch.TAPE_IN_MEMORY_BYTES = 0\n"
        "run = sortie.fly('track_target', {'duration_s': 600, 'perception.detector': 'none'},\n"
        "    progress=lambda t: print(t, flush=True))\n"
        f"run.save({str(tmp_path / 'run')!r})\n"
    )
    env = os.environ | {"TMPDIR": str(made)}
    with subprocess.Popen([sys.executable, "-c", flight], stdout=subprocess.PIPE, text=True, env=env) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if float(line) >= 5:
                break
        process.send_signal(signal.SIGKILL)
    assert list(made.iterdir()) == []
    assert not (tmp_path / "run").exists()


PEAK = """
import resource, sys
import sortie
short = {"perception.detector": "none", "fleet.battery.capacity_wh": 1000}
def peak_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 10 if sys.platform != "darwin" else 1 << 20)
for seconds in (20, float(sys.argv[1])):
    run = sortie.fly("track_target", {**short, "duration_s": seconds})
    run.outcome, run.fingerprint
    run.save(sys.argv[2] + str(seconds), recording=False)
    print(peak_mb())
"""


@pytest.mark.slow
def test_memory_does_not_grow_with_the_duration(tmp_path: Path) -> None:
    """Twenty seconds, then twenty minutes of five drones in the same process: at most 100 MB more at its peak."""
    done = subprocess.run(
        [sys.executable, "-c", PEAK, "1200", str(tmp_path / "run")], check=True, stdout=subprocess.PIPE, text=True
    )
    begin_mb, end_mb = map(float, done.stdout.split())
    assert end_mb - begin_mb <= 100.0
