"""What a ranking prints and keeps: every figure in its own column, of its own policy, in its own unit."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.table import Table

from sortie.scenarios.intervals import Estimate
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.experiment import board, rank
from sortie.sim.experiment.flight import Flight
from sortie.sim.experiment.places import METRICS, Control, PairDifference, Standing, standings
from sortie.sim.experiment.rank import Ranked
from sortie.sim.experiment.stored import made_now, read_results, save_results
from sortie.sim.experiment.verdict import WORDS, Verified
from sortie.sim.folders import RunError

FIGURES = {
    **{"ap50.mission": 0.31, "ap50.full_scene": 0.42, "tracking.hota": 0.53},
    **{"bytes.data_sent": 4.5e6, "bytes.context_sent": 6.5e3, "deadline_miss_rate": 0.08},
    **{"energy_j.total": 9000.0, "energy_j.fault": 1500.0, "energy_j.radio": 77.0},
    **{"mission.target_detected_share": 0.61, "mission.target_in_view_share": 0.72},
    **{"mission.region_observed_share": 0.83, "mission.flown_share": 0.94},
    **{"policies.violated_ticks": 5.0, "policies.invariant_violations": 6.0, "switches": 7.0},
    **{"age_s.p99": 0.123, "policy_eval_us.p50": 20.0, "policy_eval_us.p99": 90.0},
}


def flight(scale: float = 1.0, error: str = "") -> Flight:
    values: dict[str, float | None] = {name: None if error else FIGURES[name] * scale for name in METRICS}
    return Flight(error, f"{scale:.4f}", values)


def standing(policy: str, place: tuple[int, int], scale: float, failed: tuple[str, ...] = ()) -> Standing:
    figures = {name: Estimate(v * scale, v * scale * 0.9, v * scale * 1.1, 2) for name, v in FIGURES.items()}
    score = Estimate(0.7 * scale, 0.6 * scale, 0.8 * scale, 2)
    return Standing(policy, place, score, failed, figures)


def ranking() -> Ranked:
    """`mine` and `ours` were asked for, `theirs` has stored results; this machine is three times as slow."""
    rows = (standing("theirs", (1, 1), 1.0), standing("mine", (2, 3), 0.5), standing("ours", (2, 3), 0.25, ("rich",)))
    pairs = (
        PairDifference("mine", "ours", Estimate(0.05, -0.1, 0.2, 2)),
        PairDifference("mine", "theirs", Estimate(-0.3, -0.4, -0.2, 2)),
        PairDifference("theirs", "ours", Estimate(0.45, 0.35, 0.55, 2)),
    )
    flights = {
        "theirs": {"poor": flight(), "rich": flight(1.5)},
        "mine": {"poor": flight(0.5), "rich": flight(0.75)},
        "ours": {"poor": flight(0.25), "rich": flight(error="boom")},
    }
    verified = {
        "theirs": Verified(16, (), "proved", "tried"),
        "mine": Verified(16, (), "tried", "proved"),
        "ours": Verified(16, ("stale views", "silence"), "proved", "refuted"),
    }
    about = {"suite": "small", "digest": "abc", "sortie": "1.2", "stored": "1.1", "stale": False, "speed": 3.0}
    asked = {"entries": ("mine", "ours"), "taken": ("theirs",), "conditions": 2, "control": None, "width": 1.0}
    return Ranked(**about, **asked, detector="surrogate", rows=rows, pairs=pairs, flights=flights, verified=verified)


def cells(table: Table) -> list[list[str]]:
    return [list(row) for row in zip(*(map(str, column.cells) for column in table.columns), strict=True)]


def test_each_table_has_each_figure_in_its_column() -> None:
    tables = [part for part in board.summary(ranking())._parts if isinstance(part, Table)]
    titles = ["small (abc), 2 conditions, surrogate", "mission and cost, a sortie"]
    assert [str(table.title) for table in tables] == [*titles, "context, rules and time, a sortie"]
    assert [[str(c.header) for c in table.columns] for table in tables] == [
        ["place", "policy", "AP, 95 % interval", "mission", "full", "HOTA", "failed"],
        ["place", "policy", "found", "seen", "data", "missed", "energy"],
        ["place", "policy", "context", "radio", "unsafe", "verified", "decides"],
    ]
    assert [cells(table) for table in tables] == [
        [
            ["1", "theirs", "0.700 [0.600, 0.800]", "0.310", "0.420", "0.530", "–"],
            ["2–3", "mine", "0.350 [0.300, 0.400]", "0.155", "0.210", "0.265", "–"],
            ["2–3", "ours", "0.175 [0.150, 0.200]", "0.077", "0.105", "0.133", "1"],
        ],
        [
            ["1", "theirs", "61.0 %", "83.0 %", "4.5 MB", "8.0 %", "7.50 kJ"],
            ["2–3", "mine", "30.5 %", "41.5 %", "2.2 MB", "4.0 %", "3.75 kJ"],
            ["2–3", "ours", "15.2 %", "20.8 %", "1.1 MB", "2.0 %", "1.88 kJ"],
        ],
        [
            ["1", "theirs", "6.5 kB", "77 J", "5", "tried", "60 µs"],  # as on this machine
            ["2–3", "mine", "3.2 kB", "38 J", "2", "tried", "10 µs"],
            ["2–3", "ours", "1.6 kB", "19 J", "1", "2 of 16 broken", "5 µs"],
        ],
    ]
    assert [table.rows[0].style for table in tables] == [""] * 3
    assert [table.rows[1].style for table in tables] == ["bold"] * 3


def test_sentences_are_of_the_policies_that_were_asked_for() -> None:
    told = list(map(str, board.sentences(ranking())))
    assert told[:7] == [
        "mine takes place 2–3 of 3.",
        "  worse than theirs",
        "  not separated from ours",
        "ours takes place 2–3 of 3.",
        "  worse than theirs",
        "  not separated from mine",
        "  failed in rich: boom",
    ]
    assert told[7] == "  breaks the rules stale views and silence; `sortie verify` shows why"
    assert "flown with Sortie 1.1;" in told[-1]
    stale = list(map(str, board.sentences(replace(ranking(), stale=True))))
    assert "This version, 1.2, flies otherwise than that one" in stale[-1]
    assert len(list(board.sentences(replace(ranking(), stored=None)))) == len(told) - 1


def test_of_many_policies_six_are_named() -> None:
    names = [f"p{k}" for k in range(8)]
    rows = (*(standing(p, (1, 8), 1.0) for p in names), standing("mine", (9, 9), 0.5))
    pairs = tuple(PairDifference("mine", p, Estimate(-0.3, -0.4, -0.2, 2)) for p in names)
    many = replace(ranking(), rows=rows, pairs=pairs, entries=("mine",))
    assert "  worse than p0, p1, p2, p3, p4, p5 and 2 more" in list(board.sentences(many))
    six = replace(many, rows=(*rows[2:8], rows[8]), pairs=pairs[2:])
    assert "  worse than p2, p3, p4, p5, p6 and p7" in list(board.sentences(six))


def test_the_surrogate_s_further_flights_are_counted_and_its_narrower_intervals_told() -> None:
    wide = _suite("poor", "rich", "poor_1", "rich_1", "poor_2")
    control = Control(wide, {"mine": {"poor": flight(0.1), "poor_1": flight(0.2)}})
    text = str(list(board.sentences(replace(ranking(), detector="torch", control=control, width=0.625)))[-2])
    assert "the same conditions and 3 further ones" in text
    assert "Intervals of differences are 0.62 times as wide as by torch alone" in text
    kept = board.plain(replace(ranking(), control=control))["by_surrogate"]
    assert kept["mine"]["poor_1"]["values"]["ap50.mission"] == pytest.approx(0.062)


def test_the_json_has_every_figure_of_every_policy() -> None:
    made = json.loads(json.dumps(board.plain(ranking())))
    about = {"suite": "small", "digest": "abc", "sortie": "1.2", "detector": "surrogate"}
    about |= {"built_in_flown_with": "1.1", "built_in_stale": False}
    assert {name: made[name] for name in about} == about
    assert made["asked_for"] == ["mine", "ours"]
    assert [p["policy"] for p in made["policies"]] == ["theirs", "mine", "ours"]
    for row, scale in zip(made["policies"], (1.0, 0.5, 0.25), strict=True):
        means = {name: e["mean"] for name, e in row["figures"].items()}
        assert means == pytest.approx({name: v * scale for name, v in FIGURES.items()})
        assert row["score"] == pytest.approx({"mean": 0.7 * scale, "low": 0.6 * scale, "high": 0.8 * scale, "count": 2})
    theirs, mine, ours = made["policies"]
    assert [p["place"] for p in (theirs, mine, ours)] == [[1, 1], [2, 3], [2, 3]]
    assert [p["decision_us"] for p in (theirs, mine, ours)] == [60.0, 10.0, 5.0]
    assert [p["failed"] for p in (theirs, mine, ours)] == [{}, {}, {"rich": "boom"}]
    broken = {"rules": 16, "broken": ["stale views", "silence"], "contract": "proved", "monotone": "refuted"}
    assert ours["verified"] == broken
    assert made["differences"] == {
        "mine": {
            "theirs": pytest.approx({"mean": -0.3, "low": -0.4, "high": -0.2, "count": 2}),
            "ours": pytest.approx({"mean": 0.05, "low": -0.1, "high": 0.2, "count": 2}),
        },
        "ours": {
            "theirs": pytest.approx({"mean": -0.45, "low": -0.55, "high": -0.35, "count": 2}),
            "mine": pytest.approx({"mean": -0.05, "low": -0.2, "high": 0.1, "count": 2}),
        },
    }
    assert made["flights"]["mine"]["rich"]["values"]["energy_j.radio"] == pytest.approx(0.75 * 77)
    assert made["by_surrogate"] is None
    assert board.plain(replace(ranking(), stored=None))["built_in_flown_with"] == "1.2"


def test_a_figure_has_a_point_a_policy_and_the_line_of_those_whom_none_beats(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from matplotlib.figure import Figure

    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda self, path: drawn.append(self))
    assert board.draw(ranking(), tmp_path / "new" / "ranking.png") == tmp_path / "new" / "ranking.png"
    (axes,) = drawn[0].axes
    points = [
        (float(line.get_xdata()[0]), float(line.get_ydata()[0]), line.get_color())  # type: ignore[arg-type,index]
        for line in axes.get_lines()
        if line.get_marker() == "o"
    ]
    near = pytest.approx
    reds = [(near(2.25), near(0.35), "tab:red"), (near(1.125), near(0.175), "tab:red")]
    assert points == [(near(4.5), near(0.7), "tab:blue"), *reds]
    (front,) = (line for line in axes.get_lines() if line.get_drawstyle() == "steps-post")
    assert list(front.get_xdata()) == pytest.approx([1.125, 2.25, 4.5])  # type: ignore[arg-type]
    assert [text.get_text() for text in axes.texts] == ["1  theirs", "2–3  mine", "2–3  ours"]


def test_of_two_verdicts_the_weaker_is_shown() -> None:
    for contract, monotone in itertools.product(WORDS, WORDS):
        found = Verified(16, (), contract, monotone)
        assert found.text == min(contract, monotone, key=WORDS.index)
        assert found.keeps_all == ("refuted" not in (contract, monotone))
        assert not Verified(16, ("x",), contract, monotone).keeps_all


def _suite(*names: str, metric: str = "full_scene") -> ConditionSet:
    conditions = tuple({"name": name, "budget": 0.1, "metric": metric} for name in names)
    return ConditionSet.model_validate({"base": "track_target", "seeds": (), "conditions": conditions})


def test_a_standing_has_the_mean_of_each_figure_over_the_conditions_that_were_flown() -> None:
    """Each under its own name; a failure counts in the score alone."""
    flights = {
        "a": {"poor": flight(), "rich": flight(0.5), "third": flight(error="boom")},
        "b": {"poor": flight(0.2), "rich": flight(0.4), "third": flight(0.3)},
    }
    rows, (pair,) = standings(_suite("poor", "rich", "third"), flights)
    assert [r.policy for r in rows] == ["a", "b"]
    assert rows[0].failed == ("third",)
    for row, scale, count in zip(rows, (0.75, 0.3), (2, 3), strict=True):
        means = {name: e.mean for name, e in row.figures.items()}
        assert means == pytest.approx({name: v * scale for name, v in FIGURES.items()})
        assert {e.count for e in row.figures.values()} == {count}
        assert row.energy_j == pytest.approx(7500 * scale)
    assert rows[0].score.mean == pytest.approx(0.42 * 1.5 / 3)
    assert pair.difference.mean == pytest.approx(0.42 * (1.5 - 0.9) / 3)
    assert (pair.policy, pair.other) == ("a", "b")


# --- what is kept ---------------------------------------------------------------------------------------------------


def test_stored_results_come_back_figure_by_figure_and_those_of_another_suite_do_not(tmp_path: Path) -> None:
    found = ranking()
    results = made_now("small", "abc", found.flights, found.verified)
    path = save_results(results, tmp_path)
    back = read_results("folder/small.yaml", "abc", tmp_path)
    assert back == results
    assert back is not None
    assert back.flights["ours"]["rich"] == flight(error="boom")
    assert back.verified["ours"].monotone == "refuted"
    assert read_results("small", "abd", tmp_path) is None
    assert read_results("other", "abc", tmp_path) is None
    path.write_text(path.read_text()[:-9])
    with pytest.raises(RunError, match=r"small\.json: is damaged"):
        read_results("small", "abc", tmp_path)


def test_stored_results_are_compared_with_a_flight_of_the_reference_in_the_first_condition(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[list[str], dict[str, None], Any]] = []

    def fly(suite: ConditionSet, decides: dict[str, None], kept: Any) -> Any:
        asked.append(([c.name for c in suite.conditions], decides, kept))
        return {"worked": {"poor": replace(flight(1.0), values={**flight().values, "policy_eval_us.p50": 50.0})}}

    monkeypatch.setattr(rank, "fly", fly)
    stored = made_now("small", "abc", {"worked": {"poor": flight(1.0), "rich": flight(2.0)}}, {})
    assert rank._checked(stored, _suite("poor", "rich"), Path("out")) == (False, 2.5)
    assert asked == [(["poor"], {"worked": None}, Path("out"))]
    other = made_now("small", "abc", {"worked": {"poor": replace(flight(1.0), fingerprint="x")}}, {})
    assert rank._checked(other, _suite("poor", "rich"), Path("out")) == (True, 2.5)


def test_a_policy_that_failed_everywhere_has_dashes_and_nulls() -> None:
    nothing = {name: Estimate(math.nan, math.nan, math.nan, 0) for name in METRICS}
    row = replace(standing("mine", (1, 1), 1.0), figures=nothing, failed=("poor", "rich"))
    alone = replace(ranking(), rows=(row,), pairs=(), entries=())
    first, second, third = (cells(part)[0] for part in board.summary(alone)._parts if isinstance(part, Table))
    assert first[3:] == ["–", "–", "–", "2"]
    assert second[2:] == ["–"] * 5
    assert third[2:] == ["–", "–", "–", "tried", "–"]
    (kept,) = board.plain(alone)["policies"]
    assert kept["decision_us"] is None
    assert kept["figures"]["switches"] == {"mean": None, "low": None, "high": None, "count": 0}
