"""`python -m research bench`, as a user meets it."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from research.__main__ import app
from research.benchmark.command import DensityName, RangeName, SplitName
from research.benchmark.dataset import Benchmark
from research.benchmark.difficulty import DENSITIES, Split
from sortie.perception.geometry import FULL, SMALL
from sortie.scenarios.errors import SortieError

run = CliRunner()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("bench")
    arguments = ["bench", "make", "--out", str(root), "--seed", "5", "--split", "tau", "--scenes", "1"]
    result = run.invoke(app, [*arguments, "--range", "51.2", "--density", "sparse", "--workers", "1"])
    assert result.exit_code == 0, result.output
    (made,) = root.iterdir()
    assert made.name.startswith("seed5-sparse-51.2m-")
    assert str(made) in result.output.replace("\n", "")
    return made


def test_made_as_asked_and_verified(folder: Path) -> None:
    bench = Benchmark.at(folder)
    assert (bench.seed, bench.difficulty.density, bench.geometry) == (5, "sparse", SMALL)
    result = run.invoke(app, ["bench", "verify", str(folder)])
    assert (result.exit_code, result.output) == (0, "1 files, all as the manifest says\n")


def test_a_frame_is_drawn(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    path = tmp_path / "sheet.png"
    result = run.invoke(app, ["bench", "show", str(folder), "tau", "0", "--out", str(path)])
    assert result.exit_code == 0, result.output
    assert path.read_bytes().startswith(b"\x89PNG")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("show", "FOLDER", "tau", "40"), "scene is 40, must be 0 to 39 in the tau split"),
        (("show", "FOLDER", "tau", "0", "--frame", "1"), "frame is 1, must be 0 to 0 in the tau split"),
        (
            ("verify", "nowhere"),
            "nowhere/manifest.json: missing, make the benchmark with python -m research bench make",
        ),
        (("difficulty", "--weights", "nowhere"), "nowhere"),
    ],
)
def test_what_a_user_can_mend_is_one_line(folder: Path, arguments: tuple[str, ...], message: str) -> None:
    result = run.invoke(app, ["bench", *(str(folder) if a == "FOLDER" else a for a in arguments)])
    assert isinstance(result.exception, SortieError)
    assert message in str(result.exception)


def test_a_tampered_file_is_told(folder: Path) -> None:
    (path,) = (folder / "tau").glob("scene_*.npz")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    result = run.invoke(app, ["bench", "verify", str(folder)])
    path.write_bytes(whole)
    assert result.exit_code == 1
    assert path.name in result.output.replace("\n", "")


def test_the_choices_are_the_benchmarks_own() -> None:
    assert [s.value for s in SplitName] == list(Split.__args__)
    assert [d.value for d in DensityName] == list(DENSITIES)
    assert {float(r.value) for r in RangeName} == {FULL.half_extent_m, SMALL.half_extent_m}
