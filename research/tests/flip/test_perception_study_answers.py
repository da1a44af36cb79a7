"""What a study's report tells of several networks, each told apart by its own figures."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from research.flip import run as study_run
from research.flip.measure import StudyRow
from research.flip.networks import StudyConfig
from research.flip.plan import PLAN, MeasuredGrid, StudyPlan, Variant, read_plan
from research.flip.report import FixedSettings, StudyRows, answers, flips, networks, short, thresholds
from research.flip.run import conditions
from sortie.perception.network.model import ModelConfig

PLANNED = read_plan(PLAN)
FRAMES = 80


def row(
    name: str, unsent: str, quantity: str, budget: float, value: float, half: float = 1.0, **fixed: str
) -> StudyRow:
    variant, seed = name.rsplit("-", 1)
    ways = {"density": "default", "cells_by": "confidence", "tau_name": "model"} | fixed
    return StudyRow(
        variant, int(seed), ways["density"], unsent, ways["cells_by"], ways["tau_name"], 0.1, quantity, budget, value,
        value - half, value + half, FRAMES,
    )  # fmt: skip


def told(name: str, unsent: str, contrasts: tuple[float, ...], **of: float) -> list[StudyRow]:
    """One network under one filling: its contrasts by budget, and single figures by name."""
    out = [row(name, unsent, "contrast", b, v) for b, v in zip(PLANNED.measured.budgets, contrasts, strict=True)]
    out += [row(name, unsent, "gain", math.nan, of["full"] - of["alone"])]
    out += [row(name, unsent, "level", 0.0, of["alone"]), row(name, unsent, "level", 1.0, of["full"])]
    out += [row(name, unsent, "starved", 0.01, of["starved"]), row(name, unsent, "oracle", math.nan, of["oracle"], 0.9)]
    if unsent == "zero":
        out += [row(name, unsent, "fill", 0.01, of["fill"])]
        out += [row(name, unsent, "fill", b, -9.0) for b in PLANNED.measured.budgets]
    return out


FLAT, FLIP = (-2.0, -2.0, -2.0, -2.0), (7.0, 2.0, -4.0, -5.0)
ROWS = [
    *told("full-0", "zero", FLIP, alone=30.0, full=55.0, starved=3.0, oracle=0.4, fill=-3.0),
    *told("full-0", "masked", FLAT, alone=31.0, full=55.5, starved=4.0, oracle=0.7),
    *told("full-1", "zero", FLAT, alone=32.0, full=56.0, starved=-3.0, oracle=0.2, fill=0.5),
    *told("full-1", "masked", FLAT, alone=33.0, full=56.5, starved=0.5, oracle=1.2),
    *told("full-more-0", "zero", FLAT, alone=34.0, full=57.0, starved=2.0, oracle=0.3, fill=-5.0),
    *told("dropout-0", "zero", FLAT, alone=35.0, full=58.0, starved=2.0, oracle=0.5, fill=4.0),
]
SWEPT = [
    row("full-1", "masked", "contrast", b, v, density="dense", cells_by="norm", tau_name="0.3")
    for b, v in zip(PLANNED.measured.budgets, FLIP, strict=True)
]


def test_each_answer_names_the_networks_that_it_is_about() -> None:
    lines = answers(PLANNED, StudyRows(ROWS))
    assert lines[0].startswith(
        "- **The flip appears in the networks full-0**, at the model's own threshold, under zero "
    )
    assert lines[1] == "- At a budget of 0.01, the networks full-1 have a lower AP than a drone alone."
    zero = "Zero fill has a significantly lower AP than masked fusion, at that budget, in"
    assert lines[2:4] == [f"- {zero} 1 of the 2 networks `full`.", f"- {zero} 0 of the 1 networks `dropout`."]
    assert lines[4].endswith("appears in 1 cases: full-0, zero, cells by confidence, τ model, default.")
    assert "gains at most +1.2 AP points over the best single one (full-1, masked)." in lines[-1]


def test_a_flip_under_one_way_alone_is_a_case_of_that_way() -> None:
    lines = answers(PLANNED, StudyRows([*ROWS, *SWEPT]))
    assert "appears in 2 cases" in lines[4]
    assert lines[4].endswith("; full-1, masked, cells by norm, τ 0.3, dense.")
    assert lines[0].startswith("- **The flip appears in the networks full-0**")


def test_a_row_of_a_table_is_of_its_own_network_and_filling() -> None:
    text = networks(PLANNED, StudyRows(ROWS))
    zero, masked = text.split("**Masked fusion**")
    for name, alone, full in (("full-0", 30, 55), ("full-1", 32, 56), ("full-more-0", 34, 57), ("dropout-0", 35, 58)):
        assert f"| {name} | {alone:.1f} | {full:.1f} | " in zero
    assert [line.split(" | ")[:3] for line in masked.splitlines() if line.startswith("| full")] == [
        ["| full-0", "31.0", "55.5"],
        ["| full-1", "33.0", "56.5"],
    ]
    mine = next(line for line in zero.splitlines() if line.startswith("| full-0 |"))
    cells = [c.strip() for c in mine.strip("|").split("|")]
    assert cells[3:] == [
        "+3.0 [+2.0, +4.0]", "−3.0 [−4.0, −2.0]", "▲ +7.0 [+6.0, +8.0]", "▲ +2.0 [+1.0, +3.0]", "▼ −4.0 [−5.0, −3.0]",
        "▼ −5.0 [−6.0, −4.0]", "+0.4 [−0.5, +1.3]",
    ]  # fmt: skip


def test_the_page_shows_what_it_compares_under_both_fillings() -> None:
    text = short(PLANNED, ROWS, "../study.md")
    zero, _, masked = text.partition("| network, masked ")
    assert "| network, zero fill |" in zero
    assert "| full-0 | 30.0 | 55.0 |" in zero
    assert "| dropout-0 | 35.0 | 58.0 |" in zero
    assert "full-more-0 |" not in text
    assert "| full-0 | 31.0 | 55.5 |" in masked
    assert "| dropout-0 |" not in masked


def test_the_sweep_of_thresholds_is_the_first_network_s() -> None:
    def at(tau: str, value: float, name: str = "full-0") -> list[StudyRow]:
        made = [
            replace(r, value=value, tau=0.37)
            for r in told(name, "zero", FLAT, alone=1, full=2, starved=3, oracle=0, fill=0)
        ]
        return [replace(r, tau_name=tau) for r in made]

    rows = [*at("model", 11.0), *at("f1", 22.0), *at("0.3", 33.0), *at("0.3", 99.0, "full-1")]
    lines = [line for line in thresholds(PLANNED, StudyRows(rows)).splitlines() if line.startswith("| 0.")]
    assert [line.split(" | ")[:2] for line in lines] == [
        ["| 0.37, the model's", "11.0"],
        ["| 0.37, F1-optimal", "22.0"],
        ["| 0.3", "33.0"],
    ]


@pytest.mark.parametrize(
    ("order", "there"), [((0.25, 0.02, 0.1, 0.05), True), ((0.02, 0.05, 0.1, 0.25), True), ((0.02,), False)]
)
def test_a_flip_is_looked_for_by_rising_budget_in_whichever_order_they_are_given(
    order: tuple[float, ...], there: bool
) -> None:
    assert flips(StudyRows(ROWS), FixedSettings("full", 0), order) is there


def test_what_is_evaluated_of_a_network_follows_from_where_it_comes_from_and_the_density() -> None:
    """By norm only of what was trained from scratch at the default density; alone and with everything once."""
    grid = MeasuredGrid((0.1, 0.2), 0.01, ("all-4", "best-2"), ("zero", "masked"), ("confidence", "norm"), ("model",), ("default",))  # fmt: skip
    scratch, later = Variant("full", "why", (0,)), Variant("more", "why", (0,), "full")
    for variant, density, ranks in (
        (scratch, "default", {"confidence", "norm"}),
        (scratch, "dense", {"confidence"}),
        (later, "default", {"confidence"}),
    ):
        asked = list(conditions(grid, variant, density))  # type: ignore[arg-type]
        assert [c.label for c in asked[:2]] == ["single", "all-4@1"]
        every = {(c.received_budget, c.peers, c.unsent, c.cells_by) for c in asked[2:]}
        assert len(asked) == 2 + len(every)
        assert every == {
            (b, p, u, by) for b in (0.01, 0.1, 0.2) for p in grid.policies for u in grid.unsent for by in ranks
        }


def test_what_others_begin_from_is_trained_before_them() -> None:
    """First the first seed of all, then further ones; a run says the name of what it begins from."""
    first = Variant("full", "why", (0, 1))
    plan = StudyPlan("", "", PLANNED.measured, (first, Variant("more", "why", (0, 1), "full", {"steps": 7})))
    assert [v.job(s) for v, s in plan.jobs()] == ["full-0", "more-0", "full-1", "more-1"]
    recipe = plan.variants[1].recipe_for(1)
    assert (recipe.warm_start, recipe.seed, recipe.steps) == ("full-1.safetensors", 1, 7)
    assert plan.variants[0].recipe_for(1).warm_start == ""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '"model", "f1", 0.01',
            '"model", "f1", 0.0',
            r"evaluation\.taus has 0\.0, must be model, f1 or above 0 and below 1",
        ),
        ('"model", "f1", 0.01', '"model", "f1", 1.0', r"evaluation\.taus has 1\.0, must be"),
        ('"model", "f1", 0.01', '"model", "f1", 1', r"evaluation\.taus has 1, must be"),
        ("seeds = [0, 1, 2]", "seeds = [0, 1]", "variant dropout has seeds that full has not"),
    ],
)
def test_a_plan_that_cannot_be_measured_or_trained_is_named(old: str, new: str, message: str, tmp_path: Path) -> None:
    text = PLAN.read_text("utf-8")
    assert old in text
    (tmp_path / "plan.toml").write_text(text.replace(old, new, 1), "utf-8")
    with pytest.raises(ValueError, match=message):
        read_plan(tmp_path / "plan.toml")


def test_a_network_is_trained_as_the_plan_says_from_the_weights_that_it_begins_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From one's own weights before those that ship; what has weights in either place is not trained again."""
    asked: list[Any] = []

    def train(out: Path, recipe: Any, model: Any, **rest: Any) -> str:
        asked.append((out, recipe, model, rest["root"], rest["work"], rest["warm_start"]))
        return "trained"

    monkeypatch.setattr(study_run, "train", train)
    mine, shipped, root = tmp_path / "mine", tmp_path / "shipped", tmp_path / "bench"
    mine.mkdir()
    shipped.mkdir()
    (shipped / "full-0.safetensors").write_bytes(b"")
    signed = next(v for v in PLANNED.variants if v.name == "signed")

    def trained(job: str) -> Any:
        return study_run.train_job(PLANNED, job, mine, root, shipped=shipped)

    assert trained("full-0") is None
    assert study_run.train_job(PLANNED, "full-0", mine, root) == "trained"
    for folder in (shipped, mine):
        (folder / "full-0.safetensors").write_bytes(b"")
        assert trained("signed-0") == "trained"
        assert asked.pop() == (
            mine / "signed-0.safetensors", signed.recipe_for(0), StudyConfig(exchange="signed"), root, mine / "signed-0",
            folder / "full-0.safetensors",
        )  # fmt: skip
    assert asked == [
        (mine / "full-0.safetensors", PLANNED.variants[0].recipe_for(0), ModelConfig(), root, mine / "full-0", None)
    ]
    (mine / "signed-0.safetensors").write_bytes(b"")
    assert trained("signed-0") is None
