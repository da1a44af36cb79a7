"""Reasons from the record are told as the record has them."""

from __future__ import annotations

import dataclasses

import pyarrow as pa
from sim_examples import example

from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.explain import explain_metric
from sortie.sim.results.outcome import outcome


def test_a_reason_keeps_its_figures() -> None:
    """`1.05 s old` was told as `15 s old`."""
    record = run_sortie(example("duration_s=2"))
    table = record.tables["directives"]
    reasons = ["goodput 4.0 < 5 Mb/s"] + ["detached: descriptor 1.05 s old"] * (table.num_rows - 1)
    table = table.set_column(table.schema.get_field_index("reason"), "reason", pa.array(reasons))
    told = dataclasses.replace(record, tables={**record.tables, "directives": table})
    assert explain_metric("switches", told, outcome(record)) == (
        f"decided because of 'detached: descriptor 1.05 s old' ×{table.num_rows - 1}, 'goodput 4.0 < 5 Mb/s' ×1"
    )
