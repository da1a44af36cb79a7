"""What figures draw: each number where it belongs, by its own pose, region, instrument and interval."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from paper_examples import Made

from research.paper.claims import BUDGETS, CLAIMS, CURVE
from research.paper.figure_frame import draw
from research.paper.figures import PAPER, PAPER_CURVE, POLICY_COLOURS, forest, frontier, peer_selection
from research.paper.picture import Picture
from research.paper.rows import Point, judge
from research.paper.verdict import MeasuredValue
from sortie.perception.geometry import SMALL, to_world
from sortie.perception.metrics.overlap import corners
from sortie.perception.types import Boxes
from sortie.scenarios.disc import Disc

Floats = np.ndarray[Any, np.dtype[np.float64]]


def point(peers: str, budget: float, instrument: str, region: str, ap: float, allocation: str = "uniform") -> Point:
    """An interval that reaches further down than up."""
    return Point(peers, budget, allocation, instrument, region, ap, ap - 0.03, ap + 0.01)


def curve(instrument: str, region: str) -> list[float]:
    first = 0.2 + 0.3 * (region == "mission") + 0.1 * (instrument == "masked")
    return [first + 0.02 * k for k in range(len(CURVE))]


def test_the_frontier_has_each_regions_own_curves_single_drone_and_paper() -> None:
    points = [
        point("all-4", budget, i, r, ap)
        for i in ("zero", "masked")
        for r in ("full", "mission")
        for budget, ap in zip(CURVE, curve(i, r), strict=True)
    ]
    points += [
        point("none", 0.0, i, r, 0.1 + 0.05 * (r == "mission")) for i in ("zero", "masked") for r in ("full", "mission")
    ]
    points += [point("all-4", 0.1, "zero", "full", 0.99, "overlap"), point("best-2", 0.1, "zero", "full", 0.98)]
    for ax, region in zip(frontier(points).axes, ("full", "mission"), strict=True):
        for container, instrument in zip(ax.containers, ("zero", "masked"), strict=True):
            line, _, (bars,) = container.lines  # type: ignore[union-attr,misc]
            ap = np.array(curve(instrument, region))
            np.testing.assert_allclose(line.get_xydata(), np.column_stack([CURVE, ap]))
            ends = np.array([segment[:, 1] for segment in bars.get_segments()])
            np.testing.assert_allclose(ends, np.column_stack([ap - 0.03, ap + 0.01]))
        lines = {str(line.get_label()): line for line in ax.lines}
        assert set(lines["a single drone"].get_ydata()) == {0.1 + 0.05 * (region == "mission")}
        drawn = dict(np.asarray(lines["paper (UAV3D)"].get_xydata()).tolist())
        assert drawn == PAPER_CURVE[region]
        assert ("paper, a single drone" in lines) == (region == "full")


def test_the_best_policy_of_a_budget_is_marked_by_its_ap() -> None:
    """Not by the upper end of an interval; over its own mark, in its own colour."""
    names = list(POLICY_COLOURS)
    points = [
        Point(name, budget, "uniform", "zero", "full", 0.3 + 0.01 * ((k + b) % 4), 0.2, 0.5 - 0.01 * ((k + b) % 4))
        for b, budget in enumerate(BUDGETS)
        for k, name in enumerate(names)
    ]
    (ax,) = peer_selection(points).axes
    marks = [line for line in ax.lines if line.get_marker() == "v"]
    for b, mark in enumerate(marks):
        k = (3 - b) % 4
        assert np.asarray(mark.get_xydata()).tolist() == [pytest.approx([b + 0.13 * (k - 1.5), 0.47 + 0.012])]
        assert mark.get_color() == POLICY_COLOURS[names[k]]
    assert len(marks) == len(BUDGETS)
    for k, container in enumerate(ax.containers):
        wanted = [0.3 + 0.01 * ((k + b) % 4) for b in range(len(BUDGETS))]
        assert container.lines[0].get_ydata() == pytest.approx(wanted)  # type: ignore[union-attr]


def test_the_forest_has_a_line_a_difference_with_the_papers_interval_beside_both_of_ours() -> None:
    claims = [c for c in CLAIMS if c.id in ("gain", "starved", "single")]
    ours = {"zero": 0.31, "masked": 0.35}
    scores = {i: Made({("all-4@1", "full"): v, ("single", "full"): 0.2}, noise=0.0) for i, v in ours.items()}
    rows = judge(scores, {"nothing": MeasuredValue(1.0)}, claims)  # type: ignore[arg-type]
    (ax,) = forest(rows).axes
    drawn = {
        tuple(np.round(np.asarray(line.get_xydata())[0], 6)): line
        for line in ax.lines
        if line.get_marker() in "oD" and len(line.get_xydata())
    }
    assert [t.get_text() for t in ax.get_yticklabels()] == [c.says for c in claims if c.unit == "AP points"]
    assert drawn[18.5, 0.22].get_markerfacecolor() == PAPER
    assert drawn[-5.4, -0.78].get_markerfacecolor() == "white", "arithmetic on the paper's figures"
    assert drawn[11.0, 0.02].get_markerfacecolor() != "white"
    assert drawn[15.0, -0.2].get_markerfacecolor() == "white", "masked fusion"
    assert [16.9, 20.3] in [np.asarray(line.get_xdata()).tolist() for line in ax.lines]


def test_the_frame_is_drawn_by_true_poses_and_its_cells_by_the_pose_that_was_believed() -> None:
    """Drones and the square of the truth where they are; the ego's cells where it places them; views from straight above."""
    rng = np.random.default_rng(0)
    true = rng.normal(0.0, 20.0, (3, 3))
    est = true + rng.normal(0.0, 4.0, (3, 3))
    views = np.broadcast_to(np.arange(15, dtype=np.uint8).reshape(3, 5, 1, 1, 1), (3, 5, 4, 6, 3))
    boxes = [
        Boxes.placed(rng.uniform((-30, -30, 4, 1.8, -3, 0.2), (30, 30, 5, 2, 3, 1), (n, 6)), (0.0, 0.0, 0.0))
        for n in (5, 3)
    ]
    counts = rng.integers(0, 3, (64, 64))
    seen = Picture("a frame", 1, SMALL, true, est, boxes[0], boxes[1], Disc(5.0, 6.0, 32.0), ((0.25, counts),), views)
    figure = draw(seen)
    above, below = figure.subfigs
    for drone, ax in enumerate(above.axes):
        assert np.unique(np.asarray(ax.images[0].get_array())).tolist() == [5 * drone + 4]
        assert ("the ego" in ax.get_title()) == (drone == 1)
    ground, cells = below.axes[:2]
    for ax in (ground, cells):
        square, drones = ax.lines
        ring = 51.2 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
        np.testing.assert_allclose(square.get_xydata(), np.column_stack(to_world(*ring.T, true[1])))
        np.testing.assert_allclose(drones.get_xydata(), true[:, :2])
        assert (*ax.patches[0].center, ax.patches[0].radius) == (5.0, 6.0, 32.0)  # type: ignore[attr-defined]
    for drawn, there in zip(ground.collections, boxes, strict=True):
        np.testing.assert_allclose([p.vertices[:4] for p in drawn.get_paths()], corners(there.table()))
    mesh = cells.collections[0]
    edge = (np.arange(65) - 32) * 1.6
    wanted = np.stack(to_world(*np.meshgrid(edge, edge, indexing="ij"), est[1]), axis=-1)
    np.testing.assert_allclose(mesh.get_coordinates(), wanted)  # type: ignore[attr-defined]
    array = np.ma.asarray(mesh.get_array()).reshape(64, 64)
    np.testing.assert_array_equal(array.filled(0), counts)
    np.testing.assert_array_equal(np.ma.getmaskarray(array), counts == 0)
