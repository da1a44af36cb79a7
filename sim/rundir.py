"""The run directory: outcome.json, the record's tables as Parquet, the resolved scenario; whole or not at all."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from scenarios.load import ScenarioError, dump, loads
from sim.outcome import outcome
from sim.record import TABLES, SortieRecord

OUTCOME, SCENARIO, RECORD, RECORDING = "outcome.json", "scenario.yaml", "record.json", "sortie.rrd"


class RunError(ValueError):
    """A run directory that cannot be written or read; the message names the path."""


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
    if path.exists() and not path.is_dir():
        raise RunError(f"{path}: is a file, a run needs a folder")
    if path.is_dir() and any(path.iterdir()) and not (path / OUTCOME).is_file():
        raise RunError(f"{path}: holds files but no {OUTCOME}; a run would replace them, name another folder")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{path}: cannot make its folder: {error.strerror}") from error
    if not os.access(path.parent, os.W_OK):
        raise RunError(f"{path}: its folder {path.parent} is not writable")


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
    partial = path.with_name(f".{path.name}.partial")
    result = outcome(record)
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
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
        _replace(partial, path)
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
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


def _replace(new: Path, path: Path) -> None:
    """Rename `new` to `path`; an older run steps aside first, since a folder cannot be renamed over a full one."""
    if not path.exists():
        new.rename(path)
        return
    aside = path.with_name(f".{path.name}.old")
    shutil.rmtree(aside, ignore_errors=True)
    path.rename(aside)
    new.rename(path)
    shutil.rmtree(aside)
