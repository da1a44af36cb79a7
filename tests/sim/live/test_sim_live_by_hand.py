"""The figures of a live flight, each worked out by hand, and what a live drone is given of its scenario and of its trace."""

from __future__ import annotations

import io
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import simpy
from memory_bus import MemoryBus
from record_by_hand import tables_of
from rich.console import Console
from sim_examples import example

from sortie.fleet.memory import PeerMemory
from sortie.fleet.plane import FleetRules
from sortie.perception.types import Capture
from sortie.policies.contract import Directive, Representation
from sortie.policies.staleness import LinkHealth
from sortie.sim.cli import live as live_command
from sortie.sim.export.topics import CONTEXT, PAYLOADS, Topic, TopicKind
from sortie.sim.live.bench import Bench, FleetReports
from sortie.sim.live.context import Published, Trace, _runs, _trace
from sortie.sim.live.node import LiveNode, Role
from sortie.sim.live.own_events import status_of
from sortie.sim.live.payload_message import pack_bytes
from sortie.sim.live.reports import Count, HealthChange, NewDirective, Notice, Report, SinceLastReport
from sortie.sim.live.result import LiveResult, Lost, overhead_rows, summarise
from sortie.sim.live.roles import RoleNode, RoleOrders
from sortie.sim.live.rules import guard_of, rules_of
from sortie.sim.live.seals import Seals
from sortie.sim.live.sentences import describe_changes
from sortie.sim.results.record import Recorder

FRESH, DEGRADED, DETACHED = LinkHealth.FRESH, LinkHealth.DEGRADED, LinkHealth.DETACHED
ORDER, FEATURES, COMPACT = TopicKind.DIRECTIVE, TopicKind.FEATURES, TopicKind.COMPACT


def report(drone: int, t_s: float, k: int, new: SinceLastReport, begin_s: float = 50.0, **more: Any) -> Report:
    """Counts that differ from one another and, by `k`, from those of other reports."""
    return Report(
        drone=drone, begin_s=begin_s, t_s=t_s, cpu_s=0.5 * k, published=20 * k, heard=30 * k, lost=4 * k, refused={"descriptor late": k},
        late_s=0.01 * k, sent={ORDER: Count(100 * k, 3600 * k), FEATURES: Count(40 * k, 9000 * k), COMPACT: Count(10 * k, 700 * k)},
        received={FEATURES: Count(30 * k, 8000 * k), COMPACT: Count(5 * k, 300 * k)}, new=new, **more,
    )  # fmt: skip


def summary(*late: Report, **changes: Any) -> LiveResult:
    """Three drones, ten seconds from 50 s on: drone 0 in two reports, drone 1 in one, drone 2 ends at 55 s."""
    fleet = FleetReports()
    for each in late:
        fleet.add(each, late=True)
    fleet.add(
        report(0, 52.0, 1, SinceLastReport([1_000_000], [0.1], [HealthChange(51.0, 0, 1, FRESH, 0.1)])), late=False
    )
    fleet.add(
        report(1, 60.0, 3, SinceLastReport(
            [3_000_000, 4_000_000], [0.4], [
                HealthChange(50.5, 1, 2, FRESH, 0.1), HealthChange(55.4, 1, 2, DEGRADED, 0.4), HealthChange(56.5, 1, 2, DETACHED, 1.5),
            ], [NewDirective(53.0, 1, 0, "features", 5.0, "far")], [Notice(54.0, 1, "noticed")],
        )), late=False,
    )  # fmt: skip
    fleet.add(
        report(0, 60.0, 2, SinceLastReport(
            [2_000_000], [0.2, 0.3], [
                HealthChange(52.0, 0, 2, DEGRADED, 0.4), HealthChange(52.5, 0, 2, FRESH, 0.1), HealthChange(55.3, 0, 2, DEGRADED, 0.3),
                HealthChange(56.0, 0, 2, DETACHED, 1.0),
            ], [
                NewDirective(51.0, 0, 1, "features", 10.0, "near"), NewDirective(51.5, 0, 1, "features", 10.0, "moved"),
                NewDirective(58.0, 0, 1, "none", 0.0, "gone"),
            ],
        ), fallbacks=7, policy_restarts=2), late=False,
    )  # fmt: skip
    bench = SimpleNamespace(
        cpu_s=0.25,
        of={
            TopicKind.CONTEXT: Count(80, 14_400), ORDER: Count(400, 16_000), FEATURES: Count(150, 2_000_000), COMPACT: Count(60, 1_040_000),
        }.__getitem__,
    )  # fmt: skip
    given = {"begin_s": 50.0, "flown_s": 10.0, "loss": 0.1, "lost": [Lost(2, 55.0, "was killed")], "interrupted": False}
    return summarise(example("fleet.drones=3", "policy={name: silence}"), bench, fleet, **(given | changes))  # type: ignore[arg-type]


def test_every_figure_of_a_live_flight_by_hand() -> None:
    found = summary()
    assert (found.scenario, found.policy, found.drones) == ("example", "silence", 3)
    assert (found.begin_s, found.flown_s, found.loss, found.interrupted) == (50.0, 10.0, 0.1, False)
    assert found.descriptor_bytes == 180.0
    assert found.directives_per_s == 40.0
    assert found.context_bytes_per_s == pytest.approx(3040.0)
    assert found.data_bytes_per_s == pytest.approx(304_000.0)
    assert found.context_share == pytest.approx(0.01)
    assert (found.decide_ms_p50, found.decide_ms_p99, found.decisions) == (2.5, pytest.approx(3.97), 4)
    assert found.data_age_ms_p50 == pytest.approx(250.0)
    assert [d._asdict() for d in found.each] == [
        {
            "drone": d, "cpu_percent": pytest.approx(5.0 * k), "published": 20 * k, "heard": 30 * k, "dropped_by_loss": 4 * k,
            "refused": {"descriptor late": k}, "payloads_arrived": 35 * k, "fallbacks": fallbacks, "policy_restarts": restarts,
            "publishes_within_s": 0.01 * k,
        }
        for d, k, fallbacks, restarts in ((0, 2, 7, 2), (1, 3, 0, 0))
    ]  # fmt: skip
    assert found.drones_cpu_percent == pytest.approx(25.0)
    assert found.bench_cpu_percent == pytest.approx(2.5)
    assert [h.t_s for h in found.health] == sorted(h.t_s for h in found.health)
    assert [o.t_s for o in found.orders] == [51.0, 51.5, 53.0, 58.0]
    assert found.notices == [Notice(54.0, 1, "noticed")]


def test_processor_time_counts_from_the_begin_of_each_process() -> None:
    """Drone 2 starts late and flies two seconds; its percentage is of these, and the total is of the whole flight."""
    found = summary(report(2, 60.0, 1, SinceLastReport(), begin_s=58.0))
    assert [(d.drone, d.cpu_percent) for d in found.each] == [(0, 10.0), (1, 15.0), (2, 25.0)]
    assert found.drones_cpu_percent == pytest.approx(30.0)


def test_each_kind_of_topic_has_its_rates_and_shares() -> None:
    """By the last report of each drone, five times the counts of `report` were sent and received."""
    context, order, features, compact = summary().topics
    assert [t.topics for t in (context, order, features, compact)] == [
        "/fleet/context", "/drone_*/to_drone_*/directive", "/drone_*/to_drone_*/features", "/drone_*/to_drone_*/compact",
    ]  # fmt: skip
    assert [t.qos.partition(",")[0] for t in (context, order, features, compact)] == [
        "best effort", "reliable", "best effort", "reliable",
    ]  # fmt: skip
    figures = [
        (t.samples_per_s, t.bytes_per_s, t.mean_bytes, t.heard_share, t.delivered_share)
        for t in (context, order, features, compact)
    ]
    assert figures == [
        (8.0, 1440.0, 180.0, pytest.approx(80 / 100), None),
        (40.0, 1600.0, 40.0, pytest.approx(400 / 500), None),
        (15.0, 200_000.0, pytest.approx(13_333.33, abs=0.01), pytest.approx(150 / 200), pytest.approx(150 / 200)),
        (
            6.0,
            104_000.0,
            pytest.approx(17_333.33, abs=0.01),
            1.0,
            pytest.approx(25 / 50),
        ),  # it heard what came after a report
    ]


def test_who_is_lost_is_noticed_by_each_of_the_others() -> None:
    (noticed,) = summary().noticed
    assert (noticed.drone, noticed.by) == (2, 2)
    assert noticed.degraded_s == pytest.approx((0.3, 0.4))
    assert noticed.detached_s == pytest.approx((1.0, 1.5))
    (unseen,) = summary(lost=[Lost(1, 59.5, "ended")]).noticed
    assert (unseen.degraded_s, unseen.detached_s, unseen.by) == (None, None, 0)


def test_the_time_to_notice_a_lost_drone_ends_at_its_return() -> None:
    """Drone 2 is back from 57 s on, and its context degrades and detaches once more."""
    again = SinceLastReport(
        health=[HealthChange(t_s, 0, 2, to, 0.1) for t_s, to in ((57.2, FRESH), (58.0, DEGRADED), (59.0, DETACHED))]
    )
    (noticed,) = summary(report(2, 60.0, 1, again, begin_s=57.0)).noticed
    assert noticed.degraded_s == pytest.approx((0.3, 0.4))
    assert noticed.detached_s == pytest.approx((1.0, 1.5))


def test_without_traffic_there_are_no_ratios() -> None:
    silent = SimpleNamespace(cpu_s=0.0, of=lambda kind: Count())
    found = summarise(
        example("fleet.drones=3"), silent, FleetReports(), begin_s=0.0, flown_s=4.0, loss=0.0, lost=[], interrupted=True  # type: ignore[arg-type]
    )  # fmt: skip
    assert (found.descriptor_bytes, found.context_share, found.decide_ms_p50, found.data_age_ms_p50) == (None,) * 4
    assert {(t.mean_bytes, t.heard_share, t.delivered_share) for t in found.topics} == {(None, None, None)}
    assert dict(overhead_rows(found))["context over data"] == "–"


def test_the_overhead_table_and_the_changes_are_the_result_s() -> None:
    found = summary()
    assert dict(overhead_rows(found)) == {
        "descriptor, serialised": "180 B", "descriptors a second": "8.0 of 3 drones", "directives a second": "40",
        "context plane": "3.0 kB/s", "data plane": "0.3 MB/s", "context over data": "1.00 %", "a decision, median": "2.500 ms",
        "a decision, 99th %": "3.970 ms", "of one core": "25 % by 3 drones, 2 % by the bench",
    }  # fmt: skip
    assert describe_changes(found) == [
        "  55.0 s  drone 2: its process was killed",
        "          drone 2 was degraded at the others after 0.30–0.40 s, detached after 1.00–1.50 s (2 of 2)",
        "contexts of peers went degraded 3 times, detached 2 times, and fresh again 1 times",
        "  51.0 s  drone 0 → 1: features at 10 Hz, because near",
        "  53.0 s  drone 1 → 0: features at 5 Hz, because far",
        "  54.0 s  drone 1: noticed",
        "  58.0 s  drone 0 → 1: nothing, because gone",
    ]


def test_the_command_prints_each_figure_in_its_column(monkeypatch: pytest.MonkeyPatch) -> None:
    console = Console(file=io.StringIO(), width=200)
    monkeypatch.setattr(live_command, "out", console)
    live_command._show(summary())
    text = console.file.getvalue()  # type: ignore[attr-defined]
    rows = [[cell.strip() for cell in line.strip("│┃").replace("┃", "│").split("│")] for line in text.splitlines()]
    for row in (
        ["topic", "QoS", "per s", "kB/s", "heard", "arrived"],
        ["/fleet/context", "best effort", "8.0", "1.4", "80.0%", "–"],
        ["/drone_*/…/directive", "reliable", "40.0", "1.6", "80.0%", "–"],
        ["/drone_*/…/features", "best effort", "15.0", "200.0", "75.0%", "75.0%"],
        ["/drone_*/…/compact", "reliable", "6.0", "104.0", "100.0%", "50.0%"],
        ["drone", "CPU", "published", "heard", "lost", "refused", "fallback", "publishes within"],
        ["0", "10.0 %", "40", "60", "8", "2 descriptor late", "7", "20 ms"],
        ["1", "15.0 %", "60", "90", "12", "3 descriptor late", "0", "30 ms"],
    ):
        assert row in rows, row
    assert "example, 50–60 s, silence, 10% of descriptors lost" in text
    assert "; 4 decisions" in text


def test_the_json_has_every_figure_by_name() -> None:
    made = summary().as_json()
    assert made["health"][0] == {"t_s": 50.5, "drone": 1, "peer": 2, "health": "fresh", "age_s": 0.1}
    assert made["orders"][0] == {
        "t_s": 51.0, "drone": 0, "peer": 1, "representation": "features", "rate_hz": 10.0, "reason": "near",
    }  # fmt: skip
    assert made["lost"] == [{"drone": 2, "t_s": 55.0, "how": "was killed"}]
    assert made["each"][1]["heard"] == 90
    assert made["topics"][2]["samples_per_s"] == 15.0


def test_a_process_that_came_back_is_counted_beside_the_one_that_was_lost() -> None:
    fleet = FleetReports()
    for k, late in ((1, False), (2, True), (3, True)):
        fleet.add(report(0, 50.0 + k, k, SinceLastReport([k])), late=late)
    assert [r.published for r in fleet.last.values()] == [20, 60]
    assert [new.decide_ns for new in fleet.news] == [[1], [2], [3]]


def test_the_bench_counts_samples_and_bytes_of_each_link_and_from_the_begin_on() -> None:
    bus = MemoryBus()
    bench = Bench(bus, 3)  # type: ignore[arg-type]
    bus.writer(CONTEXT).write(bytes(100))
    bench.begin()
    for topic, size in (
        (CONTEXT, 180),
        (Topic(ORDER, 0, 1), 36),
        (Topic(ORDER, 2, 1), 40),
        (Topic(FEATURES, 1, 0), 5000),
    ):
        bus.writer(topic).write(pack_bytes(bytes(size)) if topic.kind in PAYLOADS else bytes(size))
    bench.take()
    bus.writer(Topic(COMPACT, 2, 0)).write(b"no payload")
    bench.take()
    assert {topic: tuple(count) for topic, count in bench.counts.items() if count.samples} == {
        CONTEXT: (1, 180), Topic(ORDER, 0, 1): (1, 36), Topic(ORDER, 2, 1): (1, 40), Topic(FEATURES, 1, 0): (1, 5000),
        Topic(COMPACT, 2, 0): (1, 10),
    }  # fmt: skip
    assert bench.of(ORDER) == Count(2, 76)
    assert len(bench.counts) == 1 + 3 * 2 * 3


# --- what a drone is given --------------------------------------------------------------------------------------------


def test_the_rules_on_the_bus_are_the_scenario_s_own() -> None:
    """But for the hysteresis band: what is replayed went through it in the simulated flight."""
    scenario = example(
        "context={rate_hz: 5, degraded_after_periods: 4, detached_after_periods: 17, publish_every: 2, roster: true, trust: false}",
        "policy={name: silence, dwell_s: 0.7, hysteresis: 0.15}", "perception.compute_delay_s=0.06", "perception.code_bytes=3",
        "perception.thermal={}", "perception.scene.trucks=0.1", "fleet.makes=[{name: slow, drones: [1], compute_delay_s: 0.5}]",
    )  # fmt: skip
    rules = rules_of(scenario, 1.0, 4.0)
    assert rules == FleetRules(
        period_s=0.2, frames=15, degraded_after_periods=4, detached_after_periods=17, dwell_s=0.7, hysteresis=0.0,
        compute_delay_s=0.06, code_bytes=3, publish_every=2, trust=False, roster=True, makes=rules.makes, people=True, classes=True,
    )  # fmt: skip
    assert [rules.equipment(d).compute_delay_s for d in (0, 1)] == [0.06, 0.5]
    odd = example("duration_s=5.04")
    assert rules_of(odd, 0.0, odd.duration_s).frames == odd.frames == 51  # the last frame begins before the end
    plain = rules_of(example(), 0.0, 6.0)
    assert (plain.people, plain.classes, plain.frames) == (False, False, 60)


@pytest.mark.parametrize("rate_hz", [10.0, 5.0, 1.0])
def test_a_live_drone_acts_at_a_moment_of_its_own_in_the_first_10_ms_of_a_frame(rate_hz: float) -> None:
    """As the simulator's drones do. So a payload's deadline counts from no later than that."""
    orders = [RoleOrders(example(f"context.rate_hz={rate_hz}"), d, 0.0, None) for d in range(3)]
    moments = [RoleNode(Role.GATE, MemoryBus(), each)._agent._phase_s for each in orders]
    assert len({round(m, 9) for m in moments}) == 3
    assert 0.0 <= min(moments) < max(moments) < 0.01


def test_a_guard_judges_by_the_scenario_s_invariants_and_its_own_make_s_policy() -> None:
    scenario = example(
        "policy={name: silence, invariants: 'representation >= detections', shield: true}",
        "fleet.makes=[{name: other, drones: [1], policy: boxes}]", "fleet.drones=3",
    )  # fmt: skip
    guards = [guard_of(scenario, drone, simpy.Environment(), Recorder()) for drone in range(3)]
    assert [guard.__self__.policy.name for guard in guards] == ["silence", "boxes", "silence"]  # type: ignore[union-attr]
    assert [guard.__self__._keeper.shielded for guard in guards] == [True] * 3  # type: ignore[union-attr]
    assert guard_of(example("policy={name: silence}"), 0, simpy.Environment(), Recorder()) is None


def test_a_trace_has_the_drone_s_own_rows_and_the_time_of_their_frames() -> None:
    """Drone 1 of two: up for frames 1 and 2 of four of a tenth of a second, home-bound in its second descriptor."""
    said = [
        (0.004, 0, 0.9, 0.8, 0.7, [1.0], "search", 0.0, 0), (0.103, 1, 0.6, 0.5, 0.4, [2.0], "track", 5.0, 4),
        (0.208, 1, 0.3, 0.2, 0.1, [3.0], "landing", float("nan"), 0), (0.209, 0, 0.9, 0.8, 0.7, [4.0], "landing", 1.0, 4),
    ]  # fmt: skip
    names = (
        "t_s",
        "drone",
        "soc",
        "cpu_headroom",
        "gpu_headroom",
        "goodput_mbps",
        "phase",
        "region_x_m",
        "novelty_flags",
    )
    tables: dict[str, pa.Table] = tables_of({
        "descriptors": [dict(zip(names, row, strict=True)) for row in said],
        "states": [{"t_s": k / 10, "drone": d, "airborne": d == 0 or k in (1, 2)} for k in range(4) for d in range(2)],
        "events": [
            {"t_s": t_s, "drone": d, "kind": kind, "text": text} for t_s, d, kind, text in (
                (0.1, 1, "drone_joins", "joins"), (0.2, 0, "drone_lost", "not mine"), (0.25, 1, "lie", "not replayed"), (0.3, 1, "landed", "lands"),
            )
        ],
    })  # fmt: skip
    found = _trace(example("fleet.drones=2"), 1, None, (0.0, 1.0, 2.0, 3.0), tables)  # type: ignore[arg-type]
    assert found.t_s == pytest.approx((0.1, 0.2))
    assert [tuple(p.platform) for p in found.published] == [(0.6, 0.5, 0.4), (0.3, 0.2, 0.1)]
    assert [p.goodput_mbps for p in found.published] == [(2.0,), (3.0,)]
    assert [p.homebound for p in found.published] == [False, True]
    assert found.aloft == (pytest.approx((0.1, 0.3)),)
    assert found.events == ((0.1, "joins"), (0.3, "lands"))
    assert found.bounds == (0.0, 1.0, 2.0, 3.0)


def test_a_trace_says_what_was_published_last() -> None:
    said = tuple(Published(goodput_mbps=(float(k),)) for k in range(3))
    trace = Trace(None, (0.0,) * 4, (0.1, 0.2, 0.5), said)  # type: ignore[arg-type]
    for t_s, k in ((0.0, 0), (0.1, 0), (0.19, 0), (0.2, 1), (0.2 - 1e-9, 1), (0.49, 1), (0.5, 2), (9.0, 2)):
        assert trace.at(t_s) is said[k], t_s


@pytest.mark.parametrize(
    ("up", "spans"),
    [
        ([True, True], ((0.0, float("inf")),)),
        ([False, True, True, False, True], ((0.5, 1.5), (2.0, float("inf")))),
        ([True, False], ((0.0, 0.5),)),
        ([False], ()),
    ],
)
def test_frames_in_the_air_are_spans(up: list[bool], spans: tuple[tuple[float, float], ...]) -> None:
    assert _runs(np.array(up), 0.5) == spans


# --- what a node counts ---------------------------------------------------------------------------------------------


def node(bus: MemoryBus, drone: int, drones: int, **more: Any) -> LiveNode:
    scenario = example(f"fleet.drones={drones}", "context.authentication=false")
    made = LiveNode(bus, Seals(None, drone), drone, drones, seed=4, **more)  # type: ignore[arg-type]
    clock = SimpleNamespace(now=1.0)
    rules = rules_of(scenario, 0.0, 6.0)
    memory = PeerMemory(drone, rules, status_of(scenario, drone, time.time()))
    made.fly(clock, memory, rules, tuple)  # type: ignore[arg-type]
    return made


def test_a_node_counts_what_it_sends_by_kind_and_receives_from_its_own_links_alone() -> None:
    bus = MemoryBus()
    first, second, third = (node(bus, d, 3) for d in range(3))
    capture = Capture(0, 1.0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 60.0), 0.0)
    first.handshake(1, 24, capture, 0.1)
    first.handshake(1, 30, capture, 0.1)
    first.gate.enforce(Directive(0, 2, Representation.DETECTIONS, 0.0, None, 5.0, reason="x"))
    first.gate.republish()
    first.gate.republish()
    for each in (first, second, third):
        each.take()
    told = [each.report(2.0) for each in (first, second, third)]
    assert [(r.drone, r.begin_s, r.t_s) for r in told] == [(0, 1.0, 2.0), (1, 1.0, 2.0), (2, 1.0, 2.0)]
    assert told[0].sent == {ORDER: Count(2, 72), FEATURES: Count(2, 54), COMPACT: Count()}
    assert [r.received[FEATURES] for r in told] == [Count(), Count(2, 54), Count()]
    assert [r.received[COMPACT] for r in told] == [Count()] * 3
    assert first.gate.in_force(2) is not None  # its own gate reads it, and no other drone's
    assert second.gate.in_force(0) is None
    assert third.gate.in_force(0) is None


def test_each_health_of_a_peer_is_told_once_with_its_age() -> None:
    made = node(MemoryBus(), 0, 3)
    view = SimpleNamespace(peers=(1, 2))
    for ages in ({1: 0.1, 2: 5.0}, {1: 0.15, 2: 5.1}, {1: 0.45, 2: 0.1}, {1: 1.5, 2: 0.1}):
        view.age_s = ages
        made.note_health(view)  # type: ignore[arg-type]
    assert made.report(1.0).new.health == [
        HealthChange(1.0, 0, 1, FRESH, 0.1), HealthChange(1.0, 0, 1, DEGRADED, 0.45), HealthChange(1.0, 0, 2, FRESH, 0.1),
        HealthChange(1.0, 0, 1, DETACHED, 1.5),
    ]  # fmt: skip
    assert made.report(2.0).new.health == []


def test_descriptors_are_lost_by_draws_of_each_link_s_own() -> None:
    made, other = node(MemoryBus(), 0, 4, loss=0.5), node(MemoryBus(), 1, 4, loss=0.5)
    draws = [made._loss_stream(2).random(40), made._loss_stream(3).random(40), other._loss_stream(2).random(40)]
    again = made._loss_stream(2).random(40)
    for k, one in enumerate([*draws, again]):
        for two in [*draws, again][k + 1 :]:
            assert len(set(one.tolist()) & set(two.tolist())) == 0
