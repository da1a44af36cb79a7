"""The layout on disk: round trips, npz and Zarr alike, and every rule broken once with its message."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_examples import score_map, small
from wrong_rows import wrong_rows

from sortie.perception.recordings.exchange import moved
from sortie.perception.recordings.recording import RecordingError, cells_of, open_recording
from sortie.perception.recordings.writing import write_recording


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return small(tmp_path / "small.npz")


@pytest.mark.parametrize("name", ["small.npz", "small.zarr"])
def test_what_is_written_is_read(name: str, tmp_path: Path) -> None:
    rec = open_recording(small(tmp_path / name, confidence=np.full((2, 2, 64, 64), 0.25)))
    assert (len(rec), rec.drones, rec.grid, rec.cell_bytes, rec.geometry.half_extent_m) == (2, 2, (3, 64, 64), 6, 102.4)
    assert (rec.t_s.tolist(), rec.scene.tolist()) == ([0.0, 0.1], [0, 0])
    np.testing.assert_allclose(rec.boxes(1, 1), [(-1, 20, 4.5, 1.9, 0.2, 0.8)])
    np.testing.assert_allclose(rec.truth(0)[:, 0], [8, 10])
    np.testing.assert_array_equal(rec.features(0, 0), score_map(rec.boxes(0, 0), 3))
    assert (rec.rank(0, 0) == 0.25).all()
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_zarr_reads_only_what_is_asked_for(tmp_path: Path) -> None:
    """One chunk a frame and drone: with the others gone, it still reads; so memory holds one at a time."""

    def frames() -> Iterator[np.ndarray]:
        for k in range(3):
            yield np.full((2, 4, 64, 64), k, np.float16)

    none = [[np.zeros((0, 6))] * 2] * 3
    arrays = dict(t_s=[0, 1, 2], pose=np.zeros((3, 2, 3)), boxes=none, truth=[np.zeros((0, 5))] * 3, cell_m=3.2)
    rec = open_recording(write_recording(tmp_path / "r", **arrays, features=frames()))
    chunks = sorted(p for p in (tmp_path / "r" / "features").rglob("*") if p.is_file() and p.name != "zarr.json")
    assert len(chunks) == 4  # of six, as frame 0 is all zeros
    for chunk in chunks:
        if "/2/1/" not in chunk.as_posix():
            chunk.write_bytes(b"broken")
    assert (rec.features(2, 1) == 2).all()
    with pytest.raises(Exception):  # noqa: B017 (whatever the codec says)
        rec.features(1, 1)


def test_confidence_left_out_is_the_score_of_the_boxes(path: Path) -> None:
    rank = open_recording(path).rank(0, 1)
    assert np.argwhere(rank).tolist() == [[32, 38]]  # the car 20 m to the left, 0 m ahead
    assert rank.max() == pytest.approx(0.8)


def test_a_cell_ranks_by_its_best_box_whichever_comes_last_and_a_box_may_be_anywhere(tmp_path: Path) -> None:
    """Of 1e300 m: it lies in no cell, and nothing warns."""
    rows = np.array([(8, 1, 4.5, 1.9, 0.1, 0.9), (8.5, 1.5, 4.5, 1.9, 0.1, 0.3), (1e300, 0, 4.5, 1.9, 0.1, 1.0)])
    for order in ([0, 1, 2], [2, 1, 0]):
        path = small(tmp_path / "r.npz", boxes=[[rows[order], []]] * 2, features=None)
        rank = open_recording(path).rank(0, 0)
        assert (rank[34, 32], rank.sum()) == (0.9, 0.9)


def test_finer_grids_are_exchanged_in_blocks(tmp_path: Path) -> None:
    """128 × 128 columns of 1.6 m: an exchanged cell of 3.2 m holds four."""
    fine = np.zeros((2, 2, 3, 128, 128), np.float16)
    fine[:, :, 0, 10:12, 20:22] = 2
    confidence = np.zeros((2, 2, 128, 128))
    confidence[:, :, 11, 20] = 0.7
    rec = open_recording(small(tmp_path / "x.npz", features=fine, confidence=confidence, cell_m=1.6))
    assert (rec.geometry.half_extent_m, rec.cell_bytes) == (102.4, 24)
    rank = rec.rank(0, 0)
    assert np.argwhere(rank).tolist() == [[5, 10]]
    assert rank.max() == pytest.approx(0.7, rel=1e-3)


def spoiled(path: Path, **changes: Any) -> Path:
    with np.load(path) as file:
        arrays = {k: file[k] for k in file.files}
    for name, value in changes.items():
        if value is None:
            del arrays[name]
        else:
            arrays[name] = value(arrays[name]) if callable(value) else value
    np.savez(path, **arrays)
    return path


def put(at: Any, value: Any) -> Any:
    def change(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array[at] = value
        return array

    return change


FIELDS = "format, cell_m, t_s, pose, boxes, boxes_offset, truth, truth_offset"
BROKEN = [
    ("t_s", None, f"t_s is missing, a recording must hold {FIELDS}"),
    (
        "speed",
        np.zeros(2),
        "speed is unknown, beside what it must hold a recording may hold scene, est_pose, features, con",
    ),
    ("format", np.array(2), "format is 2, must be 1"),
    ("cell_m", np.array(0.0), "cell_m is 0, must be 0.001 to 1000 m"),
    ("cell_m", np.array("a"), "cell_m is <U1, must be numbers"),
    ("t_s", np.array([0.1, 0.1]), "t_s is 0.1 in frame 1, must be above 0.1, the frame before"),
    ("t_s", np.array([0.0, np.nan]), "t_s [1] is nan, must be finite"),
    ("t_s", np.zeros((2, 1)), "t_s has shape [2, 1], must be [any]"),
    ("scene", np.array([0.0, 1.0]), "scene is float64, must be whole numbers"),
    ("pose", np.zeros((3, 2, 3)), "pose has shape [3, 2, 3], must be [2, any, 3]"),
    ("pose", put((0, 1, 2), np.inf), "pose [0, 1, 2] is inf, must be finite"),
    ("pose", put((1, 0, 2), 180), "pose [1, 0, 2] is 180, must be within ±12.57 rad, not degrees"),
    ("pose", np.zeros((2, 0, 3)), "pose has no drones, must be at least one"),
    ("est_pose", np.zeros((2, 1, 3)), "est_pose has shape [2, 1, 3], must be [2, 2, 3]"),
    ("boxes", np.ones((4, 7)), "boxes has shape [4, 7], must be [any, 6]"),
    ("boxes", put((2, 3), 0.0), "boxes: width in row 2 (from 0) is 0, must be 0.001 to 1000 m"),
    ("boxes", put((1, 2), -4.5), "boxes: length in row 1 (from 0) is -4.5, must be 0.001 to 1000 m"),
    ("boxes", put((0, 3), np.nan), "boxes [0, 3] is nan, must be finite"),
    ("boxes", put((3, 5), 1.5), "boxes: score in row 3 (from 0) is 1.5, must be 0 to 1"),
    ("boxes", put((3, 5), -0.1), "boxes: score in row 3 (from 0) is -0.1, must be 0 to 1"),
    ("boxes", put((3, 4), 90), "boxes: yaw in row 3 (from 0) is 90, must be within ±12.57 rad, not degrees"),
    ("truth", put((1, 4), -90), "truth: yaw in row 1 (from 0) is -90, must be within ±12.57 rad, not degrees"),
    ("truth", put((1, 2), 0), "truth: length in row 1 (from 0) is 0, must be 0.001 to 1000 m"),
    ("boxes_offset", np.array([0, 1, 2, 3, 5]), "boxes_offset runs from 0 to 5, must be 0 to 4, the rows of boxes"),
    ("boxes_offset", np.array([0, 3, 2, 3, 4]), "boxes_offset falls, must be ascending"),
    ("boxes_offset", np.array([0, 4]), "boxes_offset has shape [2], must be [5]"),
    ("truth_offset", np.array([0, 2, 4, 4]), "truth_offset has shape [4], must be [3]"),
    ("features", np.zeros((2, 2, 3, 64, 64), np.float32), "features is float32, must be float16"),
    (
        "features",
        np.zeros((2, 1, 3, 64, 64), np.float16),
        "features has shape [2, 1, 3, 64, 64], must be [n, drones, C, H",
    ),
    ("confidence", np.zeros((2, 2, 32, 64)), "confidence has a grid of 32 × 64, must be the features' 64 × 64"),
    ("confidence", np.zeros((2, 2, 64, 64), int), "confidence is int64, must be floating"),
]


def test_a_broken_recording_is_told(tmp_path: Path) -> None:
    def check(field: str, value: Any, message: str) -> None:
        path = small(tmp_path / "small.npz")
        with pytest.raises(RecordingError, match=f"^{re.escape(f'{path}: {message}')}"):
            open_recording(spoiled(path, **{field: value}))

    assert wrong_rows(BROKEN, check) == {}


def test_scenes_come_in_runs_and_have_clocks_of_their_own(tmp_path: Path) -> None:
    frames = dict(pose=np.zeros((3, 1, 3)), boxes=[[np.zeros((0, 6))]] * 3, truth=[np.zeros((0, 5))] * 3, cell_m=3.2)
    write_recording(tmp_path / "a.npz", t_s=[5, 6, 0], scene=[1, 1, 0], **frames)
    with pytest.raises(RecordingError, match="scene comes back to a scene it left, must be one run of frames a scene"):
        write_recording(tmp_path / "b.npz", t_s=[5, 0, 6], scene=[1, 0, 1], **frames)
    assert not (tmp_path / "b.npz").exists()


def test_large_arrays_are_checked_when_they_are_read(path: Path) -> None:
    rec = open_recording(spoiled(path, features=put((1, 0, 2, 3, 4), np.nan)))
    assert rec.features(0, 0).shape == (3, 64, 64)
    with pytest.raises(RecordingError, match=r"features frame 1, drone 0 is not finite, must be finite every"):
        rec.features(1, 0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: None, "no such recording, must be an npz file or a Zarr folder"),
        (lambda p: p.write_bytes(b"PK\x03\x04 torn"), "cannot be read as npz"),
        (lambda p: p.write_text("x"), "cannot be read as npz"),
        (lambda p: p.mkdir(), "cannot be read as a Zarr group"),
        (lambda p: np.savez(p, t_s=np.array([None])), "cannot be read as npz"),  # would need a pickle
    ],
)
def test_no_recording_is_told(make: Any, message: str, tmp_path: Path) -> None:
    make(tmp_path / "r.npz")
    with pytest.raises(RecordingError, match=rf"r\.npz: {message}"):
        open_recording(tmp_path / "r.npz")


def test_writing_zarr_is_whole_or_not_at_all(tmp_path: Path) -> None:
    few = [np.zeros((2, 3, 64, 64))]
    with pytest.raises(RecordingError, match="features end after 1 frames, must be 2"):
        small(tmp_path / "r", features=few)
    with pytest.raises(
        RecordingError, match=r"features of frame 1 have shape \[2, 4, 64, 64\], must be \[2, C, H, W\]"
    ):
        small(tmp_path / "r", features=[*few, np.zeros((2, 4, 64, 64))])
    assert not list(tmp_path.iterdir())
    small(tmp_path / "r")
    with pytest.raises(RecordingError, match="r: exists already, a Zarr recording must be written to a new folder"):
        small(tmp_path / "r")


def test_what_would_be_refused_when_it_is_read_is_not_written(tmp_path: Path) -> None:
    """1e5 is infinite in float16. Six rows of seven numbers are as many numbers as seven of six."""
    fits, box, cars = np.full((2, 3, 64, 64), 65504.0), np.array([(8, 0, 4.5, 1.9, 0.1, 0.9)]), np.ones((5, 6))
    infinite = "are not finite as float16, must be within ±65504"
    maps = [({"features": [fits, np.full_like(fits, v)]}, f"features of frame 1 {infinite}") for v in (1e5, np.nan)]
    rows = [
        *maps,
        ({"confidence": np.full((2, 2, 64, 64), -1e5)}, f"confidence {infinite}"),
        ({"boxes": [[box, np.full((6, 7), 0.5)], [box, box]]}, "boxes of frame 0 have shape [6, 7], must be [any, 6]"),
        ({"boxes": [[box, box], [box, box[0]]]}, "boxes of frame 1 have shape [6], must be [any, 6]"),
        ({"truth": [cars[:, :5], cars]}, "truth of frame 1 have shape [5, 6], must be [any, 5]"),
        ({"boxes": [[box], [box, box, box]]}, "boxes of frame 0 are of 1 drones, must be of 2"),
    ]

    def check(changes: dict[str, Any], message: str) -> None:
        for name in ("r", "r.npz"):
            with pytest.raises(RecordingError, match=re.escape(message)):
                small(tmp_path / name, **({"features": None} | changes))

    assert wrong_rows(rows, check) == {}
    assert not list(tmp_path.iterdir())
    small(tmp_path / "x.npz", features=None, boxes=[[box, []], [[], box]])


def test_grids_that_cells_do_not_divide_are_told(tmp_path: Path) -> None:
    rec = open_recording(small(tmp_path / "x.npz", features=np.zeros((2, 2, 3, 50, 50))))
    with pytest.raises(RecordingError, match="features has a grid of 50 × 50, must be square and a multiple of 64"):
        _ = rec.geometry


def test_moved_is_its_own_inverse_and_cells_follow_the_grid() -> None:
    rng = np.random.Generator(np.random.PCG64(3))
    boxes = rng.uniform(-50, 50, (20, 6))
    a, b = rng.uniform(-3, 3, 3), rng.uniform(-3, 3, 3)
    np.testing.assert_allclose(moved(moved(boxes, a, b), b, a), boxes, atol=1e-12)
    here = moved(np.array([(1.0, 0, 4, 2, 0, 1)]), (10.0, 5.0, np.pi / 2), (10.0, 0.0, 0.0))
    np.testing.assert_allclose(here[0, [0, 1, 4]], (0, 6, np.pi / 2), atol=1e-12)
    from sortie.perception.geometry import FULL

    row, column, inside = cells_of(np.array([(-102.4, 102.3, 4, 2, 0, 1), (102.4, 0, 4, 2, 0, 1)]), FULL)
    assert (row[0], column[0], inside.tolist()) == (0, 63, [True, False])


def rewritten(path: Path, **members: bytes) -> None:
    """Put other bytes in place of arrays of an npz file."""
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in (contents | {f"{k}.npy": v for k, v in members.items()}).items():
            archive.writestr(name, content)


def test_a_member_that_is_no_array_or_claims_too_much_is_one_line(path: Path) -> None:
    """Eighty gigabytes are missed before they are asked for."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000,), }".ljust(69)
    for content, said in (
        (b"no array", "cannot be read as npz (the magic string is not correct"),
        (b"", "cannot be read as npz (EOF: reading magic string, expected 8 bytes got 0)"),
        (b"\x93NUMPY\x01\x00\x46\x00" + header + b"\n", "cannot be read as npz (t_s.npy is of 80000000000 B, its"),
    ):
        rewritten(path, t_s=content)
        with pytest.raises(RecordingError, match=f"^{re.escape(f'{path}: {said}')}[^\n]*$"):
            open_recording(path)
