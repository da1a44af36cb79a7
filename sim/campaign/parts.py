"""What lies in a campaign's folder, how it is read, and how it gets onto the disk.

    campaign.json            the specification; with the code version in it, its digest says whose results these are
    runs/part-00000.parquet  one row a run, in the order of runs; a part is written whole, renamed, and never touched again
    journal/00000.jsonl      rows of a part that is not finished: each line with its checksum, on disk before it counts

A part is a function of its rows, so the table does not tell how often, or where, a campaign was interrupted.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sortie.scenarios.schema.campaign import Choice, Column, Grid
from sortie.sim.campaign.plan import FORMAT, CampaignPlan
from sortie.sim.campaign.work import RunResult
from sortie.sim.folders import RunError

MANIFEST, RUNS, JOURNAL = "campaign.json", "runs", "journal"
FIXED: dict[str, pa.DataType] = {
    "run": pa.int64(), "unit": pa.int64(), "cell": pa.int64(), "replication": pa.int64(), "policy": pa.string(),
    "seed": pa.int64(), "status": pa.string(), "error": pa.string(), "fingerprint": pa.string(), "key": pa.string(),
}  # fmt: skip
"""Columns that every table has; then one a varied field (its value) and one a metric (float, null without one)."""


class BrokenPartError(RunError):
    """A file of the table that is damaged, or not the part that its name says."""


def read_plan(folder: Path) -> CampaignPlan:
    """The plan of a campaign's folder.

    Raises:
        RunError: there is none, or one of another format.
    """
    try:
        manifest = json.loads((folder / MANIFEST).read_text())
        spec = manifest["spec"]
        if spec["format"] != FORMAT:
            raise RunError(f"{folder}: holds results of format {spec['format']}, must be {FORMAT}; name another folder")
        plan = CampaignPlan(spec)
        if plan.digest != manifest["digest"]:
            raise RunError(f"{folder / MANIFEST}: was changed by hand, its digest is another")
    except FileNotFoundError:
        raise RunError(f"{folder}: no campaign there ({MANIFEST} is missing)") from None
    except RunError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(f"{folder / MANIFEST}: cannot be read: {error}") from None
    return plan


def columns(plan: CampaignPlan) -> dict[str, pa.DataType]:
    """The table's columns and their types."""
    found = dict(FIXED)
    for name, spread in plan.campaign.vary.items():
        values: Sequence[Any] = ()
        if isinstance(spread, Choice | Grid):
            values = spread.values
        elif isinstance(spread, Column):
            values = plan.spec["columns"][name]
        numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
        found[name] = pa.float64() if numbers else pa.string()
    for name in plan.campaign.metrics:
        if name in found:
            raise RunError(f"metrics: {name}, is the name of another column")
        found[name] = pa.float64()
    return found


def shards(plan: CampaignPlan) -> int:
    """Parts of the whole campaign."""
    return -(-plan.runs // plan.shard)


def runs_of(plan: CampaignPlan, shard: int) -> range:
    """The runs of a part."""
    return range(shard * plan.shard, min(plan.runs, (shard + 1) * plan.shard))


def part_file(folder: Path, shard: int) -> Path:
    """A part's file."""
    return folder / RUNS / f"part-{shard:05d}.parquet"


def journal_file(folder: Path, shard: int) -> Path:
    """The file of a part's rows until all of them are there."""
    return folder / JOURNAL / f"{shard:05d}.jsonl"


def read_part(folder: Path, plan: CampaignPlan, shard: int) -> pa.Table | None:
    """A finished part, read in full and held against the plan; None where there is no such file.

    Keys are held against the plan at the part's ends: each costs 0.3 ms, five minutes for a million runs.

    Raises:
        BrokenPartError: it is damaged, or holds other runs.
        RunError: the disk does not give it.
    """
    path = part_file(folder, shard)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror}") from None
    try:  # on one thread: pyarrow's others may outlive what a damaged file raises, and abort the process
        table = pq.read_table(pa.BufferReader(data), page_checksum_verification=True, use_threads=False)
        table.validate(full=True)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise _broken(path, f"cannot be read: {' '.join(str(error).split())[:120]}") from None
    runs = runs_of(plan, shard)
    if not table.schema.equals(schema_of(plan), check_metadata=True):
        raise _broken(path, "its columns are not this campaign's")
    if table["run"].to_pylist() != list(runs):
        raise _broken(path, f"it must hold the runs {runs[0]} … {runs[-1]}")
    if any(table["key"][run - runs[0]].as_py() != plan.key(run) for run in (runs[0], runs[-1])):
        raise _broken(path, "its keys are not this campaign's")
    return table


def _broken(path: Path, why: str) -> BrokenPartError:
    return BrokenPartError(f"{path}: is broken ({why}); the campaign's command flies it again")


def schema_of(plan: CampaignPlan) -> pa.Schema:
    """The schema of its parts, whose campaign stands in the metadata."""
    return pa.schema(list(columns(plan).items()), {"sortie.campaign": plan.digest})


def find_in_journal(folder: Path, plan: CampaignPlan, run: int) -> RunResult | None:
    """A run's result, where its part is not finished; None where it has none."""
    try:
        results, _ = read_lines(journal_file(folder, run // plan.shard))
    except FileNotFoundError:
        return None
    return next((r for r in results if r.run == run and r.key == plan.key(run)), None)


def row_of(plan: CampaignPlan, kinds: Mapping[str, pa.DataType], result: RunResult) -> dict[str, Any]:
    """A result's row of the table, whose columns are `kinds`."""
    at = plan.at(result.run)
    varied = {
        name: json.dumps(value) if kinds[name] == pa.string() and not isinstance(value, str) else value
        for name, value in plan.varied(at.cell).items()
    }
    return {
        **at._asdict(),
        "policy": plan.policies[at.policy],
        "seed": plan.seed(at.cell),
        "status": result.status,
        "error": result.error,
        "fingerprint": result.fingerprint,
        "key": result.key,
        **varied,
        **dict(zip(plan.campaign.metrics, result.values, strict=True)),
    }


def check_same(folder: Path, plan: CampaignPlan) -> None:
    """Refuse a folder that holds results of another campaign, or of other code; an empty one will do.

    Raises:
        RunError: what differs first.
    """
    if not (folder / MANIFEST).is_file():
        return
    old = read_plan(folder)
    if old.digest == plan.digest:
        return
    if {**old.spec, "code": 0} == {**json.loads(json.dumps(plan.spec)), "code": 0}:
        raise RunError(f"{folder}: holds results of Sortie {old.code}, this is {plan.code}; name another folder")
    differs = next(k for k in plan.spec if old.spec.get(k) != json.loads(json.dumps(plan.spec[k])))
    raise RunError(
        f"{folder}: holds results of another campaign, its {_what(old.spec, plan.spec, differs)} differs; name another folder"
    )


def _what(old: Mapping[str, Any], new: Mapping[str, Any], key: str) -> str:
    a, b = old.get(key), json.loads(json.dumps(new[key]))
    if isinstance(a, dict) and isinstance(b, dict):
        return f"{key}.{next(k for k in {**b, **a} if a.get(k) != b.get(k))}"
    return key


def line_of(result: RunResult) -> bytes:
    """A result's line of the journal, its checksum first."""
    text = json.dumps(result, separators=(",", ":")).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


def read_lines(path: Path) -> tuple[list[RunResult], int]:
    """The rows up to the first line that is not whole, and how many bytes they take."""
    results: list[RunResult] = []
    good = 0
    with path.open("rb") as file:
        for line in file:
            checksum, _, text = line.rstrip(b"\n").partition(b" ")
            if not line.endswith(b"\n") or checksum != b"%08x" % zlib.crc32(text):
                break
            run, key, status, error, fingerprint, values = json.loads(text)
            results.append(RunResult(run, key, status, error, fingerprint, tuple(values)))
            good += len(line)
    return results, good
