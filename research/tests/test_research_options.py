"""What each command of the laboratory passes on: every option arrives in its own place, and every figure that they print
stands in its own column. What they call is stood in for, so that nothing is computed.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from cli_examples import Seen, table_rows
from laboratory import command
from sim_examples import BASE

from research.learn.learn import Lesson
from research.paper import command as paper_command
from sortie.perception.geometry import Geometry
from sortie.perception.uncertainty import BoxErrors
from sortie.scenarios.intervals import Estimate
from sortie.sim.cli import console


@pytest.fixture(autouse=True)
def _wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console.out, "_width", 200)  # tables as they are, whatever the terminal's width


def tuple_of(*args: Any, **kwargs: Any) -> tuple[Any, ...]:
    return (*args, kwargs) if kwargs else args


def stand_in(monkeypatch: pytest.MonkeyPatch, module: str, **names: Any) -> None:
    """Let a module that takes long to import be these names."""
    monkeypatch.setitem(sys.modules, module, SimpleNamespace(**names))  # type: ignore[misc]


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
    stand_in(monkeypatch, "sortie.perception.network.model", ModelConfig=tuple_of)
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
    stand_in(monkeypatch, "research.train", box_errors=None)
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
    stand_in(monkeypatch, "research.train", box_errors=box_errors)
    stand_in(monkeypatch, "research.calibrate.errors", moments=found)
    assert command("fit", "errors", *given) == 0
    assert json.loads((here / kept).read_text())["made"]["command"] == f"python -m research fit errors {told}"


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


def test_from_uav3d(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    converted = Seen(Path("o"))
    monkeypatch.setattr("research.uav3d.command.convert", converted)
    assert command("from-uav3d", "u", "--out", "o", "--split", "train") == 0
    assert converted.args == (Path("u"), "train", Path("o"))


# --- studies --------------------------------------------------------------------------------------------------------


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


# --- the paper ------------------------------------------------------------------------------------------------------


def test_overhead(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    row = SimpleNamespace(
        policy="p", context_bytes_per_s=2500.0, data_bytes_per_s=3_500_000.0, context_share=0.125, p50_ms=0.25, p99_ms=0.75,
    )  # fmt: skip
    measured = Seen(row)
    monkeypatch.setattr("research.overhead.command.measure", measured)
    monkeypatch.setattr("research.overhead.command.host_s", lambda: 0.5)
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
    assert (weights, frames, seed, told, live, fusion) == (
        Path("shipped/net"),
        None,
        0,
        "python -m research paper",
        None,
        {},
    )
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
