"""From frames to bootstrapped scores, with a made instrument in the network's place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from paper_examples import ELSEWHERE, FACTS, MadeInstrument, made_frames

from research.benchmark.dataset import SIZES
from research.paper import report, rows
from research.paper.measures import under
from research.paper.measuring import bench_frames, measure
from research.paper.results import TableResults, TableSettings
from research.paper.sensitivity import BY_DISC, BY_TAU, DISCS, TAUS, sensitivity
from research.paper.ways import FULL_SHARING, SINGLE, Sharing
from sortie.perception.metrics.ap import average_precision

N = 6


@pytest.fixture(scope="module")
def found() -> TableResults:
    return measure(MadeInstrument(), made_frames(N), TableSettings(draws=100))


def test_scores_are_the_evaluations_at_the_threshold(found: TableResults) -> None:
    c = Sharing(0.1, unsent="masked")
    by_hand = average_precision([m.at(0.1) for m in found.evaluation.matched(c)])
    assert found.scores("masked").ap(Sharing(0.1), "full") == pytest.approx(by_hand)
    assert found.scores("zero").ap(Sharing(0.1), "full") != pytest.approx(by_hand)
    assert found.scores("zero", tau=0.99).ap(Sharing(0.1), "full") == 0.0


def test_a_draw_is_the_ap_of_its_frames(found: TableResults) -> None:
    scores = found.scores("zero")
    weights = scores._once("resamples", N)
    draws = scores.draws(FULL_SHARING, "full")
    units = found.evaluation.at(0.1).matched(FULL_SHARING)
    for draw in (0, 7, 42):
        frames = np.repeat(np.arange(N), weights[draw].astype(int))
        assert len(frames) == N
        drawn = [units[5 * f + ego] for f in frames for ego in range(5)]
        assert draws[draw] == pytest.approx(average_precision(drawn))


def test_halves_are_the_aps_of_their_frames(found: TableResults) -> None:
    scores = found.scores("zero")
    first = scores.halves(SINGLE, "full", resampled=False)[3, 0]
    member = scores._once("half 0 False", N)[3] > 0
    units = found.evaluation.at(0.1).matched(SINGLE)
    drawn = [units[5 * f + ego] for f in np.flatnonzero(member) for ego in range(5)]
    assert first == pytest.approx(average_precision(drawn))


def test_bytes_are_those_of_all_egos(found: TableResults) -> None:
    assert found.scores("masked").fleet_frame_bytes(FULL_SHARING) == [20 * 4096 * 160] * N
    assert found.scores("masked").fleet_frame_bytes(Sharing(0.1)) == [5 * 1638 * 160] * N
    assert found.scores("zero").fleet_frame_bytes(SINGLE) == [0] * N


def test_the_disc_may_lie_around_the_ego(found: TableResults) -> None:
    e = found.evaluation.at(0.1)
    for disc in DISCS:
        got = found.scores("zero", disc=disc).ap(FULL_SHARING, "mission")
        assert got == pytest.approx(e.ap(FULL_SHARING, disc))
    assert found.scores("zero", disc="ego").ap(SINGLE, "full") == pytest.approx(e.ap(SINGLE))


def test_a_second_run_takes_what_is_finished(tmp_path: Path) -> None:
    class Counts(MadeInstrument):
        looked = 0

        def look(self, frames, frame):  # type: ignore[no-untyped-def]
            Counts.looked += 1
            return super().look(frames, frame)

    first = measure(Counts(), made_frames(3), TableSettings(("zero",)), store=tmp_path)
    assert Counts.looked == 3
    again = measure(Counts(), made_frames(3), TableSettings(("zero",)), store=tmp_path)
    assert Counts.looked == 3
    assert again.scores("zero").ap(SINGLE, "full") == first.scores("zero").ap(SINGLE, "full")


def test_the_table_and_its_sensitivity_from_made_frames(found: TableResults) -> None:
    table = rows.judge(found.all_scores(), ELSEWHERE)
    assert next(r for r in table if r.id == "bytes.full").verdict == "reproduced"
    varied = sensitivity(found)
    assert len(varied) == 2 * (len(BY_TAU) * len(TAUS) + len(BY_DISC) * len(DISCS))
    varied_rows = {(v.id, v.instrument): v for v in varied if v.setting in ("0.1", "around the target")}
    for row in table:
        if (row.id, row.instrument) in varied_rows:
            v = varied_rows[row.id, row.instrument]
            assert (v.value, v.low, v.high, v.verdict) == (row.value, row.low, row.high, row.verdict)
    text = report.report(table, FACTS, (), varied)
    assert "**score threshold τ**, masked fusion:" in text
    assert "| claim | 0.01 | 0.1 | 0.2 | 0.3 | 0.5 |" in text
    other = next(v for v in varied if v.verdict != varied_rows[v.id, v.instrument].verdict)
    (line,) = [
        one
        for one in text.partition("How the verdicts depend on threshold and region")[2].splitlines()
        if one.startswith(f"| {next(r.says for r in table if r.id == other.id)} |") and "*" in one
    ][:1]
    assert " * |" in line


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"unsent": ()}, "unsent names no instrument"),
        ({"tau": 0.001}, r"tau is 0.001, must be at least 0.01 and below 1"),
        ({"draws": 0}, "draws is 0, must be at least 1"),
    ],
)
def test_a_setting_out_of_bounds_is_named(field: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TableSettings(**field)  # type: ignore[arg-type]


def test_conditions_are_put_under_the_instrument() -> None:
    assert under(Sharing(0.1), "masked", "norm") == Sharing(0.1, unsent="masked", cells_by="norm")


@pytest.mark.slow
def test_frames_left_out_are_the_whole_test_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SIZES, "test", (2, 1))
    first = bench_frames(0, 1, tmp_path)
    both = bench_frames(0, None, tmp_path)
    assert (len(first), len(both)) == (1, 2)
    np.testing.assert_array_equal(both.images[0], first.images[0])
    with pytest.raises(ValueError, match=r"frames is 3, must be 1 to the test split's 2"):
        bench_frames(0, 3, tmp_path)
