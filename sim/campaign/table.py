"""A campaign's table: its columns, and its Parquet file `runs/table.parquet` with the rows of finished parts."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from sortie.scenarios.replacing import replacing
from sortie.scenarios.schema.campaign import Choice, Column, Grid
from sortie.sim.campaign.plan import CampaignPlan
from sortie.sim.campaign.work import RunResult
from sortie.sim.folders import RunError

TABLE = "runs/table.parquet"
FIXED: dict[str, pa.DataType] = {
    "run": pa.int64(),
    "unit": pa.int64(),
    "cell": pa.int64(),
    "replication": pa.int64(),
    "policy": pa.string(),
    "seed": pa.int64(),
    "status": pa.string(),
    "error": pa.string(),
    "fingerprint": pa.string(),
    "key": pa.string(),
}
"""Columns of every table. Each varied field (its value) and each metric (float, null without one) adds a column."""


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


def write_table(folder: Path, plan: CampaignPlan, parts: Iterable[pa.Table]) -> None:
    """Write the table.

    Raises:
        OSError: the disk refuses.
    """
    schema = pa.schema(list(columns(plan).items()), {"sortie.campaign": plan.digest})
    how: dict[str, Any] = {"compression": "zstd", "write_page_checksum": True}
    with replacing(folder / TABLE) as partial, pq.ParquetWriter(partial, schema, **how) as writer:
        for part in parts:
            writer.write_table(part)
