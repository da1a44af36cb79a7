"""The context plane's cost by fleet size: its bytes beside the data plane's, and the time to decide."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sortie.policies.contract import Directive, FleetView
from sortie.policies.registry import resolve
from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.policy_text import policy_overrides
from sortie.sim.results.outcome import outcome

SCENARIO = "search_grid"
FLEETS = (5, 25, 100)
SECONDS = 6.0


@dataclass(frozen=True, slots=True)
class Overhead:
    """One policy at one size of fleet."""

    policy: str
    drones: int
    context_bytes_per_s: float
    """Descriptors and directives of the whole fleet, as sent."""
    data_bytes_per_s: float
    """Payloads of the whole fleet, as offered to the radio."""
    p50_ms: float
    p99_ms: float
    """CPU time of one drone's decision."""
    decisions: int

    @property
    def context_share(self) -> float:
        """Context bytes over all bytes."""
        return self.context_bytes_per_s / (self.context_bytes_per_s + self.data_bytes_per_s)


def measure(
    policy: str, drones: int, seconds: float = SECONDS, *, progress: Callable[[float], None] | None = None
) -> Overhead:
    """Fly the search with so many drones, without a detector, and time each decision; garbage collection is held off.

    Raises:
        PolicyError: an unknown policy.
    """
    sets = ["perception.detector=none", f"fleet.drones={drones}", f"duration_s={seconds}"]
    scenario = load(SCENARIO, [*sets, *policy_overrides(policy, load(SCENARIO).policy.name)])
    decide = resolve(scenario.policy.name, scenario.policy.params)
    took_ns: list[int] = []

    def timed(view: FleetView) -> Sequence[Directive]:
        decide(view)  # the caches are this decision's, not the simulator's
        begin_ns = time.thread_time_ns()
        directives = decide(view)
        took_ns.append(time.thread_time_ns() - begin_ns)
        return directives

    timed.__name__ = policy
    collecting = gc.isenabled()
    gc.disable()
    try:
        flown = outcome(run_sortie(scenario, timed, progress=progress))["bytes"]
    finally:
        if collecting:
            gc.enable()
    settled = took_ns[len(took_ns) // 2 :]  # by then every drone has heard every other
    p50_ms, p99_ms = (float(v) for v in np.percentile(settled, [50, 99]) / 1e6)
    return Overhead(
        policy, drones, flown["context_sent"] / seconds, flown["data_sent"] / seconds, p50_ms, p99_ms, len(settled)
    )


def host_s() -> float:
    """CPU time of a million additions in a plain loop, s: about 0.03 on an idle desktop; a crowded host takes longer."""
    begin_s, total = time.process_time(), 0
    for k in range(1_000_000):
        total += k
    return time.process_time() - begin_s
