"""Training in miniature: batches keep their labels, a run that was cut off ends where the whole one does."""

import json
import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from research.benchmark.dataset import Benchmark, Frames, load_frames, make_scene_file
from research.benchmark.difficulty import VARIED
from research.flip.networks import StudyConfig, StudyNet
from research.train import train as training
from research.train.learn import Thinning, draw_batch, gradients, local_cars
from research.train.recipe import Recipe, command
from research.train.train import learning_rate, train
from research.train.validation import card, history, publish
from sortie.perception.network.checkpoint import load_weights, read_facts, save_weights
from sortie.perception.network.detector import SHIPPED_WEIGHTS
from sortie.perception.network.fusion.own import OwnFusion
from sortie.perception.network.model import CarNet, ModelConfig
from sortie.scenarios.streams import stream

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scene_file(Benchmark(), "train", 77, 2, tmp_path_factory.mktemp("frames") / "scene_77_2.npz")


@pytest.fixture(scope="module")
def frames(scene_file: Path) -> Frames:
    return load_frames([scene_file])


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, scene_file: Path) -> None:
    """Training and validation on the two frames."""
    monkeypatch.setattr(training, "make_split", lambda *_, **__: [scene_file])
    monkeypatch.setattr("research.train.validation.LEVELS", ((1.0, 1.0),))


def test_turning_and_mirroring_keep_cars_on_their_pixels(frames: Frames) -> None:
    """Under every augmentation, the image about a car differs from grass and asphalt as it did before."""

    def busy(images: np.ndarray, cars: np.ndarray) -> float:
        """Mean local contrast at the cars' pixels, over that of the whole image."""
        grey = images[:3].astype(float).mean(axis=0)
        edge = np.abs(np.diff(grey, axis=0))[:, :-1] + np.abs(np.diff(grey, axis=1))[:-1]
        near = cars[np.hypot(*cars[:, :2].T) < 50]
        rows, columns = (np.floor((near[:, k] + 102.4) / 0.8).astype(int) for k in (0, 1))
        return float(
            np.mean([edge[r - 2 : r + 3, c - 2 : c + 3].mean() for r, c in zip(rows, columns, strict=True)])
            / edge.mean()
        )

    for step in range(8):
        batch = draw_batch(frames, Recipe(seed=3, batch=2), step, 0)
        image, cars = batch.seen(CPU)[0, 0].numpy(), local_cars(batch.cars[0], batch.pose[0, 0])
        assert busy(image, cars) > 1.5
        assert busy(image, cars * [-1, 1, 1, 1, 1]) < busy(image, cars)


def test_turning_and_mirroring_keep_headings_and_what_drones_believe(frames: Frames) -> None:
    """Cars keep their heading in a drone's own frame, and a belief its error; a mirror changes the sign of both."""
    seen = frames.true_pose
    errors = frames.est_pose[..., 2] - seen[..., 2]
    for step in range(8):
        batch = draw_batch(frames, Recipe(seed=3, batch=2), step, 0)
        error = batch.est[..., 2] - batch.pose[..., 2]
        for k in range(len(batch.cars)):
            near = np.abs(np.abs(error[k])[:, None] - np.abs(errors.ravel())).min(axis=1)
            assert near.max() < 1e-9
        cars, pose = batch.cars[0], batch.pose[0, 0]
        local = local_cars(cars, pose)
        turned = cars[:, 4] - pose[2]
        assert len(local)
        assert np.nanmin(np.abs(np.sin(local[:, 4][:, None] - turned)), axis=1).max() < 1e-6


def test_batches_follow_from_seed_step_and_shard(frames: Frames) -> None:
    a, b = draw_batch(frames, Recipe(seed=0, batch=2), 4, 1), draw_batch(frames, Recipe(seed=0, batch=2), 4, 1)
    assert np.array_equal(a.seen(CPU), b.seen(CPU))
    assert np.array_equal(a.est, b.est)
    assert torch.equal(a.labels.heat, b.labels.heat)
    others = [
        draw_batch(frames, Recipe(seed=1, batch=2), 4, 1),
        draw_batch(frames, Recipe(seed=0, batch=2), 5, 1),
        draw_batch(frames, Recipe(seed=0, batch=2), 4, 0),
    ]
    assert not any(a.images.shape == o.images.shape and np.array_equal(a.images, o.images) for o in others)


def test_keys_and_queries_learn_from_the_detection_loss(frames: Frames) -> None:
    """Every part of the handshake has a gradient, the same for the same seed."""

    def grads() -> dict[str, torch.Tensor]:
        torch.manual_seed(3)
        net = CarNet(ModelConfig(fusion="when2com")).train()
        _, found = gradients(net, draw_batch(frames, Recipe(seed=0, batch=2), 1, 0), CPU)
        named = zip(net.named_parameters(), found, strict=True)
        return {name: grad for (name, _), grad in named if name.startswith("fusion.handshake.")}

    one, two = grads(), grads()
    assert {name.split(".")[2] for name in one} == {"look", "query", "key", "match"}
    # a key's bias moves all scores of a row alike, so it does not matter
    assert all(bool(g.abs().max() > 0) for name, g in one.items() if name != "fusion.handshake.key.bias")
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_the_rate_rises_and_falls() -> None:
    rates = [learning_rate(s, 100) for s in range(100)]
    assert np.argmax(rates) == 10
    assert rates[0] < 0.2 * rates[10]
    assert rates[-1] < 0.03 * rates[10]


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("steps", 0, "steps is 0, must be 1 to 1000000"),
        ("scenes", 10_001, "scenes is 10001, must be 1 to 10000"),
        ("batch", 1, "batch is 1, must be 2 to 1024"),
        ("batch", 5, "batch is 5, must be even"),
        ("peak_lr", 0.0, "peak_lr is 0.0, must be above 0 and at most 1"),
        ("cell_dropout", 1.5, "cell_dropout is 1.5, must be 0 to 1"),
        ("unsent", "half", "unsent is 'half', must be masked or zero"),
    ],
)
def test_a_recipe_names_what_is_wrong(field: str, value: object, message: str) -> None:
    with pytest.raises(ValueError) as caught:
        Recipe(**{field: value})  # type: ignore[arg-type]
    assert str(caught.value) == message


def test_thinning_drops_as_often_and_as_much_as_it_says() -> None:
    assert Thinning.of(Recipe(), 3, 0) is None
    half = Thinning.of(Recipe(cell_dropout=0.5, unsent="zero"), 3, 0)
    assert half is not None
    kept = half.sent(2000).float().mean(dim=(1, 2, 3)).numpy()
    thinned = kept < 0.999  # all but the few that kept nearly everything
    assert 0.46 < thinned.mean() < 0.54
    quarters = np.log(kept[thinned]) / np.log(0.01)  # log-uniform: even between 0 and 1
    assert np.histogram(quarters, bins=4, range=(0, 1))[0].min() > 0.2 * thinned.sum()
    again = Thinning.of(Recipe(cell_dropout=0.5, unsent="zero"), 3, 0)
    assert again is not None
    assert np.array_equal(again.sent(2000).float().mean(dim=(1, 2, 3)).numpy(), kept)


def test_the_command_repeats_the_run() -> None:
    recipe = Recipe(steps=150, seed=2, cell_dropout=0.8, unsent="zero", warm_start="full-2.safetensors")
    model = asdict(StudyConfig(decoder="deep", half_extent_m=51.2))
    assert command({**asdict(recipe), "done": 150}, model, 3, "w.safetensors") == (
        "python -m research train --steps 150 --seed 2 --cell-dropout 0.8 --unsent zero --warm-start full-2.safetensors "
        "--range 51.2 --decoder deep --bench-seed 3 --out w.safetensors"
    )
    assert (
        command(asdict(Recipe()), asdict(ModelConfig()), 0, "w.safetensors")
        == "python -m research train --out w.safetensors"
    )


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_a_run_cut_off_and_resumed_ends_where_the_whole_one_does(tmp_path: Path) -> None:
    seen: list[tuple[int, dict[str, float]]] = []

    def run(name: str, **more: float) -> Path:
        out = tmp_path / name / "w.safetensors"
        train(out, Recipe(steps=2, cell_dropout=0.5), device="cpu", scalars=lambda *a: seen.append(a), **more)  # type: ignore[arg-type]
        return out

    whole = load_file(run("whole"))
    assert [step for step, _ in seen] == [2, 2]
    assert set(seen[0][1]) == {"train/loss", "train/lr"}
    assert set(seen[1][1]) == {"validation/ap_single", "validation/ap_full"}
    part = load_file(run("parts", minutes=1e-6))  # one step, then out of time
    resumed = load_file(run("parts"))
    assert any(not np.array_equal(whole[k], part[k]) for k in whole)
    for name, value in whole.items():
        assert np.array_equal(value, resumed[name]), name
    path = tmp_path / "whole" / "w.safetensors"
    facts = read_facts(path)
    assert facts["runs"][0]["done"] == 2
    assert path.with_suffix(".md").read_text() == card("w.safetensors", asdict(ModelConfig()), facts)
    assert (
        "`python -m research train --steps 2 --cell-dropout 0.5 --out w.safetensors`"
        in path.with_suffix(".md").read_text()
    )
    assert (path.parent / "loss.csv").read_text().startswith("step,loss,lr,ap_single,ap_full\n2,")
    assert not list(tmp_path.glob("**/*.part"))
    json.dumps(facts)


def test_a_card_names_each_run_with_the_network_that_it_made(tmp_path: Path) -> None:
    """Not the last one's: a deep network of another fusion began from a shallow one."""
    net, bench, done = CarNet(), Benchmark(), {"done": 5, "loss": 1.0, "minutes": 2.0}
    publish(net, tmp_path / "first.safetensors", bench, [asdict(Recipe(steps=5)) | done], [])
    runs = [*history(tmp_path / "first.safetensors"), asdict(Recipe(steps=7, warm_start="first.safetensors")) | done]
    deep = StudyNet(StudyConfig(fusion="fcooper", decoder="deep"))
    publish(deep, tmp_path / "second.safetensors", bench, runs, [])
    runs = [*history(tmp_path / "second.safetensors"), asdict(Recipe(warm_start="second.safetensors")) | done]
    publish(net, tmp_path / "third.safetensors", bench, runs, [])
    told = (tmp_path / "third.md").read_text()
    flags = "--steps 7 --warm-start first.safetensors --fusion fcooper --decoder deep"
    assert "`python -m research train --steps 5 --out first.safetensors`" in told
    assert f"`python -m research train {flags} --out second.safetensors`" in told
    assert "`python -m research train --warm-start second.safetensors --out third.safetensors`" in told


def test_a_warm_start_takes_what_fits_and_names_the_rest(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    torch.manual_seed(1)
    old = CarNet()
    save_weights(old, tmp_path / "old.safetensors")
    deep = StudyNet(StudyConfig(decoder="deep"))
    with caplog.at_level(logging.INFO, "sortie.train"):
        training._begin_from(deep, tmp_path / "old.safetensors", logging.getLogger("sortie.train"))
    assert torch.equal(deep.encoder.stem[0].weight, old.encoder.stem[0].weight)
    assert "begin anew: head.trunk.down_16.0.0.weight" in caplog.text
    assert "encoder" not in caplog.text
    small = CarNet(ModelConfig(half_extent_m=51.2))
    with pytest.raises(ValueError, match="made for another range than ±51"):
        training._begin_from(small, tmp_path / "old.safetensors", logging.getLogger("sortie.train"))
    assert load_weights(tmp_path / "old.safetensors").config == ModelConfig()


def test_a_run_from_weights_or_a_checkpoint_of_another_image_is_refused_before_anything_is_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "make_split", lambda *_, **__: pytest.fail("rendered"))
    save_weights(CarNet(), tmp_path / "old.safetensors")
    sharp = ModelConfig(image_px=512)
    with pytest.raises(ValueError, match=r"old\.safetensors: image_px is 256, must be 512 as in the run$"):
        train(tmp_path / "w.safetensors", Recipe(), sharp, warm_start=tmp_path / "old.safetensors")
    with pytest.raises(ValueError, match="the benchmark's image_px is 256, must be the network's 512"):
        train(tmp_path / "w.safetensors", Recipe(), sharp, Benchmark())
    checkpoint, net = tmp_path / "checkpoint.safetensors", CarNet()
    optimiser = torch.optim.AdamW(net.parameters())
    run = {"model": asdict(net.config), "benchmark": Benchmark().key()}
    older = {k: v for k, v in run["model"].items() if k != "image_px"}  # type: ignore[attr-defined]
    training._save(checkpoint, {**run, "model": older, "step": 7, "spent_s": 2.0}, net, optimiser)
    with pytest.raises(ValueError, match=r"image_px is 256, must be 512 as in the run; --no-resume starts anew$"):
        train(tmp_path / "w.safetensors", Recipe(), sharp)
    assert training._restore(checkpoint, run, net, optimiser, logging.getLogger("sortie.train")).step == 7


@pytest.mark.usefixtures("small")
def test_a_fusion_of_ones_own_is_trained_with_its_encoder(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "import torch\n\nclass Mine(torch.nn.Module):\n    def __init__(self):\n        super().__init__()\n"
        "        self.gain = torch.nn.Parameter(torch.tensor(0.5))\n"
        "    def forward(self, agents, takes_part, weight):\n        return agents[:, 0] + self.gain * agents[:, 1:].sum(1)\n"
    )
    name, path = f"{tmp_path / 'mine.py'}:Mine", tmp_path / "w.safetensors"
    train(path, Recipe(steps=1, cell_dropout=0.5), ModelConfig(fusion=name), warm_start=SHIPPED_WEIGHTS)
    trained, shipped = load_weights(path, OwnFusion(name)), load_weights(SHIPPED_WEIGHTS)
    assert trained.config.fusion == name
    assert trained.fusion.model.gain != 0.5
    assert not torch.equal(trained.head.out.weight, shipped.head.out.weight)
    again = CarNet(ModelConfig(fusion=name), OwnFusion(name))
    training._begin_from(again, path, logging.getLogger("sortie.train"))
    assert torch.equal(again.fusion.model.gain, trained.fusion.model.gain)


def test_a_share_of_the_steps_is_on_the_varied_scenes(
    tmp_path: Path, scene_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which scenes a step is drawn from follows from the seed alone."""
    other = make_scene_file(Benchmark(difficulty=VARIED), "train", 77, 1, tmp_path / "scene_78_1.npz")
    scenes: dict[int, int] = {}

    def split(bench: Benchmark, *_: object, **__: object) -> list[Path]:
        return [other if bench.difficulty == VARIED else scene_file]

    class Stop(Exception):
        """The steps have been drawn."""

    def draw(frames: Frames, recipe: Recipe, step: int, *_: object) -> None:
        if step == 19:
            raise Stop
        scenes[step] = int(frames.scene[0])

    monkeypatch.setattr(training, "make_split", split)
    monkeypatch.setattr(training, "draw_batch", draw)
    monkeypatch.setattr(training, "gradients", lambda net, *_: (1.0, [torch.zeros_like(p) for p in net.parameters()]))
    with pytest.raises(Stop):
        train(tmp_path / "w.safetensors", Recipe(steps=30, varied=0.3), device="cpu", resume=False)
    steps = [scenes[step] for step in range(19)]
    assert steps.count(78) == sum(stream(0, 0, step, "train.varied").random() < 0.3 for step in range(19)) > 0
    assert steps.count(77) > steps.count(78)


class Killed(Exception):
    """The run ends in the middle of a step."""


class Runs:
    """Runs of thirty steps that compute no gradients: the loss of a step is its square root. Checkpoints at 15 and 30."""

    def __init__(self, folder: Path, scene_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.killed_at = folder, 99
        self.published: list[dict[str, Any]] = []
        monkeypatch.setattr(training, "SAVE_STEPS", 15)
        monkeypatch.setattr(training, "make_split", lambda *_, **__: [scene_file])
        monkeypatch.setattr(training, "draw_batch", self._draw)
        monkeypatch.setattr(
            training, "gradients", lambda net, step, *_: (step**0.5, map(torch.zeros_like, net.parameters()))
        )
        gain = SimpleNamespace(ap_a=0.25, ap_b=0.5)
        monkeypatch.setattr(training, "validate_all", lambda *_: [SimpleNamespace(gain=gain)])
        monkeypatch.setattr(training, "publish", lambda net, out, bench, runs, levels: self.published.append(runs[-1]))

    def _draw(self, frames: Frames, recipe: Recipe, step: int, *_: object) -> int:
        if step == self.killed_at:
            raise Killed
        return step

    def train(self, name: str, killed_at: int = 99) -> list[tuple[int, dict[str, float]]]:
        """The values of the loss curves."""
        self.killed_at = killed_at
        seen: list[tuple[int, dict[str, float]]] = []
        train(self.folder / name / "w.safetensors", Recipe(steps=30), device="cpu", scalars=lambda *at: seen.append(at))
        return seen

    def curve(self, name: str) -> str:
        return (self.folder / name / "loss.csv").read_text()


@pytest.fixture
def runs(tmp_path: Path, scene_file: Path, monkeypatch: pytest.MonkeyPatch) -> Runs:
    return Runs(tmp_path, scene_file, monkeypatch)


def test_a_run_that_was_killed_and_resumed_has_the_loss_and_the_curves_of_the_whole_one(runs: Runs) -> None:
    """Rows after the checkpoint are written again, not twice; the recording gets those from before it as well."""
    whole = runs.train("whole")
    assert [step for step, _ in whole] == [10, 20, 30, 30]
    with pytest.raises(Killed):
        runs.train("parts", killed_at=22)
    assert runs.curve("parts") == runs.curve("whole")[: len(runs.curve("parts"))]
    assert "\n20," in runs.curve("parts")
    resumed = runs.train("parts")
    assert runs.curve("parts") == runs.curve("whole")
    assert [step for step, _ in resumed] == [10, 20, 30, 30]
    assert all(now == pytest.approx(then, rel=1e-3) for (_, now), (_, then) in zip(resumed, whole, strict=True))
    assert runs.published[1]["loss"] == runs.published[0]["loss"] == round(sum(k**0.5 for k in range(30)) / 30, 4)


def test_a_finished_run_that_is_started_again_writes_the_same_card_and_the_same_curve(runs: Runs) -> None:
    runs.train("whole")
    curve = runs.curve("whole")
    again = runs.train("whole", killed_at=0)  # no step is left
    first, second = runs.published
    assert {**second, "minutes": first["minutes"]} == first
    assert runs.curve("whole") == curve
    assert [step for step, _ in again] == [10, 20, 30, 30]


@pytest.mark.parametrize("cut", ["30", "20,1.1,0.0", "20,1.1,0.001,,0.", "\0\0\0\0"])
def test_a_line_of_the_curve_that_a_kill_cut_is_left_out(cut: str, tmp_path: Path) -> None:
    curve = tmp_path / "loss.csv"
    curve.write_text(f"step,loss,lr,ap_single,ap_full\n10,2.5,0.001,,\n{cut}")
    assert training._resume_curve(curve, 40) == [(10, {"train/loss": 2.5, "train/lr": 0.001})]
    assert curve.read_text().splitlines() == ["step,loss,lr,ap_single,ap_full", "10,2.5,0.001,,"]


def test_batches_are_drawn_ahead_and_come_in_order() -> None:
    """No more than two steps ahead, and a batch that cannot be drawn fails at its own step."""
    drawn: list[int] = []

    def draw(step: int, shard: int) -> tuple[int, int]:
        drawn.append(step)
        if step == 5:
            raise Killed
        return step, shard

    with ThreadPoolExecutor(1) as pool:
        steps: Any = training._drawn_ahead(pool, draw, range(2, 9))  # type: ignore[arg-type]
        for wanted in (2, 3, 4):
            assert next(steps) == (wanted, [(wanted, 0), (wanted, 1)])
            assert max(drawn) <= wanted + 2
        with pytest.raises(Killed):
            next(steps)
