"""The paper's data figure of one frame by matplotlib: camera views, ground truth and detections, and the shared cells."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from research.paper.picture import Picture
from sortie.perception.evaluation.sharing import Floats
from sortie.perception.geometry import CELLS, to_world
from sortie.perception.metrics.overlap import corners
from sortie.perception.types import Boxes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NADIR = -1
"""The camera that looks straight down is the last."""
TRUTH, FOUND, DRONE, DISC = "#8c8c8c", "#1f6fb4", "#222222", "#c33a8a"


def draw(picture: Picture) -> Figure:
    """Five nadir views over three maps of the ego's square, east right and north up."""
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    parts: Any = figure.subfigures(2, 1, height_ratios=[1.0, 3.0])
    above, below = parts
    _views(above, picture)
    axes = below.subplots(1, 1 + len(picture.shared), sharex=True, sharey=True)
    axes = np.atleast_1d(axes).ravel().tolist()
    _ground(axes[0], picture)
    _boxes(axes[0], picture.truth, TRUTH, filled=True, label=f"truth ({len(picture.truth)})")
    _boxes(axes[0], picture.found, FOUND, filled=False, label=f"detections ({len(picture.found)})")
    axes[0].set_title(f"(a) {picture.name}: truth and detections", fontsize=9, loc="left")
    axes[0].legend(fontsize=7, loc="upper right", framealpha=0.9)
    peers = max(1, len(picture.est_pose) - 1)
    shades = ListedColormap(colormaps["YlGnBu"](np.linspace(0.3, 1.0, peers)))
    steps = BoundaryNorm(np.arange(0.5, peers + 1), peers)
    for k, (ax, (budget, counts)) in enumerate(zip(axes[1:], picture.shared, strict=True)):
        x, y = _cell_corners(picture)
        mesh = ax.pcolormesh(x, y, np.ma.masked_equal(counts, 0), cmap=shades, norm=steps, rasterized=True)
        _ground(ax, picture)
        _boxes(ax, picture.truth, TRUTH, filled=False, label="")
        ax.set_title(
            f"({'bcdef'[k]}) cells shared with drone {picture.ego} at a budget of {budget:g}", fontsize=9, loc="left"
        )
        if k == len(picture.shared) - 1:
            bar = below.colorbar(
                mesh, ax=ax, ticks=range(1, peers + 1), boundaries=np.arange(0.5, peers + 1), shrink=0.6
            )
            bar.set_label("peers that share the cell", fontsize=8)
            bar.ax.tick_params(labelsize=7)
    return figure


def _views(figure: Any, picture: Picture) -> None:
    """Each drone's nadir camera; nothing where the frame has no images."""
    if picture.views is None:
        return
    axes = np.atleast_1d(figure.subplots(1, len(picture.views))).ravel().tolist()
    for drone, (ax, view) in enumerate(zip(axes, picture.views, strict=True)):
        ax.imshow(view[NADIR])
        ax.set_title(f"drone {drone}" + (", the ego" if drone == picture.ego else ""), fontsize=8)
        ax.set_axis_off()


def _ground(ax: Axes, picture: Picture) -> None:
    from matplotlib.patches import Circle

    reach = picture.geometry.half_extent_m
    square = np.array([(-reach, -reach), (reach, -reach), (reach, reach), (-reach, reach), (-reach, -reach)])
    x, y = to_world(square[:, 0], square[:, 1], picture.true_pose[picture.ego])
    ax.plot(x, y, color=DRONE, lw=0.6, alpha=0.4)
    ax.plot(picture.true_pose[:, 0], picture.true_pose[:, 1], "^", color=DRONE, ms=5, mec="white", mew=0.6, zorder=5)
    if picture.disc is not None:
        ax.add_patch(Circle(picture.disc[:2], picture.disc[2], fill=False, color=DISC, lw=1.0, ls="--"))
    ax.set_aspect("equal")
    ax.tick_params(labelsize=7)
    ax.set_xlabel("east, m", fontsize=8)


def _boxes(ax: Axes, boxes: Boxes, colour: str, *, filled: bool, label: str) -> None:
    from matplotlib.collections import PolyCollection

    ax.add_collection(
        PolyCollection(
            list(corners(boxes.table())),
            facecolors=colour if filled else "none",
            edgecolors=colour,
            linewidths=0.9,
            label=label,
            zorder=3 if filled else 4,
        )
    )


def _cell_corners(picture: Picture) -> tuple[Floats, Floats]:
    """World coordinates [65, 65] of the corners of the ego's cells, by its estimated pose."""
    along = (np.arange(CELLS + 1) - CELLS / 2) * picture.geometry.cell_m
    forward, left = np.meshgrid(along, along, indexing="ij")
    return to_world(forward, left, picture.est_pose[picture.ego])
