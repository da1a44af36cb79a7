"""A frame of the benchmark on one page: five drones' views, their bird's-eye images, and the cars."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from research.benchmark.dataset import Benchmark
from research.benchmark.difficulty import Split
from research.benchmark.scenes import DRONES, draw_captures, draw_scene, model_of, scene_id
from research.benchmark.visibility import SEEN, inside, visible
from sortie.perception.errors import InputError
from sortie.perception.network.bev import lift
from sortie.perception.scene.render import CAMERAS, Renderer
from sortie.scenarios.replacing import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SEEN_COLOUR, PEER_COLOUR, HIDDEN_COLOUR = "#ffd23f", "#4cc9f0", "#ff3b5c"


def draw(bench: Benchmark, split: Split, index: int, frame: int = 0) -> Figure:
    """A row of views for each drone; below, a bird's-eye image for each with the cars in its square.

    Yellow: the drone sees it; blue: only another does; red: none. By straight lines (`visibility.py`), not by a network.

    Raises:
        ImportError: matplotlib is missing.
        InputError: no such scene or frame.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon

    if index < 0 or frame < 0:
        raise InputError(f"scene {index}, frame {frame}: must be 0 or above")
    config = draw_scene(bench.seed, split, index, bench.difficulty)
    scene = model_of(config)
    captures = draw_captures(bench.seed, split, index, frame, bench.difficulty, bench.geometry.cameras)
    views = Renderer(scene, scene_id(bench.seed, split, index)).render(captures)
    ground = lift(views, captures, bench.geometry).numpy()
    cars = scene.cars_at(captures[0].t_s)
    seen = np.stack([visible(scene, c, cars) >= SEEN for c in captures])

    half = bench.geometry.half_extent_m
    figure = Figure(figsize=(16, 13.2), layout="constrained")
    axes = figure.subplots(DRONES + 1, len(CAMERAS), height_ratios=[0.5625] * DRONES + [1.0])
    for d, capture in enumerate(captures):
        for ax, name, view in zip(axes[d], CAMERAS, views[d], strict=True):
            ax.imshow(view)
            ax.set_title(name if d == 0 else "", fontsize=9)
        axes[d, 0].set_ylabel(f"drone {d}", fontsize=9)
        ax = axes[DRONES, d]
        # row 0 is the rearmost, column 0 the rightmost: shown with forward up and left to the left
        ax.imshow(ground[d, :3].transpose(1, 2, 0)[::-1, ::-1], extent=(half, -half, -half, half))
        counted = inside(capture, cars, half)
        c, s = np.cos(capture.true_yaw_rad), np.sin(capture.true_yaw_rad)
        for k in np.flatnonzero(counted):
            corners = _corners(cars.length_m[k], cars.width_m[k], cars.yaw_rad[k])
            corners += (cars.x_m[k] - capture.position_m[0], cars.y_m[k] - capture.position_m[1])
            local = corners @ np.array([[c, -s], [s, c]])  # forward, left
            colour = SEEN_COLOUR if seen[d, k] else PEER_COLOUR if seen[:, k].any() else HIDDEN_COLOUR
            ax.add_patch(Polygon(local[:, ::-1], closed=True, fill=False, edgecolor=colour, linewidth=0.9))
        others = seen.any(axis=0)
        counts = f"drone {d}: {counted.sum()} cars: sees {(counted & seen[d]).sum()}, fleet {(counted & others).sum()}"
        ax.set_title(counts, fontsize=9)
        ax.set_xlim(half, -half)
        ax.set_ylim(-half, half)
    for ax in axes.flat:
        ax.set_xticks([])
        ax.set_yticks([])
    figure.suptitle(
        f"{split} {index}, frame {frame}: {config.style}, blocks {config.block_m:.0f} m, built {config.building_density:.2f}, "
        f"mean height {config.building_height_m:.0f} m, trees {config.tree_density:.2f}, sun {config.sun_elevation_deg:.0f}°, "
        f"overcast {config.overcast:.2f}. Boxes: yellow seen by the drone, blue by another only, red by none.",
        fontsize=9,
    )
    return figure


def save(figure: Figure, path: Path) -> None:
    """As a PNG, under a temporary name first."""
    with replacing(path) as part:
        figure.savefig(part, format="png", dpi=110)


def _corners(length: float, width: float, yaw: float) -> np.ndarray:
    """[4, 2] around the origin."""
    box = 0.5 * np.array([(length, width), (length, -width), (-length, -width), (-length, width)])
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(box @ np.array([[c, s], [-s, c]]))
