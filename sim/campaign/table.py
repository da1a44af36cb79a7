"""A campaign's table: its columns, its Parquet file, and the manifest that says what the file must be.

    runs/table.parquet  the rows of finished parts, in the order of runs
    manifest.json       what the campaign is, its columns, and the table's SHA-256

Both are made of the rows in `campaign.sqlite`. The manifest is removed before the table is replaced and written after it, so
a manifest that is there is never older than its table.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, Field, TypeAdapter

from sortie.scenarios.schema.campaign import Choice, Column, Grid
from sortie.sim.campaign.plan import CampaignPlan
from sortie.sim.campaign.work import RunResult
from sortie.sim.folders import RunError, write_durably, writing_durably

TABLE, MANIFEST, LOCK = "runs/table.parquet", "manifest.json", ".table.lock"
FIXED: dict[str, pa.DataType] = {
    "run": pa.int64(), "unit": pa.int64(), "cell": pa.int64(), "replication": pa.int64(), "policy": pa.string(),
    "seed": pa.int64(), "status": pa.string(), "error": pa.string(), "fingerprint": pa.string(), "key": pa.string(),
}  # fmt: skip
"""Columns of every table. Each varied field (its value) and each metric (float, null without one) adds a column."""
_Number = Annotated[float, Field(allow_inf_nan=False)]


def columns(plan: CampaignPlan) -> dict[str, pa.DataType]:
    """The table's columns and their types."""
    types = dict(FIXED)
    for name, spread in plan.campaign.vary.items():
        values: Sequence[Any] = ()
        if isinstance(spread, Choice | Grid):
            values = spread.values
        elif isinstance(spread, Column):
            values = plan.spec["columns"][name]
        numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
        types[name] = pa.float64() if numbers else pa.string()
    for name in plan.campaign.metrics:
        if name in types:
            raise RunError(f"metrics: {name}, is the name of another column")
        types[name] = pa.float64()
    return types


def stored(value: Any, kind: pa.DataType) -> Any:
    """A varied field's value as its column has it: what is no number and no text is JSON."""
    return json.dumps(value) if kind == pa.string() and not isinstance(value, str) else value


def row_of(plan: CampaignPlan, schema: pa.Schema, result: RunResult) -> dict[str, Any]:
    """A result's row of the table, its columns in the schema's order."""
    at = plan.at(result.run)
    varied = {name: stored(value, schema.field(name).type) for name, value in plan.varied(at.cell).items()}
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


def row_type(plan: CampaignPlan) -> TypeAdapter[tuple[Any, ...]]:
    """What the stored values of a row must be: as many as there are columns, each of its column's type."""
    kinds: dict[str, Any] = {
        name: {pa.int64(): int, pa.string(): str, pa.float64(): _Number}[kind] for name, kind in columns(plan).items()
    }
    kinds |= dict.fromkeys(plan.campaign.metrics, _Number | None)
    kinds["status"] = Literal["done", "failed"]
    shape: Any = tuple.__class_getitem__(tuple(kinds.values()))
    return TypeAdapter(shape)


def write_table(folder: Path, plan: CampaignPlan, parts: Iterable[pa.Table]) -> None:
    """Write the table and its manifest.

    Raises:
        OSError: the disk refuses.
        RunError: a row is broken.
    """
    path = folder / TABLE
    path.parent.mkdir(parents=True, exist_ok=True)
    kinds, rows = columns(plan), 0
    schema = pa.schema(list(kinds.items()), {"sortie.campaign": plan.digest})
    with (folder / LOCK).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # a report and a driver may write at the same time
        with writing_durably(path) as file:
            with pq.ParquetWriter(file, schema, compression="zstd", write_page_checksum=True) as writer:
                for part in parts:
                    writer.write_table(part)
                    rows += part.num_rows
            (folder / MANIFEST).unlink(missing_ok=True)
        files = {TABLE: {"rows": rows, "sha256": _sha256(path)}}
        text = json.dumps({**_about(plan), "files": files}, indent=2)
        write_durably(folder / MANIFEST, f"{text}\n".encode())


def table_fault(folder: Path, plan: CampaignPlan) -> str | None:
    """What is wrong with the table or its manifest, as one line; None where both are as they were written, or there is no table.

    Raises:
        RunError: the disk refuses.
    """
    try:
        with _shared(folder):
            return _fault(folder, plan)
    except OSError as error:
        raise RunError(f"{error.filename or folder}: cannot be read: {error.strerror}") from error


def foreign_files(folder: Path) -> list[str]:
    """Names of what lies beside the table and is not the campaign's, in `runs/`."""
    beside = (folder / TABLE).parent
    partial = f".{Path(TABLE).name}."  # a table that another process is writing
    names = sorted(path.name for path in beside.iterdir()) if beside.is_dir() else []
    return [f"runs/{name}" for name in names if name != Path(TABLE).name and not name.startswith(partial)]


def foreign_line(folder: Path) -> str | None:
    """One line about foreign files; None where there are none."""
    names = foreign_files(folder)
    if not names:
        return None
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return f"{folder / names[0]}{more}: not written by the campaign, and not read; only {TABLE} is its table"


def _about(plan: CampaignPlan) -> dict[str, Any]:
    return {
        "format": plan.spec["format"],
        "campaign": plan.campaign.campaign,
        "plan": plan.digest,
        "version": plan.code,
        "runs": plan.runs,
        "columns": {name: str(kind) for name, kind in columns(plan).items()},
    }


class _Listed(BaseModel, extra="forbid", strict=True):
    rows: int
    sha256: str


_FILES = TypeAdapter(dict[str, _Listed])


def _fault(folder: Path, plan: CampaignPlan) -> str | None:
    table, manifest = folder / TABLE, folder / MANIFEST
    if not table.is_file():
        return None
    if not manifest.is_file():
        return f"{manifest}: is missing, so {TABLE} cannot be checked"
    try:
        found = json.loads(manifest.read_bytes())
        files = _FILES.validate_python(found.pop("files"))
    except (ValueError, TypeError, RecursionError, AttributeError, KeyError):
        return f"{manifest}: is broken"
    expected = _about(plan)
    for key in [*expected, *found]:
        if key not in expected or found.get(key) != expected[key]:
            return f"{manifest}: was changed, its field {key!r} is not the campaign's"
    if set(files) != {TABLE}:
        return f"{manifest}: was changed, it must list {TABLE} alone"
    if files[TABLE].sha256 != (now := _sha256(table)):
        return f"{table}: was changed, its SHA-256 is {now[:12]}…, {MANIFEST} has {files[TABLE].sha256[:12]}…"
    return None


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def _shared(folder: Path) -> Iterator[None]:
    """No table is replaced within the block."""
    if not (folder / LOCK).is_file():
        yield
        return
    with (folder / LOCK).open() as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        yield
