"""Sharp images, 512² pixels of 0.4 m: the lift, the network's shapes, its files, and frames of the benchmark."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from research.benchmark.dataset import Benchmark, load_frames, make_scene_file
from research.benchmark.scenes import draw_captures, draw_scene, model_of, scene_id
from research.train import train as training
from research.train.recipe import Recipe
from research.train.train import train
from sortie.perception.geometry import USUAL, Geometry
from sortie.perception.network.bev import lift
from sortie.perception.network.model import ModelConfig
from sortie.perception.scene.render import Renderer
from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie

SHARP = Geometry(image_px=512)
NETWORK = ModelConfig(grid="fine", image_px=512)


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sharp frame."""
    folder = tmp_path_factory.mktemp("frames")
    return make_scene_file(Benchmark(geometry=SHARP), "train", 77, 1, folder / "scene_77_1.npz")


def test_sharp_frames_are_another_benchmark_and_the_usual_ones_keep_their_name(tmp_path: Path) -> None:
    usual, sharp = Benchmark(), Benchmark(geometry=SHARP)
    assert usual.folder(tmp_path).name == "seed0-default-102.4m-76567db317f0"
    assert sharp.folder(tmp_path).name.startswith("seed0-default-102.4m-512px-")
    assert usual.parameters()["geometry"] == {"half_extent_m": 102.4}
    assert sharp.parameters()["geometry"] == {"half_extent_m": 102.4, "image_px": 512}
    folder = sharp.folder(tmp_path)
    folder.mkdir()
    header = {"format": 1, "key": sharp.key(), "benchmark": sharp.parameters(), "splits": {}}
    (folder / "manifest.json").write_text(json.dumps(header))
    assert Benchmark.at(folder) == sharp


@pytest.mark.slow
def test_sharp_frames_are_lifted_from_pictures_of_320_by_180_of_the_same_scene(scene_file: Path) -> None:
    frames, usual = load_frames([scene_file]), Benchmark()
    assert frames.images.shape == (1, 5, 4, 512, 512)
    assert round(1200 * frames.images.nbytes / 1e9, 1) == 6.3, "as the help says of the train split"
    captures = draw_captures(0, "train", 77, 0, usual.difficulty, SHARP.cameras)
    assert [c._replace(cameras=USUAL) for c in captures] == draw_captures(0, "train", 77, 0, usual.difficulty)
    scene = model_of(draw_scene(0, "train", 77, usual.difficulty))
    views = Renderer(scene, scene_id(0, "train", 77)).render(captures)
    assert views[0].shape == (5, 180, 320, 3)
    assert np.array_equal(frames.images[0], lift(views, captures, SHARP).numpy())


@pytest.mark.slow
def test_a_sharp_network_is_trained_and_flies(
    tmp_path: Path, scene_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the cameras that it was trained with, and with the usual ones."""
    asked: list[Benchmark] = []

    def make_split(bench: Benchmark, *_: object, **__: object) -> list[Path]:
        asked.append(bench)
        return [scene_file]

    monkeypatch.setattr(training, "make_split", make_split)
    monkeypatch.setattr("research.train.validation.LEVELS", ((1.0, 1.0),))
    path = tmp_path / "sharp.safetensors"
    train(path, Recipe(steps=2, batch=2), NETWORK, device="cpu")
    assert {bench.geometry for bench in asked} == {SHARP}
    told = path.with_suffix(".md").read_text()
    assert "`python -m research train --steps 2 --batch 2 --grid fine --image-px 512 --out sharp.safetensors`" in told
    assert "`python -m research bench make --image-px 512`" in told
    assert "pictures of 320 × 180 pixels (`fleet.camera.width_px` 320)" in told
    flight = ["duration_s=1", "fleet.drones=2", "perception.detector=torch", f"perception.weights={path}"]
    flown = [run_sortie(load("track_target", [*flight, *more])) for more in ([], ["fleet.camera.width_px=320"])]
    assert flown[0].fingerprint != flown[1].fingerprint
