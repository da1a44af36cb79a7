"""Training in miniature: batches keep their labels, a run that was cut off ends where the whole one does."""

from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file

from perception.training import train as training
from perception.checkpoint import load_weights
from perception.frames import Frames, load_frames, make_scene_file, random_captures, random_scene
from perception.training.learn import draw_batch, local_cars
from perception.training.train import learning_rate, train


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scene_file(77, 2, tmp_path_factory.mktemp("frames") / "scene_77_2.npz")


@pytest.fixture(scope="module")
def frames(scene_file: Path) -> Frames:
    return load_frames([scene_file])


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, scene_file: Path) -> None:
    """Training and validation on the two frames."""
    monkeypatch.setattr(training, "make_frames", lambda *_, **__: [scene_file])
    monkeypatch.setattr("perception.training.validation.LEVELS", ((1.0, 1.0),))
    monkeypatch.setattr("perception.training.learn.SHARD_FRAMES", 1)


def test_scenes_and_fleets_follow_from_their_seeds() -> None:
    assert random_scene(5) == random_scene(5) != random_scene(6)
    assert random_captures(5, 1) == random_captures(5, 1) != random_captures(5, 2)


def test_a_scene_file_is_made_once(scene_file: Path) -> None:
    before = scene_file.stat().st_mtime_ns
    make_scene_file(77, 2, scene_file)
    assert scene_file.stat().st_mtime_ns == before
    assert [p.name for p in scene_file.parent.iterdir()] == [scene_file.name]


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
        batch = draw_batch(frames, 3, step, 0)
        cars = local_cars(batch.cars[0], batch.pose[0, 0])
        assert busy(batch.images[0, 0].numpy(), cars) > 1.5
        assert busy(batch.images[0, 0].numpy(), cars * [-1, 1, 1, 1, 1]) < busy(batch.images[0, 0].numpy(), cars)


def test_batches_follow_from_seed_step_and_shard(frames: Frames) -> None:
    a, b = draw_batch(frames, 0, 4, 1), draw_batch(frames, 0, 4, 1)
    assert np.array_equal(a.images, b.images)
    assert np.array_equal(a.est, b.est)
    others = [draw_batch(frames, 1, 4, 1), draw_batch(frames, 0, 5, 1), draw_batch(frames, 0, 4, 0)]
    assert not any(a.images.shape == o.images.shape and np.array_equal(a.images, o.images) for o in others)


def test_the_rate_rises_and_falls() -> None:
    rates = [learning_rate(s, 100) for s in range(100)]
    assert np.argmax(rates) == 10
    assert rates[0] < 0.2 * rates[10]
    assert rates[-1] < 0.03 * rates[10]


@pytest.mark.parametrize("field", ["frames", "steps"])
def test_counts_below_one_are_refused(tmp_path: Path, field: str) -> None:
    with pytest.raises(ValueError, match=f"{field} is 0, must be at least 1"):
        train(tmp_path / "w.safetensors", work=tmp_path, **{field: 0})


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_a_run_cut_off_and_resumed_ends_where_the_whole_one_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(name: str, **more: float) -> Path:
        out = tmp_path / name / "w.safetensors"
        (tmp_path / name).mkdir(exist_ok=True)
        train(out, frames=3, steps=2, work=tmp_path / name, device="cpu", **more)  # type: ignore[arg-type]
        return out

    whole = load_file(run("whole"))
    part = load_file(run("parts", minutes=1e-6))  # one step, then out of time
    resumed = load_file(run("parts"))
    assert any(not np.array_equal(whole[k], part[k]) for k in whole)
    for name, value in whole.items():
        assert np.array_equal(value, resumed[name]), name
    net = load_weights(tmp_path / "whole" / "w.safetensors")
    assert sum(p.numel() for p in net.parameters()) < 600_000
    card = (tmp_path / "whole" / "README.md").read_text()
    assert "perception.training.train --frames 12 --steps 2 --seed 0" in card
    assert (tmp_path / "whole" / "loss.csv").read_text().startswith("step,loss,lr\n")
    assert not list(tmp_path.glob("**/*.part"))
