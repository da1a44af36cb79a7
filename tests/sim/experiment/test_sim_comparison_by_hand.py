"""A comparison of policies: every figure in its own row and column, and the words about it."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
from matplotlib.figure import Figure
from record_by_hand import told_outcome
from rich.console import Console

from sortie import Comparison
from sortie._run import Metrics, UnknownMetricError
from sortie.sim.experiment import comparison_page
from sortie.sim.experiment.compare import BY_BOTH, Compared, Flown, Gain
from sortie.sim.experiment.comparison_text import (
    comparison_markdown,
    comparison_table,
    explanations,
    heading,
    precision_lines,
    side_by_side,
)
from sortie.sim.experiment.half_width import Contrast, Precision


def flown(seeds: tuple[int, ...] = (3, 4)) -> Flown:
    """Policies `a` and `b` on these seeds, every figure of every sortie another one; each mean lies half-way."""
    sorties = []
    for k, seed in enumerate(seeds):
        for p, policy in enumerate("ab"):
            made = told_outcome(off=1.0 * k + 4.0 * p)
            sorties.append(Compared(policy, seed, seed + 100, made, dict.fromkeys(("full_scene", "mission")), None))
    means = {"full_scene": 0.04, "mission": 0.05, "grounded_blind.full_scene": 0.06, "grounded_blind.mission": -0.07}
    gains = [
        Gain("b", f"ap50.{metric}", mean, mean - 0.01, mean + 0.02, "sorties", 1 if metric == "mission" else 2)
        for metric, mean in means.items()
    ]
    return Flown(tuple(sorties), tuple(gains))


def test_every_figure_stands_in_its_row_and_its_policy_s_column() -> None:
    """Means of two sorties of `told_outcome`: of `a` half a hundredth above it, of `b` four and a half."""
    assert side_by_side(flown()) == {
        "flown": ["91.6 %", "95.6 %"],
        "AP@0.5 full scene": ["0.406", "0.446"],
        "  gain": ["", "+4.0 [+3.0, +6.0]"],
        "  grounded drones blind": ["0.308", "0.348"],
        "    gain": ["", "+6.0 [+5.0, +8.0]"],
        "AP@0.5 mission": ["0.507", "0.547"],
        "  gain ": ["", "+5.0 [+4.0, +7.0] (1 of 2)"],
        "  grounded drones blind ": ["0.209", "0.249"],
        "    gain ": ["", "-7.0 [-8.0, -5.0]"],
        "AP of trucks, full scene": ["0.606", "0.646"],
        "AP of people, full scene": ["0.706", "0.746"],
        "people located": ["32.0 %", "36.0 %"],
        "data sent": ["33.0 kB", "121.0 kB"],
        "data delivered": ["21.0 kB", "77.0 kB"],
        "  handshakes": ["495 B", "1.8 kB"],
        "deadlines missed": ["12.7 %", "16.7 %"],
        "medium busy": ["13.8 %", "17.8 %"],
        "context sent": ["1.6 kB", "6.0 kB"],
        "descriptors lost": ["11.6 %", "15.6 %"],
        "data age, median": ["0.27 s", "0.31 s"],
        "energy": ["17.40 kJ", "63.80 kJ"],
        "  radio": ["1.80 kJ", "6.60 kJ"],
        "  compute": ["3.45 kJ", "12.65 kJ"],
        "charge left, least": ["62.5 %", "66.5 %"],
    }


def test_a_sortie_without_a_value_is_in_no_mean_and_the_others_are_counted() -> None:
    """Also of people, whom the first sortie did not see, and of metrics of one's own."""
    both = flown()
    both.sorties[2].outcome["ap50"]["mission"] = None  # of a, under the second seed
    both.sorties[0].outcome["people"]["located_share"] = None
    for k, compared in enumerate(both.sorties):
        compared.outcome["metrics"] = {"first_s": 1.5 * k, "found": None if k < 2 else k}
    rows = side_by_side(both)
    assert rows["AP@0.5 mission"] == ["0.502 (1 of 2)", "0.547"]
    assert rows["people located"] == ["32.5 % (1 of 2)", "36.0 %"]
    assert rows["metrics.first_s"] == ["1.5", "3"]
    assert rows["metrics.found"] == ["2 (1 of 2)", "3 (1 of 2)"]
    for s in both.sorties:
        s.outcome["mission"]["flown_share"] = 1.0
    assert not [name for name in side_by_side(both) if "blind" in name or name in ("flown", "    gain", "    gain ")]


def test_a_comparison_is_headed_by_its_sorties_and_by_what_its_intervals_cover() -> None:
    assert heading(flown((3,))) == "by_hand · seed 3, in this town, this flight"
    means = "by_hand · means of {} sorties, seeds {}, each with a town and random draws of its own"
    assert heading(flown((3, 4, 5))) == means.format(3, "3 to 5")
    assert heading(flown((3, 5))) == means.format(2, "3, 5")
    for over, words in (
        ("sorties", "with Student's 95 % interval over sorties"),
        (BY_BOTH, "corrected by the surrogate's sorties as control variates"),
        ("blocks of one sortie", "95 % interval over blocks of 5 s of this one flight in this one town"),
    ):
        told = Flown(flown().sorties, (Gain("b", "ap50.full_scene", 0.1, 0.0, 0.2, over, 2),))
        caption = str(comparison_table(told).caption)
        assert caption.startswith("Gains are in AP points over a, paired: ")
        assert words in caption


def test_the_table_and_the_markdown_have_the_same_cells() -> None:
    rows = side_by_side(flown())
    table = comparison_table(flown())
    assert [column.header for column in table.columns] == ["", "a", "b"]
    cells = [list(map(str, column.cells)) for column in table.columns]
    assert cells == [list(rows), [a for a, _ in rows.values()], [b for _, b in rows.values()]]
    text = comparison_markdown(flown(), "sortie compare x").splitlines()
    assert text[2].startswith(
        "`sortie compare x`: 4 s, 3 drones, means of 2 sorties, seeds 3 to 4, each with a town and random draws of its "
        "own, accuracy scored at 2 Hz by `surrogate`. Gains are in AP points over a"
    )
    lines = ["| | a | b |", *(f"| {name.strip()} | {a} | {b} |" for name, (a, b) in rows.items())]
    assert [line for line in text if line.startswith("| ")] == lines
    assert "- **a**: 20 payloads in all sorties, 60.0 % delivered" in "\n".join(text)


def test_parameters_of_policies_are_whole_in_80_columns() -> None:
    """Long names go on in the next line; none is cut."""
    long = {"a": "best-2(received_budget=0.125)", "b": "all-4(received_budget=0.0625)"}
    told = flown()
    many = tuple(replace(s, policy=long.get(s.policy, s.policy)) for s in told.sorties)
    text = io.StringIO()
    Console(file=text, width=80).print(comparison_table(Flown(many, ())))
    head = [line.split("┃")[1:-1] for line in text.getvalue().splitlines() if line.startswith("┃")]
    names = ["".join(cells[column].strip() for cells in head) for column in range(3)]
    assert names == ["", *long.values()]


def test_why_figures_differ_is_told_of_all_sorties_of_a_policy() -> None:
    """20 payloads a policy in two sorties: fates are added up, ages are averaged."""
    both = flown()
    both.sorties[2].outcome["payload_fates"] = {"in_flight": 2, "lost/retries": 8}
    both.sorties[1].outcome["payload_fates"] = both.sorties[3].outcome["payload_fates"] = {}
    assert list(explanations(both)) == [
        (
            "a",
            ": 20 payloads in all sorties, 45.0 % lost/retries, 30.0 % delivered, 15.0 % expired/deadline_queued, "
            "10.0 % in_flight; fused data 0.27 s old at the median",
        ),
        ("b", ": sent nothing; every drone saw with its own eyes only"),
    ]
    for s in both.sorties:
        s.outcome["data_age_s"]["p50"] = None
    assert next(explanations(both)).text.endswith("10.0 % in_flight; nothing fused")


def test_dots_are_sorties_and_large_ones_their_means() -> None:
    axes = Figure().add_subplot()
    plots = list(comparison_page._dots(flown(), ["a", "b"]))
    assert [caption for caption, *_ in plots] == [caption for caption, *_ in comparison_page.DOTS]
    values = {caption: draw.keywords["values"] for caption, _, draw in plots}  # type: ignore[attr-defined]
    assert values == {
        "AP@0.5, full scene": [pytest.approx([0.401, 0.411]), pytest.approx([0.441, 0.451])],
        "AP@0.5, mission disc": [pytest.approx([0.502, 0.512]), pytest.approx([0.542, 0.552])],
        "Data delivered, MB": [pytest.approx([0.014, 0.028]), pytest.approx([0.07, 0.084])],
        "Deadlines missed, %": [pytest.approx([12.2, 13.2]), pytest.approx([16.2, 17.2])],
        "Energy, kJ": [pytest.approx([11.6, 23.2]), pytest.approx([58.0, 69.6])],
    }
    plots[-1][2](axes)
    dots = [line for line in axes.get_lines() if line.get_markersize() == 11]
    large = [(float(dot.get_xdata()[0]), float(dot.get_ydata()[0])) for dot in dots]
    assert large == [(pytest.approx(17.4), 0.0), (pytest.approx(63.8), 1.0)]
    assert [text.get_text() for text in axes.texts] == ["17.4", "63.8"]
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["a", "b"]


def test_precision_is_told_figure_by_figure() -> None:
    contrasts = (
        Contrast("b", "ap50.full_scene", 0.04, 0.91, 0.82, 0.73),
        Contrast("b", "ap50.mission", 0.09, 0.61, 0.52, 0.43),
        Contrast("c", "ap50.full_scene", 0.05, 0.31, 0.22, 0.13),
    )
    asked = {"metric": "ap50.full_scene", "asked": 0.06, "reached": True, "detector": "torch"}
    flown_ = {"control": True, "paired": 12, "further": 34, "seconds": (15.5, 1.25), "cost_ratio": 0.375}
    found = Precision(**asked, **flown_, contrasts=contrasts)
    lines = [name + text for name, text in precision_lines(found)]
    assert lines[0].startswith("half-width of ap50.full_scene: 5.00 AP points, 6 asked, reached")
    assert lines[1].startswith("flown: 12 seeds by torch, and 34 further seeds by the surrogate")
    times = "15.5 s of processor time for a seed by torch, 1.2 s by the surrogate"
    assert lines[-1].endswith(f"{times}; in all 0.38 of what torch alone is predicted to take")
    assert "  b, ap50.mission: correlation " in lines[3]


def test_a_count_that_one_sortie_lacks_is_zero_in_the_table_and_a_figure_is_null() -> None:
    both = flown((3,))
    del both.sorties[1].outcome["payload_fates"]["lost/retries"]
    both.sorties[1].outcome["ap50"]["mission"] = None
    table = Comparison(both.sorties, both.gains).table
    assert table["payload_fates.lost/retries"].to_pylist() == [1, 0]
    assert table["ap50.mission"].to_pylist() == [pytest.approx(0.502), None]
    metrics = Metrics({"battery.0": 1.0, "payload_fates.delivered": 3})
    assert metrics["payload_fates.lost/no_link"] == metrics["distrusted_by.0"] == 0
    with pytest.raises(UnknownMetricError):
        metrics["distrusted_by.1"]
