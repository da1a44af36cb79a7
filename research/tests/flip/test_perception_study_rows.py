"""Every figure of a study's table, against APs of the same boxes counted here one by one."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from research.flip.measure import F1, StudyRow, optimal_f1, rows_of, threshold
from research.flip.plan import MeasuredGrid, Variant
from research.paper.measures import under
from research.paper.scores import Bootstrap
from research.paper.ways import FULL_SHARING, SINGLE, Sharing
from sortie.perception.evaluation.harness import Evaluation, Settings
from sortie.perception.metrics.ap import Matched, average_precision

GRID = MeasuredGrid(
    (0.05, 0.2), 0.01, ("all-4", "best-2"), ("zero", "masked"), ("confidence", "norm"), ("model", "f1", 0.4), ("default",)
)  # fmt: skip
TAU_F1 = F1(0.55, 0.7)
FRAMES, EGOS = 9, 2
VARIANT = Variant("deep", "why", (3,))


def evaluation(conditions: list[Sharing]) -> Evaluation:
    """Boxes of which so many are right as the condition's place in the list says, in scenes of three frames each."""
    units = {}
    for k, c in enumerate(conditions):
        rng = np.random.default_rng(k)
        right = 0.95 - 0.8 * ((7 * k) % len(conditions)) / len(conditions)
        units[c, "full"] = [
            Matched(np.sort(rng.uniform(0.05, 1.0, 9))[::-1], rng.random(9) < right, 12) for _ in range(FRAMES * EGOS)
        ]
    none = {c: np.zeros(FRAMES * EGOS, np.int64) for c in conditions}
    target = np.full((FRAMES, 2), np.nan)
    scene = np.arange(FRAMES) // 3
    settings = Settings(egos=EGOS, floor=0.05, regions=("full",))
    return Evaluation(tuple(conditions), settings, scene, target, units, none, none, none)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def found() -> Evaluation:
    kinds = [under(c, u, by) for u in GRID.unsent for by in GRID.cells_by for c in GRID.conditions()]
    return evaluation([SINGLE, FULL_SHARING, *kinds])


@pytest.fixture(scope="module", autouse=True)
def few_draws() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("research.flip.measure.Bootstrap", partial(Bootstrap, draws=100))
        yield


@pytest.fixture(scope="module")
def rows(found: Evaluation, few_draws: None) -> list[StudyRow]:
    return rows_of(GRID, VARIANT, 3, "dense", found, TAU_F1)


def test_every_quantity_is_of_its_own_conditions_at_its_own_threshold(found: Evaluation, rows: list[StudyRow]) -> None:
    """AP in points, of boxes from the threshold on: two peers minus four, everyone minus a drone alone, zero minus masked."""
    for r in rows:

        def points(budget: float, peers: str, row: StudyRow = r, unsent: str = "") -> float:
            c = Sharing(budget, peers, unsent=unsent or row.unsent, cells_by=row.cells_by)  # type: ignore[arg-type]
            if peers == "none" or budget == 1.0:
                c = SINGLE if peers == "none" else FULL_SHARING
            cut = [
                Matched(u.score[u.score >= row.tau], u.hit[u.score >= row.tau], u.truths)
                for u in found.units[c, "full"]
            ]
            return 100.0 * average_precision(cut)

        at = r.received_budget
        every = {b: [points(b, p) for p in GRID.policies] for b in GRID.budgets}
        expected = {
            "gain": lambda at=at, p=points: p(1.0, "all-4") - p(0.0, "none"),
            "level": lambda at=at, p=points: p(at, "none" if at == 0.0 else "all-4"),
            "starved": lambda at=at, p=points: p(0.01, "all-4") - p(0.0, "none"),
            "contrast": lambda at=at, p=points: p(at, "best-2") - p(at, "all-4"),
            "level all-4": lambda at=at, p=points: p(at, "all-4"),
            "level best-2": lambda at=at, p=points: p(at, "best-2"),
            "fill": lambda at=at, p=points: p(at, "all-4", unsent="zero") - p(at, "all-4", unsent="masked"),
            "oracle": lambda e=every: np.mean([max(v) for v in e.values()]) - np.mean(list(e.values()), axis=0).max(),
        }  # fmt: skip
        assert r.value == pytest.approx(expected[r.quantity](), abs=1e-6), (r.quantity, r.received_budget, r.tau_name)
        assert r.low - 1e-6 <= r.value <= r.high + 1e-6
        assert r.high - r.low < 60.0


def test_the_table_holds_every_quantity_once_under_every_way(rows: list[StudyRow]) -> None:
    ways = {(u, by, t) for u in GRID.unsent for by in GRID.cells_by for t in ("model", "f1", "0.4")}
    assert {(r.unsent, r.cells_by, r.tau_name) for r in rows} == ways
    assert {(r.tau_name, r.tau) for r in rows} == {("model", 0.1), ("f1", 0.55), ("0.4", 0.4)}
    assert {(r.variant, r.seed, r.density, r.frames) for r in rows} == {("deep", 3, "dense", FRAMES)}
    plain = {("gain", -1.0), ("level", 0.0), ("level", 1.0), ("starved", 0.01), ("oracle", -1.0)}
    plain |= {(q, b) for q in ("contrast", "level all-4", "level best-2") for b in GRID.budgets}
    fill = {("fill", b) for b in (0.01, *GRID.budgets)}
    for way in ways:
        mine = [r for r in rows if (r.unsent, r.cells_by, r.tau_name) == way]
        told = [(r.quantity, -1.0 if math.isnan(r.received_budget) else r.received_budget) for r in mine]
        assert sorted(told) == sorted(plain | (fill if way[0] == "zero" else set()))


def test_a_ranking_that_was_not_evaluated_gives_no_rows(found: Evaluation) -> None:
    some = replace(found, conditions=tuple(c for c in found.conditions if c.cells_by == "confidence"))
    assert {r.cells_by for r in rows_of(replace(GRID, taus=("model",)), VARIANT, 3, "dense", some, TAU_F1)} == {
        "confidence"
    }


def test_the_best_threshold_counts_a_box_that_scores_just_so_and_of_equal_ones_is_the_lowest() -> None:
    """At 0.5 one box of one is right, of two cars: F1 = 2/3. From 0.6 on none is left."""
    one = [Matched(np.array([0.5, 0.3]), np.array([True, False]), 2)]
    best = optimal_f1(one, np.array([0.2, 0.4, 0.5, 0.6]))
    assert (best.tau, best.f1) == (0.4, pytest.approx(2 / 3))
    assert optimal_f1(one, np.array([0.2, 0.5, 0.6])).f1 == pytest.approx(2 / 3)
    assert threshold(0.3, best) == 0.3
