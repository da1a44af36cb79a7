"""A comparison of policies, every figure in its own row and column, and what is passed to each of its sorties."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from record_by_hand import record, told_outcome
from sim_examples import example

from sortie import Comparison
from sortie._run import Metrics, UnknownMetricError
from sortie.perception.metrics.ap import Matched
from sortie.scenarios.intervals import SHARE, mean_interval
from sortie.sim.studies import compare, comparison_page
from sortie.sim.studies.compare import BY_BOTH, Compared, Contender, Flown, Gain
from sortie.sim.studies.comparison_text import (
    comparison_markdown,
    comparison_table,
    explanations,
    heading,
    precision_lines,
    side_by_side,
)
from sortie.sim.studies.multifidelity import Contrast, Precision

pytestmark = pytest.mark.slow


def flown(seeds: tuple[int, ...] = (3, 4)) -> Flown:
    """Policies `a` and `b` on these seeds, every figure of every sortie another one; each mean lies half-way."""
    sorties = []
    for k, seed in enumerate(seeds):
        for p, policy in enumerate("ab"):
            made = told_outcome(off=1.0 * k + 4.0 * p)
            sorties.append(Compared(policy, seed, seed + 100, made, dict.fromkeys(("full_scene", "mission")), None))
    gains = [
        Gain("b", f"ap50.{metric}", mean, mean - 0.01, mean + 0.02, "sorties", count)
        for metric, mean, count in (
            ("full_scene", 0.04, 2), ("mission", 0.05, 1), ("grounded_blind.full_scene", 0.06, 2), ("grounded_blind.mission", -0.07, 2),
        )
    ]  # fmt: skip
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
    both = flown()
    both.sorties[2].outcome["ap50"]["mission"] = None  # of a, under the second seed
    rows = side_by_side(both)
    assert rows["AP@0.5 mission"] == ["0.502 (1 of 2)", "0.547"]
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
        (
            "blocks of one sortie",
            "with a descriptive 95 % interval over blocks of 5 s of this one flight in this one town",
        ),
    ):
        told = Flown(flown().sorties, (Gain("b", "ap50.full_scene", 0.1, 0.0, 0.2, over, 2),))
        caption = str(comparison_table(told).caption)
        assert caption.startswith("Gains are in AP points over a, paired: ")
        assert words in caption


def test_metrics_of_ones_own_have_a_row_each_with_the_mean_of_what_is_known() -> None:
    both = flown()
    for k, compared in enumerate(both.sorties):
        compared.outcome["metrics"] = {"first_s": 1.5 * k, "found": None if k < 2 else k}
    rows = side_by_side(both)
    by_policy = {p: [k for k, s in enumerate(both.sorties) if s.policy == p] for p in "ab"}
    assert rows["metrics.first_s"] == [f"{1.5 * sum(ks) / 2:.4g}" for ks in by_policy.values()]
    assert rows["metrics.found"][0] in ("–", "2 (1 of 2)", "3 (1 of 2)")


def test_the_table_and_the_markdown_have_the_same_cells() -> None:
    rows = side_by_side(flown())
    table = comparison_table(flown())
    assert [column.header for column in table.columns] == ["", "a", "b"]
    assert [list(map(str, c.cells)) for c in table.columns] == [
        list(rows), [a for a, _ in rows.values()], [b for _, b in rows.values()],
    ]  # fmt: skip
    text = comparison_markdown(flown(), "sortie compare x").splitlines()
    assert text[2].startswith(
        "`sortie compare x`: 4 s, 3 drones, means of 2 sorties, seeds 3 to 4, each with a town and random draws of its own, "
        "accuracy scored at 2 Hz by `surrogate`. Gains are in AP points over a"
    )
    assert [line for line in text if line.startswith("| ")] == [
        "| | a | b |", *(f"| {name.strip()} | {a} | {b} |" for name, (a, b) in rows.items()),
    ]  # fmt: skip
    assert "- **a**: 20 payloads in all sorties, 60.0 % delivered" in "\n".join(text)


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
    large = [(float(line.get_xdata()[0]), float(line.get_ydata()[0])) for line in axes.get_lines() if line.get_markersize() == 11]  # type: ignore[arg-type,index]  # fmt: skip
    assert large == [(pytest.approx(17.4), 0.0), (pytest.approx(63.8), 1.0)]
    assert [text.get_text() for text in axes.texts] == ["17.4", "63.8"]
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["a", "b"]


def test_precision_is_told_figure_by_figure() -> None:
    contrasts = (
        Contrast("b", "ap50.full_scene", 0.04, 0.91, 0.82, 0.73), Contrast("b", "ap50.mission", 0.09, 0.61, 0.52, 0.43),
        Contrast("c", "ap50.full_scene", 0.05, 0.31, 0.22, 0.13),
    )  # fmt: skip
    found = Precision(
        metric="ap50.full_scene", asked=0.06, reached=True, detector="torch", control=True, paired=12, further=34,
        seconds=(15.5, 1.25), cost_ratio=0.375, contrasts=contrasts,
    )  # fmt: skip
    lines = [name + text for name, text in precision_lines(found)]
    assert lines[0].startswith("half-width of ap50.full_scene: 5.00 AP points, 6 asked, reached")
    assert lines[1].startswith("flown: 12 seeds by torch, and 34 further seeds by the surrogate")
    assert lines[-1].endswith(
        "15.5 s of processor time for a seed by torch, 1.2 s by the surrogate; in all 0.38 of what torch alone is predicted to take"
    )
    assert "  b, ap50.mission: correlation " in lines[3]


# --- what each sortie gets ------------------------------------------------------------------------------------------


def scored(*hits: bool) -> Matched:
    """A fusion with as many cars as boxes, found or not, the surest first."""
    return Matched(np.linspace(0.9, 0.5, len(hits)), np.array(hits), len(hits))


def fake(monkeypatch: pytest.MonkeyPatch, frames: dict[tuple[str, int, bool], dict[tuple[float, int], Matched]]) -> list[tuple[Any, ...]]:  # fmt: skip
    """Nothing flies: a record says who flew, and its fusions are given by policy, seed and region."""
    calls: list[tuple[Any, ...]] = []

    def run_sortie(scenario: Any, function: Any, seed: int, progress: Any = None) -> Any:
        calls.append((scenario.policy.name, function, seed, scenario.perception.scene.seed))
        if progress is not None:
            progress(0.25)
        return SimpleNamespace(policy=scenario.policy.name, seed=seed)

    def outcome(made: Any) -> dict[str, Any]:
        return told_outcome(off=made.seed / 10 + (0.5 if made.policy == "silence" else 0.0))

    monkeypatch.setattr(compare, "run_sortie", run_sortie)
    monkeypatch.setattr(compare, "outcome", outcome)
    monkeypatch.setattr(compare, "matched", lambda made, mission, begin_s: frames[made.policy, made.seed, mission])
    return calls


FRAMES = {
    # two drones at one moment, of which the other policy has one as well: AP is 1 of a car found, 0 of one that is missed
    ("worked", 5, False): {(1.0, 0): scored(True), (1.0, 1): scored(False)},
    ("silence", 5, False): {(1.0, 0): scored(False), (2.0, 0): scored(True)},
    ("worked", 5, True): {(1.0, 0): scored(False)},
    ("silence", 5, True): {(1.0, 0): scored(True)},
    ("worked", 7, False): {(1.0, 0): scored(False)},
    ("silence", 7, False): {(1.0, 0): scored(True)},
    ("worked", 7, True): {(1.0, 0): scored(True)},
    ("silence", 7, True): {(3.0, 0): scored(True)},  # no fusion in common
}


def contenders() -> list[Contender]:
    base = example("seed=4", "perception.scene.seed=11")
    other = base.model_copy(update={"policy": base.policy.model_copy(update={"name": "silence", "params": {}})})
    return [Contender("first", base), Contender("second", other)]


def test_each_seed_has_its_town_its_first_policy_and_its_own_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    calls, told = fake(monkeypatch, FRAMES), []
    found = compare.compare(contenders(), [5, 7], progress=lambda *what: told.append(what))
    assert calls == [
        ("worked", None, 5, 12),
        ("silence", None, 5, 12),
        ("worked", None, 7, 14),
        ("silence", None, 7, 14),
    ]
    assert told == [("first", 5, 0.25), ("second", 5, 0.25), ("first", 7, 0.25), ("second", 7, 0.25)]
    assert [(s.policy, s.seed, s.town_seed, s.gain, s.record is not None) for s in found.sorties] == [
        ("first", 5, 12, {"full_scene": None, "mission": None}, True),
        ("second", 5, 12, {"full_scene": -1.0, "mission": 1.0}, True),
        ("first", 7, 14, {"full_scene": None, "mission": None}, False),
        ("second", 7, 14, {"full_scene": 1.0, "mission": None}, False),
    ]
    assert [s.outcome["ap50"]["full_scene"] for s in found.sorties] == pytest.approx([0.406, 0.411, 0.408, 0.413])
    gains = {g.metric: g for g in found.gains}
    assert {(g.policy, g.over) for g in found.gains} == {("second", "sorties")}
    wanted = mean_interval([-1.0, 1.0], SHARE.of_differences())
    full = gains["ap50.full_scene"]
    assert (full.gain, full.low, full.high, full.count) == pytest.approx((wanted.mean, wanted.low, wanted.high, 2))
    assert (gains["ap50.mission"].gain, gains["ap50.mission"].count) == (1.0, 1)
    for area in ("full_scene", "mission"):  # half a hundredth apart in both sorties
        blind = gains[f"ap50.grounded_blind.{area}"]
        assert (blind.gain, blind.count) == (pytest.approx(0.005), 2)


def test_one_seed_flies_in_the_scenario_s_own_town_and_its_interval_is_over_blocks(monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    calls = fake(monkeypatch, FRAMES)
    found = compare.compare(contenders(), [5])
    assert calls == [("worked", None, 5, 11), ("silence", None, 5, 11)]
    assert [(g.metric, g.gain, g.over, g.count) for g in found.gains] == [
        ("ap50.full_scene", -1.0, "blocks of one sortie", 1), ("ap50.mission", 1.0, "blocks of one sortie", 1),
    ]  # fmt: skip
    assert all(np.isnan([g.low, g.high]).all() for g in found.gains), "one block has no interval"


def test_instants_that_follow_each_other_do_not_narrow_the_interval_of_one_sortie(monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """The gain changes from block to block and is the same at all ten instants of each: ten times as many say no more."""
    intervals = []
    for per_block in (1, 10):
        times = [5.0 * block + k / 2 for block in range(12) for k in range(per_block)]
        frames = {(t_s, 0): scored(True, t_s // 5 % 3 > 0) for t_s in times}
        arms = {("worked", 5): {key: scored(True, False) for key in frames}, ("silence", 5): frames}
        fake(monkeypatch, {(*who, mission): made for who, made in arms.items() for mission in (False, True)})
        gain = compare.compare(contenders(), [5]).gains[0]
        assert gain.count == 12
        intervals.append((gain.low, gain.gain, gain.high))
    assert intervals[0] == pytest.approx(intervals[1])
    assert intervals[0][0] < intervals[0][1] < intervals[0][2]


def test_every_policy_is_compared_with_the_first_and_not_with_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """The third finds what the second found: over the first that is a loss, and over the second nothing."""
    third = {key: FRAMES["silence", *key[1:]] for key in (("boxes", 5, False), ("boxes", 5, True))}
    fake(monkeypatch, FRAMES | third)
    first, second = contenders()
    policy = second.scenario.policy.model_copy(update={"name": "boxes"})
    last = Contender("third", second.scenario.model_copy(update={"policy": policy}))
    for seeds in ([5], [5, 5]):
        found = compare.compare([first, second, last], seeds)
        wanted = {"full_scene": -1.0, "mission": 1.0}
        assert [s.gain for s in found.sorties[:3]] == [{"full_scene": None, "mission": None}, wanted, wanted]
        assert [g.gain for g in found.gains if g.metric == "ap50.full_scene"] == [-1.0, -1.0]


def test_functions_decide_for_their_own_contender(monkeypatch: pytest.MonkeyPatch) -> None:
    def quiet(view: Any) -> list[Any]:
        return []

    calls = fake(monkeypatch, FRAMES)
    first, second = contenders()
    compare.compare([first, second._replace(function=quiet)], [5])
    assert [(name, function) for name, function, *_ in calls] == [("worked", None), ("silence", quiet)]


def test_which_seeds_are_flown_when_none_are_listed() -> None:
    for detector, first, count, seeds in (
        ("surrogate", None, None, range(4, 12)), ("surrogate", 9, None, range(9, 10)), ("surrogate", None, 2, range(4, 6)),
        ("surrogate", 9, 3, range(9, 12)), ("torch", None, None, range(4, 5)), ("torch", 2, None, range(2, 3)),
    ):  # fmt: skip
        assert compare.chosen_seeds(example("seed=4", f"perception.detector={detector}"), first, count) == seeds


def test_lines_over_time_are_each_policy_s_own() -> None:
    """The first seed's records alone; a policy without points has no line."""
    both = flown((3,))
    first, second = (s for s in both.sorties)
    held = Flown((_with(first), _with(second)), both.gains)
    captions = [caption for caption, *_ in comparison_page._over_time(held)]
    assert captions == [
        "Accuracy over the last five seconds, full scene, AP@0.5", "Accuracy over the last five seconds, mission disc, AP@0.5",
        "Payloads delivered, Mb/s",
        *(f"{p}: what each drone was to send (upper bar), and the best that arrived each second (lower bar)" for p in "ab"),
    ]  # fmt: skip
    axes = Figure().add_subplot()
    points = {"a": np.array([(1.0, 0.2), (2.0, 0.4)]), "none": np.zeros((0, 2)), "b": np.array([(1.0, 0.6)])}
    comparison_page._draw_lines(axes, lines=points, record=record(), top=1.0)
    named = {line.get_label(): np.column_stack(line.get_data()).tolist() for line in axes.get_lines() if line.get_label() in points}  # fmt: skip
    assert named == {"a": [[1.0, 0.2], [2.0, 0.4]], "b": [[1.0, 0.6]]}
    assert axes.get_ylim() == (0.0, 1.0)
    assert not math.isnan(axes.get_xlim()[1])
    assert list(comparison_page._over_time(both)) == []


def _with(sortie: Compared) -> Compared:
    return Compared(sortie.policy, sortie.seed, sortie.town_seed, sortie.outcome, sortie.gain, record())


def test_people_have_their_rows_where_any_sortie_found_some() -> None:
    """The first sortie saw nobody."""
    both = flown()
    both.sorties[0].outcome["people"]["located_share"] = None
    both.sorties[0].outcome["ap_by_class"]["person"]["full_scene"] = None
    rows = side_by_side(both)
    assert rows["people located"] == ["32.5 % (1 of 2)", "36.0 %"]
    assert rows["AP of people, full scene"] == ["0.711 (1 of 2)", "0.746"]


def test_a_count_that_one_sortie_lacks_is_zero_in_the_table_and_a_figure_is_null() -> None:
    both = flown((3,))
    del both.sorties[1].outcome["payload_fates"]["lost/retries"]
    both.sorties[1].outcome["ap50"]["mission"] = None
    table = Comparison(both.sorties, both.gains).table
    assert table["payload_fates.lost/retries"].to_pylist() == [1, 0]
    assert table["ap50.mission"].to_pylist() == [pytest.approx(0.502), None]


def test_a_count_that_a_run_lacks_is_zero_among_its_metrics() -> None:
    metrics = Metrics({"battery.0": 1.0, "payload_fates.delivered": 3})
    assert metrics["payload_fates.lost/no_link"] == metrics["distrusted_by.0"] == 0
    with pytest.raises(UnknownMetricError):
        metrics["distrusted_by.1"]
