"""What the commands that train, measure and fit pass on: every option arrives in its own place, and every figure that they
print stands in its own column.

Commands: `train`, `calibrate`, `fit`, `bench`, `study`, `recording`, `learn`, `compare` over conditions, `paper`,
`overhead`, `verify`, `import`, `view`, `report` and `list`. What they call is stood in for, so that nothing is computed.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cli_examples import command
from sim_examples import BASE

import sortie
from research.learn.learn import Lesson
from research.paper import command as paper_command
from sortie.perception.evaluation import SINGLE, Sharing
from sortie.perception.geometry import Geometry
from sortie.perception.metrics.bootstrap import Difference
from sortie.perception.uncertainty import BoxErrors
from sortie.policies.contract import PolicyError
from sortie.policies.verification.invariants import Invariant
from sortie.scenarios.intervals import Estimate
from sortie.scenarios.reading.load import ScenarioError
from sortie.sim.cli import console
from sortie.sim.cli import verify as verify_command
from sortie.sim.cli.options import loaded, split_policies
from sortie.sim.studies.conditions import Cell


@pytest.fixture(autouse=True)
def _wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console.out, "_width", 200)  # tables as they are, whatever the terminal's width


class Seen:
    """A function that keeps what it was called with, and gives `answer` or stops the command."""

    def __init__(self, answer: Any = None) -> None:
        self.calls: list[tuple[tuple[Any, ...], dict[str, Any]]] = []
        self.answer = answer

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.calls.append((args, {name: value for name, value in kwargs.items() if name != "progress"}))
        if self.answer is None:
            raise sortie.RunError("seen")
        return self.answer

    @property
    def args(self) -> tuple[Any, ...]:
        return self.calls[-1][0]

    @property
    def kwargs(self) -> dict[str, Any]:
        return self.calls[-1][1]


def tuple_of(*args: Any, **kwargs: Any) -> tuple[Any, ...]:
    return (*args, kwargs) if kwargs else args


def stand_in(monkeypatch: pytest.MonkeyPatch, module: str, **names: Any) -> None:
    """Let a module that takes long to import be these names."""
    monkeypatch.setitem(sys.modules, module, SimpleNamespace(**names))  # type: ignore[misc]


def table_rows(text: str) -> list[list[str]]:
    """The cells of every line of a printed table, also of one without a frame."""
    lines = (line.strip("│┃ ").replace("┃", "│") for line in text.splitlines())
    return [
        [cell.strip() for cell in (line.split("│") if "│" in line else re.split(r"\s{2,}", line))] for line in lines
    ]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scenario."""
    (tmp_path / "s.yaml").write_text(BASE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


# --- networks -------------------------------------------------------------------------------------------------------


def test_train(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = Seen()
    stand_in(monkeypatch, "research.benchmark.dataset", Benchmark=tuple_of)
    names = {"shipped": lambda fusion: here / f"{fusion}.own", "named_weights": lambda path: here / path}
    stand_in(monkeypatch, "sortie.perception.network.detector", **names)
    stand_in(monkeypatch, "sortie.perception.network.fusion.registry", FUSIONS={"none": 1, "late": 2, "disconet": 3})
    stand_in(monkeypatch, "research.flip.networks", config_of=lambda fields: tuple(fields.values()))
    stand_in(monkeypatch, "research.train.recipe", Recipe=dict)
    stand_in(monkeypatch, "research.train.train", train=seen)
    monkeypatch.setitem(sys.modules, "research.train.playback", None)  # type: ignore[arg-type]  # Rerun is missing
    for name in ("late.own", "w"):
        (here / name).touch()
    options = {
        "steps": 11, "batch": 6, "scenes": 12, "seed": 13, "peak-lr": 0.25, "cell-dropout": 0.5, "unsent": "zero", "fusion": "late",
        "exchange": "signed", "decoder": "deep", "grid": "fine", "varied": 0.75, "precision": "bfloat16", "range": "51.2",
        "image-px": 512, "bench-seed": 14, "bench": "b", "warm-start": "late", "minutes": 1.5, "device": "cpu", "out": "o",
    }  # fmt: skip
    given = [word for name, value in options.items() for word in (f"--{name}", value)]
    assert command("train", *given, "--no-resume") == 2
    out, recipe, config, bench = seen.args
    assert (out, config, bench[0]) == (Path("o"), (51.2, "late", "signed", "deep", "fine", 512), 14)
    assert bench[1]["geometry"] == Geometry(51.2, 512)
    assert recipe == {
        "steps": 11, "batch": 6, "seed": 13, "scenes": 12, "peak_lr": 0.25, "cell_dropout": 0.5, "unsent": "zero", "varied": 0.75,
        "precision": "bfloat16", "warm_start": "late.own",
    }  # fmt: skip
    assert seen.kwargs == {
        "root": Path("b"), "warm_start": here / "late.own", "minutes": 1.5, "resume": False, "device": "cpu", "scalars": None,
    }  # fmt: skip
    assert command("train", "--warm-start", "w") == 2
    assert (seen.kwargs["warm_start"], seen.args[1]["warm_start"]) == (here / "w", "w")
    assert command("train") == 2
    assert seen.args[2] == (102.4, "disconet", "rectified", "shallow", "coarse", 256)
    assert (seen.kwargs["warm_start"], seen.args[1]["warm_start"], seen.kwargs["resume"]) == (None, "", True)


def test_calibrate(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    level, order = SimpleNamespace, SimpleNamespace
    levels = [
        level(condition=name, torch=0.5, surrogate=0.5 + error, error=error)
        for name, error in (("a", 0.01), ("b", -0.2))
    ]
    orders = [
        order(a="x", b=b, torch=0.25, low=0.125, high=0.375, surrogate=0.0625, significant=sure, kept=kept)
        for b, sure, kept in (("k", True, True), ("l", True, False), ("m", False, True))
    ]
    made, flown = Seen((None, SimpleNamespace(levels=levels, orders=orders))), Seen()
    stand_in(monkeypatch, "research.calibrate.calibrate", calibrate=made)
    stand_in(monkeypatch, "research.calibrate.judge", WITHIN=0.02)
    monkeypatch.setattr("research.calibrate.command.flights", flown)
    options = ("--out", "o", "--weights", "w", "--scenes", "5", "--held-out", "6", "--seed", "7", "--work", "k")
    assert command("calibrate", *options) == 0
    assert (made.args, made.kwargs) == (
        (Path("o"),), {"work": Path("k"), "weights": Path("w"), "scenes": 5, "held_out": 6, "seed": 7},
    )  # fmt: skip
    told = capsys.readouterr().out
    assert ["b", "0.500", "0.300", "-0.200"] in table_rows(told)
    assert [re.sub(r".*, ", "", line) for line in told.splitlines() if " − x: " in line] == [
        "kept",
        "lost",
        "not significant",
    ]
    assert "k − x: torch +0.250 [+0.125, +0.375], surrogate +0.062, kept" in told
    fly = ("--fly", "s.yaml", "--policies", "boxes, silence", "--rate-hz", "2", "--towns", "3")
    assert command("calibrate", *options, *fly) == 2
    assert [a for k, a in enumerate(flown.args) if k != 5] == [
        "s.yaml",
        Path("o"),
        Path("w"),
        2.0,
        ["boxes", "silence"],
        3,
    ]
    assert command("calibrate", *fly, "--made", "m") == 2
    assert (flown.args[1], len(made.calls)) == (Path("m"), 2), "nothing is fitted where a fit is named"
    assert command("calibrate", "--made", "m") == 2
    assert len(made.calls) == 2


def test_an_error_of_the_surrogate_is_as_bad_below_as_above(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from rich.console import Console

    from research.calibrate import command as calibrate

    stand_in(monkeypatch, "research.calibrate.judge", WITHIN=0.02)
    monkeypatch.setattr(
        calibrate, "out", Console(force_terminal=True, width=100, color_system="standard", no_color=False)
    )
    errors = (0.02, 0.03, -0.02, -0.03)
    levels = [SimpleNamespace(condition="c", torch=0.5, surrogate=0.5, error=error) for error in errors]
    calibrate._tell(SimpleNamespace(levels=levels, orders=[]), Path("o"))  # type: ignore[arg-type]
    colours = re.findall(r"\x1b\[(\d+)m[+-]0\.0\d0\x1b", capsys.readouterr().out)
    assert colours == ["32", "31", "32", "31"], "green and red"


def test_fit(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    net = SimpleNamespace(config=SimpleNamespace(geometry="its grid"))
    made, moments, split = Seen({"cells": 77, "unexplained": {1: 0.5, 20: 0.0625}}), Seen(), Seen()
    stand_in(monkeypatch, "research.benchmark.dataset", Benchmark=tuple_of, load_frames=None, make_split=split)
    stand_in(monkeypatch, "sortie.perception.network.checkpoint", load_weights=lambda path: net)
    stand_in(monkeypatch, "sortie.perception.network.detector", named_weights=lambda path: path or Path("shipped/net"))
    stand_in(monkeypatch, "research.train.codebook", CodebookRecipe=tuple_of, make_codebook=made)
    stand_in(monkeypatch, "research.train.boxes_alone", boxes_alone=None, moments_of=None)
    stand_in(monkeypatch, "sortie.perception.training", box_errors=None)
    stand_in(monkeypatch, "research.calibrate.errors", moments=moments)
    options = (
        "--stages",
        "3",
        "--scenes",
        "4",
        "--iterations",
        "5",
        "--seed",
        "6",
        "--bench-seed",
        "7",
        "--bench",
        "b",
    )
    assert command("fit", "codebook", *options, "--weights", "w", "--out", "o") == 0
    assert made.args == (net, Path("o"), (7, {"geometry": "its grid"}), (3, 4, 5, 6))
    assert made.kwargs == {"weights": "w", "root": Path("b")}
    told = capsys.readouterr().out
    assert ["20", "6.2 %"] in table_rows(told)
    assert "77 cells" in told
    assert command("fit", "errors", "surrogate", "--towns", "9", "--weights", "w", "--out", "o") == 2
    assert moments.args == (Path("w"), "fit", 9)
    assert command("fit", "errors", "torch", "--weights", "w", "--out", "o", "--bench-seed", "8", "--bench", "b") == 2
    assert split.args == ((8, {"geometry": "its grid"}), "validation", Path("b"))
    assert len(moments.calls) == 1


@pytest.mark.parametrize(
    ("given", "told", "kept"),
    [
        (("torch",), "torch --bench-seed 0", "shipped/net.errors.json"),
        (
            ("torch", "--weights", "my w", "--bench-seed", "8"),
            "torch --weights 'my w' --bench-seed 8",
            "my w.errors.json",
        ),
        (("surrogate", "--weights", "w", "--out", "o", "--towns", "9"), "surrogate --weights w --out o --towns 9", "o"),
    ],
)
def test_a_file_of_box_errors_names_the_command_that_repeats_it(
    here: Path, monkeypatch: pytest.MonkeyPatch, given: tuple[str, ...], told: str, kept: str
) -> None:
    net, fitted = SimpleNamespace(config=SimpleNamespace(geometry="")), SimpleNamespace(boxes=7, within=(0.7, 0.9))
    model = BoxErrors((0.0,) * 5, (0.0,) * 5, 0.25)
    box_errors = SimpleNamespace(fit=lambda found: model, calibration=lambda model, found: fitted)
    found = Seen(["boxes"])
    stand_in(monkeypatch, "research.benchmark.dataset", Benchmark=tuple_of, load_frames=found, make_split=found)
    stand_in(monkeypatch, "sortie.perception.network.checkpoint", load_weights=lambda path: net)
    stand_in(monkeypatch, "sortie.perception.network.detector", named_weights=lambda path: path or Path("shipped/net"))
    stand_in(monkeypatch, "research.train.boxes_alone", boxes_alone=found, moments_of=found)
    stand_in(monkeypatch, "sortie.perception.training", box_errors=box_errors)
    stand_in(monkeypatch, "research.calibrate.errors", moments=found)
    assert command("fit", "errors", *given) == 0
    assert json.loads((here / kept).read_text())["made"]["command"] == f"sortie fit errors {told}"


def test_bench(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    sizes = {"train": (100, 10), "validation": (30, 1), "tau": (4, 1), "test": (80, 5)}
    split, effects, counted = Seen([]), Seen([]), Seen()
    bench = Seen(SimpleNamespace(folder=lambda out: out / "made"))
    stand_in(
        monkeypatch,
        "research.benchmark.dataset",
        MOST={"train": 300, "validation": 30, "tau": 4, "test": 80},
        SIZES=sizes,
        Benchmark=bench,
        make_split=split,
    )
    stand_in(monkeypatch, "research.benchmark.survey", by_style=None, survey=counted)
    stand_in(monkeypatch, "sortie.perception.network.detector", named_weights=lambda path: path or Path("shipped/net"))
    stand_in(monkeypatch, "research.paper.difficulty_effects", measure=effects)
    files = {"splits": {"tau": {"a": {"frames": 5}, "b": {"frames": 7}}}}
    monkeypatch.setattr("research.benchmark.command.read", lambda folder: files)
    common = ("--seed", "3", "--density", "dense", "--range", "51.2")
    assert command("bench", "make", *common, "--image-px", "512", "--split", "tau", "--split", "test", "--split", "tau", "--scenes", "9",
                   "--workers", "2", "--out", "o") == 0  # fmt: skip
    assert [(args[1:], given) for args, given in split.calls] == [
        (("tau", Path("o")), {"scenes": 4, "workers": 2}), (("test", Path("o")), {"scenes": 9, "workers": 2}),
    ]  # fmt: skip
    seed, difficulty, geometry = bench.args
    assert (seed, difficulty.density, geometry) == (3, "dense", Geometry(51.2, 512))
    assert ["tau", "2", "12"] in table_rows(capsys.readouterr().out)
    assert command("bench", "make") == 0
    assert [(args[1], given["scenes"]) for args, given in split.calls[2:]] == [
        (name, n) for name, (n, _) in sizes.items()
    ]
    assert command("bench", "make", "--split", "train", "--split", "tau", "--scenes", "150") == 0
    assert [given["scenes"] for _, given in split.calls[-2:]] == [150, 4], "the train split goes on"
    assert command("bench", "survey", *common, "--scenes", "2") == 2
    seed, difficulty, geometry = bench.args
    assert (seed, difficulty.density, geometry) == (3, "dense", Geometry(51.2))
    assert counted.args == (bench.answer, "train", 0)
    assert command("bench", "difficulty", "--weights", "w", "--scenes", "5", "--store", "t", "--workers", "6") == 0
    assert (effects.args, effects.kwargs) == ((Path("w"), Path("t")), {"scenes": 5, "workers": 6})
    assert command("bench", "difficulty") == 0
    assert effects.args == (Path("shipped/net"), Path("runs/difficulty"))


def test_study(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    plan = SimpleNamespace(jobs=lambda: [(SimpleNamespace(job=lambda s: f"own-{s}"), k) for k in (1, 2)])
    gain = SimpleNamespace(validation=SimpleNamespace(ap_a=0.25, ap_b=0.5))
    trained, measured, tabled = Seen(gain), Seen([("a", [1, 2]), ("b", [3])]), Seen("table")
    written: list[Any] = []
    stand_in(monkeypatch, "research.flip.plan", read_plan=lambda: plan)
    stand_in(monkeypatch, "research.flip.run", SHIPPED=Path("shipped"), train_job=trained, measure=measured)
    stand_in(monkeypatch, "research.flip.measure", StudyRow=int, to_table=tabled)
    monkeypatch.setattr("research.flip.command._write_table", lambda table, path: written.append((table, path)))
    assert command("study", "train", "dropout-1", "--work", "w", "--bench", "b") == 0
    assert command("study", "train") == 0
    assert [(args[1:], given["shipped"]) for args, given in trained.calls] == [
        (("dropout-1", Path("w"), Path("b")), Path("shipped")),
        *((((f"own-{k}"), Path("runs/study"), Path("runs/bench")), Path("shipped")) for k in (1, 2)),
    ]
    assert "dropout-1 AP@0.5 alone 0.250, all five 0.500" in capsys.readouterr().out
    assert (
        command("study", "run", "--work", "w", "--bench", "b", "--frames", "9", "--workers", "3", "--device", "cpu")
        == 0
    )
    assert (measured.args, measured.kwargs) == (
        (plan, Path("w"), Path("b")), {"shipped": Path("shipped"), "frames": 9, "workers": 3, "device": torch.device("cpu")},
    )  # fmt: skip
    assert tabled.args == ([1, 2, 3],), "the rows of every network"
    assert written == [("table", Path("w/study.parquet"))]


def test_the_doses_of_the_study(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in(monkeypatch, "research.flip.dose_figure", draw=None)
    from research.flip import doses

    def effect(value: float) -> Any:
        return SimpleNamespace(value=value, low=value - 0.5, high=value + 0.5)

    plan = SimpleNamespace(budgets=(0.25,), starved=0.02, hypotheses=("First.", "Second."))
    row = SimpleNamespace(
        network="net", dose=SimpleNamespace(label="two"), weight_on_zeros=0.375, starved=effect(1.0), silent=effect(2.0),
        contrasts=(effect(3.0),), frames=40,
    )  # fmt: skip
    measured = Seen([row])
    stand_in(monkeypatch, "research.flip.dose_run", measure=measured)
    monkeypatch.setattr(doses, "read_plan", lambda: plan)
    monkeypatch.setattr(doses, "verdicts", lambda rows: {"net": (True, False), "other": (True, True)})
    monkeypatch.setattr("research.paper.figures.available", lambda: False)
    assert (
        command(
            "study", "doses", "--work", "w", "--bench", "b", "--frames", "7:0-239", "--workers", "2", "--device", "cpu"
        )
        == 0
    )
    assert (measured.args, measured.kwargs) == (
        (plan, Path("w"), Path("b")), {"frames": [doses.FrameRange(7, 0, 239)], "workers": 2, "device": torch.device("cpu")},
    )  # fmt: skip
    told = capsys.readouterr().out
    (printed,) = [cells for cells in table_rows(told) if cells[0] == "net"]
    assert printed[1:3] == ["two", "0.38"]
    assert [float(re.match(r"[+-]?[\d.]+", cell)[0]) for cell in printed[3:]] == [1.0, 2.0, 3.0]  # type: ignore[index]
    assert "First. Holds in 2 of 2: net, other." in told
    assert "Second. Holds in 1 of 2: other." in told
    assert command("study", "doses") == 0
    assert measured.kwargs["frames"] is None


def test_recording(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    alone, way = SINGLE, Sharing.parse("all-4@1")
    shown = SimpleNamespace(
        conditions=[alone, way], resampled="scene", groups=lambda by: np.array([1, 1, 4]),
        ap=lambda c, region="full": {"full": 0.25, "mission": 0.5}[region],
        gain=lambda c, over: Difference(0.0, 0.0, 0.125, 0.1, 0.2) if (c, over) == (way, alone) else None,
        payload_bytes={alone: np.zeros(2), way: np.array([100.0, 300.0])},
        index_bytes={alone: np.zeros(2), way: np.array([7.0, 9.0])},
    )  # fmt: skip
    at, kept = Seen(shown), Seen(True)
    evaluated = Seen(SimpleNamespace(at=at, save=kept))
    monkeypatch.setattr("sortie.perception.evaluation.evaluate_recording", evaluated)
    options = ("--fusion", "own.py:fuse", "--conditions", "single best-2@0.02", "--tau", "0.25", "--out", "m.parquet")
    assert command("recording", "evaluate", "r.npz", *options) == 0
    (path, ways), given = evaluated.args, evaluated.kwargs
    assert (path, given) == (Path("r.npz"), {"fusion": "own.py:fuse"})
    assert [w.label for w in ways] == [Sharing.parse(text).label for text in ("single", "best-2@0.02")]
    assert (at.args, kept.args) == ((0.25,), (Path("m.parquet"),))
    printed = capsys.readouterr().out
    assert ["single", "0.250", "", "0.500", "0", "0"] in table_rows(printed)
    assert ["all-4@1", "0.250", "+12.5 [+10.0, +20.0]", "0.500", "200", "8"] in table_rows(printed)
    assert "interval over 2 scene(s)" in printed
    assert command("recording", "evaluate", "r.npz", "--tau", "1") == 0
    assert (at.args, evaluated.args[1]) == ((1.0,), None)
    assert command("recording", "evaluate", "r.npz", "--tau", "1.01") == 2
    assert len(evaluated.calls) == 2


# --- studies --------------------------------------------------------------------------------------------------------

CONDITIONS = """
base: s.yaml
set: [perception.detector=surrogate, duration_s=3]
conditions:
  - {name: wide, budget: 0.5, metric: full_scene}
  - {name: narrow, budget: 0.125, metric: full_scene}
"""
LATER = {("silence", "wide"): 0.5, ("silence", "narrow"): 0.25, ("boxes", "wide"): 0.75, ("boxes", "narrow"): 0.125}


def test_compare_over_conditions(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Gains over silence: 0.25 and -0.125; the mean of each policy's conditions stands in its row."""
    (here / "c.yaml").write_text(CONDITIONS)
    cells = [Cell(p, c, ap, 2e6 if p == "boxes" else 0.0, 4000.0, 0.25) for (p, c), ap in LATER.items()]
    flown = Seen(cells)
    monkeypatch.setattr("sortie.sim.cli.conditions.fly_all", flown)
    monkeypatch.setattr("sortie.sim.cli.conditions.torch_answers", lambda: "by torch")
    own = ("--set", "duration_s=4")
    assert command("compare", "c.yaml", "--policies", "silence,boxes", *own, "--by-torch", "--out", "o.json") == 0
    conditions, policies = flown.args
    assert policies == ["silence", "boxes"]
    assert list(conditions.set) == ["perception.detector=surrogate", "duration_s=3", "duration_s=4"], (
        "the last one holds"
    )
    assert flown.kwargs["detector_of"] == "by torch"
    rows = table_rows(capsys.readouterr().out)
    assert ["wide", "0.5", "0.5", "0.75"] in [[*cells[:2], *(c.rstrip("0") for c in cells[2:])] for cells in rows]
    (silence,), (boxes,) = ([cells for cells in rows if cells[0] == p] for p in ("silence", "boxes"))
    assert silence[:4] == ["silence", "0.375", "–", "100%"]
    assert (boxes[1], boxes[2].split()[0], boxes[3]) == ("0.438", "+6.2", "117%")
    assert boxes[-2:] == ["4.0", "25.0%"]
    kept = json.loads((here / "o.json").read_text())
    assert [(row["policy"], row["data_bytes"]) for row in kept["summary"]] == [("silence", 0.0), ("boxes", 2e6)]
    assert kept["cells"][3] == {
        "policy": "boxes", "condition": "narrow", "ap": 0.125, "data_bytes": 2e6, "energy_j": 4000.0, "miss_rate": 0.25,
        "flown_share": 1.0,
    }  # fmt: skip
    command("compare", "c.yaml", "--policies", "silence")
    assert flown.kwargs["detector_of"] is not None
    assert flown.kwargs["detector_of"] != "by torch"


def test_the_best_of_a_condition_is_bold_in_whichever_table_it_stands(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a narrow terminal each policy has a table of its own."""
    from sortie.scenarios.reading.load import load_conditions
    from sortie.sim.cli.conditions import _by_condition

    (here / "c.yaml").write_text(CONDITIONS)
    conditions = load_conditions("c.yaml")
    assert conditions is not None
    cells = [Cell(p, c, ap, 0.0, 0.0, 0.0) for (p, c), ap in LATER.items()]
    tables = list(_by_condition(conditions, ["silence", "boxes"], cells, 20))
    bold = [[cell.style == "bold" for cell in table.columns[2].cells] for table in tables]
    assert bold == [[False, True], [True, False]]
    (wide,) = _by_condition(conditions, ["silence", "boxes"], cells, 200)
    assert [len(wide.columns), list(wide.columns[1].cells)] == [4, ["0.5", "0.125"]]


def test_learn(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    lessons = [Lesson((0.0,), (0.5, 0.25, 0.0), "a"), Lesson((0.0,), (0.25, 0.5, 0.5), "b")]
    flown, saved = Seen(lessons), Seen(True)
    found = {
        ("search", 0.01): Estimate(0.01, 0.005, 0.015, 9), ("track", 0.6): Estimate(-0.02, -0.03, -0.01, 9),
    }  # fmt: skip
    monkeypatch.setattr("research.learn.learn.fly_lessons", flown)
    monkeypatch.setattr("research.learn.learn.save", saved)
    monkeypatch.setattr("research.learn.learn.gains", lambda lessons, arm: found if arm == 1 else {})
    monkeypatch.setattr("research.learn.learn.thresholds", lambda lessons: {"search": 0.125})
    options = (
        "--conditions",
        "9",
        "--seed",
        "4",
        "--workers",
        "2",
        "--by-torch",
        "--set",
        "fleet.drones=3",
        "--out",
        "o",
    )
    assert command("learn", *options) == 0
    assert (flown.args, flown.kwargs) == ((4, 9), {"sets": ("fleet.drones=3",), "by_torch": True, "workers": 2})
    assert (saved.args, saved.kwargs) == ((Path("o"), lessons, 4), {"by_torch": True, "sets": ("fleet.drones=3",)})
    told = capsys.readouterr().out
    rows = table_rows(told)
    assert [cells[1:] for cells in rows if len(cells) == 3][1:4] == [["0.375", "1"], ["0.375", "1"], ["0.250", "1"]]
    gained = [cells[1:] for cells in rows if len(cells) == 5 and re.search(": search|: track", cells[0])]
    assert [[cell.split()[0] for cell in cells] for cells in gained] == [
        ["+1.0", "–", "–", "–"], ["–", "–", "–", "-2.0"], ["–"] * 4, ["–"] * 4,
    ]  # fmt: skip
    assert "from a budget of: search 0.125" in told


def test_overhead(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    row = SimpleNamespace(
        policy="p", context_bytes_per_s=2500.0, data_bytes_per_s=3_500_000.0, context_share=0.125, p50_ms=0.25, p99_ms=0.75,
    )  # fmt: skip
    measured = Seen(row)
    monkeypatch.setattr(verify_command, "measure", measured)
    monkeypatch.setattr(verify_command, "host_s", lambda: 0.5)
    assert (
        command(
            "overhead", "--policies", "worked,best-2(received_budget=0.1, k=1)", "--drones", "2,3", "--seconds", "4"
        )
        == 0
    )
    assert [args for args, _ in measured.calls] == [
        (p, n, 4.0) for p in ("worked", "best-2(received_budget=0.1, k=1)") for n in (2, 3)
    ]
    rows = table_rows(capsys.readouterr().out)
    assert [cells[1:] for cells in rows if cells[0] == "p"] == [
        [n, "2.5", "3.5", "12.50%", "0.2500", "0.7500"] for n in ("2", "3", "2", "3")
    ]


def verified(monkeypatch: pytest.MonkeyPatch, proved: str = "proved", judged: str = "holds") -> dict[str, Seen]:
    """What `sortie verify` calls, each with one verdict."""
    seen = {
        "conform": Seen([SimpleNamespace(name="rule", holds=True, what="", counterexample=None)]),
        "prove": Seen([SimpleNamespace(name="line", outcome=proved, what="", counterexample=None)]),
        "judge_over_time": Seen([SimpleNamespace(name="timed", outcome=judged, what="", view=None, scenario=None)]),
    }
    for name, function in seen.items():
        monkeypatch.setattr(verify_command, name, function)
    return seen


def test_verify(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (here / "lines").write_text("representation >= detections\nwithin 0.5 s: representation >= detections\n")
    seen, resolved = verified(monkeypatch), Seen(lambda view: [])
    monkeypatch.setattr(verify_command, "resolve", resolved)
    options = (
        "--invariants", "lines", "--drones", "3", "--budget", "4", "--views", "50", "--scenario", "s.yaml", "--courses", "6",
        "--flights", "7",
    )  # fmt: skip
    assert command("verify", "best-2(received_budget=0.25)", *options) == 0
    assert resolved.args == ("best-2", {"received_budget": 0.25})
    assert seen["conform"].kwargs == {"count": 50, "budget_s": 4.0}
    decide, rules = seen["prove"].args
    assert seen["prove"].kwargs == {"max_drones": 3, "budget_s": 4.0}
    subject, timed = seen["judge_over_time"].args
    assert [rule.over_time for rule in (*rules, *timed)] == [False, True]
    assert all(isinstance(rule, Invariant) for rule in (*rules, *timed))
    assert seen["conform"].args == (decide,)
    assert (subject.policy, subject.name, subject.params) == (decide, "best-2", {"received_budget": 0.25})
    given = seen["judge_over_time"].kwargs
    assert given.pop("scenario").name == "example"
    assert given == {"drones": 3, "budget_s": 4.0, "courses": 6, "flights": 7}


@pytest.mark.parametrize(
    ("proved", "judged", "broken"), [("refuted", "holds", 1), ("proved", "refuted", 1), ("refuted", "refuted", 2)]
)
def test_each_verdict_that_is_refuted_counts(
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    proved: str,
    judged: str,
    broken: int,
) -> None:
    (here / "lines").write_text("representation >= detections\nwithin 0.5 s: representation >= detections\n")
    verified(monkeypatch, proved, judged)
    assert command("verify", "silence", "--invariants", "lines") == 1
    assert f"{broken} do" in capsys.readouterr().err


def test_a_model_of_another_kind_is_verified_with_its_parameters(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    checks = [
        SimpleNamespace(name=name, holds=holds, what="") for name, holds in (("a", True), ("b", False), ("c", False))
    ]
    seen = Seen(checks)
    monkeypatch.setattr(verify_command, "verify_model", seen)
    monkeypatch.setattr(verify_command, "failing", lambda checks: [c for c in checks if not c.holds])
    assert command("verify", "link", "own.py:Blocked(loss_db=20, hard=true)") == 1
    assert seen.args == ("link", "own.py:Blocked", {"loss_db": 20, "hard": True})
    assert "2 do not hold" in capsys.readouterr().err
    for words in (("link",), ("link", "a", "b")):
        assert command("verify", *words) == 2
        assert "must be [KIND] REF" in capsys.readouterr().err
    assert len(seen.calls) == 1


# --- the paper ------------------------------------------------------------------------------------------------------


def claim(id_: str, instrument: str, verdict: str, **more: Any) -> Any:
    return SimpleNamespace(
        id=id_,
        instrument=instrument,
        verdict=verdict,
        says=f"says {id_}",
        section="S",
        rule="contrast",
        size="",
        **more,
    )


def paper_modules(monkeypatch: pytest.MonkeyPatch) -> dict[str, Seen]:
    seen = {"make": Seen(), "frame_picture": Seen()}
    stand_in(
        monkeypatch, "research.paper.making", PaperSettings=tuple_of, ensure_writable=lambda out: None,
        TABLE="claims.parquet", **seen,
    )  # fmt: skip
    import sortie.sim.studies as studies

    monkeypatch.setattr(studies, "paper", sys.modules["research.paper.making"], raising=False)
    stand_in(monkeypatch, "sortie.perception.network.detector", named_weights=lambda path: path or Path("shipped/net"))
    return seen


def test_paper(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = paper_modules(monkeypatch)
    options = (
        "--frames", "9", "--seed", "3", "--weights", "w/own", "--unsent", "masked", "--cells-by", "norm", "--absent", "zeros",
        "--serve", "region_first", "--temperature", "2", "--silent-weight", "0.5", "--tau", "0.25", "--by-scene",
        "--workers", "4", "--live", "l/live.json", "--device", "cpu",
    )  # fmt: skip
    assert command("paper", *options, "--work", "k") == 2
    job, work, _ = seen["make"].args
    weights, asked, frames, seed, workers, told, live, fusion, device = job
    assert (weights, frames, seed, workers, live, work) == (Path("w/own"), 9, 3, 4, Path("l/live.json"), Path("k"))
    assert (asked.unsent, asked.cells_by, asked.tau, asked.by) == (("masked",), "norm", 0.25, "scene")
    assert (asked.ways.absent, asked.ways.serve) == ("zeros", "region_first")
    assert (fusion, device) == ({"temperature": 2.0, "silent_weight": 0.5}, "cpu")
    for words in (
        "--frames 9", "--seed 3", "--weights own", "--unsent masked", "--cells-by norm", "--absent zeros", "--serve region_first",
        "--temperature 2.0", "--silent-weight 0.5", "--tau 0.25", "--by-scene", "--live live.json", "--device cpu",
    ):  # fmt: skip
        assert f" {words}" in told
    assert "workers" not in told
    command("paper", "--workers", "1")
    weights, asked, frames, seed, _, told, live, fusion, _ = seen["make"].args[0]
    assert (weights, frames, seed, told, live, fusion) == (Path("shipped/net"), None, 0, "sortie paper", None, {})
    assert (asked.unsent, asked.by) == (("zero", "masked"), "frame")
    command("paper", "--frame", "5", "--ego", "2", "--seed", "3", "--work", "k")
    assert seen["frame_picture"].args[1:] == (Path("k"), 5, 2)
    assert seen["frame_picture"].args[0][3] == 3


def test_two_reports_are_compared_in_what_both_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of four claims the other report has judged three, and one of these otherwise."""
    ours = [claim("a", "zero", "x"), claim("a", "masked", "y"), claim("b", "", "x"), claim("c", "zero", "x")]
    theirs = [claim("a", "zero", "x"), claim("a", "masked", "x"), claim("b", "", "x"), claim("d", "zero", "y")]
    by_chance: list[list[Any]] = []
    monkeypatch.setattr(paper_command, "differ_by_chance", lambda rows: by_chance.append(list(rows)) or 0.5)
    first, *others = paper_command._differences(ours, theirs, Path("old")).splitlines()
    assert first == "2 of 3 verdicts are those of old (two tables of one truth differ in 0.5 on average), but:"
    assert others == ["  says a (masked fusion): y, there x"]
    assert by_chance == [ours[:3]]


def test_a_claim_without_an_instrument_stands_in_the_first_column_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper_command.report, "ours", lambda row: f"ours {row.id}{row.instrument}")
    monkeypatch.setattr(paper_command.report, "papers", lambda row: f"paper {row.id}")
    verdict = "reproduced"
    rows = [claim("a", "zero", verdict), claim("a", "masked", verdict), claim("b", "", verdict)]
    table = paper_command.verdicts_table(rows)
    cells = list(zip(*(column.cells for column in table.columns), strict=True))[1:]
    assert [(row[1], row[2], row[4]) for row in cells] == [
        ("paper a", "ours azero", "ours amasked"), ("paper b", "ours b", ""),
    ]  # fmt: skip
    assert len(paper_command.verdicts_table(rows, masked=False).columns) == 4


# --- runs -----------------------------------------------------------------------------------------------------------


def test_view_and_report(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    viewed, pictured, reported = Seen(True), Seen(True), Seen(Path("page"))
    opened = Seen(SimpleNamespace(view=viewed, picture=pictured, report=reported))
    monkeypatch.setattr(sortie, "open_run", opened)
    assert command("view", "r", "--picture", "p.png", "--at", "2.5") == 0
    assert (opened.args, pictured.args, viewed.calls) == ((Path("r"),), (Path("p.png"), 2.5), [])
    assert command("view", "r") == 0
    assert (len(viewed.calls), len(pictured.calls)) == (1, 1)
    assert command("report", "r", "--out", "o.html") == 0
    assert command("report", "r") == 0
    assert [args for args, _ in reported.calls] == [(Path("o.html"),), (Path("r/report.html"),)]


def test_import(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = Seen()
    monkeypatch.setattr("sortie.sim.cli.import_log.flown_log", seen)
    options = (
        "--rate", "5", "--from", "1.5", "--until", "2.5", "--lift", "3.5", "--system", "7", "--system", "2", "--together", "--ground",
        "47,8", "--out", "o",
    )  # fmt: skip
    assert command("import", "a.bin", "b.tlog", *options) == 2
    assert seen.args == ([Path("a.bin"), Path("b.tlog")], Path("o"), 5.0, 1.5, 2.5, 3.5, [7, 2])
    assert seen.kwargs == {"together": True, "ground": ["47,8"]}
    command("import", "My Log.bin")
    assert seen.args == ([Path("My Log.bin")], Path("my_log"), 10.0, 0.0, None, None, ())
    assert seen.kwargs == {"together": False, "ground": ()}


# --- options that several commands take -----------------------------------------------------------------------------


def test_a_policy_that_is_named_wins_over_the_one_that_is_set(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = loaded("s.yaml", ["policy.name=boxes", "duration_s=4"], "silence")
    assert (flown.policy.name, flown.duration_s) == ("silence", 4.0)
    assert capsys.readouterr().err == ""
    own = loaded("s.yaml", ["policy.changes=[{at_s: 1, name: boxes}]"], "worked")
    assert [change.name for change in own.policy.changes] == ["boxes"], "the scenario's own policy keeps its changes"
    assert capsys.readouterr().err == ""


def test_commas_in_brackets_separate_parameters() -> None:
    assert split_policies(" a(x=1, y=f(2,3)) ,b, ") == ["a(x=1, y=f(2,3))", "b"]
    assert split_policies("a(x=[1, 2], y='c, d)'),b") == ["a(x=[1, 2], y='c, d)')", "b"]
    with pytest.raises(PolicyError, match=r"^policies 'a\(x=1,b': a bracket is not closed"):
        split_policies("a(x=1,b")


def test_quoted_commas_and_brackets_reach_a_policy_of_ones_own(here: Path) -> None:
    name, params = "d (1)/own.py:decide", {"x": "a, b", "y": "(", "z": 2.5}
    text = f"""{name}( x = "a, b", y='(', z=2.5, )"""
    flown = loaded("s.yaml", [], text).policy
    assert (flown.name, flown.params) == (name, params)
    assert verify_command._called(text, "link") == (name, params)
    with pytest.raises(ScenarioError, match=r"policy\.params\.x: a list of 2, must be a number, true, false or text$"):
        loaded("s.yaml", [], f"{name}(x=[1, 2.5])")


def test_what_is_wrong_in_the_bracket_of_a_policy_is_said_of_the_policy(here: Path) -> None:
    for policy, message in (
        ("best-2(0.1)", r"^policy 'best-2\(0.1\)': '0.1' in the bracket, must be key=value$"),
        ("best-2(rho=[0.1)", r"^policy 'best-2\(rho=\[0.1\)': the bracket is not closed"),
    ):
        with pytest.raises(PolicyError, match=message):
            loaded("s.yaml", [], policy)
