"""A run's folder: outcome.json, the record's tables as Parquet, the resolved scenario; written whole or not at all."""

from __future__ import annotations

import hashlib
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
from sortie.sim.folders import RunError, ensure_folder, replacing, settled
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
_INSTEAD = "choose another folder, or replace it with --replace (replace=True)"


class OtherRunError(RunError):
    """A folder that holds another run, which would be lost."""


def default_path(
    scenario: Scenario, seed: int, replication: int, own: Scenario | None, files: Mapping[str, str] | None = None
) -> Path:
    """The run's folder, named after what flies: `runs/SCENARIO-sSEED-POLICY`, then `-rN` for a replication.

    Six hex digits follow where the scenario is not one of the library as it is shipped. They are a digest of all that
    flies but the seed, so that other settings, other parameters of the policy, other files with the same `name`, and
    an edited policy have folders of their own. The same sortie flown again has the same folder.

    Args:
        scenario: what flies.
        seed, replication: of the random draws.
        own: the library's scenario as it is shipped, under the same policy; None for a file of the user's.
        files: digests of the files that fly with it (`sortie.sim.identity.own_files`).
    """
    policy = re.sub(r"[^A-Za-z0-9_.-]+", "_", scenario.policy.name).strip("_")
    parts = [scenario.name, f"s{seed}", policy, *([f"r{replication}"] if replication else [])]
    flown, filed = (None if s is None else _sorted_json(s) for s in (scenario, own))
    if flown != filed or policy != scenario.policy.name:  # p/a.py and p_a.py read alike here
        with_files = f"{flown}{json.dumps(dict(files), sort_keys=True)}" if files else str(flown)
        parts.append(hashlib.sha256(with_files.encode()).hexdigest()[:6])
    return Path("runs") / "-".join(parts)


def _sorted_json(scenario: Scenario) -> str:
    """A scenario without its seed, the same text in whatever order parameters were given."""
    return json.dumps(scenario.model_dump(mode="json", exclude={"seed"}), sort_keys=True)


def ensure_writable(path: Path) -> None:
    """Refuse a path that `save` could not use, before the sortie is flown.

    Raises:
        RunError: it holds something that is no run, or besides a run what is not of it; it holds the working folder; or
            it cannot be made.
    """
    if Path.cwd().is_relative_to(path.resolve()):
        raise RunError(f"{path}: is the working folder or holds it, a run would replace it; name another folder")
    ensure_folder(path, OUTCOME, "run", WRITTEN)
    with settled(path):
        if (path / PAGE).is_file() and not _is_of_the_run(path / PAGE):
            raise RunError(f"{path}: holds {PAGE}, which is not of the run there; choose another folder or move it")


def ensure_same(path: Path, scenario: Scenario, seed: int, replication: int, files: Mapping[str, str]) -> None:
    """Refuse a folder with a run that was flown from something else, before the sortie is flown; no folder is fine.

    Raises:
        OtherRunError: naming the first field that differs.
    """
    new: dict[str, Any] = {"seed": seed, "replication": replication, "own_files": dict(files)}
    with settled(path):
        if not (path / OUTCOME).is_file():
            return
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
    record: SortieRecord, path: Path, also: Callable[[Path], None] | None = None, *, replace: bool = False
) -> dict[str, Any]:
    """Write a run to a temporary folder beside `path`, then rename it; returns the outcome.

    Args:
        record: what to write.
        path: the run's folder. The same record may be there already: it is written anew, and the page and the exports
            made of it go.
        also: writes further files into the temporary folder (the recording).
        replace: whether a run with another record may be replaced.

    Raises:
        OtherRunError: a run with another record is there.
        RunError: as `ensure_writable`, or the disk refuses.
    """

    def check() -> None:
        if not replace and (other := in_place_of(path, record.fingerprint)):
            raise OtherRunError(f"{path}: holds {other}; {_INSTEAD}")

    ensure_writable(path)
    with settled(path):
        check()
    result = outcome(record)
    with replacing(path, check) as partial:
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
    return result


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


def beside(path: Path, fingerprint: str) -> Path:
    """The folder for a run that found another one in its place."""
    place = path if path.name.strip(".") else path.resolve()  # `.` has no name of its own
    return place.with_name(f"{place.name}-{fingerprint[:8]}")


def in_place_of(path: Path, fingerprint: str) -> str:
    """The run in a folder, in words, where its fingerprint is another; empty where there is none."""
    if not (path / OUTCOME).is_file():
        return ""
    try:
        old = read_json(path / OUTCOME)
        there = f"a run of {old['scenario']} under {old['policy']}, seed {old['seed']}"
        return "" if old["fingerprint"] == fingerprint else there
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


def _is_of_the_run(page: Path) -> bool:
    """Whether a page belongs to the run in its folder, by that run's fingerprint."""
    try:
        fingerprint = read_json(page.parent / OUTCOME)["fingerprint"]
        return str(fingerprint) in page.read_text(encoding="utf-8")
    except (OSError, ValueError, TypeError, LookupError):
        return False


def _scenario_of(path: Path) -> Scenario:
    """The scenario of a run. Packages that offered its models need not be installed."""
    text = read_file(path / SCENARIO).decode()
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
