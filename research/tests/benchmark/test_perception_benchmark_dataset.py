"""The benchmark on disk: the same files whoever makes them, a cut-off run goes on, and what is broken is named."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from places import ROOT

from research.benchmark import manifest
from research.benchmark.dataset import SIZES, Benchmark, load_frames, make_scene_file, make_split
from research.benchmark.difficulty import Difficulty
from research.benchmark.manifest import BenchmarkError, content_hash, problems
from research.benchmark.scenes import draw_captures, scene_id
from sortie.perception.geometry import SMALL

BENCH = Benchmark(3)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a benchmark with two scenes of its tau split, made by two workers."""
    root = tmp_path_factory.mktemp("bench")
    seen: list[tuple[int, int]] = []
    paths = make_split(BENCH, "tau", root, scenes=2, workers=2, progress=lambda done, of: seen.append((done, of)))
    assert seen == [(1, 2), (2, 2)]
    assert [p.name for p in paths] == [f"scene_{scene_id(3, 'tau', k)}_1.npz" for k in range(2)]
    return BENCH.folder(root)


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    """The benchmark's folder once more, to be broken."""
    return Path(shutil.copytree(made, tmp_path / made.name))


def files(folder: Path) -> list[Path]:
    return sorted((folder / "tau").glob("scene_*.npz"))


@pytest.mark.slow
def test_frames_are_what_was_drawn(made: Path) -> None:
    frames = load_frames(files(made))
    assert frames.images.shape == (2, 5, 4, 256, 256)
    assert frames.images.dtype == np.uint8
    assert frames.scene.tolist() == [scene_id(3, "tau", k) for k in range(2)]
    for k in range(2):
        captures = draw_captures(3, "tau", k, 0, Difficulty())
        assert frames.est_pose[k].tolist() == [list(c.est_pose) for c in captures]
        assert frames.true_pose[k][:, :2].tolist() == [list(c.position_m[:2]) for c in captures]
    many = (~np.isnan(frames.cars[..., 0])).sum(axis=1)
    assert frames.cars.shape[1] == many.max()
    assert frames.images[:, :, 3].mean() > 100  # most of the ground is seen
    assert frames.images.nbytes / len(frames) < 1.4e6


@pytest.mark.slow
def test_a_file_is_the_same_in_another_process_with_another_count_of_threads(made: Path, tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        again = make_scene_file(BENCH, "tau", 1, 1, tmp_path / "again.npz")
    finally:
        torch.set_num_threads(threads)
    assert content_hash(again) == content_hash(files(made)[1])


def test_another_seed_difficulty_or_range_is_another_folder(made: Path, tmp_path: Path) -> None:
    others = [Benchmark(4), Benchmark(3, Difficulty(tilt_sigma_deg=5.0)), Benchmark(3, geometry=SMALL)]
    assert len({b.folder(tmp_path) for b in [BENCH, *others]}) == 4
    small = make_scene_file(others[2], "tau", 0, 1, tmp_path / "small_1.npz")
    with np.load(small) as a, np.load(files(made)[0]) as b:
        assert np.array_equal(a["true_pose"], b["true_pose"])  # the same scene and fleet, seen closer
        assert (a["images"][:, :, 3] > 0).mean() > (b["images"][:, :, 3] > 0).mean()


def test_the_manifest_says_everything(made: Path) -> None:
    data = manifest.read(made)
    assert Benchmark.at(made) == BENCH
    assert (data["key"], data["benchmark"]["seed"]) == (BENCH.key(), 3)
    assert set(data["benchmark"]["difficulty"]) == set(Difficulty.__slots__)
    assert set(data["made_with"]) == {"sortie-sim", "numpy", "torch"}
    entry = data["splits"]["tau"][files(made)[1].name]
    assert (entry["index"], entry["frames"], entry["sha256"]) == (1, 1, content_hash(files(made)[1]))
    assert entry["scene"]["seed"] == scene_id(3, "tau", 1)
    assert problems(made) == []


def test_what_is_there_is_not_made_again(copy: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in copy.rglob("*") if p.is_file()}
    make_split(BENCH, "tau", copy.parent, scenes=2, workers=1, progress=lambda done, of: pytest.fail("made again"))
    assert {p: p.stat().st_mtime_ns for p in copy.rglob("*") if p.is_file()} == before


def test_a_cut_off_run_goes_on(copy: Path) -> None:
    first, second = files(copy)
    hashes, kept = [content_hash(p) for p in (first, second)], first.stat().st_mtime_ns
    second.unlink()
    (copy / manifest.MANIFEST).unlink()  # it comes last
    second.with_name(f"{second.stem}.4711.part.npz").write_bytes(b"half a fi")
    make_split(BENCH, "tau", copy.parent, scenes=2, workers=1)
    assert [content_hash(p) for p in (first, second)] == hashes
    assert first.stat().st_mtime_ns == kept
    assert problems(copy) == []
    assert len(load_frames([first, second])) == 2


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_files(tmp_path: Path, made: Path) -> None:
    script = (
        "from pathlib import Path; from research.benchmark.dataset import *\n"
        f"if __name__ == '__main__': make_split(Benchmark(3), 'tau', Path({str(tmp_path)!r}), scenes=2, workers=1)"
    )
    (tmp_path / "run.py").write_text(script)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.Popen([sys.executable, tmp_path / "run.py"], start_new_session=True, env=environment)
    folder = BENCH.folder(tmp_path)
    while not files(folder) and run.poll() is None:
        time.sleep(0.02)
    os.killpg(run.pid, signal.SIGKILL)
    run.wait()
    make_split(BENCH, "tau", tmp_path, scenes=2, workers=1)
    assert problems(folder) == []
    assert [content_hash(p) for p in files(folder) if ".part" not in p.suffixes] == [
        content_hash(p) for p in files(made)
    ]


def test_a_tampered_file_is_named(copy: Path) -> None:
    path = files(copy)[0]
    with np.load(path) as file:
        arrays = dict(file)
    arrays["cars"][0, 0, 0] += 1e-9
    np.savez(path, **arrays)
    assert problems(copy) == [f"tau/{path.name}: holds other data than the manifest says"]


def test_missing_broken_and_strange_files_are_named(copy: Path) -> None:
    first, second = files(copy)
    first.write_bytes(first.read_bytes()[:1000])
    stranger = second.with_name("scene_5_1.npz")
    second.rename(stranger)
    found = problems(copy)
    assert found[0] == "tau/scene_5_1.npz: not in the manifest"
    assert found[1].startswith(f"tau/{first.name}: cannot be read: ")
    assert found[2:] == [f"tau/{second.name}: missing"]
    with pytest.raises(BenchmarkError, match=f"{first.name}: cannot be read: "):
        load_frames([first])


def edit(folder: Path, **changes: object) -> None:
    data = manifest.read(folder)
    (folder / manifest.MANIFEST).write_text(json.dumps({**data, **changes}))


def test_a_manifest_that_does_not_fit_is_refused(copy: Path, tmp_path: Path) -> None:
    stored = manifest.read(copy)["benchmark"]
    path = copy / manifest.MANIFEST

    def message() -> str:
        with pytest.raises(BenchmarkError) as caught:
            Benchmark.at(copy)
        return str(caught.value).removeprefix(f"{path}: ")

    edit(copy, benchmark={**stored, "seed": 4})
    assert message() == f"key is {BENCH.key()}, must be {Benchmark(4).key()}: its parameters were changed"
    edit(copy, benchmark={**stored, "difficulty": {**stored["difficulty"], "fog": 1}})
    assert message() == "cannot be understood: difficulty has ['fog'] too many or too few"
    edit(copy, benchmark={"seed": 3})
    assert message() == "cannot be understood: 'difficulty'"
    edit(copy, format=0)
    assert message() == "format is 0, must be 1: make it anew"
    path.write_text("[1, 2]")
    assert message() == "not a benchmark's manifest, format, key, benchmark or splits is missing"
    path.write_text("{")
    assert message().startswith("cannot be read: ")
    with pytest.raises(
        BenchmarkError, match=r"manifest\.json: missing, make the benchmark with python -m research bench make"
    ):
        Benchmark.at(tmp_path)


def test_a_range_names_the_scenes_that_are_made(copy: Path) -> None:
    assert make_split(BENCH, "tau", copy.parent, scenes=range(1, 2)) == files(copy)[1:]


@pytest.mark.parametrize("scenes", [0, 41, range(39, 41), range(-1, 2), range(3, 3)])
def test_no_more_scenes_than_there_are(tmp_path: Path, scenes: int | range) -> None:
    with pytest.raises(ValueError, match=rf"scenes is {re.escape(str(scenes))}, must be 1 to the 40 of the tau split"):
        make_split(BENCH, "tau", tmp_path, scenes=scenes)


def test_nothing_to_load_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one file"):
        load_frames([])


def test_the_splits_have_their_sizes() -> None:
    assert SIZES == {"train": (100, 12), "validation": (12, 6), "tau": (40, 1), "test": (240, 1)}
    assert [b.key() for b in (Benchmark(), Benchmark(3))] == ["76567db317f0", BENCH.key()]  # published weights name it


def test_what_is_added_to_a_split_stands_beside_what_it_has(tmp_path: Path) -> None:
    header = {"format": 1, "key": "k", "benchmark": {}}
    manifest.add(tmp_path, header, "test", [("scene_00001.npz", {"sha256": "b"})])
    manifest.add(tmp_path, header, "train", [("scene_00000.npz", {"sha256": "a"})])
    manifest.add(tmp_path, header, "test", [("scene_00000.npz", {"sha256": "a"}), ("scene_00002.npz", {"sha256": "c"})])
    found = manifest.read(tmp_path)["splits"]
    assert {split: list(files) for split, files in found.items()} == {
        "train": ["scene_00000.npz"], "test": [f"scene_0000{k}.npz" for k in range(3)],
    }  # fmt: skip
    assert [entry["sha256"] for entry in found["test"].values()] == ["a", "b", "c"]
    assert manifest.listed(tmp_path, "test") == set(found["test"])
