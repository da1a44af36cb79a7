"""The paper's claims about the context plane's cost and its replayed traces, measured on a flown sortie.

The sortie is `paper_replay_contention`: the paper's 120 s with five drones instead of four, its directives enforced by gates and
its payloads handed to a radio. Names are those that the claims ask for (`research.paper.measures.Elsewhere`).
"""

from __future__ import annotations

import gc
import json
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from research.paper.verdict import MeasuredValue
from sortie.fleet.messages.wire import descriptor_bytes, encode_directive
from sortie.policies.contract import Directive, FleetView, Policy
from sortie.policies.registry import resolve
from sortie.scenarios.reading.load import load
from sortie.scenarios.regular import regular
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError
from sortie.sim.identity import machine
from sortie.sim.results.record import SortieRecord

SCENARIO = "paper_replay_contention"
PAPER_AGENTS, PAPER_HZ, PAPER_DIRECTIVES_HZ, PAPER_DEADLINE_MS = 4, 10, 80, 100.0
PHASE_CHANGE_S, LINK_DROP_S, TIRED, CUT_OFF = 45.0, 60.0, 1, 2
LADDER = [("features", 10.0), ("features", 5.0), ("detections", 2.0)]


def measure_plane(progress: Callable[[float], None] | None = None) -> dict[str, MeasuredValue]:
    """Fly the replay once without a detector (traffic needs none) and measure everything that it answers."""
    scenario = load(SCENARIO, ["perception.detector=none"])
    views: list[FleetView] = []
    decide = resolve(scenario.policy.name, scenario.policy.params)

    def watched(view: FleetView) -> Sequence[Directive]:
        views.append(view)
        return decide(view)

    record = run_sortie(scenario, watched, progress=progress)
    return {**rates(record), **transitions(record), **latency(decide, views, scenario)}


def rates(record: SortieRecord) -> dict[str, MeasuredValue]:
    """Bytes a second of both planes: as the paper counts them with this project's encoders, and as flown."""
    scenario, sent = record.scenario, record.tables["transmissions"]
    counted = PAPER_AGENTS * PAPER_HZ * descriptor_bytes(5) + PAPER_DIRECTIVES_HZ * len(
        encode_directive(Directive(0, 1))
    )
    context = record.totals["context_descriptor_bytes"] + record.totals["context_directive_bytes"]
    data = float(pc.sum(sent["payload_bytes"]).as_py() or 0)
    region_s = min([p.at_s for p in scenario.mission.phases if p.region is not None], default=scenario.duration_s)
    before = sent.filter(pc.less(sent["t_sent_s"], max(region_s, scenario.frame_s)))
    early = (pc.sum(before["payload_bytes"]).as_py() or 0) / max(region_s, scenario.frame_s) / 1e6
    signed = ", 28 B of authentication each" if scenario.context.authentication else ""
    flown = f"{scenario.fleet.drones} drones{signed}; directives are sent when they change"
    return {
        "descriptor_bytes": MeasuredValue(float(descriptor_bytes(5)), note="encoded, four peers"),
        "counted_kb_per_s": MeasuredValue(counted / 1e3, note="encoded sizes at the paper's rates"),
        "context_kb_per_s": MeasuredValue(context / scenario.duration_s / 1e3, note=flown),
        "data_mb_per_s": MeasuredValue(
            data / scenario.duration_s / 1e6,
            note=f"offered to the radio; {early:.0f} MB/s before the region. The paper's gates publish on one machine",
        ),
        "context_percent": MeasuredValue(100.0 * context / data, note="of the data plane as offered"),
    }


def transitions(record: SortieRecord) -> dict[str, MeasuredValue]:
    """What the phase change, the battery and the link drop did, from the record's tables."""
    sent, directives = record.tables["transmissions"], record.tables["directives"]
    features = sent.filter(pc.equal(sent["representation"], "features"))
    before = _mean_cells(features, 0.0, PHASE_CHANGE_S)
    after = _mean_cells(features, PHASE_CHANGE_S + 1.0, record.scenario.duration_s)
    return {
        "roi_shrinks": MeasuredValue(before / after, note=f"{before:.0f} cells a payload, then {after:.0f}"),
        "battery_rungs": MeasuredValue(
            float(rungs_met(_of(directives, TIRED))), note="features at 10 and 5 Hz, detections at 2 Hz"
        ),
        "link_drop_s": MeasuredValue(
            without_features_s(_of(directives, CUT_OFF), LINK_DROP_S), note="the last of its links"
        ),
    }


def rungs_met(directives: pa.Table) -> int:
    """How many rungs of the ladder a drone's gates stood on, in their order and for the battery's sake."""
    met = 0
    for row in directives.to_pylist():
        on = (row["representation"], row["rate_hz"])
        if met < len(LADDER) and on == LADDER[met] and row["reason"].startswith("battery"):
            met += 1
    return met


def without_features_s(directives: pa.Table, since_s: float) -> float:
    """Seconds from `since_s` until no outgoing link of the drone carries features; NaN if one always does."""
    carries: dict[int, str] = {}
    for row in directives.to_pylist():
        if row["t_s"] >= since_s and carries and "features" not in carries.values():
            break
        carries[row["peer"]] = row["representation"]
        last_s = row["t_s"]
    return float("nan") if not carries or "features" in carries.values() else max(0.0, last_s - since_s)


def latency(decide: Policy, views: Sequence[FleetView], scenario: Scenario) -> dict[str, MeasuredValue]:
    """CPU time of one tick of the policy for the whole fleet, over the views that were flown.

    The paper's policy node decides for all drones at each tick; here every drone decides for itself, so that a tick
    is as many decisions as there are drones, one after the other.
    """
    n = scenario.fleet.drones
    ticks = [views[i : i + n] for i in range(0, len(views) - n + 1, n)]
    took_ns = np.empty(len(ticks))
    collecting = gc.isenabled()
    gc.disable()
    try:
        for k, tick in enumerate(ticks):
            begin_ns = time.thread_time_ns()
            for view in tick:
                decide(view)
            took_ns[k] = time.thread_time_ns() - begin_ns
    finally:
        if collecting:
            gc.enable()
    p50, p99 = (float(v) for v in np.percentile(took_ns, [50, 99]) / 1e6)
    note = f"CPU time of {n} drones' decisions, {len(ticks)} ticks, {machine()}"
    return {
        "policy_ms_p50": MeasuredValue(p50, note=note),
        "policy_ms_p99": MeasuredValue(p99, note=note),
        "deadline_over_p50": MeasuredValue(PAPER_DEADLINE_MS / p50),
        **({"x86_policy_ms_p50": MeasuredValue(p50, note=note)} if _on_x86() else {}),
    }


def measured_live(path: Path) -> dict[str, MeasuredValue]:
    """What a live flight measured of the claims that take real processes on a real bus; the file is `sortie live --out`'s.

    Raises:
        RunError: the file cannot be read, or is none of these.
    """
    try:
        facts = json.loads(regular(path).read_text("utf-8"))
        note = f"{facts['drones']} processes on Cyclone DDS, {facts['policy']}, {facts['flown_s']:.0f} s, {facts['machine']}"
        core = MeasuredValue(
            float(facts["drones_cpu_percent"]), note=f"{note}; the bench took {facts['bench_cpu_percent']:.0f} %"
        )
        data = MeasuredValue(float(facts["data_bytes_per_s"]) / 1e6, note=f"{note}; goodput as in the simulated flight")
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"{path}: not what sortie live --out writes") from error
    return {"ros2_core_percent": core, **({"x86_container_mb_per_s": data} if _on_x86() else {})}


def _on_x86() -> bool:
    """Whether this machine may answer what the paper says of x86."""
    return platform.machine().lower() in ("x86_64", "amd64")


def _mean_cells(features: pa.Table, begin_s: float, end_s: float) -> float:
    t_s, cells = features["t_sent_s"].to_numpy(), features["cells"].to_numpy()
    return float(cells[(t_s >= begin_s) & (t_s < end_s)].mean())


def _of(directives: pa.Table, drone: int) -> pa.Table:
    return directives.filter(pc.equal(directives["drone"], drone)).sort_by("t_s")
