"""A comparison of policies as one self-contained HTML page: the figures side by side, and the first seed's flights over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sortie.sim.experiment.compare import Flown
from sortie.sim.experiment.comparison_text import comparison_blocks, heading, what_gains_are
from sortie.sim.experiment.half_width import Precision
from sortie.sim.folders import write_text
from sortie.sim.results.blocks import Figure, Heading, Paragraph, html_page
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.report_figures import (
    accuracy_points,
    colour,
    delivered_mbps,
    draw_lanes,
    drawn,
    legend_beside,
    mark_moments,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DOTS: tuple[tuple[str, str, float], ...] = (
    ("AP@0.5, full scene", "ap50.full_scene", 1.0),
    ("AP@0.5, mission disc", "ap50.mission", 1.0),
    ("Data delivered, MB", "bytes.data_delivered", 1e-6),
    ("Deadlines missed, %", "deadline_miss_rate", 100.0),
    ("Energy, kJ", "energy_j.total", 1e-3),
)
"""Caption, name in the outcome, and factor of each figure that has a dot for each sortie."""
Plot = tuple[str, float, Callable[["Axes"], None]]


def save_comparison_page(flown: Flown, path: Path, precision: Precision | None = None) -> None:
    """Write the page; it is there whole or not at all.

    Raises:
        RunError: the file cannot be written, or matplotlib is not installed.
    """
    write_text(path, comparison_page(flown, precision))


def comparison_page(flown: Flown, precision: Precision | None = None) -> str:
    """The page as HTML: no script, and nothing fetched from anywhere.

    Args:
        flown: the sorties; figures over time need the first seed's records, and are left out without them.
        precision: of a comparison to a half-width, what it flew.
    """
    labels = list(dict.fromkeys(s.policy for s in flown.sorties))
    plots = drawn([*_dots(flown, labels), *_over_time(flown)])
    return html_page(
        [
            Heading("Policies compared", 1),
            Paragraph(heading(flown)),
            Heading("In numbers"),
            Paragraph(what_gains_are(flown)),
            *comparison_blocks(flown, precision),
            Heading("In figures"),
            Paragraph(
                "A small dot is one sortie, a large one the mean of a policy's sorties. Figures over time show the first seed's "
                "sorties."
            ),
            *(Figure(caption, svg=svg) for caption, svg in plots.items()),
        ]
    )


def _dots(flown: Flown, labels: Sequence[str]) -> Iterator[Plot]:
    """A figure for each of `DOTS` that any sortie has."""
    for caption, place, factor in DOTS:
        values = [
            [factor * v for s in flown.sorties if s.policy == label and (v := s.outcome.number(place)) is not None]
            for label in labels
        ]
        if any(values):
            yield caption, 0.7 + 0.4 * len(labels), partial(_draw_dots, labels=labels, values=values)


def _draw_dots(axes: Axes, *, labels: Sequence[str], values: Sequence[Sequence[float]]) -> None:
    for row, each in enumerate(values):
        axes.plot(each, [row] * len(each), "o", color=colour(row), markersize=5, alpha=0.45)
        if each:
            mean = float(np.mean(each))
            axes.plot([mean], [row], "o", color=colour(row), markersize=11)
            axes.annotate(
                f"{mean:.3g}", (mean, row), xytext=(0, 9), textcoords="offset points", ha="center", fontsize=11
            )
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.5, -0.7)
    most = max((v for each in values for v in each), default=0.0) or 1.0
    axes.set_xlim(-0.03 * most, 1.08 * most)


def _over_time(flown: Flown) -> Iterator[Plot]:
    """The first seed's sorties over time: all policies in one figure, then each one's lanes."""
    records = [(s.policy, s.record) for s in flown.sorties if s.record is not None]
    if not records:
        return
    for mission, area in ((False, "full scene"), (True, "mission disc")):
        points = {label: accuracy_points(record, mission=mission) for label, record in records}
        if any(len(each) for each in points.values()):
            yield (
                f"Accuracy over the last five seconds, {area}, AP@0.5",
                2.6,
                partial(_draw_lines, lines=points, record=records[0][1], top=1.0),
            )
    traffic = {label: delivered_mbps(record) for label, record in records}
    yield "Payloads delivered, Mb/s", 2.6, partial(_draw_lines, lines=traffic, record=records[0][1])
    for label, record in records:
        height_in = 0.6 + 0.45 * record.scenario.fleet.drones
        caption = f"{label}: what each drone was to send (upper bar), and the best that arrived each second (lower bar)"
        yield caption, height_in, partial(draw_lanes, record=record)


def _draw_lines(axes: Axes, *, lines: dict[str, Any], record: SortieRecord, top: float | None = None) -> None:
    for number, (label, points) in enumerate(lines.items()):
        if len(points):
            axes.plot(*points.T, color=colour(number), linewidth=2.0, label=label)
    axes.set_ylim(0.0, top)
    mark_moments(axes, record)
    legend_beside(axes)
