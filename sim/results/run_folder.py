"""A run's folder: outcome.json, the record's tables as Parquet, the resolved scenario; written whole or not at all."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sortie.scenarios.reading.load import dump, loads
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.base import models_of_the_past
from sortie.sim.folders import RunError, ensure_folder, replacing
from sortie.sim.results import beliefs, disagreement, rosters, views
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import CLASS_COLUMN, OF_CLASSES, TABLES, SortieRecord
from sortie.sim.results.run_checks import (
    Checks,
    ensure_boxes,
    ensure_each_once,
    ensure_plain,
    ensure_together,
    read_about,
    read_file,
    read_json,
    read_table,
)
from sortie.sim.results.spool import batches, schema_of

OUTCOME, SCENARIO, RECORD, RECORDING = "outcome.json", "scenario.yaml", "record.json", "sortie.rrd"
PAGE = "report.html"
WRITTEN = frozenset(
    {
        OUTCOME,
        SCENARIO,
        RECORD,
        RECORDING,
        *(f"{name}.parquet" for name in (*TABLES, *views.TABLES, disagreement.TABLE, rosters.TABLE, beliefs.TABLE)),
    }
    | {
        PAGE,
        "sortie.tlog",
        "sortie.pcap",
        "bag/metadata.yaml",
        "bag/bag.mcap",
        "bag/foxglove_layout.json",
    }  # `sortie report` and `export`, made of the run
)
"""All that a run's folder may hold for another run to take its place: what can be made again."""
_ROW_GROUP_BYTES = 4 << 20
_POLICY_LETTERS = 60
"""Of a policy's name in the name of a folder."""
_INSTEAD = "choose another folder, or replace it with --replace (replace=True)"


class OtherRunError(RunError):
    """A folder that holds another run, which would be lost."""


def default_path(record: SortieRecord) -> Path:
    """The run's folder: `runs/SCENARIO-sSEED-POLICY`, `-rN` for a replication, and the fingerprint's first eight digits.

    So different runs lie in different folders, and equal ones in one.
    """
    policy = re.sub(r"[^A-Za-z0-9_.-]+", "_", record.policy).strip("_")
    number = [f"r{record.replication}"] if record.replication else []
    return Path("runs") / "-".join(
        [record.scenario.name, f"s{record.seed}", policy[:_POLICY_LETTERS], *number, record.fingerprint[:8]]
    )


def ensure_writable(path: Path) -> None:
    """Refuse a path that `save` could not use, before the sortie is flown.

    Raises:
        RunError: it holds something that is no run, or besides a run what is not of it; it holds the working folder; or
            it cannot be made.
    """
    if Path.cwd().is_relative_to(path.resolve()):
        raise RunError(f"{path}: is the working folder or holds it, a run would replace it; name another folder")
    ensure_folder(path, OUTCOME, "run", WRITTEN)


def ensure_same(path: Path, scenario: Scenario, seed: int, replication: int) -> None:
    """Refuse a folder with a run of something else, before the sortie is flown; no folder is fine.

    Raises:
        OtherRunError: naming the first field that differs.
    """
    if not (path / OUTCOME).is_file():
        return
    new: dict[str, Any] = {"seed": seed, "replication": replication}
    try:
        about = read_json(path / RECORD)
        old = {name: about[name] for name in new}
        there = _scenario_of(path).model_dump(mode="json")
    except (OSError, ValueError, TypeError, LookupError) as error:
        raise OtherRunError(f"{path}: holds a run that cannot be read, {_INSTEAD}") from error
    found = _difference(old, new) or _difference(there, scenario.model_dump(mode="json"))
    if found is not None:
        raise OtherRunError(f"{path}: holds another run: {found}; {_INSTEAD}")


def save(
    record: SortieRecord,
    path: Path | None = None,
    also: Callable[[Path], None] | None = None,
    *,
    replace: bool = False,
) -> Path:
    """Write a run to a temporary folder, then rename it; returns the folder.

    Args:
        record: what to write.
        path: the run's folder; None takes `default_path`. If the same run is there already, its folder stays as it is.
        also: writes further files into the temporary folder (the recording).
        replace: whether a run with another record may be replaced.

    Raises:
        OtherRunError: a run with another record is there.
        RunError: as `ensure_writable`, or the disk refuses.
    """
    place = default_path(record) if path is None else path
    ensure_writable(place)
    there = in_place_of(place, record.fingerprint)
    if there is None:
        if also is not None and not (place / RECORDING).exists():
            also(place)
        return place
    if there and not replace:
        raise OtherRunError(f"{place}: holds {there}; {_INSTEAD}")
    result = outcome(record)
    with replacing(place, replace=replace) as partial:
        (partial / OUTCOME).write_text(json.dumps(result, indent=2, allow_nan=False) + "\n", "utf-8")
        (partial / SCENARIO).write_text(dump(record.scenario), "utf-8")
        about = {
            "policy": record.policy,
            "seed": record.seed,
            "replication": record.replication,
            "version": record.version,
            "calibration": record.calibration,
            "detector": record.detector,
            "own_files": dict(record.own_files),
            "metrics": dict(record.metrics),
            "totals": dict(record.totals),
            "wall": dict(record.wall),
        }
        (partial / RECORD).write_text(json.dumps(about, indent=2) + "\n", "utf-8")
        for name in record.tables:
            _write_table(record.tables, name, partial / f"{name}.parquet")
        if also is not None:
            also(partial)
    if there := in_place_of(place, record.fingerprint):  # it came meanwhile
        raise OtherRunError(f"{place}: holds {there}; {_INSTEAD}")
    return place


def _write_table(tables: Mapping[str, pa.Table], name: str, path: Path) -> None:
    """A table as Parquet, a few megabytes of it at a time."""
    schema = schema_of(tables, name)
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        held, held_bytes = [], 0
        for batch in batches(tables, name):
            held.append(batch)
            held_bytes += batch.nbytes
            if held_bytes >= _ROW_GROUP_BYTES:
                writer.write_table(pa.Table.from_batches(held))
                held, held_bytes = [], 0
        if held:
            writer.write_table(pa.Table.from_batches(held, schema))


def in_place_of(path: Path, fingerprint: str) -> str | None:
    """The run in a folder, in words; empty where there is none, None where it is the one with this fingerprint."""
    if not (path / OUTCOME).is_file():
        return ""
    try:
        old = read_json(path / OUTCOME)
        there = f"a run of {old['scenario']} under {old['policy']}, seed {old['seed']}"
        return None if old["fingerprint"] == fingerprint else there
    except (OSError, ValueError, TypeError, LookupError):
        return "a run that cannot be read"


def _difference(old: Mapping[str, Any], new: Mapping[str, Any], within: str = "") -> str | None:
    """The first field that differs, with both values."""
    for name in {**new, **old}:
        there, here = old.get(name), new.get(name)
        if isinstance(there, Mapping) and isinstance(here, Mapping):
            if inner := _difference(there, here, f"{within}{name}."):
                return inner
        elif there != here:
            return f"{within}{name} is {there!r} there and {here!r} here"
    return None


def _scenario_of(path: Path) -> Scenario:
    """The scenario of a run. Packages that offered its models need not be installed."""
    text = read_file(path / SCENARIO).decode()
    if text and not text.endswith("\n"):
        raise ValueError(f"{path / SCENARIO}: ends within a line")
    with models_of_the_past():
        scenario = loads(text, source=str(path / SCENARIO))
    if scenario.takes_turns and not re.search("^  egos:", text, re.MULTILINE):  # of a version in which all were scored
        every = scenario.perception.model_copy(update={"egos": scenario.fleet.drones})
        scenario = scenario.model_copy(update={"perception": every})
    return scenario


def load(path: Path) -> SortieRecord:
    """Read a run back. The models that flew need not be there.

    Raises:
        RunError: no run there, or one that is damaged.
    """
    if not os.path.lexists(path / OUTCOME):
        raise RunError(f"{path}: no run there ({OUTCOME} is missing)")
    try:
        if os.path.lexists(path / RECORDING):
            ensure_plain(path / RECORDING)
        result, about, scenario = read_json(path / OUTCOME), read_about(path / RECORD), _scenario_of(path)
        record = SortieRecord(scenario=scenario, tables=_tables_of(path, scenario), **about)
        ensure_together(result, record)
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: the run is damaged: {error}") from error
    return record


def _tables_of(path: Path, scenario: Scenario) -> dict[str, pa.Table]:
    """The checked tables of a run.

    Raises:
        OSError, ValueError: one is missing or damaged.
    """
    needed: dict[str, Mapping[str, pa.DataType]] = dict(TABLES)
    if len(scenario.perception.classes) > 1:
        needed |= {name: TABLES[name] | CLASS_COLUMN for name in OF_CLASSES}
    known = dict(needed)
    if scenario.record.views:
        needed |= views.NEEDED
        known |= views.TABLES
    for name, columns, wanted in (
        (disagreement.TABLE, disagreement.COLUMNS, scenario.record.disagreement),
        (rosters.TABLE, rosters.COLUMNS, scenario.publishes_rosters),
        (beliefs.TABLE, beliefs.COLUMNS, scenario.record.beliefs),
    ):
        if wanted:
            needed[name] = known[name] = columns
    every = scenario.frames * scenario.fleet.drones
    rows = dict.fromkeys(("states", beliefs.TABLE), every)
    tables = {n: read_table(path / f"{n}.parquet", needed[n], known[n], rows.get(n)) for n in needed}
    checks = Checks(scenario, {name: len(table) for name, table in tables.items()})
    for name, table in tables.items():
        checks.check(name, table)
    ensure_boxes(tables)
    if scenario.record.views:
        ensure_each_once(tables)
    return tables
