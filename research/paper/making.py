"""`python -m research paper`: measure the paper's claims on the benchmark and on a flown sortie, and write the verdicts."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from research.paper import figure_frame, figures, report, rows
from research.paper.instrument import CarNetInstrument
from research.paper.measuring import bench_frames, camera_views, measure
from research.paper.picture import PAPER_BUDGETS, Picture, picture
from research.paper.plane_cost import measure_plane, measured_live
from research.paper.results import TableSettings
from research.paper.rows import ClaimRow, Point
from research.paper.sensitivity import Varied, sensitivity
from research.train.devices import gpu_name, measuring_device
from sortie.sim.folders import ensure_folder, write_text, writing
from sortie.sim.identity import RELEASE, machine
from sortie.sim.readme import with_section

REPORT, TABLE, POINTS, VARIED = "README.md", "paper.parquet", "points.parquet", "sensitivity.parquet"
FIGURES = {
    "frontier.png": "AP over the bytes shared, full scene and mission disc; whiskers are 95 % intervals",
    "peers.png": "Peer selection at matched bytes: ▼ marks each budget's best",
    "forest.png": "Every difference of the Evaluation, the paper's interval and ours",
    "frame.png": "One frame: camera views, truth and detections, cells shared with the ego at two budgets",
}
"""File names of the report, and what they show."""

Progress = Callable[[str, int, int], None]
"""Called with a stage, what is done and what there is to do."""


@dataclass(frozen=True, slots=True)
class PaperSettings:
    """One making of the report."""

    weights: Path
    settings: TableSettings
    frames: int | None = None
    """None: all of the test split."""
    seed: int = 0
    """The benchmark's."""
    workers: int = 1
    """Frames worked on side by side; nothing but time depends on it."""
    command: str = "python -m research paper"
    """As it was given, for the report."""
    live: Path | None = None
    """What `sortie live --out` wrote: it answers two claims that a simulated flight cannot."""
    fusion_params: Mapping[str, float] = field(default_factory=dict)
    """Interventions on the network's fusion."""
    device: str | None = "cpu"
    """As `device_named` takes it."""


@dataclass(frozen=True, slots=True)
class PaperResult:
    """What the report is made of."""

    rows: Sequence[ClaimRow]
    points: Sequence[Point]
    varied: Sequence[Varied]
    facts: dict[str, Any]
    picture: Picture | None


def make(job: PaperSettings, work: Path, progress: Progress = lambda stage, done, of: None) -> PaperResult:
    """Measure everything; what is finished is kept under `work`, so that a run that was cut off goes on.

    Raises:
        ValueError: weights that are missing or do not fit, more frames than the split has.
    """
    wall_s, cpu_s = time.perf_counter(), _cpu_s()
    on_the_bus = {} if job.live is None else measured_live(job.live)
    device = measuring_device(job.device)
    instrument = CarNetInstrument.load(job.weights, device, dict(job.fusion_params))
    frames = bench_frames(
        job.seed,
        job.frames,
        work / "bench",
        lambda done, of: progress("test scenes", done, of),
        instrument.geometry,
    )
    measured = measure(
        instrument,
        frames,
        job.settings,
        store=work / "harness",
        workers=job.workers,
        progress=lambda done, of: progress("frames", done, of),
    )
    plane = {**measure_plane(lambda t_s: progress("replay", round(t_s), 120)), **on_the_bus}
    progress("verdicts", 0, 1)
    scores = measured.all_scores()
    table, points = rows.judge(scores, plane), rows.points(scores)
    varied = sensitivity(measured)
    seen = picture(instrument, frames, 0, views=camera_views(job.seed, 0, instrument.geometry), **_drawn(job.settings))
    progress("verdicts", 1, 1)
    facts = {
        "command": job.command,
        "version": RELEASE,
        "seed": job.seed,
        "frames": len(frames.scene),
        "scenes": len(set(frames.scene.tolist())),
        "weights": job.weights.name,
        "fingerprint": instrument.fingerprint,
        "unsent": list(job.settings.unsent),
        "cells_by": job.settings.cells_by,
        **job.settings.ways._asdict(),
        "fusion_params": dict(job.fusion_params),
        "tau": job.settings.tau,
        "by": job.settings.by,
        "draws": job.settings.draws,
        "cpu_s": round(_cpu_s() - cpu_s, 1),
        "wall_s": round(time.perf_counter() - wall_s, 1),
        "machine": " and ".join(filter(None, (machine(), gpu_name(device)))),
    }
    return PaperResult(table, points, varied, facts, seen)


def frame_picture(
    job: PaperSettings, work: Path, frame: int, ego: int = 0, budgets: Sequence[float] = PAPER_BUDGETS
) -> Picture:
    """One frame of the test split as the paper's data figure has it.

    Raises:
        ValueError: no such frame or drone, or weights that do not fit.
    """
    instrument = CarNetInstrument.load(job.weights, measuring_device(job.device), dict(job.fusion_params))
    frames = bench_frames(job.seed, max(1, frame + 1), work / "bench", geometry=instrument.geometry)
    views = camera_views(job.seed, frame, instrument.geometry) if frame >= 0 else None
    return picture(instrument, frames, frame, ego=ego, budgets=budgets, views=views, **_drawn(job.settings))


def _drawn(settings: TableSettings) -> dict[str, Any]:
    """What a picture of one frame takes of the report's settings."""
    return {"tau": settings.tau, "cells_by": settings.cells_by, "ways": settings.ways}


def ensure_writable(path: Path) -> None:
    """Refuse a folder that holds something else than a report, before anything is measured.

    Raises:
        RunError: naming the path.
    """
    ensure_folder(path, TABLE, "report", {REPORT, TABLE, POINTS, VARIED, *FIGURES})


def write(result: PaperResult, path: Path) -> list[Path]:
    """Write the report's folder whole, an older one replaced; returns its files. Without matplotlib, no figures.

    Raises:
        RunError: as `ensure_writable`, or the disk refuses.
    """
    ensure_writable(path)
    with writing(path) as partial:
        partial.mkdir()
        pq.write_table(rows.to_table(result.rows, result.facts), partial / TABLE)
        for name, several in ((POINTS, result.points), (VARIED, result.varied)):
            pq.write_table(pa.Table.from_pylist([_plain(p) for p in several]), partial / name)
        drawn = _draw(result, partial) if figures.available() else []
        text = report.report(result.rows, result.facts, [(name, FIGURES[name]) for name in drawn], result.varied)
        (partial / REPORT).write_text(text, encoding="utf-8")
    return sorted(path.iterdir())


def put_into_readme(readme: Path, result_rows: Sequence[ClaimRow], facts: dict[str, Any], link: str) -> None:
    """Write the README's section anew, under a temporary name first.

    Raises:
        RunError: no such file, or one without the section's markers.
    """
    section = report.short(result_rows, facts, link)
    write_text(readme, with_section(readme, section, report.BEGIN, report.END))


def _draw(result: PaperResult, folder: Path) -> list[str]:
    drawings = {
        "frontier.png": figures.frontier(result.points),
        "peers.png": figures.peer_selection(result.points),
        "forest.png": figures.forest(result.rows),
    }
    if result.picture is not None:
        drawings["frame.png"] = figure_frame.draw(result.picture)
    for name, figure in drawings.items():
        figures.save(figure, folder / name)
    return list(drawings)


def _plain(point: Point | Varied) -> dict[str, Any]:
    return {name: getattr(point, name) for name in point.__slots__}


def _cpu_s() -> float:
    """CPU seconds of this process and of those that it started and that ended."""
    t = os.times()
    return t.user + t.system + t.children_user + t.children_system
