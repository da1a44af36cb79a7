"""Each command of the laboratory once, at its smallest size, as a user types it: it ends well, and its files are there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import uav3d_examples
from laboratory import command
from places import ROOT

from research.benchmark import dataset

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _in_a_folder_with_small_splits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for split in ("validation", "tau"):
        monkeypatch.setitem(dataset.SIZES, split, (2, 1))


def run(line: str, *files: str) -> None:
    """Run a command, and look for the files that it should write."""
    assert command(*line.split()) == 0, line
    assert [name for name in files if not Path(name).is_file()] == [], line


def test_it_is_a_program() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "research", "--help"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    names = ("bench", "study", "fit", "train", "calibrate", "paper", "learn", "overhead", "from-uav3d")
    assert [name for name in names if name not in done.stdout] == []


def test_bench() -> None:
    run("bench make --out bench --split tau --scenes 1 --range 51.2 --density sparse --workers 1")
    (folder,) = Path("bench").iterdir()
    run(f"bench show {folder} tau 0 --out sheet.png", "sheet.png")
    run(f"bench verify {folder}", f"{folder}/manifest.json")
    run("bench survey --scenes 1 --range 51.2 --density sparse")
    run("bench difficulty --scenes 2 --workers 2 --store difficulty")


def test_train_and_fit() -> None:
    run(
        "train --steps 2 --batch 2 --scenes 1 --range 51.2 --bench bench --out net.safetensors",
        "net.safetensors", "net.md", "loss.csv",
    )  # fmt: skip
    run(
        "fit codebook --weights net.safetensors --stages 2 --scenes 1 --iterations 2 --bench bench --out net.codebook.safetensors",
        "net.codebook.safetensors", "net.codebook.md",
    )  # fmt: skip
    run("fit errors surrogate --towns 4 --out errors.json", "errors.json")


def test_calibrate() -> None:
    run("calibrate --scenes 2 --held-out 2 --work work --out fast.safetensors", "fast.safetensors", "fast.md")


def test_paper() -> None:
    run("paper --frames 2 --workers 1 --work work --out report", "report/README.md", "report/paper.parquet")
    run("paper --frame 0 --work work", "work/frames/seed0_frame0_ego0.rrd")


def test_study() -> None:
    run("study train dropout-1 --work work --bench bench")  # it has its weights
    run("study run --frames 2 --network dropout-1 --work work --bench bench --workers 1", "work/study.parquet")
    run(
        f"study report {ROOT}/research/pages/study/study.parquet --out report",
        "report/README.md",
        "report/study.parquet",
    )
    run("study doses --frames 7:0-1 --network full-1 --work work --bench bench --workers 1", "work/doses.png")


def test_learn() -> None:
    run("learn --conditions 8 --set duration_s=2 --out learned.json", "learned.json")


def test_overhead() -> None:
    run("overhead --drones 2 --seconds 1")


def test_from_uav3d(tmp_path: Path) -> None:
    uav3d_examples.make(tmp_path / "uav3d")
    run("from-uav3d uav3d --out recording.npz", "recording.npz")
