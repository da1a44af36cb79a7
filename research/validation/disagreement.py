"""How often drones' views lead to different choices, and what keeping views costs (`make figures FIGURE=disagreement`
and `FIGURE=views_cost`). No detector flies: decisions do not depend on detections.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from research.validation.stored import Cell, Column, Table
from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results import run_folder
from sortie.sim.results.disagreement import CAUSES, TABLE, figures, pairs_of
from sortie.sim.results.views import TABLES
from sortie.sim.studies.replay import kept_decisions

LIBRARY = {
    "track_target": (), "paper_context": (), "paper_replay_contention": (), "search_grid": ("duration_s=10",),
}  # fmt: skip
"""Scenarios of the library as they stand; 25 drones make many pairs, so the grid flies for 10 s."""
POLICIES = ("all-4", "best-2", "random-2", "adaptive", "learned", "deputies")
SHORT = "duration_s=60"
MEETS = {
    "a descriptor every 5 frames": ("context.publish_every=5",),
    "drones 150 m apart, bursts of loss": ("fleet.formation.spacing_m=150", "radio.bursts.good_to_bad=0.3"),
    "drone 1 lies about its coverage": ("events=[{kind: lie, at_s: 5, drone: 1, until_s: 30}]",),
    "drone 1 has a clock 0.5 s slow": ("events=[{kind: clock_skew, at_s: 5, drone: 1, skew_s: -0.5}]",),
    "drone 1 is lost": ("events=[{kind: drone_lost, at_s: 5, drone: 1}]",),
}
"""What the fleet of track_target meets in 60 s."""


def flights() -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """What is flown: its name on the page, the scenario, and what it sets."""
    for name, fields in LIBRARY.items():
        yield name + "".join(f", {field.partition('=')[2]} s" for field in fields), name, fields
    for policy in POLICIES:
        yield f"track_target under {policy}", "track_target", (f"policy.name={policy}", "policy.params={}", SHORT)
    for name, fields in MEETS.items():
        yield f"track_target, {name}", "track_target", (*fields, SHORT)


def table() -> Table:
    """A row a flight."""
    shares = [Column(name, ".2f", " %", 100.0) for name in ("of link-time", "about whether to send", *CAUSES)]
    lasts = [Column(name, ".2f", " s") for name in ("mean", "99th percentile", "longest")]
    columns = [Column("flight"), *shares[:2], Column("episodes"), *lasts, *shares[2:]]
    rows: list[list[Cell]] = []
    for name, scenario, fields in flights():
        flown = load(scenario, ["perception.detector=none", "record.disagreement=true", *fields])
        told = figures(pairs_of(run_sortie(flown).tables[TABLE]))
        rows.append(
            [
                name, told["share"], told["sends_share"], told["episodes"], told["mean_s"], told["p99_s"],
                told["longest_s"], *(told["causes"][cause] for cause in CAUSES),
            ]
        )  # fmt: skip
    return Table(columns, rows, "One flight a row, without a detector.")


def cost() -> Table:
    """What `record.views` adds to a flight of track_target: bytes on disk and processor time."""
    times: dict[bool, list[float]] = {False: [], True: []}
    plain = load("track_target", ["perception.detector=none"])
    kept = load("track_target", ["perception.detector=none", "record.views=true"])
    record = run_sortie(kept)
    for _ in range(5):
        for views, scenario in ((False, plain), (True, kept)):
            begin_s = time.process_time()
            run_sortie(scenario)
            times[views].append(time.process_time() - begin_s)
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        run_folder.save(record, run)
        views_bytes = sum((run / f"{name}.parquet").stat().st_size for name in TABLES)
        rest_bytes = sum(file.stat().st_size for file in run.iterdir()) - views_bytes
    decisions = sum(1 for _ in kept_decisions(record))
    took_s = {views: statistics.median(each) for views, each in times.items()}
    rows: list[list[Cell]] = [
        ["the run without views and recording", rest_bytes / 1e6, took_s[False], None, None],
        [
            "what views add", views_bytes / 1e6, took_s[True] - took_s[False], views_bytes / decisions,
            (took_s[True] - took_s[False]) / decisions * 1e6,
        ],
    ]  # fmt: skip
    columns = [
        Column(""), Column("on disk", ".2f", " MB"), Column("processor time", ".2f", " s"),
        Column("bytes a decision", ".0f"), Column("time a decision", ".0f", " µs"),
    ]  # fmt: skip
    about = f"`track_target` without a detector, {decisions:,} decisions; medians of five flights each."
    return Table(columns, rows, about)
