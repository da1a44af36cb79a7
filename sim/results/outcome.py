"""The outcome of a sortie: the values of outcome.json, computed from the record.

Everything here is computed from the record's tables, piece after piece: they may be larger than memory. `outcome.md` beside this file lists
every field.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sortie.perception.classes import CAR, TargetClass
from sortie.policies.verification.enforced import CAUSES
from sortie.radio.counters import CAUSES as LOSS_CAUSES
from sortie.scenarios.plugins.reference import is_file
from sortie.scenarios.representation import CELL_NAMES
from sortie.sim.results import disagreement
from sortie.sim.results.accuracy import FULL_SCENE, MISSION, Scored, score
from sortie.sim.results.connectivity import connectivity_outcome
from sortie.sim.results.mission_outcome import mission_outcome
from sortie.sim.results.people_outcome import people_outcome
from sortie.sim.results.record import DECISIONS_OF, VIOLATIONS_OF, SortieRecord
from sortie.sim.results.selection import Pieces, percentiles
from sortie.sim.results.spool import batches
from sortie.sim.results.tracking_outcome import tracking_outcome
from sortie.sim.results.traffic import Span, Traffic, feature_payload_p50, traffic

_INSTANT_S = 1e-6
"""A frame begins a few digits beside the time that a scenario names."""


def outcome(record: SortieRecord) -> dict[str, Any]:
    """All figures of one sortie, JSON-ready; ratios of nothing are null."""
    tables, totals = record.tables, record.totals
    phases = list(_phases(record))
    sent, *by_phase = traffic(tables, [span for span, _ in phases])
    data_sent = sent.sent_bytes
    context_bytes = totals["context_descriptor_bytes"] + totals["context_directive_bytes"]
    scenario = record.scenario
    minutes = scenario.duration_s / 60.0
    links = scenario.fleet.drones * (scenario.fleet.drones - 1)
    switched = list(transitions(tables["directives"], {}))
    looked_for = _looked_for(scenario.perception.classes)
    scored = score(record, [CAR, *(kind for kind in looked_for if kind != CAR)])
    drones = _drones(tables["states"], tables["energy"], scenario.fleet.drones, scored)
    return {
        "scenario": scenario.name,
        "policy": record.policy,
        "seed": record.seed,
        "replication": record.replication,
        "version": record.version,
        "own_files": dict(record.own_files),
        "fingerprint": record.fingerprint,
        "duration_s": scenario.duration_s,
        "frame_s": scenario.frame_s,
        "ap50": {
            **scored.ap(CAR),
            "detector": record.detector,
            "fusion": _fusion(record),
            "calibration": record.calibration,
            "grounded_blind": scored.grounded_blind(),
            "sample_rate_hz": min(scenario.perception.sample_rate_hz, scenario.context.rate_hz),
            "scored_fusions": tables["fusions"].num_rows,
            "scored_drones": 0 if record.detector == "none" else scenario.scored_drones,
            "scorable_drones": len(scenario.scorable_drones),
        },
        "ap_by_class": _by_class(scored, looked_for),
        "tracking": tracking_outcome(record),
        "mission": mission_outcome(record),
        "people": people_outcome(record),
        "bytes": {
            "context_sent": int(context_bytes),
            "context_descriptors": int(totals["context_descriptor_bytes"]),
            "context_directives": int(totals["context_directive_bytes"]),
            "data_sent": data_sent,
            "handshakes_sent": sent.handshake_bytes,
            **{f"data_{status}": count for status, count in sent.bytes_by_status().items()},
        },
        "context": _context(tables["receptions"], 0.0, scenario.duration_s),
        "connectivity": connectivity_outcome(record),
        "context_share": _ratio(context_bytes, context_bytes + data_sent),
        "data_rate_mbps": data_sent * 8e-6 / scenario.duration_s,
        "deadline_miss_rate": sent.miss_rate(),
        "payload_fates": sent.fates(),
        "medium_busy_fraction": totals["medium_busy_fraction"],
        "age_s": _p50_p99(lambda: _column(tables, "ages", "age_s")),
        "data_age_s": _p50_p99(lambda: _flat(tables, "fusions", "ages_s")),
        "data_age_mean_s": pc.mean(
            pa.array(np.concatenate([np.zeros(0), *_flat(tables, "fusions", "ages_s")]))
        ).as_py(),
        "descriptor_drops": _counts(tables, "drops", "reason"),
        "battery": {d: v["soc"] for d, v in drones.items()},
        "drones": drones,
        "energy_j": _energy(tables["energy"]),
        "policies": {
            "decisions": {k.removeprefix(DECISIONS_OF): v for k, v in totals.items() if k.startswith(DECISIONS_OF)},
            "changes": totals["policy_changes"],
            "shield_interventions": totals["shield_interventions"],
            "invariant_violations": totals["invariant_violations"],
            "violated_ticks": totals["violated_ticks"],
            "violations_by_cause": {c.replace(" ", "_"): totals[f"{VIOLATIONS_OF}{c}"] for c in CAUSES},
        },
        "switches": sum(len(c["peers"]) for c in switched) / (links * minutes) if links else None,
        "transitions": switched,
        "phases": [
            _phase(record, scored, payloads, span, name)
            for payloads, (span, name) in zip(by_phase, phases, strict=True)
        ],
        "distrusted_by": _distrusted_by(tables),
        "events": tables["events"].to_pylist(),
        "disagreement": disagreement.figures(
            disagreement.pairs_of(tables[disagreement.TABLE]) if disagreement.TABLE in tables else ()
        ),
        "metrics": dict(record.metrics),
        "policy_eval_us": {
            "p50": record.wall.get("policy_eval_us_p50"),
            "p99": record.wall.get("policy_eval_us_p99"),
        },
        "wall_s": record.wall.get("wall_s"),
        "realtime_factor": _ratio(scenario.duration_s, record.wall.get("wall_s", 0.0)),
    }


# --- traffic, decisions, energy ------------------------------------------------------------------


def _sum(column: pa.ChunkedArray) -> int:
    return int(pc.sum(pc.cast(column, pa.int64())).as_py() or 0)


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _column(tables: Mapping[str, pa.Table], name: str, column: str) -> Iterator[NDArray[np.float64]]:
    """A table's column, piece after piece."""
    return (batch.column(0).to_numpy() for batch in batches(tables, name, [column]))


def _flat(tables: Mapping[str, pa.Table], name: str, column: str) -> Iterator[NDArray[np.float64]]:
    """The values in a column of lists, piece after piece."""
    return (batch.column(0).flatten().to_numpy() for batch in batches(tables, name, [column]))


def _p50_p99(pieces: Pieces) -> dict[str, float | None]:
    found = percentiles(pieces, (50.0, 99.0))
    return dict.fromkeys(("p50", "p99")) if found is None else dict(zip(("p50", "p99"), found, strict=True))


def _counts(tables: Mapping[str, pa.Table], name: str, column: str) -> dict[str, int]:
    """How often each value stands in a column, in the order in which they first come."""
    counts: Counter[str] = Counter()
    for batch in batches(tables, name, [column]):
        for each in pc.value_counts(batch.column(0)).to_pylist():
            counts[str(each["values"])] += each["counts"]
    return dict(counts)


def _looked_for(classes: Sequence[str]) -> list[TargetClass]:
    """The classes that drones look for; none where cars are the only one, as `ap50` says it."""
    return [kind for kind in TargetClass if len(classes) > 1 and kind.name.lower() in classes]


def _by_class(scored: Scored, looked_for: Sequence[TargetClass]) -> dict[str, dict[str, float | None]]:
    """AP of each class that drones look for; null of others."""
    return {
        kind.name.lower(): scored.ap(kind) if kind in looked_for else dict.fromkeys((FULL_SCENE, MISSION))
        for kind in TargetClass
    }


def _fusion(record: SortieRecord) -> str | None:
    """What fuses payloads, as the scenario names it; None where a detector flew that the scenario does not name."""
    section = record.scenario.perception
    fuses = record.detector == section.detector != "none" and not is_file(section.detector)
    return (section.recorded_fusion or section.fusion) if fuses else None


def _distrusted_by(tables: Mapping[str, pa.Table]) -> dict[str, int]:
    """For each doubted drone, how many drones doubted it."""
    pairs = {
        (row["peer"], row["drone"])
        for batch in batches(tables, "trust", ["drone", "peer", "trust"])
        for row in batch.to_pylist()
        if row["trust"] < 1.0
    }
    return {str(peer): sum(p == peer for p, _ in pairs) for peer in sorted({p for p, _ in pairs})}


def _context(receptions: pa.Table, begin_s: float, end_s: float) -> dict[str, Any]:
    """Shares of descriptor receptions that were lost, in frames that begin from `begin_s` to before `end_s`."""
    t_s = receptions["t_s"].to_numpy() + _INSTANT_S
    within = receptions.filter(pa.array((begin_s <= t_s) & (t_s < end_s)))
    lost = {cause: _sum(within[cause]) for cause in LOSS_CAUSES}
    every = _sum(within["heard"]) + sum(lost.values())
    return {
        "lost": _ratio(sum(lost.values()), every),
        "lost_to": {cause: _ratio(count, every) for cause, count in lost.items()},
    }


def _drones(states: pa.Table, energy: pa.Table, drones: int, scored: Scored) -> dict[str, dict[str, Any]]:
    """Each drone at the end, the energy it spent, and how well it saw."""
    last = states.slice(max(0, states.num_rows - drones))
    spent = np.zeros(drones)
    np.add.at(spent, energy["drone"].to_numpy(), energy["energy_j"].to_numpy())
    return {
        str(row["drone"]): {
            **{name: row[name] for name in ("soc", "voltage_v", "airborne")},
            "energy_j": float(spent[row["drone"]]),
            "ap50": {scope: scored.pools[CAR, scope].ap_of(row["drone"]) for scope in (FULL_SCENE, MISSION)},
        }
        for row in last.to_pylist()
    }


def _energy(energy: pa.Table) -> dict[str, float]:
    by_cause = energy.group_by("cause", use_threads=False).aggregate([("energy_j", "sum")])
    return {
        **{row["cause"]: row["energy_j_sum"] for row in by_cause.to_pylist()},
        "total": float(pc.sum(energy["energy_j"]).as_py() or 0.0),
    }


def describe(row: dict[str, Any]) -> str:
    """A directive in words: `features ρ=0.25 at 10 Hz in 32 m`."""
    if row["representation"] == "none" or row["rate_hz"] <= 0:
        return "nothing"
    budget = f" ρ={row['rho']:.3g}" if row["representation"] in CELL_NAMES else ""
    roi = "" if np.isnan(row["roi_radius_m"]) else f" in {row['roi_radius_m']:.0f} m"
    return f"{row['representation']}{budget} at {row['rate_hz']:g} Hz{roi}"


def changes(directives: pa.Table, carried: dict[tuple[int, int], str]) -> Iterator[tuple[dict[str, Any], str, str]]:
    """The directives that change what their link carries (a disc that moves is no change), with what before and after.

    `carried` is what each (drone, peer) carried before. It is brought up to date when the next change is asked for.
    """
    for row in chain.from_iterable(batch.to_pylist() for batch in directives.to_batches()):
        link, level = (row["drone"], row["peer"]), describe(row)
        before = carried.get(link, "nothing")
        if level != before:
            yield row, before, level
            carried[link] = level


def transitions(directives: pa.Table, carried: dict[tuple[int, int], str]) -> Iterator[dict[str, Any]]:
    """The `changes` of links; those of a drone that change alike in one entry.

    The same entries as `outcome.json` has, but in slices: `carried` is what each (drone, peer) carried before and is
    brought up to date. Each entry comes before the next one's changes are in `carried`.
    """
    entry: dict[str, Any] | None = None
    for row, before, level in changes(directives, carried):
        change = {"t_s": row["t_s"], "drone": row["drone"], "from": before, "to": level, "reason": row["reason"]}
        if entry is not None and all(entry[k] == v for k, v in change.items()):
            entry["peers"].append(row["peer"])
        else:
            if entry is not None:
                yield entry
            entry = {**change, "peers": [row["peer"]]}
    if entry is not None:
        yield entry


def _phases(record: SortieRecord) -> Iterator[tuple[Span, str]]:
    phases, end_s = record.scenario.mission.phases, record.scenario.duration_s
    for phase, following in zip(phases, [*phases[1:], None], strict=True):
        if phase.at_s < end_s:
            yield (phase.at_s, min(end_s, following.at_s) if following else end_s), phase.phase


def _phase(record: SortieRecord, scored: Scored, payloads: Traffic, span: Span, name: str) -> dict[str, Any]:
    begin_s, end_s = span
    return {
        "phase": name,
        "begin_s": begin_s,
        "end_s": end_s,
        "ap50": scored.ap(CAR, begin_s, end_s),
        "context": _context(record.tables["receptions"], begin_s, end_s),
        "data_rate_mbps": payloads.sent_bytes * 8e-6 / (end_s - begin_s),
        "feature_payload_bytes": feature_payload_p50(record.tables, span),
        "deadline_miss_rate": payloads.miss_rate(),
    }
