"""Every measured figure of the pages: the list, and the command that measures and renders them (`make figures`).

    python -m research.validation.figures [NAME …]     measure these, or all of them, cheapest first, and render the pages
    python -m research.validation.figures --list       names, and how many minutes each takes on two cores
    python -m research.validation.figures --render     write the stored tables into the pages; measures nothing

What is measured goes to research/tables/NAME.json (`stored.py`). A page shows a table where it has its markers.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from research.validation.stored import FOLDER, MARKED, ROOT, Column, Table, rendered, save, sections
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Directive, FleetView, Policy, Representation
from sortie.scenarios.intervals import SHARE, mean_interval
from sortie.scenarios.reading.load import load, load_conditions
from sortie.scenarios.shipped import NETWORKS, SHIPPED_WEIGHTS
from sortie.sim.folders import write_text

PICTURES = ROOT / "research/pages/validation"
WORK = ROOT / "runs/figures"
"""What long measurements keep, so that a run that was cut off goes on."""
Tables = Mapping[str, Table | str]


@dataclass(frozen=True, slots=True)
class Figure:
    """One file of tables, and what measures it."""

    minutes: float
    """On two cores."""
    measure: Callable[[], Tables | None]
    """None where a command writes its own tables and pages."""
    timed: bool = False
    """Times of this host are measured; the page names it."""
    network: bool = False
    """What the default network, or its surrogate, finds is measured; the page names it."""


# --- by the scripts beside this one -----------------------------------------------------------------


def _liars() -> Tables:
    from research.validation import liars

    return liars.tables(range(1, 3), 40.0)


def _context_forms() -> Tables:
    from research.validation import minimal_context
    from sortie.sim.experiment.compare import BLOCK_S

    rows = list(minimal_context.measure(range(1, 3), 40.0))
    return {
        "context_forms": minimal_context.table(
            rows, f"Two sorties of 40 s for each row; intervals over blocks of {BLOCK_S:g} s of the sorties."
        )
    }


def _disagreement() -> Tables:
    from research.validation import disagreement

    return {"disagreement": disagreement.table()}


def _views_cost() -> Tables:
    from research.validation import disagreement

    return {"views_cost": disagreement.cost()}


def _viewpoints() -> Tables:
    from research.validation import repositions

    rows = list(repositions.measure(range(1, 9), 60.0))
    return {"viewpoints": repositions.table(rows, "Eight sorties of 60 s in eight towns; intervals over sorties.")}


def _fusion_age() -> Tables:
    from research.validation import fusion_age
    from sortie.perception.network.checkpoint import load_weights

    rows = fusion_age.measure(load_weights(SHIPPED_WEIGHTS), scenes=16, frames=2)
    return {
        "fusion_age": fusion_age.table(rows, "16 test scenes of two frames, five egos each; intervals over scenes.")
    }


def _join_rules() -> Tables:
    from research.validation import join_rules

    return {"join_rules": join_rules.table()}


def _late_shares() -> Tables:
    from research.validation import late_shares

    return {"late_shares": late_shares.table(towns=120)}


def _fusion_methods() -> Tables:
    """Trains the methods that are not shipped for 120 steps from the study's `full-0`, then evaluates all of them."""
    from research.benchmark.dataset import Benchmark, load_frames, make_split
    from research.validation import fusion_comparison
    from sortie.perception.network.checkpoint import load_weights

    files = {"disconet": NETWORKS / "disconet.safetensors"}  # trained as the others are
    for method in ("fcooper", "where2comm", "v2vnet"):
        files[method] = WORK / f"{method}.safetensors"
        _sortie(
            "train", "--fusion", method, "--steps", "120", "--peak-lr", "0.001", "--out", files[method],
            "--warm-start", ROOT / "research/flip/weights/full-0.safetensors",
        )  # fmt: skip
    split = make_split(Benchmark(), "test", ROOT / "runs/bench", scenes=30)
    rows = fusion_comparison.measure({name: load_weights(path) for name, path in files.items()}, load_frames(split))
    return {"fusion_methods": fusion_comparison.table(rows, "30 frames of the test split; intervals over scenes.")}


def _representations() -> Tables:
    """Needs the codebook and the box errors that lie beside the shipped weights (`python -m research fit`)."""
    from research.validation import representations

    return representations.tables(ROOT / "research/pages/representations.png", ROOT / "runs/bench")


def _track_prediction() -> Tables:
    from research.validation import track_prediction

    return track_prediction.tables()


def _handshakes() -> Tables:
    from research.benchmark.dataset import Benchmark, load_frames, make_split
    from research.validation import handshakes
    from sortie.perception.network.checkpoint import load_weights
    from sortie.perception.network.detector import shipped

    split = make_split(Benchmark(), "test", ROOT / "runs/bench", scenes=60)
    rows = handshakes.measure(load_weights(shipped("when2com")), load_frames(split), workers=2)
    about = "60 frames of the test split, five egos each; intervals over scenes, differences in points of AP."
    return {"handshakes": handshakes.table(rows, about)}


def _requests() -> Tables:
    from research.benchmark.dataset import Benchmark, load_frames, make_split
    from research.validation import requests_of_cells
    from sortie.perception.network.checkpoint import load_weights
    from sortie.perception.network.detector import shipped

    split = make_split(Benchmark(), "test", ROOT / "runs/bench", scenes=60)
    rows = requests_of_cells.measure(load_weights(shipped("where2comm")), load_frames(split), workers=2)
    about = "60 frames of the test split, five egos each; intervals over scenes, differences in points of AP."
    return {"requests": requests_of_cells.table(rows, about)}


def _link() -> Tables:
    from research.validation import link

    link.draw(PICTURES / "link.png")
    return link.tables()


def _radio_scale() -> Tables:
    from research.validation import link

    return link.scale_tables()


def _ns3() -> Tables:
    from research.validation.ns3 import wifi_compare

    return wifi_compare.tables()


def _ns3_drawn() -> Tables:
    from research.validation.ns3 import wifi_drawn

    return {"ns3_drawn": wifi_drawn.table(seed=20261124, plans=12)}


def _transport() -> Tables:
    from research.validation import transport

    return transport.tables(PICTURES / "transport_framing.png")


def _energy() -> Tables:
    from research.validation import energy

    energy.draw_effects(PICTURES)
    return energy.tables()


def _flight() -> Tables:
    from research.validation import energy

    energy.draw_flight(energy.read_log(energy.LOG), PICTURES)
    return energy.flight_tables(energy.LOG)


# --- policies over conditions -----------------------------------------------------------------------


def _over_conditions(name: str, policies: Sequence[str], *sets: str, by_torch: bool = False) -> Table:
    """As `sortie compare NAME --policies …`: every policy's AP, and its gain over the best fixed one, by phase and budget."""
    from sortie.sim.experiment.conditions import best_fixed, fly_conditions, summarise

    conditions = load_conditions(name)
    assert conditions is not None, name
    conditions = conditions.model_copy(update={"set": (*conditions.set, *sets)})
    one_by_one = (conditions.model_copy(update={"conditions": (c,)}) for c in conditions.conditions)
    # the policies of a condition share what the network has encoded
    cells = [cell for one in one_by_one for cell in fly_conditions(one, policies, by_torch=by_torch)]
    rows = summarise(cells)
    first = best_fixed(rows)
    ap = {(c.policy, c.condition): c.ap for c in cells}
    budgets = sorted({c.budget for c in conditions.conditions})
    parts = [
        *([c for c in conditions.conditions if (c.metric == "mission") == tracking] for tracking in (False, True)),
        *([c for c in conditions.conditions if c.budget == budget] for budget in budgets),
    ]

    def gain(policy: str, part: Sequence[Any]) -> tuple[float, float, float] | None:
        over = np.array([ap[policy, c.name] - ap[first, c.name] for c in part])
        found = mean_interval(over, SHARE.of_differences())
        return (found.mean, found.low, found.high) if found.count else None

    gains = ["searching", "tracking", *(f"budget {budget:g}" for budget in budgets)]
    return Table(
        [
            Column("policy"),
            Column("AP", ".3f"),
            *(Column(name, "+.1f", factor=100) for name in (f"over {first}", *gains)),
            Column("of the oracle", ".0f", " %", 100),
            Column("data a sortie", ".1f", " MB", 1e-6),
            Column("missed", ".1f", " %", 100),
        ],
        [
            [
                r.policy, r.ap, None if r.policy == first else r.gain,
                *(None if r.policy == first else gain(r.policy, part) for part in parts),
                r.of_oracle, r.data_bytes, r.miss_rate,
            ]
            for r in sorted(rows, key=lambda r: -r.ap)
        ],
        f"{len(conditions.conditions)} conditions; gains in AP points, with intervals over conditions.",
    )  # fmt: skip


def _boxes_in_place_of_maps(view: FleetView) -> list[Directive]:
    """The worked policy's peers and rates, with boxes wherever it sends feature maps."""
    return [
        d._replace(representation=Representation.DETECTIONS, rho=0.0)
        if d.representation == Representation.FEATURES
        else d
        for d in worked(view)
    ]


def _worked_over_silence() -> Tables:
    """The worked policy with the paper's parameters (ρ = 1 on every link) over silence, on the held-out conditions.

    Set down before it was measured: the mean gain over the forty conditions is above 0, in the full scene and, of the
    conditions in which the fleet tracks, in the mission disc, with the whole 95 % interval. Scored at 2 Hz by the
    surrogate, each condition with its first seed, the same draws for all policies. The two rows without maps were added
    when averaging became the default, to see what the worked policy's choice of maps costs.
    """
    from sortie.sim.engine.sortie import run_sortie
    from sortie.sim.experiment.conditions import scenario_of
    from sortie.sim.results.outcome import outcome

    conditions = load_conditions("conditions_fourth")
    assert conditions is not None
    policies: dict[str, str | Policy] = {
        "silence": "silence", "worked": "worked", "worked, boxes in place of maps": _boxes_in_place_of_maps, "boxes": "boxes",
    }  # fmt: skip
    ap: dict[tuple[str, str], list[float]] = {}
    for condition in conditions.conditions:
        for label, policy in policies.items():
            base = scenario_of(conditions, condition, policy if isinstance(policy, str) else "worked")
            scenario = base.model_copy(update={"policy": base.policy.model_copy(update={"params": {}})})
            found = outcome(run_sortie(scenario, None if isinstance(policy, str) else policy, conditions.seeds[0]))
            for area in ("full_scene", "mission"):
                value = found["ap50"][area]
                ap.setdefault((area, label), []).append(np.nan if value is None else value)
    rows: list[list[Any]] = []
    for area, where in (("full_scene", "full scene"), ("mission", "mission disc")):
        silence = np.array(ap[area, "silence"])
        for label in policies:
            its = np.array(ap[area, label])
            gain = mean_interval(its - silence, SHARE.of_differences())
            both = np.isfinite(its) & np.isfinite(silence)
            over: list[Any] = [(gain.mean, gain.low, gain.high), int((its[both] > silence[both]).sum())]
            rows.append(
                [where, label, int(both.sum()), its[both].mean(), *(over if label != "silence" else [None] * 2)]
            )
    columns = [
        Column("scored area"), Column("policy"), Column("conditions"), Column("AP", ".3f"),
        Column("over silence", "+.1f", factor=100), Column("conditions in which it is above"),
    ]  # fmt: skip
    return {"worked_over_silence": Table(columns, rows, "AP@0.5; gains in points, intervals over conditions.")}


ADAPTIVE = ("adaptive", "boxes", "learned", "worked")
SLOWLY = "perception.sample_rate_hz=0.5"


def _held_out() -> Tables:
    from sortie.sim.experiment.conditions import FIXED

    return {"held_out": _over_conditions("conditions_fourth", [*FIXED, *ADAPTIVE], SLOWLY, by_torch=True)}


def _conditions_first() -> Tables:
    policies = ["all-4", "adaptive", "boxes"]
    return {
        "first_by_torch": _over_conditions("conditions", policies, SLOWLY, by_torch=True),
        "first_by_surrogate": _over_conditions("conditions", policies),
    }


def _where_boxes_average() -> Tables:
    policies = ["all-4", "boxes", "adaptive", "learned"]
    return {"where_boxes_average": _over_conditions("conditions_third", policies)}


def _half_width() -> Tables:
    from research.validation import half_width_coverage

    return half_width_coverage.tables()


def _large_fleets() -> Tables:
    from research.validation import large_fleets

    return large_fleets.tables()


def _price() -> Tables:
    """From the flown seeds of compare_price.csv; `compare_price.py` flies what it lacks."""
    from research.validation import compare_price

    return compare_price.tables()


def _ranking() -> Tables:
    from research.validation import ranking

    return ranking.measure(WORK / "ranking")


def _ranking_by_torch() -> Tables:
    from research.validation import ranking

    return ranking.by_torch(WORK / "ranking_by_torch")


def _learned_example() -> Tables:
    from research.validation import learned_example

    return learned_example.measure(WORK / "learned_example")


def _arms() -> Tables:
    """The training conditions of `python -m research learn --by-torch`, which fits the policy `learned`.

    Planned before they were flown with averaged boxes, the default now: the same 100 conditions of seed 0. Expected: boxes to
    all gain more than with suppressed boxes at every budget and in both phases, with whole intervals above zero in each of the
    eight cells; so `learned`, fitted again, sends boxes in at least 95 % of its decisions in `conditions_fourth`, and its AP
    there is within a point of that of `boxes`.
    """
    from research.learn.learn import BUDGETS, fly_lessons, gains
    from sortie.policies.catalogue.adaptive import ARMS

    lessons = fly_lessons(0, 100, by_torch=True, workers=2)
    rows: list[list[Any]] = []
    for k, arm in enumerate(ARMS[1:], start=1):
        found = gains(lessons, k)
        for phase in ("search", "track"):
            means = [found.get((phase, budget)) for budget in BUDGETS]
            rows.append(
                [
                    arm.text,
                    phase,
                    *(m and (m.mean if m.count < 2 else (m.mean, m.low, m.high)) for m in means),
                ]
            )
    budgets = [Column(f"budget {budget:g}", "+.1f", factor=100) for budget in BUDGETS]
    about = f"{len(lessons)} training conditions; AP points over maps to all, with 95 % intervals over conditions."
    return {"arms": Table([Column("arm"), Column("phase"), *budgets], rows, about)}


def _surrogate_in_flight() -> Tables:
    """As `python -m research calibrate --fly conditions_fourth --towns 10`; a run that was cut off goes on after its last condition."""
    from research.calibrate.in_flight import REGIONS, ConditionAp, flights, means
    from sortie.perception.surrogate.model import SHIPPED
    from sortie.sim.identity import codes_here

    policies = ["silence", "all-4", "boxes", "adaptive"]
    kept = WORK / "surrogate_in_flight" / f"{codes_here()[1]}.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    text = kept.read_text("utf-8") if kept.exists() else ""
    found = [
        [ConditionAp(**row) for row in json.loads(line)] for line in text.splitlines(keepends=True) if line[-1] == "\n"
    ]
    write_text(kept, "".join(line for line in text.splitlines(keepends=True) if line[-1] == "\n"))  # one was cut off
    done = {row.condition for rows in found for row in rows}
    new = flights("conditions_fourth", SHIPPED, None, 0.5, policies, None, 10, leave_out=done)
    for _, rows in itertools.groupby(new, key=lambda row: row.condition):
        found.append(list(rows))
        with kept.open("a", encoding="utf-8") as file:
            file.write(json.dumps([dataclasses.asdict(row) for row in found[-1]]) + "\n")
    levels = [row for rows in found for row in rows]
    columns = [
        Column("region"),
        Column("policy"),
        *_points("torch", ".1f"),
        *_points("surrogate", ".1f"),
        *_points("error"),
    ]
    return {
        "surrogate_in_flight": Table(
            columns,
            [[REGIONS[m.region], m.what, m.torch, m.surrogate, m.error] for m in means(levels)],
            "Forty conditions in ten towns each; points of AP, with intervals over conditions.",
        )
    }


def _points(name: str, form: str = "+.1f") -> Iterator[Column]:
    yield Column(name, form, factor=100)


# --- perception -------------------------------------------------------------------------------------


def _difficulty() -> Tables:
    from research.paper.difficulty_effects import SEED, measure

    rows = [
        [
            e.move.parameter, e.move.value, e.gain.ap_a, e.gain.ap_b, e.gain.delta,
            None if e.change is None else (e.change.delta, e.change.low, e.change.high),
        ]
        for e in measure(SHIPPED_WEIGHTS, WORK / "difficulty", scenes=60, workers=2)
    ]  # fmt: skip
    about = f"`{SHIPPED_WEIGHTS.name}`, 60 scenes of seed {SEED}'s test layouts, one fleet-frame of five egos each. Change: of AP under full sharing against the first row, paired by scene."
    ap = [Column(name, ".3f") for name in ("AP alone", "AP sharing all")]
    gains = [Column(name, "+.3f") for name in ("cooperation", "change")]
    return {"difficulty": Table([Column("parameter"), Column("moved to"), *ap, *gains], rows, about)}


def _fine_network() -> Tables:
    from research.validation import fine_network

    return fine_network.tables(ROOT / "runs/bench", ROOT / "research/pages/fine_network.png")


def _sent_boxes() -> Tables:
    from research.validation import sent_boxes

    return sent_boxes.tables(ROOT / "research/pages/sent_boxes.png")


def _sent_flights() -> Tables:
    from research.validation import sent_boxes

    return {"sent_flights": sent_boxes.flight_table()}


def _sent_own_look() -> Tables:
    from research.validation import sent_boxes

    return {"sent_own_look": sent_boxes.own_look_table()}


def _corrected_frames() -> Tables:
    from research.validation import corrected_boxes

    return {"corrected_frames": corrected_boxes.frame_table()}


def _corrected_own_look() -> Tables:
    from research.validation import corrected_boxes

    return {"corrected_own_look": corrected_boxes.own_look()}


def _corrected_flights() -> Tables:
    from research.validation import corrected_boxes

    return {"corrected_flights": corrected_boxes.flight_table()}


def _corrected_times() -> Tables:
    from research.validation import corrected_boxes

    return {"corrected_times": corrected_boxes.times()}


def _trucks() -> Tables:
    from research.validation import trucks

    return {"trucks": trucks.table()}


def _score_threshold() -> Tables:
    from research.validation import score_threshold

    return {"score_threshold": score_threshold.table()}


def _fine_fleets() -> Tables:
    from research.validation import fine_network

    return {"fine_fleets": fine_network.other_fleets(WORK / "fine_fleets")}


def _fine_times() -> Tables:
    from research.validation import fine_network

    return {"fine_times": fine_network.times()}


def _fine_flights() -> Tables:
    from research.validation import fine_network

    return {"fine_flights": fine_network.flights()}


def _survey() -> Tables:
    """As `python -m research bench survey --scenes 40`."""
    from research.benchmark.dataset import SIZES, Benchmark
    from research.benchmark.survey import by_style, survey

    bench = Benchmark()
    rows = []
    for split, (scenes, _) in SIZES.items():
        counted = [survey(bench, split, k) for k in range(min(40, scenes))]
        for style, n, c in by_style(counted):
            rows.append([split, style, n, c.cars, c.alone, c.fleet, c.built, c.height_m, c.lot_m])
    columns = [
        Column("split"), Column("style"), Column("scenes", ".0f"), Column("cars in ±102.4 m", ".1f"),
        *(Column(name, ".2f") for name in ("seen by the drone", "by any of five", "built")),
        Column("height", ".1f", " m"), Column("lot", ".0f", " m"),
    ]  # fmt: skip
    return {"survey": Table(columns, rows)}


def _paper() -> None:
    """Writes research/pages/paper and its section."""
    _sortie(
        "paper",
        "--readme",
        ROOT / "research/pages/claims.md",
        "--out",
        ROOT / "research/pages/paper",
        "--work",
        WORK / "paper",
    )


def _study() -> None:
    """Measures the networks that have weights; writes research/pages/study and its section."""
    _sortie("study", "run", "--work", WORK / "study")
    report = ("--out", ROOT / "research/pages/study", "--readme", ROOT / "research/pages/flip.md")
    _sortie("study", "report", WORK / "study/study.parquet", *report)


def _doses() -> Tables:
    from research.validation import doses

    return doses.tables(WORK / "study", ROOT / "runs/bench", PICTURES / "doses.png")


def _paper_seeds() -> Tables:
    """`python -m research paper` on other benchmarks and with other weights, beside research/pages/paper."""
    from research.paper import rows

    weights = ROOT / "research/flip/weights"
    makings = {
        "benchmark seed 1": ("--seed", "1"),
        "benchmark seed 2": ("--seed", "2"),
        "training seed 0": ("--weights", weights / "full-0.safetensors"),
        "training seed 2": ("--weights", weights / "full-2.safetensors"),
    }
    shipped, _ = rows.read(ROOT / "research/pages/paper/paper.parquet")
    tables = {"as shipped": shipped}
    for name, options in makings.items():
        out = WORK / name.replace(" ", "_")
        _sortie("paper", *options, "--out", out, "--work", WORK / "paper")
        tables[name], _ = rows.read(out / "paper.parquet")
    return {"paper_seeds": seeds_table(tables)}


def seeds_table(tables: Mapping[str, Sequence[Any]]) -> Table:
    """How many verdicts are those of the first table, and what some claims come to in each."""
    from research.paper.claims import Kind
    from research.paper.report import ours

    first = next(iter(tables.values()))
    verdicts = {(r.id, r.instrument): r.verdict for r in first}
    same = [sum(verdicts.get((r.id, r.instrument)) == r.verdict for r in some) for some in tables.values()]
    says = {r.id: r.says for r in first if r.headline and r.kind == Kind.EFFECT}
    found: list[list[Any]] = [[f"verdicts as in the first column, of {len(first)}", *same]]
    for claim, text in says.items():
        mine = ([r for r in some if (r.id, r.instrument) == (claim, "zero")] for some in tables.values())
        found.append([text, *(ours(r[0]) if r else None for r in mine)])
    return Table([Column("the paper's instrument"), *(Column(name, ".0f") for name in tables)], found)


# --- sorties, the bus, the host ---------------------------------------------------------------------


def _compare() -> Tables:
    surrogate = ("--set", "perception.detector=surrogate")  # by torch, a flight takes a minute and more
    command = ("compare", "track_target", "--policies", "worked,all-4,silence", "--seeds", "8", *surrogate)
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.md"
        page.write_text("<!-- compare:begin --><!-- compare:end -->", "utf-8")
        _sortie(*command, "--readme", page)
        return {"compare": _between(page.read_text("utf-8"), "compare")}


def _coverage() -> Tables:
    """From the stored sorties; `python -m research.validation.compare_coverage` flies those that are missing."""
    from research.validation import compare_coverage

    return {"coverage": compare_coverage.table()}


def _mixed_fleet() -> Tables:
    from research.validation import mixed_fleet

    return mixed_fleet.tables(range(1, 21))


def _hysteresis() -> Tables:
    from sortie.sim.engine.sortie import run_sortie
    from sortie.sim.results.outcome import outcome

    rows = []
    for band in (0.0, 0.2, 1.0):
        record = run_sortie(load("paper_replay_contention", ["perception.detector=none", f"policy.hysteresis={band}"]))
        rows.append([band, record.tables["directives"].num_rows, outcome(record)["switches"]])
    columns = [
        Column("`policy.hysteresis`", "g"),
        Column("directives", ",.0f"),
        Column("switches a link and minute", ".2f"),
    ]
    return {"hysteresis": Table(columns, rows, "`paper_replay_contention`, one sortie each.")}


def _replay_contention() -> Tables:
    from research.validation import replay_contention

    return {"replay_contention": replay_contention.table()}


def _overhead() -> Tables:
    """As `python -m research overhead`."""
    from research.overhead.overhead import FLEETS, SCENARIO, SECONDS, measure

    rows = []
    for drones in FLEETS:
        r = measure("worked", drones)
        rows.append([drones, r.p50_ms, r.p99_ms, r.context_bytes_per_s, r.data_bytes_per_s, r.context_share])
    columns = [
        Column("drones", ".0f"),
        *(Column(name, ".0f", " µs", 1000) for name in ("a decision, median", "99th percentile")),
        Column("context", ".1f", " kB/s", 1e-3), Column("data", ".1f", " MB/s", 1e-6),
        Column("context of all bytes", ".2f", " %", 100),
    ]  # fmt: skip
    return {"overhead": Table(columns, rows, f"`worked` in `{SCENARIO}`, {SECONDS:g} s.")}


def _live() -> Tables:
    """As `sortie live`, in real time."""
    from sortie.sim.live.result import overhead_rows
    from sortie.sim.live.session import fly_live

    four = ["fleet.drones=4"]
    full = [*four, "policy.name=all-4", "policy.params={received_budget: 1}"]
    one, other = (
        fly_live(load("paper_replay_contention", four)),
        fly_live(load("paper_replay_contention", full), duration_s=30.0),
    )
    both = zip(overhead_rows(one), overhead_rows(other), strict=True)
    columns = [Column(""), Column("worked"), Column("all-4(received_budget=1)")]
    overhead = Table(
        columns, [[*row, there[1]] for row, there in both], "Four drones; 120 s and 30 s of `paper_replay_contention`."
    )
    lossy = fly_live(load("paper_replay_contention"), begin_s=50.0, duration_s=30.0, loss=0.3, kill=(3, 70.0))
    dropped, heard = (sum(getattr(d, name) for d in lossy.each) for name in ("dropped_by_loss", "heard"))
    noticed = [n for n in lossy.noticed if n.drone == 3]
    rows: list[list[Any]] = [
        ["descriptors dropped", f"{dropped:,} of {dropped + heard:,}"],
        *([f"contexts that became {h.name.lower()}", sum(c.health == h for c in lossy.health)] for h in _healths()),
        ["a capture's way to its receiver, median", f"{lossy.data_age_ms_p50:.0f} ms"],
    ]
    for n in noticed:
        for what, span in (("degraded", n.degraded_s), ("detached", n.detached_s)):
            rows.append(
                [f"drone 3, killed, {what} at {n.by} others after", span and f"{span[0]:.2f} to {span[1]:.2f} s"]
            )
    return {"live": overhead, "live_losses": Table([Column("measured"), Column("value", ".0f")], rows)}


def _healths() -> Sequence[Any]:
    from sortie.policies.staleness import LinkHealth

    return list(LinkHealth)


def _speed() -> Tables:
    """As `make bench-all`."""
    return {"speed": speed_table(_benchmarks("tests/benchmarks"))}


def _benchmarks(where: str) -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / "bench.json"
        bench = ("pytest", where, "--benchmark-enable", "--benchmark-only", f"--benchmark-json={kept}", "-q")
        subprocess.run([sys.executable, "-m", *bench], cwd=ROOT, check=True)
        measured: list[dict[str, Any]] = json.loads(kept.read_text("utf-8"))["benchmarks"]
    return measured


def _campaign_scale() -> Tables:
    from research.validation import campaign_scale

    return campaign_scale.tables()


def _pace() -> Tables:
    from research.validation import pace

    made, found = pace.tables()
    pace.draw(found, ROOT / "docs/results/fleet_pace.png")
    return made


def _inference_libraries() -> Tables:
    """Needs onnx, onnxruntime and openvino for their rows."""
    measured = _benchmarks("tests/benchmarks/test_bench_inference_libraries.py")
    times = [(b["params"]["way"], b["stats"]["min"], b["stats"]["median"]) for b in measured]
    columns = [Column("method"), *(Column(name, ".1f", " ms", 1e3) for name in ("least", "median"))]
    return {"inference_libraries": Table(columns, sorted(times, key=lambda row: row[1]))}


def speed_table(benchmarks: Sequence[Mapping[str, Any]]) -> Table:
    """The median time of every benchmark, by file and group."""

    def median(seconds: float) -> str:
        unit, factor = next(u for u in ((" s", 1.0), (" ms", 1e3), (" µs", 1e6)) if seconds * u[1] >= 1 or u[1] == 1e6)
        return f"{seconds * factor:.3g}{unit}"

    rows = [
        [b["fullname"].partition("::")[0].rpartition("test_bench_")[2].removesuffix(".py"), b["group"] or "",
         b["name"].encode().decode("unicode_escape").removeprefix("test_").replace("_", " ").replace("[", ", ").removesuffix("]"), median(b["stats"]["median"]), b["stats"]["rounds"]]
        for b in benchmarks
    ]  # fmt: skip
    return Table([*map(Column, ("part", "group", "what", "median")), Column("rounds", ".0f")], rows)


# --- the list ---------------------------------------------------------------------------------------

FIGURES: dict[str, Figure] = {
    "hysteresis": Figure(0.2, _hysteresis),
    "mixed_fleet": Figure(1, _mixed_fleet, network=True),
    "overhead": Figure(0.5, _overhead, timed=True),
    "energy": Figure(0.5, _energy),
    "flight": Figure(0.5, _flight),
    "survey": Figure(1, _survey),
    "views_cost": Figure(0.5, _views_cost, timed=True),
    "disagreement": Figure(2, _disagreement),
    "learned_example": Figure(10, _learned_example, network=True),
    "compare": Figure(2, _compare, network=True),
    "coverage": Figure(0.5, _coverage),
    "price": Figure(0.2, _price, timed=True, network=True),
    "half_width": Figure(1, _half_width),
    "worked_over_silence": Figure(2, _worked_over_silence, network=True),
    "viewpoints": Figure(2, _viewpoints, network=True),
    "join_rules": Figure(4, _join_rules, network=True),
    "where_boxes_average": Figure(3, _where_boxes_average, network=True),
    "replay_contention": Figure(4, _replay_contention),
    "live": Figure(3.5, _live, timed=True),
    "track_prediction": Figure(4, _track_prediction, network=True),
    "radio_scale": Figure(3, _radio_scale, timed=True),
    "liars": Figure(4, _liars, network=True),
    "context_forms": Figure(4, _context_forms, network=True),
    "fusion_age": Figure(4, _fusion_age, network=True),
    "late_shares": Figure(2, _late_shares, network=True),
    "representations": Figure(4, _representations, network=True),
    "link": Figure(5, _link),
    "ns3": Figure(15, _ns3, timed=True),
    "ns3_drawn": Figure(5, _ns3_drawn, timed=True),
    "transport": Figure(6, _transport, network=True),
    "paper": Figure(8, _paper),
    "conditions_first": Figure(8, _conditions_first, network=True),
    "inference_libraries": Figure(2, _inference_libraries, timed=True, network=True),
    "large_fleets": Figure(25, _large_fleets, timed=True, network=True),
    "campaign_scale": Figure(10, _campaign_scale, timed=True),
    "speed": Figure(12, _speed, timed=True),
    "pace": Figure(12, _pace, timed=True),
    "difficulty": Figure(12, _difficulty, network=True),
    "surrogate_in_flight": Figure(45, _surrogate_in_flight, network=True),
    "arms": Figure(20, _arms, network=True),
    "ranking": Figure(10, _ranking, timed=True, network=True),
    "ranking_by_torch": Figure(20, _ranking_by_torch, network=True),
    "handshakes": Figure(5, _handshakes),
    "requests": Figure(5, _requests),
    "fine_times": Figure(1, _fine_times, timed=True),
    "corrected_times": Figure(1, _corrected_times, timed=True),
    "fine_network": Figure(7, _fine_network),
    "sent_boxes": Figure(20, _sent_boxes),
    "sent_own_look": Figure(10, _sent_own_look),
    "sent_flights": Figure(30, _sent_flights),
    "corrected_frames": Figure(10, _corrected_frames),
    "corrected_own_look": Figure(5, _corrected_own_look),
    "corrected_flights": Figure(30, _corrected_flights),
    "trucks": Figure(1, _trucks),
    "score_threshold": Figure(4, _score_threshold),
    "fine_fleets": Figure(5, _fine_fleets),
    "fine_flights": Figure(20, _fine_flights),
    "fusion_methods": Figure(25, _fusion_methods),
    "paper_seeds": Figure(30, _paper_seeds),
    "held_out": Figure(30, _held_out, network=True),
    "study": Figure(60, _study),
    "doses": Figure(110, _doses),
}
"""By the name of the file."""
CLOSED = ("fused_grids",)
"""Stored tables whose scripts left with the options that they measured: their pages keep them, and no command makes them."""


def _sortie(*words: object) -> None:
    subprocess.run([sys.executable, "-m", "sortie", *map(str, words)], cwd=ROOT, check=True)


def _between(text: str, name: str) -> str:
    return text.partition(f"<!-- {name}:begin -->")[2].partition(f"<!-- {name}:end -->")[0].strip()


def _paper_section() -> str:
    from research.paper import report, rows

    return _between(report.short(*rows.read(ROOT / "research/pages/paper/paper.parquet"), "paper/README.md"), "paper")


def _study_section() -> str:
    import pyarrow.parquet as pq

    from research.flip import report
    from research.flip.measure import from_table
    from research.flip.plan import read_plan

    table = from_table(pq.read_table(ROOT / "research/pages/study/study.parquet"))
    return _between(report.short(read_plan(), table, "study/README.md"), "study")


def _fields_section() -> str:
    sys.path.insert(0, str(ROOT / "docs/site"))
    from fields_page import fields_markdown

    return fields_markdown().strip()


OTHERS = {"paper": _paper_section, "study": _study_section, "fields": _fields_section}
"""Sections that are made from a report's own table or from the code, not from research/tables."""


def all_sections(stale: Callable[[str, ValueError], None] | None = None) -> dict[str, str]:
    """Every section by its name, as it should stand on its page.

    Args:
        stale: called with a report that this version cannot read, which is then left out.

    Raises:
        ValueError: such a report, if `stale` is None.
    """
    found = {}
    for name, section in OTHERS.items():
        try:
            found[name] = section()
        except ValueError as error:
            if stale is None:
                raise
            stale(name, error)
    for file in sorted(FOLDER.glob("*.json")):
        found |= sections(file.stem)
    return found


def pages() -> list[Path]:
    """Every page of the repository but the changelog."""
    return sorted(
        path
        for path in ROOT.rglob("*.md")
        if not {"runs", "node_modules"} & set(path.parts)
        and not any(part.startswith(".") for part in path.relative_to(ROOT).parts)
        and path.name != "CHANGELOG.md"
    )


def render() -> Iterator[Path]:
    """Write the sections into the pages; yields those that changed. A report that is to be measured again stays as it is."""
    left: list[str] = []

    def stale(name: str, error: ValueError) -> None:
        left.append(name)
        sys.stderr.write(f"{name} stays as it is: {error}\n")

    found = all_sections(stale)
    for page in pages():
        old = page.read_text("utf-8")
        there = {name: _between(old, name) for name in left if name in MARKED.findall(old)}
        if MARKED.search(old) and (new := rendered(old, found | there)) != old:
            write_text(page, new)
            yield page


def _host() -> str:
    from research.overhead.overhead import host_s
    from sortie.sim.identity import machine

    return f"{machine()}, which takes {1e3 * host_s():.0f} ms for a million additions in a loop"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--render", action="store_true")
    asked = parser.parse_args()
    if unknown := [name for name in asked.names if name not in FIGURES]:
        parser.error(f"no figure is called {unknown[0]}; there are {', '.join(FIGURES)}")
    cheapest_first = sorted(FIGURES, key=lambda name: FIGURES[name].minutes)
    if asked.list:
        sys.stdout.writelines(f"{name:24}{FIGURES[name].minutes:g} min\n" for name in cheapest_first)
        return
    for name in [] if asked.render else asked.names or cheapest_first:
        begin_s = time.monotonic()
        found = FIGURES[name].measure()
        if found is not None:
            network = SHIPPED_WEIGHTS.name if FIGURES[name].network else ""
            save(name, found, _host() if FIGURES[name].timed else "", network)
        sys.stdout.write(f"{name} measured in {(time.monotonic() - begin_s) / 60:.1f} min\n")
        sys.stdout.flush()
    for page in render():
        sys.stdout.write(f"{page.relative_to(ROOT)} written\n")


if __name__ == "__main__":
    main()
