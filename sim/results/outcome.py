"""The outcome of a sortie: the values of outcome.json, computed from the record.

Everything here is computed from the record's tables; `outcome.md` beside this file lists every field.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sortie.perception.classes import CAR, TargetClass
from sortie.perception.metrics.ap import Matched, average_precision, judge
from sortie.perception.types import Boxes
from sortie.policies.verification.enforced import CAUSES
from sortie.radio.counters import CAUSES as LOSS_CAUSES
from sortie.radio.transmission import Status
from sortie.scenarios.plugins.reference import is_file
from sortie.sim.results import disagreement
from sortie.sim.results.mission_outcome import mission_outcome
from sortie.sim.results.outcome_fields import REASONS
from sortie.sim.results.people_outcome import people_outcome
from sortie.sim.results.record import DECISIONS_OF, HANDSHAKE, VIOLATIONS_OF, SortieRecord, classes_in
from sortie.sim.results.regions import Regions
from sortie.sim.results.tracking_outcome import tracking_outcome

DATA_STATUSES = ("delivered", "lost", "expired", "in_flight")
_INSTANT_S = 1e-6
"""A frame begins a few digits beside the time that a scenario names."""


def outcome(record: SortieRecord) -> dict[str, Any]:
    """All figures of one sortie, JSON-ready; ratios of nothing are null."""
    tables, totals = record.tables, record.totals
    sent = tables["transmissions"]
    data_sent = _sum(sent["payload_bytes"])
    by_status = {s: _sum(sent.filter(pc.equal(sent["status"], s))["payload_bytes"]) for s in DATA_STATUSES}
    partial = sent.filter(pc.equal(sent["status"], "partial"))
    by_status["delivered"] += _sum(partial["arrived_bytes"])
    rest = pc.subtract(partial["payload_bytes"], partial["arrived_bytes"])
    for status in (Status.LOST, Status.EXPIRED):  # the rest of them came to what their reasons are of
        by_status[status] += _sum(rest.filter(pc.is_in(partial["reason"], pa.array(REASONS[status]))))
    context_bytes = totals["context_descriptor_bytes"] + totals["context_directive_bytes"]
    scenario = record.scenario
    minutes = scenario.duration_s / 60.0
    links = scenario.fleet.drones * (scenario.fleet.drones - 1)
    changes = list(transitions(tables["directives"], {}))
    drones = _drones(tables["states"], tables["energy"], scenario.fleet.drones)
    fusions = _Fusions(record, 0.0, float("inf"))
    both = fusions.both(CAR)
    ap = _accuracy(both)
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
            **ap,
            "detector": record.detector,
            "fusion": _fusion(record),
            "calibration": record.calibration,
            "grounded_blind": _grounded_blind(record, both, ap),
            "sample_rate_hz": min(scenario.perception.sample_rate_hz, scenario.context.rate_hz),
            "scored_fusions": tables["fusions"].num_rows,
        },
        "ap_by_class": _by_class(scenario.perception.classes, fusions),
        "tracking": tracking_outcome(record),
        "mission": mission_outcome(record),
        "people": people_outcome(record),
        "bytes": {
            "context_sent": int(context_bytes),
            "context_descriptors": int(totals["context_descriptor_bytes"]),
            "context_directives": int(totals["context_directive_bytes"]),
            "data_sent": data_sent,
            "handshakes_sent": _sum(sent.filter(pc.equal(sent["representation"], HANDSHAKE))["payload_bytes"]),
            **{f"data_{status}": count for status, count in by_status.items()},
        },
        "context": _context(tables["receptions"], 0.0, scenario.duration_s),
        "context_share": _ratio(context_bytes, context_bytes + data_sent),
        "data_rate_mbps": data_sent * 8e-6 / scenario.duration_s,
        "deadline_miss_rate": _miss_rate(sent),
        "payload_fates": {
            f"{row['status']}{'/' + row['reason'] if row['reason'] else ''}": row["count_all"]
            for row in sent.group_by(["status", "reason"]).aggregate([([], "count_all")]).sort_by("status").to_pylist()
        },
        "medium_busy_fraction": totals["medium_busy_fraction"],
        "age_s": _percentiles(tables["ages"]["age_s"]),
        "data_age_s": _percentiles(pc.list_flatten(tables["fusions"]["ages_s"])),
        "data_age_mean_s": pc.mean(pc.list_flatten(tables["fusions"]["ages_s"])).as_py(),
        "descriptor_drops": _counts(tables["drops"]["reason"]),
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
        "switches": sum(len(c["peers"]) for c in changes) / (links * minutes) if links else None,
        "transitions": changes,
        "phases": [_phase(record, both, begin_s, end_s, name) for begin_s, end_s, name in _phases(record)],
        "distrusted_by": _distrusted_by(tables["trust"]),
        "events": tables["events"].to_pylist(),
        "disagreement": disagreement.figures(
            disagreement.pairs_of(tables[disagreement.TABLE]) if disagreement.TABLE in tables else ()
        ),
        "policy_eval_us": {
            "p50": record.wall.get("policy_eval_us_p50"),
            "p99": record.wall.get("policy_eval_us_p99"),
        },
        "wall_s": record.wall.get("wall_s"),
        "realtime_factor": _ratio(scenario.duration_s, record.wall.get("wall_s", 0.0)),
    }


# --- accuracy ------------------------------------------------------------------------------------


def matched(
    record: SortieRecord, *, mission: bool, begin_s: float = 0.0, end_s: float = float("inf")
) -> dict[tuple[float, int], Matched]:
    """The cars of every scored fusion from `begin_s` (inclusive) to `end_s` (exclusive), by (time, ego), matched to the truth.

    Args:
        mission: count the mission disc alone, and only fusions made while there is one.
    """
    fusions = _Fusions(record, begin_s, end_s)
    return fusions.in_mission(CAR) if mission else fusions.in_full(CAR)


def accuracy(record: SortieRecord, begin_s: float = 0.0, end_s: float = float("inf")) -> dict[str, float | None]:
    """AP@0.5 of cars in the full scene and in the mission disc, pooled over egos and scored frames; null without any."""
    return _accuracy(both_matched(record), begin_s, end_s)


Both = dict[str, dict[tuple[float, int], Matched]]
"""Matched fusions, `full_scene` and `mission`."""


def both_matched(record: SortieRecord) -> Both:
    """The cars of every scored fusion matched in the full scene and in the mission disc."""
    return _Fusions(record, 0.0, float("inf")).both(CAR)


def _by_class(classes: Sequence[str], fusions: _Fusions) -> dict[str, dict[str, float | None]]:
    """AP of each class that drones look for; null of all where cars are the only one, as `ap50` says it."""
    nothing: dict[str, float | None] = {"full_scene": None, "mission": None}
    looked_for = classes if len(classes) > 1 else ()
    return {
        (name := kind.name.lower()): _accuracy(fusions.both(kind)) if name in looked_for else nothing
        for kind in TargetClass
    }


def _grounded_blind(record: SortieRecord, both: Both, ap: dict[str, float | None]) -> dict[str, float | None]:
    """AP with every drone that left the air counted as one that detects nothing.

    Its cars join the truths and it adds no detection. So precision stays, and each recall and AP shrink by one factor.
    """
    truths = record.tables["truths"]
    scored = both["full_scene"].keys()  # who left the air has cars and no fusion
    blind = [row not in scored for row in zip(truths["t_s"].to_pylist(), truths["drone"].to_pylist(), strict=True)]
    blind = np.array(blind, bool) & (classes_in(truths) == CAR)
    t_s, drone, x_m, y_m = (truths[c].to_numpy()[blind] for c in ("t_s", "drone", "x_m", "y_m"))
    disc_x_m, disc_y_m, radius_m = Regions(record.tables["mission"], record.scenario.mission).at(t_s, drone).T
    inside = (x_m - disc_x_m) ** 2 + (y_m - disc_y_m) ** 2 <= radius_m**2
    missed = {"full_scene": len(t_s), "mission": int(np.count_nonzero(inside))}
    sought = {name: sum(m.truths for m in fusions.values()) for name, fusions in both.items()}
    shares = {name: _ratio(sought[name], sought[name] + missed[name]) for name in both}
    return {name: None if share is None else share * (ap[name] or 0.0) for name, share in shares.items()}


def _fusion(record: SortieRecord) -> str | None:
    """What fuses payloads, as the scenario names it; None where a detector flew that the scenario does not name."""
    section = record.scenario.perception
    fuses = record.detector == section.detector != "none" and not is_file(section.detector)
    return (section.recorded_fusion or section.fusion) if fuses else None


class _Fusions:
    """The scored fusions of a record from `begin_s` to `end_s`; overlaps are computed once for all queries."""

    def __init__(self, record: SortieRecord, begin_s: float, end_s: float) -> None:
        tables = record.tables
        t_s, drone = tables["fusions"]["t_s"].to_numpy(), tables["fusions"]["drone"].to_numpy()
        within = (begin_s <= t_s) & (t_s < end_s)
        self._discs = Regions(tables["mission"], record.scenario.mission).at(t_s[within], drone[within])
        self._keys = list(zip(t_s[within].tolist(), drone[within].tolist(), strict=True))
        boxes, at = _boxes_of(self._keys, tables["detections"])
        self._truth, cars = _boxes_of(self._keys, tables["truths"])
        self._matches = judge(boxes, at, self._truth, cars, len(self._keys))
        self._boxes = boxes.take(self._matches.order)

    def both(self, kind: TargetClass) -> Both:
        """Those of a class matched in the full scene and in the mission disc."""
        return {"full_scene": self.in_full(kind), "mission": self.in_mission(kind)}

    def in_full(self, kind: TargetClass) -> dict[tuple[float, int], Matched]:
        """By (time, ego), the full scene."""
        return dict(zip(self._keys, self._matches.matched(*self._of(kind)), strict=True))

    def in_mission(self, kind: TargetClass) -> dict[tuple[float, int], Matched]:
        """By (time, ego), the mission disc, where there is one."""
        disc, (boxes, truth) = self._discs, self._of(kind)
        images, cars = self._matches.image, self._matches.cars
        inside = self._matches.matched(
            boxes & _within(self._boxes, disc[images]), truth & _within(self._truth, disc[cars])
        )
        there = ~np.isnan(disc[:, 2])
        return {key: m for key, m, is_ in zip(self._keys, inside, there.tolist(), strict=True) if is_}

    def _of(self, kind: TargetClass) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which boxes and which truths are of a class."""
        return self._boxes.kind == kind, self._truth.kind == kind


def _within(boxes: Boxes, disc: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each box's centre is in its disc [n, 3], as `Boxes.inside` says; in none that is NaN."""
    dx, dy = boxes.xy_m[:, 0] - disc[:, 0], boxes.xy_m[:, 1] - disc[:, 1]
    return np.asarray(dx * dx + dy * dy <= disc[:, 2] ** 2)


def _accuracy(both: Both, begin_s: float = 0.0, end_s: float = float("inf")) -> dict[str, float | None]:
    accuracy = {}
    for name, fusions in both.items():
        frames = [m for (t_s, _), m in fusions.items() if begin_s <= t_s < end_s]
        ap = average_precision(frames) if frames else float("nan")
        accuracy[name] = None if np.isnan(ap) else ap
    return accuracy


def _boxes_of(keys: Sequence[tuple[float, int]], table: pa.Table) -> tuple[Boxes, NDArray[np.int64]]:
    """A box table's boxes of some fusions (time, ego), and which of them each is of; both in order of time."""
    column = {c: table[c].to_numpy() for c in table.column_names}
    t_s, drone = column["t_s"], column["drone"]
    # rows of one fusion stand together
    first = np.flatnonzero(np.concatenate([[True], (np.diff(t_s) != 0) | (np.diff(drone) != 0)])[: len(t_s)])
    number = {key: k for k, key in enumerate(keys)}
    of = [number.get(key, -1) for key in zip(t_s[first].tolist(), drone[first].tolist(), strict=True)]
    at = np.repeat(np.array(of, np.int64), np.diff(first, append=len(t_s)))
    score = column.get("score", np.ones(len(t_s)))
    xy = np.column_stack([column["x_m"], column["y_m"]])
    boxes = Boxes(
        xy, np.column_stack([column["length_m"], column["width_m"]]), column["yaw_rad"], score, kind=classes_in(table)
    )
    return (boxes, at) if len(at) == 0 or at.min() >= 0 else (boxes.take(at >= 0), at[at >= 0])


# --- traffic, decisions, energy ------------------------------------------------------------------


def _sum(column: pa.ChunkedArray) -> int:
    return int(pc.sum(pc.cast(column, pa.int64())).as_py() or 0)


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _percentiles(column: Any) -> dict[str, float | None]:
    values = column.to_numpy()
    if len(values) == 0:
        return {"p50": None, "p99": None}
    p50, p99 = np.percentile(values, [50, 99])
    return {"p50": float(p50), "p99": float(p99)}


def _counts(column: pa.ChunkedArray) -> dict[str, int]:
    return {str(v["values"]): int(v["counts"]) for v in pc.value_counts(column).to_pylist()}


def _distrusted_by(trust: pa.Table) -> dict[str, int]:
    """For each doubted drone, how many drones doubted it."""
    pairs = {(r["peer"], r["drone"]) for r in trust.to_pylist() if r["trust"] < 1.0}
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


def _miss_rate(sent: pa.Table) -> float | None:
    """Payloads that missed their deadline or were replaced before it, over those whose fate is known.

    One of tiles that was cut short is one, whatever of it had come: it is `partial`, with the reason of an expired one.
    """
    known = sent.num_rows - _counts(sent["status"]).get(Status.IN_FLIGHT, 0)
    reasons = _counts(sent["reason"])
    return _ratio(sum(reasons.get(reason, 0) for reason in REASONS[Status.EXPIRED]), known)


def _drones(states: pa.Table, energy: pa.Table, drones: int) -> dict[str, dict[str, Any]]:
    """Each drone at the end, and the energy it spent."""
    last = states.slice(max(0, states.num_rows - drones))
    spent = np.zeros(drones)
    np.add.at(spent, energy["drone"].to_numpy(), energy["energy_j"].to_numpy())
    return {
        str(row["drone"]): {
            **{name: row[name] for name in ("soc", "voltage_v", "airborne")},
            "energy_j": float(spent[row["drone"]]),
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
    budget = f" ρ={row['rho']:.3g}" if row["representation"] == "features" else ""
    roi = "" if np.isnan(row["roi_radius_m"]) else f" in {row['roi_radius_m']:.0f} m"
    return f"{row['representation']}{budget} at {row['rate_hz']:g} Hz{roi}"


def transitions(directives: pa.Table, carried: dict[tuple[int, int], str]) -> Iterator[dict[str, Any]]:
    """Changes of what a link carries (a disc that moves is none); links of a drone that change alike in one entry.

    The same entries as `outcome.json` has, but in slices: `carried` is what each (drone, peer) carried before and is
    brought up to date. Each entry comes before the next one's changes are in `carried`.
    """
    entry: dict[str, Any] | None = None
    for row in directives.to_pylist():
        link, level = (row["drone"], row["peer"]), describe(row)
        before = carried.get(link, "nothing")
        if level == before:
            continue
        change = {"t_s": row["t_s"], "drone": row["drone"], "from": before, "to": level, "reason": row["reason"]}
        if entry is not None and all(entry[k] == v for k, v in change.items()):
            entry["peers"].append(row["peer"])
        else:
            if entry is not None:
                yield entry
            entry = {**change, "peers": [row["peer"]]}
        carried[link] = level
    if entry is not None:
        yield entry


def _phases(record: SortieRecord) -> Iterator[tuple[float, float, str]]:
    phases, end_s = record.scenario.mission.phases, record.scenario.duration_s
    for phase, following in zip(phases, [*phases[1:], None], strict=True):
        if phase.at_s < end_s:
            yield phase.at_s, min(end_s, following.at_s) if following else end_s, phase.phase


def _phase(record: SortieRecord, both: Both, begin_s: float, end_s: float, name: str) -> dict[str, Any]:
    sent = record.tables["transmissions"]
    sent = sent.filter(pc.and_(pc.greater_equal(sent["captured_s"], begin_s), pc.less(sent["captured_s"], end_s)))
    features = sent.filter(pc.equal(sent["representation"], "features"))
    return {
        "phase": name,
        "begin_s": begin_s,
        "end_s": end_s,
        "ap50": _accuracy(both, begin_s, end_s),
        "context": _context(record.tables["receptions"], begin_s, end_s),
        "data_rate_mbps": _sum(sent["payload_bytes"]) * 8e-6 / (end_s - begin_s),
        "feature_payload_bytes": _percentiles(pc.cast(features["payload_bytes"], pa.float64()))["p50"],
        "deadline_miss_rate": _miss_rate(sent),
    }
