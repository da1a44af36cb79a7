"""Counts of a split's scenes, without rendering: cars, how many are hidden, and how much ground is built on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from research.benchmark.dataset import Benchmark
from research.benchmark.difficulty import Split
from research.benchmark.scenes import AREA_M, draw_captures, draw_scene, model_of
from research.benchmark.visibility import SEEN, inside, visible


@dataclass(frozen=True, slots=True)
class Counts:
    """One fleet-frame, means over its five egos."""

    style: str
    cars: float
    """Cars in the ego's square: the ground truth of AP."""
    alone: float
    """Part of them that the ego sees."""
    fleet: float
    """Part of them that some drone sees: the most that sharing could reach."""
    built: float
    """Part of the fleet's ground under roofs."""
    height_m: float
    """Mean height of its buildings, each counted once."""
    lot_m: float
    """Mean side of its lots."""


def survey(bench: Benchmark, split: Split, index: int, frame: int = 0) -> Counts:
    """Count one frame of a scene; about a fifth of a CPU second."""
    config = draw_scene(bench.seed, split, index, bench.difficulty)
    scene = model_of(config)
    captures = draw_captures(bench.seed, split, index, frame, bench.difficulty)
    cars = scene.cars_at(captures[0].t_s)
    counted = np.stack([inside(c, cars, bench.geometry.half_extent_m) for c in captures])
    near = np.flatnonzero(counted.any(axis=0))
    cars, counted = cars.where(near), counted[:, near]
    seen = np.stack([visible(scene, c, cars) >= SEEN for c in captures])
    blocks = scene.town.blocks(-AREA_M, -AREA_M, AREA_M, AREA_M)
    lots, buildings = np.concatenate([b.lots for b in blocks]), np.concatenate([b.buildings for b in blocks])
    total = max(int(counted.sum()), 1)
    return Counts(
        style=config.style,
        cars=float(counted.sum(axis=1).mean()),
        alone=float((seen & counted).sum() / total),
        fleet=float((seen.any(axis=0) & counted).sum() / total),
        built=float(_area(buildings).sum() / (len(blocks) * config.block_m**2)),
        height_m=float(buildings[:, 4].mean()) if len(buildings) else 0.0,
        lot_m=float(np.sqrt(_area(lots)).mean()),
    )


def _area(rectangles: np.ndarray) -> np.ndarray:
    x0, y0, x1, y1 = rectangles.T[:4]
    return np.asarray((x1 - x0) * (y1 - y0))


def by_style(rows: Sequence[Counts]) -> list[tuple[str, int, Counts]]:
    """(style, scenes, means) of each style, and of all under the name `all`."""
    out = []
    for style in [*dict.fromkeys(r.style for r in rows), "all"]:
        mine = [r for r in rows if style in (r.style, "all")]
        means = {f.name: float(np.mean([getattr(r, f.name) for r in mine])) for f in fields(Counts)[1:]}
        out.append((style, len(mine), Counts(style, **means)))
    return out
