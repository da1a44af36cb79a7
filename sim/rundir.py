"""The run directory: outcome.json, the record's tables as Parquet, the resolved scenario; whole or not at all."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from scenarios.load import ScenarioError, dump, loads
from sim.folders import RunError, ensure_folder, replacing
from sim.outcome import outcome
from sim.record import TABLES, SortieRecord

OUTCOME, SCENARIO, RECORD, RECORDING = "outcome.json", "scenario.yaml", "record.json", "sortie.rrd"


def default_path(record: SortieRecord) -> Path:
    """`runs/SCENARIO-POLICY-seedN`: flying the same sortie again replaces it, since it comes out the same."""
    policy = re.sub(r"[^A-Za-z0-9_.-]+", "_", record.policy).strip("_")
    replication = f"-rep{record.replication}" if record.replication else ""
    return Path("runs") / f"{record.scenario.name}-{policy}-seed{record.seed}{replication}"


def ensure_writable(path: Path) -> None:
    """Refuse a path that `save` could not use, before the sortie is flown.

    Raises:
        RunError: it holds something that is no run, or cannot be made.
    """
    ensure_folder(path, OUTCOME, "run")


def save(record: SortieRecord, path: Path, also: Callable[[Path], None] | None = None) -> dict[str, Any]:
    """Write a run to a temporary folder beside `path`, then rename it; returns the outcome.

    Args:
        record: what to write.
        path: the run's folder; an older run there is replaced.
        also: writes further files into the temporary folder (the recording).

    Raises:
        RunError: as `ensure_writable`, or the disk refuses.
    """
    ensure_writable(path)
    result = outcome(record)
    with replacing(path) as partial:
        (partial / OUTCOME).write_text(json.dumps(result, indent=2, allow_nan=False) + "\n")
        (partial / SCENARIO).write_text(dump(record.scenario))
        about = {
            "policy": record.policy,
            "seed": record.seed,
            "replication": record.replication,
            "version": record.version,
            "calibration": record.calibration,
            "totals": dict(record.totals),
            "wall": dict(record.wall),
        }
        (partial / RECORD).write_text(json.dumps(about, indent=2) + "\n")
        for name, table in record.tables.items():
            pq.write_table(table, partial / f"{name}.parquet", compression="zstd")
        if also is not None:
            also(partial)
    return result


def load(path: Path) -> SortieRecord:
    """Read a run back.

    Raises:
        RunError: no run there, or one that is damaged.
    """
    if not (path / OUTCOME).is_file():
        raise RunError(f"{path}: no run there ({OUTCOME} is missing)")
    try:
        about = json.loads((path / RECORD).read_text())
        scenario = loads((path / SCENARIO).read_text(), source=str(path / SCENARIO))
        tables = {name: pq.read_table(path / f"{name}.parquet") for name in TABLES}
        return SortieRecord(scenario=scenario, tables=tables, **about)
    except (OSError, ValueError, TypeError, ScenarioError) as error:
        raise RunError(f"{path}: the run is damaged: {error}") from error
