"""A run's folder: outcome.json, the record's tables as Parquet, the resolved scenario; written whole or not at all."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from sortie.scenarios.reading.load import ScenarioError, dump, loads
from sortie.scenarios.schema import Scenario
from sortie.sim.folders import RunError, ensure_folder, replacing
from sortie.sim.results import disagreement, views
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import TABLES, SortieRecord

OUTCOME, SCENARIO, RECORD, RECORDING = "outcome.json", "scenario.yaml", "record.json", "sortie.rrd"
PAGE = "report.html"
WRITTEN = frozenset(
    {
        OUTCOME,
        SCENARIO,
        RECORD,
        RECORDING,
        *(f"{name}.parquet" for name in (*TABLES, *views.TABLES, disagreement.TABLE)),
    }
    | {PAGE, "sortie.tlog", "bag/metadata.yaml", "bag/bag.mcap"}  # `sortie report` and `export`, made of the run
)
"""All that a run's folder may hold for another run to take its place: what can be made again."""


def default_path(scenario: Scenario, seed: int, replication: int, own: Scenario | None) -> Path:
    """The run's folder, named after what flies: `runs/SCENARIO-sSEED-POLICY`, then `-rN` for a replication.

    Six hex digits follow where the scenario is not one of the library as it is shipped. They are a digest of all that
    flies but the seed, so that other settings, other parameters of the policy, and other files with the same `name`
    have folders of their own. The same sortie flown again has the same folder.

    Args:
        scenario: what flies.
        seed, replication: of the random draws.
        own: the library's scenario as it is shipped, under the same policy; None for a file of the user's.
    """
    policy = re.sub(r"[^A-Za-z0-9_.-]+", "_", scenario.policy.name).strip("_")
    parts = [scenario.name, f"s{seed}", policy, *([f"r{replication}"] if replication else [])]
    flown, filed = (None if s is None else _sorted_json(s) for s in (scenario, own))
    if flown != filed or policy != scenario.policy.name:  # p/a.py and p_a.py read alike here
        parts.append(hashlib.sha256(str(flown).encode()).hexdigest()[:6])
    return Path("runs") / "-".join(parts)


def _sorted_json(scenario: Scenario) -> str:
    """A scenario without its seed, the same text in whatever order parameters were given."""
    return json.dumps(scenario.model_dump(mode="json", exclude={"seed"}), sort_keys=True)


def ensure_writable(path: Path) -> None:
    """Refuse a path that `save` could not use, before the sortie is flown.

    Raises:
        RunError: it holds something that is no run, or besides a run what is not of it; or it cannot be made.
    """
    ensure_folder(path, OUTCOME, "run", WRITTEN)
    if (path / PAGE).is_file() and not _is_of_the_run(path / PAGE):
        raise RunError(f"{path}: holds {PAGE}, which is not of the run there; choose another folder or move it")


def save(record: SortieRecord, path: Path, also: Callable[[Path], None] | None = None) -> dict[str, Any]:
    """Write a run to a temporary folder beside `path`, then rename it; returns the outcome.

    Args:
        record: what to write.
        path: the run's folder; an older run there is replaced, with the page and the exports made of it.
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
            "detector": record.detector,
            "own_files": dict(record.own_files),
            "totals": dict(record.totals),
            "wall": dict(record.wall),
        }
        (partial / RECORD).write_text(json.dumps(about, indent=2) + "\n")
        for name, table in record.tables.items():
            pq.write_table(table, partial / f"{name}.parquet", compression="zstd")
        if also is not None:
            also(partial)
    return result


def in_place_of(path: Path, fingerprint: str) -> str:
    """What to say of the run that another one with this fingerprint is about to replace; empty where nothing is lost."""
    try:
        old = json.loads((path / OUTCOME).read_text())
        replaced = f", in place of a run of {old['scenario']} under {old['policy']}, seed {old['seed']}"
        return "" if old["fingerprint"] == fingerprint else replaced
    except (OSError, ValueError, TypeError, LookupError):
        return ""  # none, or one that nobody can read


def _is_of_the_run(page: Path) -> bool:
    """Whether a page belongs to the run in its folder, by that run's fingerprint."""
    try:
        fingerprint = json.loads((page.parent / OUTCOME).read_text())["fingerprint"]
        return str(fingerprint) in page.read_text(encoding="utf-8")
    except (OSError, ValueError, TypeError, LookupError):
        return False


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
        expected = dict(TABLES)
        if scenario.record.views:
            expected |= views.TABLES
        if scenario.record.disagreement:
            expected[disagreement.TABLE] = disagreement.COLUMNS
        tables = {name: pq.read_table(path / f"{name}.parquet") for name in expected}
        for name, columns in expected.items():
            if lacking := [c for c in columns if c not in tables[name].column_names]:
                raise ValueError(f"{name}.parquet has no column {lacking[0]}; another version's, perhaps: fly it again")
        return SortieRecord(scenario=scenario, tables=tables, **about)
    except (OSError, ValueError, TypeError, ScenarioError) as error:
        raise RunError(f"{path}: the run is damaged: {error}") from error
