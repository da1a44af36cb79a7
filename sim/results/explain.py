"""The facts in a record that explain a metric, in one line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from sortie.sim.results.record import SortieRecord
from sortie.sim.results.sentences import losses_in_words

FEW = 3
GROUNDED = ("landed", "drone_lost", "power_lost")
"""Kinds of events by which a drone leaves the air."""


def explain_metric(metric: str, record: SortieRecord, result: dict[str, Any]) -> str:
    """The facts behind a metric: fates of payloads, what was fused, energy by cause; and what happened to the fleet."""
    top = metric.partition(".")[0]
    facts = []
    if top in ("ap50", "mission"):
        facts.append(_grounded(record))
    if top in ("ap50", "mission", "data_age_s", "phases"):
        facts.append(_fused(record, result))
    if top in (
        "bytes",
        "context_share",
        "data_rate_mbps",
        "deadline_miss_rate",
        "payload_fates",
        "phases",
        "ap50",
        "medium_busy_fraction",
        "data_age_s",
    ):
        facts.append(_payloads(result))
    if top in ("context", "age_s"):
        facts.append(f"descriptors lost: {losses_in_words(result['context']) or 'none'}")
    if top in ("age_s", "descriptor_drops"):
        facts.append(_descriptors(result))
    if top in ("energy_j", "battery", "drones"):
        energy = {k: v for k, v in result["energy_j"].items() if k != "total"}
        facts.append("energy " + ", ".join(f"{k} {v / 1e3:.1f} kJ" for k, v in _most(energy)))
    facts += [_decisions(record), _events(record)]
    return "; ".join(f for f in facts if f)


def _most(counts: Mapping[str, float]) -> list[tuple[str, float]]:
    return sorted(((k, v) for k, v in counts.items() if v), key=lambda item: -item[1])[:FEW]


def _payloads(result: dict[str, Any]) -> str:
    fates = result["payload_fates"]
    if not fates:
        return "no payload was sent"
    shown = ", ".join(f"{v} {k}" for k, v in _most(fates))
    return f"payloads: {shown} of {sum(fates.values())}, medium {100 * result['medium_busy_fraction']:.0f} % busy"


def _grounded(record: SortieRecord) -> str:
    rows = record.tables["events"].filter(pc.is_in(record.tables["events"]["kind"], pa.array(GROUNDED))).to_pylist()
    shown = ", ".join(f"drone {r['drone']} at {r['t_s']:g} s ({r['text']})" for r in rows[:FEW])
    more = f" and {len(rows) - FEW} more" if len(rows) > FEW else ""
    return f"left the air: {shown}{more}" if rows else ""


def _fused(record: SortieRecord, result: dict[str, Any]) -> str:
    fusions = record.tables["fusions"]
    if not fusions.num_rows:
        return f"nothing was scored (the detector is {record.detector})"
    held = pc.sum(pc.list_value_length(fusions["peers"])).as_py() or 0
    age = result["data_age_s"]["p50"]
    late = "" if age is None else f", {age:.2f} s old at the median"
    return f"{held / fusions.num_rows:.1f} peers' payloads a fusion{late}"


def _descriptors(result: dict[str, Any]) -> str:
    refused = ", ".join(f"{v} {k}" for k, v in _most(result["descriptor_drops"]))
    return f"descriptors refused: {refused}" if refused else "no descriptor was refused"


def _decisions(record: SortieRecord) -> str:
    table = record.tables["directives"]
    counts = {str(v["values"]): int(v["counts"]) for v in pc.value_counts(table["reason"]).to_pylist()}
    shown = ", ".join(f"{reason!r} ×{n}" for reason, n in _most({k: v for k, v in counts.items() if k}))
    return f"decided because of {shown}" if shown else ""


def _events(record: SortieRecord) -> str:
    rows = record.tables["events"].to_pylist()
    return "happened: " + ", ".join(f"{r['t_s']:g} s {r['kind']}" for r in rows[:FEW]) if rows else ""
