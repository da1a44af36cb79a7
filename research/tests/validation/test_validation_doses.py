"""The dose–response study's tables: rows in the plan's order, verdicts by network, and how many frames they stand on."""

from __future__ import annotations

from dataclasses import replace

import pytest

from research.flip.dose_figure import draw
from research.flip.doses import Dose, DosePlan, DoseRow, Effect, read_plan
from research.validation import doses

PLAN = read_plan()


def rows(plan: DosePlan, frames: int) -> list[DoseRow]:
    """Every dose of two networks; in the second a starved fleet gains at every weight."""

    def effect(value: float) -> Effect:
        return Effect(value, value - 1.0, value + 1.0)

    def row(network: str, dose: Dose, sign: float) -> DoseRow:
        weight = 0.0 if dose.unsent == "masked" else 0.02 + 0.1 * dose.silent_weight + 0.7 * (dose.temperature > 1.0)
        low = 5.0 if dose.unsent == "masked" else 5.0 - 10.0 * weight * sign
        two = [-4.0 + 8.0 * weight * (k == 0) for k in range(len(plan.budgets))]
        return DoseRow(network, dose, weight, effect(low), effect(10.0 * weight), tuple(map(effect, two)), frames)

    return [row(name, dose, sign) for name, sign in (("full-0", 1.0), ("full-1", 0.0)) for dose in plan.dose]


def test_a_table_says_which_part_of_the_plan_it_stands_on() -> None:
    assert doses.dose_table(PLAN, rows(PLAN, 50)).about.startswith("The first 50 of the plan's 400 frames, in")
    assert doses.dose_table(PLAN, rows(PLAN, 400)).about.startswith("All 400 frames of the plan. Five egos")
    by_gpu = doses.verdict_table(PLAN, rows(PLAN, 400), "NVIDIA H200").about
    assert by_gpu == "All 400 frames of the plan, on an NVIDIA H200."


def test_every_dose_of_every_network_has_its_row() -> None:
    table = doses.dose_table(PLAN, rows(PLAN, 50))
    assert [row[:2] for row in table.rows] == [[n, d.label] for n in ("full-0", "full-1") for d in PLAN.dose]
    head = "| network | dose | weight on zeros | starved, 0.01 | two silent − four silent | two − four, 0.02 | two"
    assert head in table.markdown()
    assert "| full-0 | T ∞, masked | 0.00 | +5.0 [+4.0, +6.0] |" in table.markdown()


def test_a_hypothesis_is_shown_with_the_networks_in_which_it_held() -> None:
    table = doses.verdict_table(PLAN, rows(PLAN, 50))
    assert [row[0] for row in table.rows] == ["Rises", "Flips", "Falls", "Masked", "Silence"]
    assert [row[2:] for row in table.rows][2] == ["held", "not held", "1 of 2"]
    assert [row[-1] for row in table.rows] == ["2 of 2", "2 of 2", "1 of 2", "2 of 2", "2 of 2"]


def test_the_picture_has_a_panel_for_each_difference_and_names_every_mark() -> None:
    pytest.importorskip("matplotlib")
    figure = draw(PLAN, rows(PLAN, 50))
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert titles[:3] == [
        "four peers, budget 0.01 − a drone alone", "two silent peers − four silent peers",
        "two peers − four peers, budget 0.02",
    ]  # fmt: skip
    assert len({ax.get_ylim() for ax in figure.axes[2:]}) == 1
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "full-0", "full-1", "zero fill, by weight", "masked fusion (control)", "peers not chosen count as zeros",
        "the paper's value",
    ]  # fmt: skip
    # masked fusion lies at weight 0, each network a little apart
    masked = [line.get_xdata()[0] for line in figure.axes[2].lines if line.get_markerfacecolor() == "white"]
    assert sorted(set(masked)) == pytest.approx([-0.006, 0.006])


def test_another_number_of_networks_has_other_columns() -> None:
    one = [replace(row, network="one") for row in rows(PLAN, 3)[:9]]
    assert [c.name for c in doses.verdict_table(PLAN, one).columns] == ["hypothesis", "it says", "one", "held in"]
