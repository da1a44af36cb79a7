"""The figures of a live flight, each worked out by hand, and what a live drone gets of its scenario and its trace."""

from __future__ import annotations

import io
import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import simpy
from cli_examples import table_rows
from memory_bus import MemoryBus
from record_by_hand import tables_of
from rich.console import Console
from sim_examples import example

from sortie.fleet.plane import FleetRules
from sortie.policies.staleness import LinkHealth
from sortie.sim.cli import live as live_command
from sortie.sim.export.topics import CONTEXT, PAYLOADS, Topic, TopicKind
from sortie.sim.live.bench import Bench, FleetReports
from sortie.sim.live.context import Published, Trace, _runs, _trace
from sortie.sim.live.node import Role
from sortie.sim.live.payload_message import pack_bytes
from sortie.sim.live.reports import Count, HealthChange, NewDirective, Notice, Report, SinceLastReport
from sortie.sim.live.result import LiveResult, Lost, overhead_rows, summarise
from sortie.sim.live.roles import RoleNode, RoleOrders
from sortie.sim.live.rules import guard_of, rules_of
from sortie.sim.live.sentences import describe_changes
from sortie.sim.results.record import Recorder

FRESH, DEGRADED, DETACHED = LinkHealth.FRESH, LinkHealth.DEGRADED, LinkHealth.DETACHED
ORDER, FEATURES, COMPACT = TopicKind.DIRECTIVE, TopicKind.FEATURES, TopicKind.COMPACT


def report(drone: int, t_s: float, k: int, new: SinceLastReport, begin_s: float = 50.0, **more: Any) -> Report:
    """Counts that differ from one another and, by `k`, from those of other reports."""
    sent = {ORDER: Count(100 * k, 3600 * k), FEATURES: Count(40 * k, 9000 * k), COMPACT: Count(10 * k, 700 * k)}
    received = {FEATURES: Count(30 * k, 8000 * k), COMPACT: Count(5 * k, 300 * k)}
    counts = {"published": 20 * k, "heard": 30 * k, "lost": 4 * k, "refused": {"descriptor late": k}}
    times = {"begin_s": begin_s, "t_s": t_s, "cpu_s": 0.5 * k, "late_s": 0.01 * k}
    return Report(drone=drone, **times, **counts, sent=sent, received=received, new=new, **more)


def changes(drone: int, peer: int, *rows: tuple[float, LinkHealth, float]) -> list[HealthChange]:
    """Of one link: when, to what, and at which age."""
    return [HealthChange(t_s, drone, peer, health, age_s) for t_s, health, age_s in rows]


def summary(*late: Report, **more: Any) -> LiveResult:
    """Three drones, ten seconds from 50 s on: drone 0 in two reports, drone 1 in one, drone 2 ends at 55 s."""
    fleet = FleetReports()
    for each in late:
        fleet.add(each, late=True)
    first = SinceLastReport([1_000_000], [0.1], changes(0, 1, (51.0, FRESH, 0.1)))
    of_drone_1 = SinceLastReport(
        [3_000_000, 4_000_000],
        [0.4],
        changes(1, 2, (50.5, FRESH, 0.1), (55.4, DEGRADED, 0.4), (56.5, DETACHED, 1.5)),
        [NewDirective(53.0, 1, 0, "features", 5.0, "far")],
        [Notice(54.0, 1, "noticed")],
    )
    second = SinceLastReport(
        [2_000_000],
        [0.2, 0.3],
        changes(0, 2, (52.0, DEGRADED, 0.4), (52.5, FRESH, 0.1), (55.3, DEGRADED, 0.3), (56.0, DETACHED, 1.0)),
        [
            NewDirective(51.0, 0, 1, "features", 10.0, "near"),
            NewDirective(51.5, 0, 1, "features", 10.0, "moved"),
            NewDirective(58.0, 0, 1, "none", 0.0, "gone"),
        ],
    )
    fleet.add(report(0, 52.0, 1, first), late=False)
    fleet.add(report(1, 60.0, 3, of_drone_1), late=False)
    fleet.add(report(0, 60.0, 2, second, fallbacks=7, policy_restarts=2), late=False)
    counts = {TopicKind.CONTEXT: Count(80, 14_400), ORDER: Count(400, 16_000)}
    counts |= {FEATURES: Count(150, 2_000_000), COMPACT: Count(60, 1_040_000)}
    bench: Any = SimpleNamespace(cpu_s=0.25, of=counts.__getitem__)
    given = {"begin_s": 50.0, "flown_s": 10.0, "loss": 0.1, "lost": [Lost(2, 55.0, "was killed")], "interrupted": False}
    return summarise(example("fleet.drones=3", "policy={name: silence}"), bench, fleet, **(given | more))


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
    for each, (drone, k, fallbacks, restarts) in zip(found.each, ((0, 2, 7, 2), (1, 3, 0, 0)), strict=True):
        assert (each.drone, each.fallbacks, each.policy_restarts) == (drone, fallbacks, restarts)
        assert each.cpu_percent == pytest.approx(5.0 * k)
        assert (each.published, each.heard, each.dropped_by_loss, each.payloads_arrived) == (
            20 * k,
            30 * k,
            4 * k,
            35 * k,
        )
        assert (each.refused, each.publishes_within_s) == ({"descriptor late": k}, 0.01 * k)
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
    topics = summary().topics
    links = [f"/drone_*/to_drone_*/{name}" for name in ("directive", "features", "compact")]
    assert [t.topics for t in topics] == ["/fleet/context", *links]
    assert [t.qos.partition(",")[0] for t in topics] == ["best effort", "reliable"] * 2
    near = pytest.approx
    assert [(t.samples_per_s, t.bytes_per_s, t.mean_bytes, t.heard_share, t.delivered_share) for t in topics] == [
        (8.0, 1440.0, 180.0, near(80 / 100), None),
        (40.0, 1600.0, 40.0, near(400 / 500), None),
        (15.0, 200_000.0, near(13_333.33, abs=0.01), near(150 / 200), near(150 / 200)),
        (6.0, 104_000.0, near(17_333.33, abs=0.01), 1.0, near(25 / 50)),  # it heard what came after a report
    ]


def test_who_is_lost_is_noticed_by_each_of_the_others_until_it_returns() -> None:
    """With the second flight drone 2 is back from 57 s on, and its context degrades and detaches once more."""
    again = SinceLastReport(health=changes(0, 2, (57.2, FRESH, 0.1), (58.0, DEGRADED, 0.1), (59.0, DETACHED, 0.1)))
    for late in ([], [report(2, 60.0, 1, again, begin_s=57.0)]):
        (noticed,) = summary(*late).noticed
        assert (noticed.drone, noticed.by) == (2, 2)
        assert noticed.degraded_s == pytest.approx((0.3, 0.4))
        assert noticed.detached_s == pytest.approx((1.0, 1.5))
    (unseen,) = summary(lost=[Lost(1, 59.5, "ended")]).noticed
    assert (unseen.degraded_s, unseen.detached_s, unseen.by) == (None, None, 0)


def test_without_traffic_there_are_no_ratios() -> None:
    silent: Any = SimpleNamespace(cpu_s=0.0, of=lambda kind: Count())
    given = {"begin_s": 0.0, "flown_s": 4.0, "loss": 0.0, "lost": [], "interrupted": True}
    found = summarise(example("fleet.drones=3"), silent, FleetReports(), **given)  # type: ignore[arg-type]
    assert (found.descriptor_bytes, found.context_share, found.decide_ms_p50, found.data_age_ms_p50) == (None,) * 4
    assert {(t.mean_bytes, t.heard_share, t.delivered_share) for t in found.topics} == {(None, None, None)}
    assert dict(overhead_rows(found))["context over data"] == "–"


def test_the_overhead_table_and_the_changes_are_the_result_s() -> None:
    found = summary()
    rates = {"descriptors a second": "8.0 of 3 drones", "directives a second": "40", "context plane": "3.0 kB/s"}
    rates |= {"descriptor, serialised": "180 B", "data plane": "0.3 MB/s", "context over data": "1.00 %"}
    times = {"a decision, median": "2.500 ms", "a decision, 99th %": "3.970 ms"}
    assert dict(overhead_rows(found)) == {**rates, **times, "of one core": "25 % by 3 drones, 2 % by the bench"}
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
    rows = table_rows(text)
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
    sizes = {CONTEXT: 180, Topic(ORDER, 0, 1): 36, Topic(ORDER, 2, 1): 40, Topic(FEATURES, 1, 0): 5000}
    for topic, size in sizes.items():
        bus.writer(topic).write(pack_bytes(bytes(size)) if topic.kind in PAYLOADS else bytes(size))
    bench.take()
    bus.writer(Topic(COMPACT, 2, 0)).write(b"no payload")
    bench.take()
    sizes[Topic(COMPACT, 2, 0)] = 10
    counted = {topic: tuple(count) for topic, count in bench.counts.items() if count.samples}
    assert counted == {topic: (1, size) for topic, size in sizes.items()}
    assert bench.of(ORDER) == Count(2, 76)
    assert len(bench.counts) == 1 + 3 * 2 * 3


# --- what a drone is given --------------------------------------------------------------------------------------------


def test_the_rules_on_the_bus_are_the_scenario_s_own() -> None:
    """But for the hysteresis band: what is replayed went through it in the simulated flight."""
    context = {"degraded_after_periods": 4, "detached_after_periods": 17, "publish_every": 2, "roster": True}
    scenario = example(
        f"context={json.dumps({**context, 'rate_hz': 5, 'trust': False})}",
        "policy={name: silence, dwell_s: 0.7, hysteresis: 0.15}",
        "perception={detector: none, compute_delay_s: 0.06, code_bytes: 3, thermal: {}, scene: {trucks: 0.1}}",
        "fleet.makes=[{name: slow, drones: [1], compute_delay_s: 0.5}]",
    )
    rules = rules_of(scenario, 1.0, 4.0)
    wanted = {**context, "period_s": 0.2, "frames": 15, "trust": False, "dwell_s": 0.7, "hysteresis": 0.0}
    wanted |= {"compute_delay_s": 0.06, "code_bytes": 3, "people": True, "classes": True}
    assert rules == FleetRules(**wanted, makes=rules.makes)
    assert [rules.equipment(d).compute_delay_s for d in (0, 1)] == [0.06, 0.5]
    odd = example("duration_s=5.04")
    assert rules_of(odd, 0.0, odd.duration_s).frames == odd.frames == 51  # the last frame begins before the end
    plain = rules_of(example(), 0.0, 6.0)
    assert (plain.people, plain.classes, plain.frames) == (False, False, 60)


def test_a_live_drone_acts_at_a_moment_of_its_own_in_the_first_10_ms_of_a_frame() -> None:
    """As the simulator's drones do. So a payload's deadline counts from no later than that."""
    for rate_hz in (10.0, 1.0):
        orders = [RoleOrders(example(f"context.rate_hz={rate_hz}"), d, 0.0, None) for d in range(3)]
        moments = [RoleNode(Role.GATE, MemoryBus(), each)._agent._phase_s for each in orders]
        assert len({round(m, 9) for m in moments}) == 3
        assert 0.0 <= min(moments) < max(moments) < 0.01


def test_a_guard_judges_by_the_scenario_s_invariants_and_its_own_make_s_policy() -> None:
    scenario = example(
        "policy={name: silence, invariants: 'representation >= detections', shield: true}",
        "fleet.makes=[{name: other, drones: [1], policy: boxes}]",
        "fleet.drones=3",
    )
    guards = [guard_of(scenario, drone, simpy.Environment(), Recorder()) for drone in range(3)]
    assert [guard.__self__.policy.name for guard in guards] == ["silence", "boxes", "silence"]
    assert [guard.__self__._keeper.shielded for guard in guards] == [True] * 3  # type: ignore[union-attr]
    assert guard_of(example("policy={name: silence}"), 0, simpy.Environment(), Recorder()) is None


def test_a_trace_has_the_drone_s_own_rows_and_the_time_of_their_frames() -> None:
    """Drone 1 of two: up for frames 1 and 2 of four of a tenth of a second, home-bound in its second descriptor."""
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
    said: list[tuple[Any, ...]] = [
        (0.004, 0, 0.9, 0.8, 0.7, [1.0], "search", 0.0, 0),
        (0.103, 1, 0.6, 0.5, 0.4, [2.0], "track", 5.0, 4),
        (0.208, 1, 0.3, 0.2, 0.1, [3.0], "landing", float("nan"), 0),
        (0.209, 0, 0.9, 0.8, 0.7, [4.0], "landing", 1.0, 4),
    ]
    happened = [
        (0.1, 1, "drone_joins", "joins"),
        (0.2, 0, "drone_lost", "not mine"),
        (0.25, 1, "lie", "not replayed"),
        (0.3, 1, "landed", "lands"),
    ]
    tables: dict[str, pa.Table] = tables_of(
        {
            "descriptors": [dict(zip(names, row, strict=True)) for row in said],
            "states": [
                {"t_s": k / 10, "drone": d, "airborne": d == 0 or k in (1, 2)} for k in range(4) for d in range(2)
            ],
            "events": [dict(zip(("t_s", "drone", "kind", "text"), row, strict=True)) for row in happened],
        }
    )
    found = _trace(example("fleet.drones=2"), 1, None, (0.0, 1.0, 2.0, 3.0), tables)  # type: ignore[arg-type]
    assert found.t_s == pytest.approx((0.1, 0.2))
    assert [tuple(p.platform) for p in found.published] == [(0.6, 0.5, 0.4), (0.3, 0.2, 0.1)]
    assert [p.goodput_mbps for p in found.published] == [(2.0,), (3.0,)]
    assert [p.homebound for p in found.published] == [False, True]
    assert found.aloft == (pytest.approx((0.1, 0.3)),)
    assert found.events == ((0.1, "joins"), (0.3, "lands"))
    assert found.bounds == (0.0, 1.0, 2.0, 3.0)


def test_a_trace_says_what_was_published_last_and_frames_in_the_air_are_spans() -> None:
    said = tuple(Published(goodput_mbps=(float(k),)) for k in range(3))
    trace = Trace(None, (0.0,) * 4, (0.1, 0.2, 0.5), said)  # type: ignore[arg-type]
    for t_s, k in ((0.0, 0), (0.1, 0), (0.19, 0), (0.2, 1), (0.49, 1), (0.5, 2), (9.0, 2)):
        assert trace.at(t_s) is said[k], t_s
    on = float("inf")
    for up, spans in (
        ([True, True], ((0.0, on),)),
        ([False, True, True, False, True], ((0.5, 1.5), (2.0, on))),
        ([True, False], ((0.0, 0.5),)),
        ([False], ()),
    ):
        assert _runs(np.array(up), 0.5) == spans
