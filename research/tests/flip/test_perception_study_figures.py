"""What the study's figures show, mark by mark: each network's own figures in the panel and at the place that say so."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from research.flip.dose_figure import APART, COLOURS, draw
from research.flip.doses import Dose, DosePlan, DoseRow, Effect
from research.flip.figures import PAPER_CONTRAST, contrasts, starved
from research.flip.measure import StudyRow
from research.flip.plan import PLAN, read_plan

pytest.importorskip("matplotlib")
PLANNED = read_plan(PLAN)
BUDGETS = PLANNED.measured.budgets
NETWORKS = (("full", 0), ("full", 1), ("deep", 0))


def row(k: int, unsent: str, quantity: str, budget: float, value: float) -> StudyRow:
    variant, seed = NETWORKS[k]
    ways = (variant, seed, "default", unsent, "confidence", "model", 0.1)
    return StudyRow(*ways, quantity, budget, value, value - 1 - k, value + 2 + k, 80)


ROWS = [
    made
    for k in range(len(NETWORKS))
    for unsent, up in (("zero", 0.0), ("masked", 100.0))
    for made in (
        *(row(k, unsent, "contrast", b, up + 10 * k + i) for i, b in enumerate(BUDGETS)),
        row(k, unsent, "starved", 0.01, up + 50 + k),
    )
]


def test_each_network_has_its_marks_beside_those_of_the_others_in_its_filling_s_panel() -> None:
    figure = contrasts(PLANNED, ROWS)
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["Zero fill, as in the paper", "Masked fusion"]
    for ax, up in zip(figure.axes, (0.0, 100.0), strict=True):
        assert len(ax.containers) == len(NETWORKS)
        for k, bars in enumerate(ax.containers):
            line: Any = bars[0]
            np.testing.assert_allclose(line.get_xdata(orig=False), np.arange(4) + 0.2 * (k - 1))
            np.testing.assert_allclose(line.get_ydata(orig=False), up + 10 * k + np.arange(4))
            ends = [sorted(end[1] for end in segment) for segment in bars[2][0].get_segments()]
            expected = [(up + 10 * k + i - 1 - k, up + 10 * k + i + 2 + k) for i in range(4)]
            np.testing.assert_allclose(ends, expected)
        paper = [line for line in ax.lines if line.get_marker() == "D"]
        assert len(paper) == (up == 0.0)
    np.testing.assert_array_equal(paper_of(figure.axes[0])[0], np.arange(4))
    np.testing.assert_array_equal(paper_of(figure.axes[0])[1], [PAPER_CONTRAST[b] for b in BUDGETS])
    labels = [t.get_text() for t in figure.legends[0].get_texts()]
    assert sorted(labels) == ["deep", "full", "paper"]


def paper_of(ax: Any) -> tuple[Any, Any]:
    (line,) = [line for line in ax.lines if line.get_marker() == "D"]
    return line.get_xdata(orig=False), line.get_ydata(orig=False)


def test_a_budget_that_is_no_paper_s_has_no_mark_and_what_was_not_measured_neither() -> None:
    plan = replace(PLANNED, measured=replace(PLANNED.measured, budgets=(0.03, 0.05)))
    some = [r for r in ROWS if r.quantity == "starved" or r.received_budget == 0.05]
    ax = contrasts(plan, some).axes[0]
    assert [list(v) for v in paper_of(ax)] == [[1], [PAPER_CONTRAST[0.05]]]
    np.testing.assert_allclose(ax.containers[0][0].get_xdata(orig=False), [1 - 0.2])


def test_a_starved_fleet_is_a_line_a_network_under_each_filling() -> None:
    """Hollow where it is masked, from the interval's one end to the other."""
    (ax,) = starved(PLANNED, ROWS).axes
    marks = {(round(float(line.get_ydata()[0]), 2)): line for line in ax.lines if line.get_marker() == "o"}
    spans = {
        (round(float(line.get_ydata()[0]), 2)): line.get_xdata() for line in ax.lines if len(line.get_xdata()) == 2
    }
    for k in range(len(NETWORKS)):
        for down, value, hollow in ((0.12, 50.0 + k, False), (-0.12, 150.0 + k, True)):
            y = round(down - k, 2)
            assert list(marks[y].get_xdata()) == [value]
            assert (marks[y].get_markerfacecolor() == "white") is hollow
            assert list(spans[y]) == [value - 1 - k, value + 2 + k]
    assert [t.get_text() for t in ax.get_yticklabels()] == ["full-0", "full-1", "deep-0"]


STUDY = DosePlan("", ("",) * 5, ("a", "b"), BUDGETS, 0.01, "all-4", "best-2", ())  # type: ignore[arg-type]


def dosed(network: str, dose: Dose, weight: float, up: float) -> DoseRow:
    def effect(value: float) -> Effect:
        return Effect(up + value, up + value - 1, up + value + 3)

    return DoseRow(network, dose, weight, effect(10), effect(20), tuple(effect(30 + i) for i in range(4)), 80)


DOSED = [
    dosed("a", Dose(math.inf), 0.8, 1.0), dosed("a", Dose(), 0.2, 2.0), dosed("a", Dose(unsent="masked"), 0.0, 3.0),
    dosed("a", Dose(absent="zeros"), 0.5, 4.0), dosed("b", Dose(), 0.3, 5.0),
]  # fmt: skip


def test_each_panel_of_the_doses_shows_its_own_effect_over_the_weight_on_zeros() -> None:
    """The line joins doses of zero fill by weight; what has that weight by definition is moved aside, network by network."""
    figure = draw(STUDY, DOSED)
    values = [10, 20, 30, 31, 32, 33]
    paper = [-5.4, None, *(PAPER_CONTRAST[b] for b in BUDGETS)]
    for ax, value, level in zip(figure.axes, values, paper, strict=True):
        joined = [
            line for line in ax.lines if line.get_lw() == 1 and line.get_ls() == "-" and len(line.get_xdata()) > 0
        ]
        assert [(list(v.get_xdata()), list(v.get_ydata()), v.get_color()) for v in joined] == [
            ([0.2, 0.8], [value + 2.0, value + 1.0], COLOURS[0]), ([0.3], [value + 5.0], COLOURS[1]),
        ]  # fmt: skip
        points = [line for line in ax.lines if line.get_marker() in ("o", "s") and len(line.get_xdata()) == 1]
        spans = [line for line in ax.lines if line.get_lw() == 1.4]
        for r, point, span in zip(DOSED, points, spans, strict=True):
            beside = {"a": -APART / 2, "b": APART / 2}[r.network]
            own = r.dose.unsent == "masked" or r.dose.absent == "zeros"
            x = r.weight_on_zeros + (beside if own else 0.0)
            up = r.starved.value - 10
            assert (point.get_xdata()[0], point.get_ydata()[0]) == pytest.approx((x, up + value))
            assert list(span.get_ydata()) == [up + value - 1, up + value + 3]
            assert point.get_marker() == ("s" if r.dose.absent == "zeros" else "o")
            assert (point.get_markerfacecolor() == "white") == (r.dose.unsent == "masked")
        dotted = [line.get_ydata()[0] for line in ax.lines if line.get_ls() == ":" and len(line.get_xdata()) == 2]
        assert dotted == ([] if level is None else [level])
    scales = [ax.get_ylim() for ax in figure.axes]
    assert len(set(scales[2:])) == 1
    assert scales[2][0] <= min(paper[2:])  # type: ignore[type-var]
    assert scales[2][1] >= 33 + 5 + 3
