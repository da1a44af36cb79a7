"""What a live flight came to: bytes, decision time and processor time, and who was lost."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from sortie.policies.staleness import LinkHealth
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.pilot import named_policy
from sortie.sim.export.topics import CONTEXT, PAYLOADS, Topic, TopicKind
from sortie.sim.identity import machine
from sortie.sim.live.bench import Bench, FleetReports
from sortie.sim.live.reports import HealthChange, NewDirective, Notice, Report


class Lost(NamedTuple):
    """A process that ended in the air."""

    drone: int
    t_s: float
    how: str


class DroneResult(NamedTuple):
    """One drone's process."""

    drone: int
    cpu_percent: float
    """Of one core, all threads, from the process's begin to its last report."""
    published: int
    heard: int
    dropped_by_loss: int
    refused: dict[str, int]
    payloads_arrived: int
    """Accepted payloads, of all kinds."""
    fallbacks: int
    """Decisions by the fallback, because the policy gave none in time."""
    policy_restarts: int
    publishes_within_s: float
    """From a frame's begin to its descriptor, at most."""


class TopicRate(NamedTuple):
    """One kind of topic, all of them together, as the bench heard them."""

    topics: str
    type: str
    qos: str
    samples_per_s: float
    bytes_per_s: float
    mean_bytes: float | None
    heard_share: float | None
    """Of what the drones' last reports say was published, the bench heard so much."""
    delivered_share: float | None
    """Of payloads, so many came in at the drones that they were for."""


class Noticed(NamedTuple):
    """How the other drones noticed a lost drone: the first and the last of them, in seconds after the loss."""

    drone: int
    degraded_s: tuple[float, float] | None
    detached_s: tuple[float, float] | None
    by: int
    """The number of other drones that detached it."""


@dataclass(frozen=True, slots=True)
class LiveResult:
    """The measurements of a live flight."""

    scenario: str
    policy: str
    drones: int
    begin_s: float
    flown_s: float
    loss: float
    interrupted: bool
    machine: str
    topics: list[TopicRate]
    descriptor_bytes: float | None
    directives_per_s: float
    context_bytes_per_s: float
    """Descriptors and directives, as serialised."""
    data_bytes_per_s: float
    """Payloads, as the bench received them."""
    context_share: float | None
    """Context over data."""
    decide_ms_p50: float | None
    """Processor time of one drone's decision."""
    decide_ms_p99: float | None
    decisions: int
    data_age_ms_p50: float | None
    """From a capture to its payload's arrival, compute delay included."""
    drones_cpu_percent: float
    """All drones' processes together, of one core, over the whole flight."""
    bench_cpu_percent: float
    each: list[DroneResult]
    lost: list[Lost]
    noticed: list[Noticed]
    health: list[HealthChange]
    """Fresh, degraded, detached: by drone and peer, as time goes."""
    orders: list[NewDirective]
    notices: list[Notice]

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        plain = asdict(self)
        for name in ("topics", "each", "lost", "noticed", "orders", "notices"):
            plain[name] = [row._asdict() for row in getattr(self, name)]
        plain["health"] = [{**row._asdict(), "health": row.health.name.lower()} for row in self.health]
        return plain


def summarise(
    scenario: Scenario,
    bench: Bench,
    fleet: FleetReports,
    *,
    begin_s: float,
    flown_s: float,
    loss: float,
    lost: Sequence[Lost],
    interrupted: bool,
) -> LiveResult:
    """Combine the bench's counts and the drones' reports; `flown_s` is the wall-clock time in the air."""
    decide_ms = np.array([ns for new in fleet.news for ns in new.decide_ns]) / 1e6
    data_age_ms = np.array([s for new in fleet.news for s in new.data_age_s]) * 1e3
    health = sorted(c for new in fleet.news for c in new.health)
    context, directives = bench.of(TopicKind.CONTEXT), bench.of(TopicKind.DIRECTIVE)
    data_bytes = sum(bench.of(kind).bytes for kind in PAYLOADS)
    context_bytes = context.bytes + directives.bytes
    each = [
        DroneResult(
            r.drone,
            100 * r.cpu_s / max(r.t_s - r.begin_s, 1e-9),
            r.published,
            r.heard,
            r.lost,
            r.refused,
            sum(r.received[kind].samples for kind in PAYLOADS),
            r.fallbacks,
            r.policy_restarts,
            r.late_s,
        )
        for r in fleet.last.values()
    ]
    return LiveResult(
        scenario=scenario.name,
        policy=named_policy(scenario.policy.name, scenario.policy.params).name,
        drones=scenario.fleet.drones,
        begin_s=begin_s,
        flown_s=flown_s,
        loss=loss,
        interrupted=interrupted,
        machine=machine(),
        topics=list(_topics(bench, fleet, flown_s)),
        descriptor_bytes=context.bytes / context.samples if context.samples else None,
        directives_per_s=directives.samples / flown_s,
        context_bytes_per_s=context_bytes / flown_s,
        data_bytes_per_s=data_bytes / flown_s,
        context_share=context_bytes / data_bytes if data_bytes else None,
        decide_ms_p50=_percentile(decide_ms, 50),
        decide_ms_p99=_percentile(decide_ms, 99),
        decisions=len(decide_ms),
        data_age_ms_p50=_percentile(data_age_ms, 50),
        drones_cpu_percent=100 * sum(r.cpu_s for r in fleet.last.values()) / flown_s,
        bench_cpu_percent=100 * bench.cpu_s / flown_s,
        each=sorted(each),
        lost=list(lost),
        noticed=[_time_to_notice(gone, health, fleet.last.values()) for gone in lost],
        health=health,
        orders=sorted(o for new in fleet.news for o in new.orders),
        notices=sorted(n for new in fleet.news for n in new.notices),
    )


def overhead_rows(result: LiveResult) -> Iterator[tuple[str, str]]:
    """What the plane cost: quantity and figure, in the order of the paper's paragraph on overhead."""
    descriptors = f"{result.topics[0].samples_per_s:.1f} of {result.drones} drones"
    share = None if result.context_share is None else 100 * result.context_share
    cpu = f"{result.drones_cpu_percent:.0f} % by {result.drones} drones, {result.bench_cpu_percent:.0f} % by the bench"
    yield "descriptor, serialised", _figure(result.descriptor_bytes, "{:.0f} B")
    yield "descriptors a second", descriptors
    yield "directives a second", f"{result.directives_per_s:.0f}"
    yield "context plane", f"{result.context_bytes_per_s / 1e3:.1f} kB/s"
    yield "data plane", f"{result.data_bytes_per_s / 1e6:.1f} MB/s"
    yield "context over data", _figure(share, "{:.2f} %")
    yield "a decision, median", _figure(result.decide_ms_p50, "{:.3f} ms")
    yield "a decision, 99th %", _figure(result.decide_ms_p99, "{:.3f} ms")
    yield "of one core", cpu


def _figure(value: float | None, text: str) -> str:
    return "–" if value is None else text.format(value)


def _percentile(values: np.ndarray, percent: float) -> float | None:
    return float(np.percentile(values, percent)) if len(values) else None


def _topics(bench: Bench, fleet: FleetReports, flown_s: float) -> Iterator[TopicRate]:
    for kind in TopicKind:
        topic = CONTEXT if kind == TopicKind.CONTEXT else Topic(kind, 0, 1)
        name = topic.name.replace("drone_0", "drone_*").replace("drone_1", "drone_*")
        count = bench.of(kind)
        if kind == TopicKind.CONTEXT:
            sent = sum(r.published for r in fleet.last.values())
        else:
            sent = sum(r.sent[kind].samples for r in fleet.last.values())
        yield TopicRate(
            name,
            kind.ros_type,
            ("reliable" if kind.reliable else "best effort") + ", keep last 1",
            count.samples / flown_s,
            count.bytes / flown_s,
            count.bytes / count.samples if count.samples else None,
            min(1.0, count.samples / sent) if sent else None,
            min(1.0, sum(r.received[kind].samples for r in fleet.last.values()) / sent)
            if sent and kind in PAYLOADS
            else None,
        )


def _time_to_notice(gone: Lost, health: Sequence[HealthChange], reports: Iterable[Report]) -> Noticed:
    """When the others degraded and detached the context of a lost drone, up to its return."""
    back_s = min((r.begin_s for r in reports if r.drone == gone.drone and r.begin_s > gone.t_s), default=math.inf)
    after = [c for c in health if c.peer == gone.drone and gone.t_s - 1.0 < c.t_s < back_s]
    # the last change of each of the others is the one that lasts
    last: dict[int, dict[LinkHealth, float]] = {}
    for c in after:
        last.setdefault(c.drone, {})[c.health] = max(0.0, c.t_s - gone.t_s)
    degraded = [at[LinkHealth.DEGRADED] for at in last.values() if LinkHealth.DEGRADED in at]
    detached = [at[LinkHealth.DETACHED] for at in last.values() if LinkHealth.DETACHED in at]
    return Noticed(
        gone.drone,
        (min(degraded), max(degraded)) if degraded else None,
        (min(detached), max(detached)) if detached else None,
        len(detached),
    )
