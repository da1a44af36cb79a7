"""Sorties of one scenario under several policies, side by side in one recording: a scene each, and plots that share an axis."""

from __future__ import annotations

import re
from collections.abc import Sequence

import rerun as rr
import rerun.blueprint as rrb

from sortie.scenarios.schema import Scenario
from sortie.sim.playback.layout import lanes_view, log_view, scene_view, sheet, time_axis
from sortie.sim.results.palette import DRONE_COLOURS

SHARED = (
    ("AP@0.5 in the mission disc, last 5 s", "ap/mission", (0.0, 1.0)),
    ("features delivered, Mb/s", "traffic/features_delivered", None),
    ("age of descriptors, 99th percentile, ms", "age/p99_ms", None),
    ("descriptors lost, %", "lost/percent", None),
    ("channel busy, %", "medium/busy_percent", (0.0, 104.0)),
)
"""Plots in which every policy has a line: name, entity below `plots`, range."""


def roots(labels: Sequence[str]) -> list[str]:
    """An entity path for each policy: its label in letters that need no escaping, numbered where two would be the same."""
    plain = [re.sub(r"[^A-Za-z0-9_-]+", "_", label).strip("_") or "policy" for label in labels]
    return [f"{name}_{k}" if name in plain[:k] else name for k, name in enumerate(plain)]


def comparison(scenario: Scenario, labels: Sequence[str]) -> rrb.Blueprint:
    """A column a policy (scene, lanes, decisions), and below the plots that they share."""
    columns = [
        rrb.Vertical(
            scene_view(scenario, f"/{root}", label),
            lanes_view(scenario, f"/{root}", f"{label}: what each drone sends on its best link"),
            log_view(f"/{root}", f"{label}: who decided what, and why"),
            row_shares=[2.7, 2.7, 1.4],
        )
        for root, label in zip(roots(labels), labels, strict=True)
    ]
    shared = SHARED if scenario.perception.detector != "none" else SHARED[1:]
    plots = [_plot(scenario, labels, *plot) for plot in shared]
    return sheet(rrb.Vertical(rrb.Horizontal(*columns), rrb.Horizontal(*plots), row_shares=[4, 1]))


def _plot(scenario: Scenario, labels: Sequence[str], name: str, entity: str, y: tuple[float, float] | None) -> rrb.View:
    """One line a policy, in a colour of its own, whatever colour it has in its own recording."""
    lines = {f"/{root}/plots/{entity}": k for k, root in enumerate(roots(labels))}
    return rrb.TimeSeriesView(
        name=name,
        contents=list(lines),
        overrides={
            path: rr.SeriesLines(colors=[DRONE_COLOURS[k % len(DRONE_COLOURS)]], names=[labels[k]], widths=[2.0])
            for path, k in lines.items()
        },
        axis_x=time_axis(scenario),
        axis_y=None if y is None else rrb.ScalarAxis(range=y),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )
