"""A run's folder: outcome.json, the record's tables as Parquet, the resolved scenario; written whole or not at all."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq

from sortie.scenarios.reading.load import dump
from sortie.scenarios.schema import Scenario
from sortie.sim.folders import RunError, ensure_folder, writing
from sortie.sim.results.accuracy_table import TABLE, accuracy_table
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.run_files import OUTCOME, RECORD, RECORDING, SCENARIO, WRITTEN, About, read_json, read_run
from sortie.sim.results.spool import write_parquet

_POLICY_LETTERS = 60
"""Of a policy's name in the name of a folder."""


class OtherRunError(RunError):
    """A folder that holds another run, which would be lost."""

    def __init__(self, folder: Path) -> None:
        super().__init__(f"{folder}: holds another run; choose another folder, or replace it with --replace")


def default_path(record: SortieRecord) -> Path:
    """The run's folder: `runs/SCENARIO-sSEED-POLICY-FINGERPRINT`, with `-rN` before the fingerprint of a replication."""
    policy = re.sub(r"[^A-Za-z0-9_.-]+", "_", record.policy).strip("_")[:_POLICY_LETTERS]
    number = f"-r{record.replication}" if record.replication else ""
    return Path("runs") / f"{record.scenario.name}-s{record.seed}-{policy}{number}-{record.fingerprint[:8]}"


def ensure_usable(path: Path, scenario: Scenario, seed: int, replication: int, *, replace: bool) -> None:
    """Refuse a folder that `save` could not use, before the sortie is flown.

    Raises:
        OtherRunError: it holds another run, and `replace` is false.
        RunError: it holds a damaged run or other files, holds the working folder, or cannot be made.
    """
    ensure_folder(path, OUTCOME, "run", WRITTEN)
    if not replace and (path / OUTCOME).exists():
        there = load(path)
        if (there.scenario, there.seed, there.replication) != (scenario, seed, replication):
            raise OtherRunError(path)


def save(
    record: SortieRecord, path: Path | None = None, also: Callable[[Path], None] | None = None, *, replace: bool = False
) -> Path:
    """Write a run's folder, whole or not at all; returns it. If an equal run is there already, it stays as it is.

    Args:
        record: what to write.
        path: the run's folder; None takes `default_path`.
        also: writes further files into the folder (the recording).
        replace: whether another run may be replaced.

    Raises:
        OtherRunError: another run is there.
        RunError: the folder holds other files, or cannot be written.
    """
    place = default_path(record) if path is None else path
    ensure_folder(place, OUTCOME, "run", WRITTEN)
    if _holds(place, record):
        if also is not None and not (place / RECORDING).exists():
            also(place)
        return place
    if (place / OUTCOME).exists() and not replace:
        raise OtherRunError(place)
    try:
        with writing(place, replace=replace) as folder:
            folder.mkdir()
            about = {name: getattr(record, name) for name in About.model_fields}
            (folder / OUTCOME).write_text(json.dumps(outcome(record), indent=2, allow_nan=False) + "\n", "utf-8")
            (folder / SCENARIO).write_text(dump(record.scenario), "utf-8")
            (folder / RECORD).write_text(json.dumps(about, indent=2, default=dict) + "\n", "utf-8")
            for name in record.tables:
                write_parquet(record.tables, name, folder / f"{name}.parquet")
            pq.write_table(accuracy_table(record), folder / f"{TABLE}.parquet", compression="zstd")
            if also is not None:
                also(folder)
    except RunError:
        if not _holds(place, record):  # an equal run may have come meanwhile
            raise
    return place


def _holds(folder: Path, record: SortieRecord) -> bool:
    try:
        return bool(read_json(folder / OUTCOME).get("fingerprint") == record.fingerprint)
    except (OSError, ValueError):
        return False


def load(path: Path) -> SortieRecord:
    """Read a run back. The models that flew need not be there.

    Raises:
        RunError: no run there, or one that is damaged.
    """
    if not (path / OUTCOME).is_symlink() and not (path / OUTCOME).exists():
        raise RunError(f"{path}: no run there ({OUTCOME} is missing)")
    try:
        return read_run(path)
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: the run is damaged: {error}") from error
