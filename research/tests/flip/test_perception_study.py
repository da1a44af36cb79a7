"""The study's rows and what is told of them by rule."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from research.flip import run as study_run
from research.flip.measure import StudyRow, from_table, optimal_f1, threshold, to_table
from research.flip.plan import PLAN, read_plan
from research.flip.report import FixedSettings, StudyRows, answers, flips, on_frames, report, sign
from research.flip.run import SHIPPED, train_job, weights_of
from sortie.perception.metrics.ap import Matched

BUDGETS = (0.02, 0.05, 0.1, 0.25)
ONE = StudyRow("full", 0, "default", "zero", "confidence", "model", 0.1, "contrast", 0.02, 1.0, 0.5, 1.5, 80)


def rows_with(
    contrasts: tuple[float, float, float, float], half_width: float = 1.0, **changes: object
) -> list[StudyRow]:
    """One network's rows: these contrasts by budget, the rest plain."""
    base = replace(ONE, **changes)  # type: ignore[arg-type]
    out = [replace(base, quantity="gain", received_budget=math.nan, value=18.0, low=16.0, high=20.0)]
    out += [
        replace(base, received_budget=budget, value=v, low=v - half_width, high=v + half_width)
        for budget, v in zip(BUDGETS, contrasts, strict=True)
    ]
    out.append(replace(base, quantity="starved", received_budget=0.01, value=-3.0, low=-4.0, high=-2.0))
    out.append(replace(base, quantity="oracle", received_budget=math.nan, value=0.4, low=0.1, high=0.9))
    return out


def test_a_study_says_on_how_many_frames_it_stands() -> None:
    assert on_frames([ONE, ONE]) == "Measured on the first 80 of the 240 frames of the test split."
    whole = replace(ONE, frames=240)
    assert on_frames([whole]) == "Measured on all 240 frames of the test split."
    assert on_frames([whole, ONE]) == "Measured on the first 80 of the 240 and all 240 frames of the test split."


@pytest.mark.parametrize(
    ("contrasts", "half_width", "there"),
    [
        ((7.7, 1.4, -4.0, -4.8), 1.0, True),  # the paper's
        ((7.7, 1.4, -4.0, -4.8), 9.0, False),  # not significant
        ((-4.0, -4.0, 1.4, 7.7), 1.0, False),  # the other way round
        ((-2.8, -2.8, -2.3, -2.6), 1.0, False),
        ((2.0, 2.0, 2.0, 2.0), 1.0, False),
        ((0.5, 2.0, 0.0, -2.0), 1.0, True),
    ],
)
def test_a_flip_is_two_first_and_four_later_both_significant(
    contrasts: tuple[float, float, float, float], half_width: float, there: bool
) -> None:
    assert flips(StudyRows(rows_with(contrasts, half_width)), FixedSettings("full", 0), BUDGETS) is there


def test_a_sign_needs_an_interval_without_zero() -> None:
    assert sign(ONE) == 1
    assert sign(replace(ONE, low=-0.1)) == 0
    assert sign(replace(ONE, value=-1.0, low=-1.5, high=-0.5)) == -1
    assert sign(replace(ONE, low=math.nan, high=math.nan)) == 0
    assert sign(None) == 0


def test_rows_survive_their_file(tmp_path: Path) -> None:
    rows = rows_with((1.0, 2.0, 3.0, 4.0))
    pq.write_table(to_table(rows), tmp_path / "rows.parquet")
    back = from_table(pq.read_table(tmp_path / "rows.parquet"))
    assert repr(back) == repr(rows)  # NaN is not equal to itself


def test_the_report_tells_of_a_flip_where_there_is_one_and_names_what_is_missing() -> None:
    plan = read_plan()
    rows = rows_with((7.7, 1.4, -4.0, -4.8)) + rows_with((-2, -2, -2, -2), unsent="masked")
    text = report(plan, rows)
    assert "The flip appears in the networks full-0" in text
    assert "the networks full-0 have a lower AP than a drone alone" in text
    assert "▲ +7.7 [+6.7, +8.7]" in text
    assert "▼ −4.8 [−5.8, −3.8]" in text
    assert "Not trained yet" in text
    assert "deep-0" in text.partition("Not trained yet")[2]
    quiet = "\n".join(answers(plan, StudyRows(rows_with((-2, -2, -2, -2)))))
    assert "The flip appears in none of the 1 networks" in quiet
    assert "appears nowhere" in quiet


def test_the_f1_optimal_threshold_is_where_a_plain_search_finds_it() -> None:
    rng = np.random.default_rng(3)
    units = []
    for _ in range(7):
        score = rng.random(30)
        units.append(Matched(score=score, hit=rng.random(30) < score, truths=20))
    taus = np.arange(0.05, 0.95, 0.05)

    def f1(tau: float) -> float:
        tp = sum(int((u.hit & (u.score >= tau)).sum()) for u in units)
        fp = sum(int((~u.hit & (u.score >= tau)).sum()) for u in units)
        fn = sum(u.truths for u in units) - tp
        return 2 * tp / (2 * tp + fp + fn)

    found = optimal_f1(units, taus)
    assert found.f1 == pytest.approx(max(f1(t) for t in taus))
    assert f1(found.tau) == pytest.approx(found.f1)
    assert [threshold(n, found) for n in ("model", "f1", 0.3)] == [0.1, found.tau, 0.3]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('unsent = ["zero", "masked"]', 'unsent = ["zeros"]', "evaluation.unsent has 'zeros', must be zero or masked"),
        ('from = "full"', 'from = "fool"', "variant full-more is from 'fool', must be a variant before it"),
        ('name = "deep"', 'name = "full"', "variant full is named twice"),
        ('"model", "f1", 0.01', '"model", "f1", 1.5', "evaluation.taus has 1.5, must be model, f1 or above 0 and below 1"),
        ("[question]", "[quest]", "not a plan of a study"),
    ],
)  # fmt: skip
def test_a_broken_plan_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = PLAN.read_text("utf-8")
    assert old in text
    broken = tmp_path / "plan.toml"
    broken.write_text(text.replace(old, new, 1), "utf-8")
    with pytest.raises(ValueError, match=message.replace("(", r"\(")) as error:
        read_plan(broken)
    assert str(broken) in str(error.value)


def test_a_job_that_begins_from_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"dropout-1 begins from full-1, which has no weights"):
        train_job(read_plan(), "dropout-1", tmp_path, tmp_path)
    with pytest.raises(ValueError, match=r"fool-0 is not in the plan, must be one of full-0, "):
        train_job(read_plan(), "fool-0", tmp_path, tmp_path)


def test_every_network_that_ships_is_in_the_plan() -> None:
    jobs = {v.job(s) for v, s in read_plan().jobs()}
    assert {p.stem for p in SHIPPED.glob("*.safetensors")} <= jobs
    assert weights_of("full-0", SHIPPED) is not None
    assert weights_of("fool-0", SHIPPED) is None


def test_a_network_is_measured_at_each_density_and_its_threshold_is_found_on_scenes_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, str, int | None]] = []

    class Found:
        def matched(self, *_: Any) -> list[Any]:
            return []

    def make_split(bench: Any, split: str, root: Path, *, scenes: int | None = None) -> list[Path]:
        asked.append((bench.difficulty.density, split, scenes))
        return []

    stand_ins: dict[str, Any] = {
        "make_split": make_split, "load_frames": lambda paths: paths, "evaluate": lambda *_, **__: Found(),
        "optimal_f1": lambda *_: "f1", "rows_of": lambda *a: [(a[3], a[5])], "CarNetInstrument": SimpleNamespace(load=lambda path, device: path),
        "weights_of": lambda job, *_: Path(job),
    }  # fmt: skip
    for name, made in stand_ins.items():
        monkeypatch.setattr(study_run, name, made)
    plan = read_plan(PLAN)
    rows = [rows for _, rows in study_run.measure(plan, tmp_path, tmp_path, frames=7)]
    densities = plan.measured.densities
    assert len(densities) > 1
    assert rows[0] == [(density, "f1") for density in densities]
    assert asked[: len(densities) + 1] == [("default", "tau", None), *((density, "test", 7) for density in densities)]
    assert rows[1:] == [[("default", "f1")]] * (len(list(plan.jobs())) - 1)
