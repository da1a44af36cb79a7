"""What each representation is worth for its bytes: AP of five drones that share it (`make figures FIGURE=representations`).

Each ego has its own look and what its four peers send of the same moment. Joining, budgets and bytes are those of a sortie.
`representations.toml` is the plan: frames and hypotheses were written before the test frames were evaluated.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats

from research.benchmark.dataset import Benchmark, Frames, load_frames, make_split
from research.paper.instrument import CarNetView
from research.paper.ways import Sharing
from research.train.box_errors import Calibration, Errors, Moment, calibration
from research.train.boxes_alone import boxes_alone, moments_of
from research.validation.stored import Column, Table
from sortie.perception import budget
from sortie.perception.evaluation.harness import Settings, exchanges, frame_keys, match_all
from sortie.perception.geometry import CELLS, Geometry
from sortie.perception.ground_truth import ground_truth
from sortie.perception.joining import EgoSources, Rule, joined_many, source_of
from sortie.perception.metrics.ap import Matched, average_precision, match
from sortie.perception.metrics.bootstrap import rank
from sortie.perception.network.checkpoint import load_weights
from sortie.perception.network.codebook import Codebook, load_codebook
from sortie.perception.network.decode import placed_boxes
from sortie.perception.network.detector import SHIPPED_WEIGHTS
from sortie.perception.network.inference import folded
from sortie.perception.network.model import CarNet
from sortie.perception.types import Capture, Share
from sortie.perception.uncertainty import BoxErrors, load_errors
from sortie.scenarios.intervals import percentile_interval, resamples
from sortie.scenarios.schema import Perception
from sortie.scenarios.shipped import CODEBOOK, ERRORS, beside

PLAN = Path(__file__).with_name("representations.toml")
TAU = Perception().score_threshold
Unit = list[Matched]
"""One for each ego of each frame."""


@dataclass(frozen=True, slots=True)
class Way:
    """One way to share."""

    representation: str
    label: str
    rho: float = 0.0
    code_bytes: int = 0
    join: Rule = "average"
    common: float | None = None
    """The share of a variance that several drones' errors may have in common; None: as fitted."""


SILENCE = Way("none", "silence")
BOX_WAYS = (
    Way("tracks", "tracks"),
    Way("detections", "detections, suppressed", join="nms"),
    Way("detections", "detections, averaged"),
    Way("uncertain_boxes", "uncertain boxes"),
    Way("uncertain_boxes", "uncertain boxes, anything in common", common=1.0),
)


@dataclass(frozen=True, slots=True)
class Row:
    """What a way is worth."""

    way: Way
    kilobytes: float
    """That an ego receives in a frame from its four peers: content with its index, without headers."""
    ap: float
    low: float
    high: float
    draws: NDArray[np.float64]
    """AP of the same resampled scenes for every way."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What is measured, and what was expected."""

    question: str
    hypotheses: tuple[str, ...]
    bench_seed: int
    frames: int
    rho: tuple[float, ...]
    code_bytes: tuple[int, ...]


def read_plan(path: Path = PLAN) -> Plan:
    """The plan in its file."""
    found = tomllib.loads(path.read_text("utf-8"))
    return Plan(**{k: tuple(v) if isinstance(v, list) else v for k, v in found.items()})


def measure(
    frames: Frames,
    weights: Path,
    rho: Sequence[float],
    code_bytes: Sequence[int],
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Every way on these frames, silence first; intervals over scenes.

    Args:
        frames: with images.
        weights: a network's, with a codebook and box errors beside them.
        rho: shares of a sender's cells.
        code_bytes: of a cell.
    """
    net = load_weights(weights)
    errors, codebook = load_errors(beside(weights, ERRORS), weights.name), load_codebook(beside(weights, CODEBOOK), net)
    net = folded(net)
    units: dict[Way, Unit] = {}
    received: dict[Way, float] = {}
    for f in range(len(frames)):
        with torch.inference_mode():
            features = net.encoder(torch.from_numpy(frames.images[f]))
            heads = net.head(net.spread(features))
        for way, its_units, its_bytes in (
            *_boxes(frames, f, heads, net.config.geometry, errors),
            *_maps(frames, f, net, features, codebook, rho, code_bytes),
        ):
            units.setdefault(way, []).extend(its_units)
            received[way] = received.get(way, 0.0) + its_bytes / len(frames)
        if progress is not None:
            progress(f + 1, len(frames))
    scene = np.repeat(frames.scene, frames.est_pose.shape[1])
    rows = []
    for way, its in units.items():
        ranked = rank(its, scene)
        draws = ranked.ap(resamples(len(ranked.truths)))
        rows.append(Row(way, received[way] / 1e3, average_precision(its), *percentile_interval(draws), draws))
    return rows


def _boxes(
    frames: Frames, f: int, heads: torch.Tensor, geometry: Geometry, errors: BoxErrors
) -> Iterator[tuple[Way, Unit, float]]:
    """Every way to share boxes: what each ego of a frame is scored by, and the bytes that an ego receives on average."""
    captures = [_capture(d, *pair) for d, pair in enumerate(zip(frames.true_pose[f], frames.est_pose[f], strict=True))]
    found = [placed_boxes(head, c.est_pose, TAU, geometry) for head, c in zip(heads, captures, strict=True)]
    truths = [ground_truth(frames.cars[f], frames.true_pose[f, c.drone]) for c in captures]
    for way in (SILENCE, *BOX_WAYS):
        sent, units = 0, []
        for ego, truth in zip(captures, truths, strict=True):
            late = []
            for peer in captures if way is not SILENCE else ():
                if peer is not ego:
                    boxes = found[peer.drone]
                    late.append(source_of(Share(peer, way.representation, 0.0, None, 1.0), boxes, errors))
                    count = budget.boxes_sent(way.representation, len(boxes))
                    sent += budget.content_bytes(way.representation, boxes=count)
            own_errors = errors if way.common is None else replace(errors, common=way.common)
            sources = EgoSources.of(ego, (), found[ego.drone], False, late)._replace(errors=own_errors)
            units.append(match(joined_many([sources], way.join)[0], truth))
        yield way, units, sent / len(captures)


def _maps(
    frames: Frames,
    f: int,
    net: CarNet,
    features: torch.Tensor,
    codebook: Codebook,
    rho: Sequence[float],
    code_bytes: Sequence[int],
) -> Iterator[tuple[Way, Unit, float]]:
    """Every way to share maps, the same cells for all; what was not sent is left out of the fusion."""
    geometry, drones = net.config.geometry, len(features)
    settings = Settings(egos=drones, floor=TAU)
    key = frame_keys(frames)[f]
    est = frames.est_pose[f]
    near = torch.from_numpy(est - np.array([*est.mean(axis=0)[:2], 0.0])).float()
    view = CarNetView(net, features, near)
    conditions = [Sharing(r, unsent="masked") for r in rho]
    given = [e for e, _ in exchanges(view, frames, f, key, conditions, settings, geometry, None)]
    there = [ground_truth(frames.cars[f], pose, geometry.half_extent_m) for pose in frames.true_pose[f]]
    ego_of = np.array([e.ego for e in given])
    cells = features.permute(0, 2, 3, 1).reshape(-1, features.shape[1])
    codes = codebook.encode(cells, max(code_bytes)) if code_bytes else None
    for length in (0, *code_bytes):
        if length:
            assert codes is not None
            read = codebook.decode(codes[:, :length]).view(drones, CELLS, CELLS, -1).permute(0, 3, 1, 2)
            view = CarNetView(net, features, near, read)
        local = view.detect(given, TAU)
        matched = match_all(local, ego_of, est, there, {"full": None}, settings)["full"]
        for k, r in enumerate(rho):
            units = matched[k * drones : (k + 1) * drones]
            name, label = ("codes", f"codes of {length} B") if length else ("features", "features")
            each = budget.content_bytes(name, cells=budget.cells_in(r), code_bytes=length)
            yield Way(name, f"{label}, ρ = {r:g}", r, length), units, float(each * (drones - 1))
            if not length and r == 1.0:
                yield Way("raw", "raw images", r), units, float(budget.RAW_BYTES * (drones - 1))


def _capture(drone: int, true: NDArray[np.float64], est: NDArray[np.float64]) -> Capture:
    x, y, yaw = true.tolist()
    ex, ey, eyaw = est.tolist()
    return Capture(drone, 0.0, (x, y, 0.0), (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)), (ex, ey, 0.0), eyaw)


def difference(rows: Sequence[Row], of: str, over: str) -> tuple[float, float, float]:
    """AP of one way minus another's, with its interval over scenes."""
    by = {r.way.label: r for r in rows}
    a, b = by[of], by[over]
    return (a.ap - b.ap, *percentile_interval(a.draws - b.draws))


def table(rows: Sequence[Row], about: str) -> Table:
    """A row for each way."""
    silence = rows[0].way.label
    return Table(
        [
            Column("shared"),
            Column("an ego receives in a frame", ",.2f", " kB"),
            Column("AP@0.5", ".3f"),
            Column("over silence", "+.1f", factor=100),
        ],
        [
            [r.way.label, r.kilobytes, (r.ap, r.low, r.high), None if r is rows[0] else difference(rows, r.way.label, silence)]
            for r in rows
        ],
        about,
    )  # fmt: skip


def verdicts(plan: Plan, rows: Sequence[Row], torch_boxes: Calibration) -> list[bool]:
    """Which of the plan's hypotheses hold, in the plan's order."""

    def above(of: str, over: str, points: float) -> bool:
        return difference(rows, of, over)[1] > points / 100.0

    def loses_less(length: int, points: float) -> bool:
        return all(above(f"codes of {length} B, ρ = {r:g}", f"features, ρ = {r:g}", -points) for r in plan.rho)

    one, two = torch_boxes.within
    averaged = "detections, averaged"
    return [
        loses_less(10, 1.5),
        loses_less(5, 2.5),
        above("codes of 5 B, ρ = 0.25", "features, ρ = 0.02", 0.0),
        above("uncertain boxes", averaged, -1.0),
        difference(rows, "uncertain boxes, anything in common", averaged)[2] < 0.0,
        above(averaged, "features, ρ = 1", 0.0),
        0.65 <= one <= 0.75 and 0.93 <= two <= 0.97,
    ]


def verdict_table(plan: Plan, found: Sequence[bool]) -> Table:
    """Each hypothesis, and whether it holds."""
    rows = [[h, "holds" if holds else "does not hold"] for h, holds in zip(plan.hypotheses, found, strict=True)]
    return Table([Column("hypothesis"), Column("on these frames")], rows)


BINS: tuple[tuple[str, Callable[[Errors], NDArray[np.bool_]]], ...] = (
    ("all", lambda e: e.score >= 0.0),
    ("score below 0.4", lambda e: e.score < 0.4),
    ("score 0.4 to 0.7", lambda e: (e.score >= 0.4) & (e.score < 0.7)),
    ("score from 0.7", lambda e: e.score >= 0.7),
    ("nearer than 40 m", lambda e: e.distance_m < 40.0),
    ("40 to 80 m", lambda e: (e.distance_m >= 40.0) & (e.distance_m < 80.0)),
    ("from 80 m", lambda e: e.distance_m >= 80.0),
)


def calibration_table(found: Mapping[str, tuple[BoxErrors, Sequence[Moment]]], about: str) -> Table:
    """How often errors lie within their deviations, by detector, score and distance; errors were not fitted."""
    rows: list[list[str | float]] = []
    for detector, (model, moments) in found.items():
        for name, where in BINS:
            c = calibration(model, moments, where)
            rows.append([detector, name, c.boxes, *c.within, *c.within_ellipse])
    rows.append(["normal errors", "", None, *NORMAL])  # type: ignore[list-item]
    shares = [
        Column(n, ".1f", " %", 100) for n in ("within 1 σ", "within 2 σ", "in the 1 σ ellipse", "in the 2 σ ellipse")
    ]
    return Table([Column("boxes of"), Column("which"), Column("boxes", ",d"), *shares], rows, about)


NORMAL = [float(stats.chi2.cdf(deviations**2, axes)) for axes in (1, 2) for deviations in (1, 2)]
"""Of normal errors, the shares that `Calibration` has."""


def draw(rows: Sequence[Row], path: Path) -> None:
    """AP over bytes, each representation a line with the intervals over scenes."""
    from matplotlib.figure import Figure

    figure = Figure((8.0, 5.0), layout="constrained")
    axes = figure.add_subplot()
    silence = rows[0]
    axes.axhspan(silence.low, silence.high, color="#d5d7db", alpha=0.5, lw=0)
    axes.axhline(silence.ap, color="#7a7d85", lw=1, label="silence")
    by: dict[str, list[Row]] = {}
    for row in rows[1:]:
        by.setdefault(row.way.label.partition(", ρ")[0], []).append(row)
    for (name, several), (colour, marker) in zip(by.items(), MARKS, strict=True):
        x, y = [r.kilobytes for r in several], [r.ap for r in several]
        off = [[r.ap - r.low for r in several], [r.high - r.ap for r in several]]
        axes.errorbar(x, y, yerr=off, color=colour, marker=marker, ms=6, lw=1.4, elinewidth=0.8, capsize=2, label=name)
    axes.set_xscale("log")
    axes.set_xlabel("content that an ego receives in a frame from four peers, kB (logarithmic)")
    axes.set_ylabel("AP@0.5")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, ncols=2, loc="lower right")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


MARKS = (
    ("#4f7fd0", "v"), ("#e0b060", "o"), ("#d08a1d", "s"), ("#c05a2a", "D"), ("#a04a4a", "P"), ("#3f9a52", "o"),
    ("#b04fb0", "*"), ("#1d6f80", "^"), ("#2a9ab0", "X"), ("#70c0d0", "h"),
)  # fmt: skip


def tables(picture: Path, root: Path) -> dict[str, Table]:
    """All of it, as the plan says: measured, drawn and judged.

    Args:
        picture: file of the plot.
        root: folder of benchmarks.
    """
    from research.calibrate.errors import moments
    from sortie.perception.surrogate.model import SHIPPED

    plan = read_plan()
    frames = load_frames(make_split(Benchmark(plan.bench_seed), "test", root, scenes=plan.frames))
    weights = SHIPPED_WEIGHTS
    model = load_errors(beside(weights, ERRORS), weights.name)
    found = moments_of(frames, boxes_alone(load_weights(weights), frames, TAU))
    rows = measure(frames, weights, plan.rho, plan.code_bytes)
    draw(rows, picture)
    of_surrogate = load_errors(beside(SHIPPED, ERRORS), SHIPPED.name), moments(SHIPPED, "held-out", 40)
    about = f"{len(frames)} frames of the test split of benchmark seed {plan.bench_seed}, five egos each"
    losses = [
        [r.way.label, r.way.rho, budget.payload_bytes(1) / r.way.code_bytes, difference(rows, r.way.label, f"features, ρ = {r.way.rho:g}")]
        for r in rows
        if r.way.code_bytes
    ]  # fmt: skip
    columns = [Column("codes"), Column("ρ", "g"), Column("times fewer bytes a cell", ".0f"), Column("over features", "+.1f", factor=100)]  # fmt: skip
    return {
        "representations": table(rows, f"{about}; intervals over scenes. Content with its index, without headers."),
        "codes_over_features": Table(columns, losses, "Points of AP against features in the same cells."),
        "box_errors": calibration_table(
            {"torch": (model, found), "surrogate": of_surrogate},
            f"Errors that were not fitted: {about}, and 40 held-out towns of the surrogate's calibration.",
        ),
        "representation_verdicts": verdict_table(plan, verdicts(plan, rows, calibration(model, found))),
    }
