"""What a GPU computes, where there is one: the harness as on a processor, to rounding; training, cut off and resumed.

`python -m pytest research/tests/test_research_gpu.py` on a machine with CUDA; elsewhere all of it is skipped.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from research.benchmark.dataset import Benchmark, Frames, load_frames, make_scene_file
from research.flip.dose_run import frame_of
from research.flip.doses import read_plan
from research.paper.instrument import CarNetInstrument
from research.paper.ways import FULL_SHARING, SINGLE, Sharing, evaluate
from research.train import train as training
from research.train.devices import gpu_name, measuring_device
from research.train.recipe import Recipe
from research.train.train import train
from sortie.perception.evaluation.harness import Settings, exchanges
from sortie.perception.network.checkpoint import load_weights, read_facts
from sortie.scenarios.shipped import NETWORKS

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU with CUDA")
CONDITIONS = (SINGLE, Sharing(0.02, "best-2"), Sharing(0.05, "all-4", unsent="masked"), FULL_SHARING)


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scene_file(Benchmark(), "test", 3, 2, tmp_path_factory.mktemp("frames") / "scene_3_2.npz")


@pytest.fixture(scope="module")
def frames(scene_file: Path) -> Frames:
    return load_frames([scene_file])


def on_gpu(name: str) -> CarNetInstrument:
    return CarNetInstrument.load(NETWORKS / f"{name}.safetensors", measuring_device("cuda"))


def boxes(instrument: CarNetInstrument, frames: Frames) -> list[NDArray[np.float64]]:
    """Of each ego under each condition, where all exchange the cells that a processor ranks first."""
    view = CarNetInstrument.load(NETWORKS / "disconet.safetensors").look(frames, 0)
    given = exchanges(view, frames, 0, (3, 0), CONDITIONS, Settings(), instrument.geometry, None)
    return instrument.look(frames, 0).detect([e for e, _ in given], 0.1)


@pytest.mark.parametrize("name", ["disconet", "fine", "where2comm", "v2vnet"])
def test_a_gpu_finds_the_boxes_of_a_processor(name: str, frames: Frames) -> None:
    """But for a few: a cell has arrived where half of its support has, and there a rounding of poses decides. On a processor,
    poses that are moved by a ten-millionth do the same to four boxes of three thousand."""
    here = boxes(CarNetInstrument.load(NETWORKS / f"{name}.safetensors"), frames)
    there = boxes(on_gpu(name), frames)
    apart_m = np.concatenate([nearest(*pair) for a, b in zip(here, there, strict=True) for pair in ((a, b), (b, a))])
    assert len(apart_m) > 2000
    assert (apart_m > 2e-3).mean() < 3e-3


def nearest(some: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far each box is from the one of the others that is most alike, in its worst number."""
    sure = some[some[:, 5] > 0.101]  # a score at the floor may fall on either side of it
    apart = np.abs(sure[:, None] - others[None])
    apart[..., 4] = np.abs(np.sin(apart[..., 4]))  # headings turn over at half a circle
    out: NDArray[np.float64] = apart.max(axis=2).min(axis=1, initial=np.inf)
    return out


def test_a_gpu_repeats_itself_and_is_named_where_results_are_kept(frames: Frames) -> None:
    one, two = on_gpu("fine"), on_gpu("fine")
    assert all(np.array_equal(a, b) for a, b in zip(boxes(one, frames), boxes(two, frames), strict=True))
    assert one.fingerprint.endswith(f" on {gpu_name(torch.device('cuda'))}")
    assert one.fingerprint != CarNetInstrument.load(NETWORKS / "fine.safetensors").fingerprint


def test_ap_does_not_depend_on_the_device(frames: Frames) -> None:
    found = [evaluate(i, frames, CONDITIONS, regions=("full",)) for i in (on_gpu("fine"), CarNetInstrument.load(NETWORKS / "fine.safetensors"))]  # fmt: skip
    for c in CONDITIONS:
        a, b = (e.matched(c) for e in found)
        hits = [sum(int(unit.hit.sum()) for unit in units) for units in (a, b)]
        assert abs(hits[0] - hits[1]) <= 0.01 * hits[1] + 1


def test_doses_do_not_depend_on_the_device(frames: Frames) -> None:
    plan = read_plan()
    plan = replace(plan, dose=plan.dose[-3:], budgets=(0.05,))
    net = load_weights(NETWORKS / "disconet.safetensors")
    (a, weights), (b, others) = (
        frame_of(plan, CarNetInstrument(net, device), frames, 0, (3, 0), Settings(egos=2))
        for device in (measuring_device("cuda"), torch.device("cpu"))
    )
    for label, found in a.items():
        assert weights[label] == pytest.approx(others[label], abs=1e-4)
        for key, units in found.units.items():
            hits = [sum(int(u.hit.sum()) for u in several) for several in (units, b[label].units[key])]
            assert abs(hits[0] - hits[1]) <= 0.01 * hits[1] + 1


def test_a_run_that_was_cut_off_goes_on_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scene_file: Path
) -> None:
    """A GPU adds up in another order each time, so the losses are near each other rather than equal."""
    monkeypatch.setattr(training, "make_split", lambda *_, **__: [scene_file])
    monkeypatch.setattr("research.train.validation.LEVELS", ((1.0, 1.0),))
    recipe = Recipe(steps=6, precision="bfloat16")

    def run(name: str, minutes: float | None = None) -> training.TrainResult:
        return train(tmp_path / name / "w.safetensors", recipe, device="auto", minutes=minutes)

    whole, cut = run("whole"), run("parts", 1e-6)
    assert (whole.steps, cut.steps) == (6, 1)
    resumed = run("parts")
    assert resumed.steps == 6
    assert resumed.loss == pytest.approx(whole.loss, rel=0.02)
    (made_by,) = read_facts(resumed.weights)["runs"]
    assert made_by["device"] == gpu_name(torch.device("cuda"))
