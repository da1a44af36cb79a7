"""A recording in the harness: what reaches whom, by which bytes, fusions of one's own, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_examples import score_map, small
from wrong_rows import wrong_rows

from sortie.perception.evaluation import SINGLE, Settings, Sharing, evaluate, evaluate_recording
from sortie.perception.evaluation.recorded import RecordedInstrument, content_hash, frames_of
from sortie.perception.evaluation.sharing import Exchange
from sortie.perception.recordings.exchange import Sent, fusion_hash, received_boxes
from sortie.perception.recordings.recording import RecordingError, open_recording
from sortie.scenarios.plugins.reference import PluginError

GREEDY = """
import numpy as np

def peaks(agents, takes_part, weight):
    best = (agents[:, 0] * takes_part * weight[:, None, None]).max(axis=0)
    row, column = np.nonzero(best)
    x, y = (row + 0.5) * 3.2 - 102.4, (column + 0.5) * 3.2 - 102.4
    return np.stack([x, y, *(np.full(len(x), v) for v in (4.5, 1.9, 0.0)), best[row, column]], axis=1)

def wrong(agents, takes_part, weight):
    return np.zeros((3, 5))

def degrees(agents, takes_part, weight):
    return np.array([(0, 0, 4.5, 1.9, 90, 0.5)])

def raises(agents, takes_part, weight):
    raise ValueError("no such layer")

def torn(agents, takes_part, weight):
    import torch
    return torch.from_numpy(agents) @ torch.zeros(3, 3)
"""


@pytest.fixture
def fusion(tmp_path: Path) -> str:
    (tmp_path / "fusion.py").write_text(GREEDY)
    return f"{tmp_path / 'fusion.py'}:peaks"


def cells(*at: tuple[int, int]) -> np.ndarray:
    out = np.zeros((1, 64, 64), bool)
    for row, column in at:
        out[0, row, column] = True
    return out


def test_a_peers_box_arrives_with_the_cell_of_its_centre(tmp_path: Path) -> None:
    """Drone 1's car lies in its cell (32, 38), 10 m ahead and 20 m to the left of drone 0."""
    rec = open_recording(small(tmp_path / "r.npz"))
    view = RecordedInstrument(rec).look(frames_of(rec), 0)
    asked = [
        Exchange(0, (1,), cells((32, 38))),
        Exchange(0, (1,), cells((32, 37), (31, 38))),
        Exchange(0, (), cells()[:0]),
    ]
    with_it, without, alone = view.detect(asked, 0.0)
    np.testing.assert_allclose(with_it, [(8, 0, 4.5, 1.9, 0.1, 0.9), (10, 20, 4.5, 1.9, 0.2, 0.8)])
    np.testing.assert_allclose(without, alone)
    assert len(view.detect(asked[:1], 0.85)[0]) == 1


def test_the_harness_evaluates_a_recording_with_its_own_bytes(tmp_path: Path) -> None:
    """Each drone knows one of two cars: alone AP is 1/2, a single cell of the right peer makes it 1."""
    path = small(tmp_path / "r.npz")
    found = evaluate_recording(path, [SINGLE, Sharing(1 / 4096, "all-1"), Sharing(1.0, "all-1")])
    few, full = found.conditions[1:]
    assert found.ap(SINGLE) == pytest.approx(0.5)
    assert found.ap(few) == pytest.approx(1.0)
    assert found.ap(full) == pytest.approx(1.0)
    assert found.payload_bytes[few].tolist() == [1 * 3 * 2] * 4
    assert found.payload_bytes[full].tolist() == [4096 * 3 * 2] * 4
    assert found.index_bytes[few].tolist() == [2] * 4
    assert evaluate_recording(path).conditions[-1] == full


def test_frames_that_stand_still_are_told_apart_where_they_are_kept(tmp_path: Path) -> None:
    """Of two frames with the same poses and cars the second finds nothing; each is evaluated alone, into one store."""
    pose, car = np.zeros((2, 1, 3)), np.array([(8, 0, 4.5, 1.9, 0.1)])
    boxes = [[np.append(car, [[0.9]], axis=1)], [np.zeros((0, 6))]]
    rec = open_recording(small(tmp_path / "r.npz", pose=pose, boxes=boxes, truth=[car, car], features=None))
    for f, ap in ((0, 1.0), (1, 0.0), (0, 1.0)):
        one = frames_of(rec, [f])
        assert evaluate(RecordedInstrument(rec), one, [SINGLE], Settings(1), store=tmp_path / "store").ap(SINGLE) == ap


def test_one_drone_alone_is_evaluated(tmp_path: Path) -> None:
    car = np.array([(8, 0, 4.5, 1.9, 0.1)])
    box = np.append(car, [[0.9]], axis=1)
    one = dict(pose=np.zeros((2, 1, 3)), boxes=[[box], [box]], truth=[car, car], features=None)
    found = evaluate_recording(small(tmp_path / "r.npz", **one))
    assert (found.conditions, found.ap(SINGLE)) == ((SINGLE,), 1.0)


def test_a_users_fusion_gets_warped_features_and_says_what_is_there(tmp_path: Path, fusion: str) -> None:
    """Poses a whole number of cells apart, so that warping is exact: peaks come back in their cells."""
    pose = np.array([[(0, 0, 0), (9.6, 0, 0)]] * 2)
    rec = open_recording(small(tmp_path / "r.npz", pose=pose))
    view = RecordedInstrument(rec, fusion).look(frames_of(rec), 0)
    found, without = view.detect([Exchange(0, (1,), cells((32, 38))), Exchange(0, (1,), cells((0, 0)))], 0.0)
    np.testing.assert_allclose(found[:, :2], [(8.0, 1.6), (11.2, 20.8)], atol=1e-4)  # centres of the cells
    np.testing.assert_allclose(found[:, 5], (0.9, 0.8), atol=1e-3)
    assert len(without) == 1
    stand_in = RecordedInstrument(rec)
    assert stand_in.fingerprint != RecordedInstrument(rec, fusion).fingerprint != ""


def test_a_fusion_that_fails_or_is_not_there_is_told(tmp_path: Path, fusion: str) -> None:
    rec = open_recording(small(tmp_path / "r.npz"))
    (tmp_path / "f.py").write_text("1 / 0")
    rows = [
        (fusion.replace("peaks", "wrong"), r"the fusion gave shape \[3, 5\], must be boxes \[m, 6\]"),
        (
            fusion.replace("peaks", "degrees"),
            r"the fusion gave boxes: yaw in row 0 \(from 0\) is 90, must be within ±12",
        ),
        (fusion.replace("peaks", "raises"), "the fusion failed, ValueError: no such layer"),
        (fusion.replace("peaks", "torn"), "the fusion failed, RuntimeError: "),
        (fusion.replace("peaks", "missing"), "has no function or class 'missing'"),
        (
            f"{tmp_path / 'f.py'}:f",
            r"recorded_fusion file '.*f\.py' does not load: ZeroDivisionError: division by zero",
        ),
        (f"{tmp_path / 'g.py'}:f", r"recorded_fusion file '.*g\.py' not found"),
    ]

    def check(name: str, message: str) -> None:
        with pytest.raises((RecordingError, PluginError), match=message):
            RecordedInstrument(rec, name).look(frames_of(rec), 0).detect([Exchange(0, (1,), cells((1, 1)))], 0)

    assert wrong_rows(rows, check) == {}


NONE = np.zeros((0, 6))


POSE = np.array([[(0, 0, 0), (20, 0, 0), (0, 30, 0)]] * 3, float)


EST = POSE + np.array([(3.0, 0.0, 0.0), (0.0, 2.0, 0.0), (-2.0, 0.0, 0.0)])


TELLS = """
import numpy as np

def tell(agents, takes_part, weight):
    rows = [(10.0 * k, 0, 4.5, 1.9, 0, w) for k, w in enumerate(weight)]
    rows.append((-50.0, 0, 4.5, 1.9, 0, takes_part[1:].mean()))
    return np.array(rows)

def other(agents, takes_part, weight):
    return tell(agents, takes_part, weight)
"""


def box(x: float, y: float = 0.0, score: float = 0.8) -> np.ndarray:
    return np.array([(x, y, 4.5, 1.9, 0.1, score)])


def recorded(path: Path, frames: Any, **changes: Any) -> Path:
    """Three frames, a tenth of a second apart, of three drones that stand still and believe that they are elsewhere."""
    arrays = {"t_s": [0.0, 0.1, 0.2], "pose": POSE, "est_pose": EST, "truth": [np.zeros((0, 5))] * 3, "features": None}
    return small(path, boxes=frames, **(arrays | changes))


def test_some_frames_are_evaluated_as_themselves(tmp_path: Path) -> None:
    """Frames of two scenes, poses believed and true, and the boxes of just those."""
    frames = [[box(8.0 + k), NONE, NONE] for k in range(3)]
    rec = open_recording(recorded(tmp_path / "r.npz", frames, scene=[4, 7, 7], pose=POSE * [[[1.0]], [[2.0]], [[3.0]]]))
    some = frames_of(rec, [2, 0])
    assert (some.scene.tolist(), some.index.tolist()) == ([7, 4], [2, 0])
    np.testing.assert_array_equal(some.true_pose, rec.pose[[2, 0]])
    np.testing.assert_array_equal(some.est_pose, EST[[2, 0]])
    view = RecordedInstrument(rec).look(some, 0)
    alone = Exchange(0, (), np.zeros((0, 64, 64), bool))
    assert view.detect([alone], 0.0)[0][0, 0] == 10.0
    assert [len(b) for b in view.detect([alone], 0.81)] == [0]
    whole = Exchange(1, (0,), np.ones((1, 64, 64), bool))
    np.testing.assert_allclose(view.detect([whole], 0.0)[0][0, :2], [10.0 + 3.0 - 20.0, -2.0])  # by what both believe


def test_an_instrument_is_known_by_its_recording_and_its_fusion(tmp_path: Path) -> None:
    """Which file, which function of it, and where in a folder a file lies; alone nothing is fused."""
    (tmp_path / "f.py").write_text(TELLS)
    (tmp_path / "g.py").write_text(TELLS + "\n")
    maps = [np.stack([score_map(NONE, 2)] * 3)] * 3
    rec = open_recording(recorded(tmp_path / "r.npz", [[box(8.0), NONE, NONE]] * 3, features=maps))
    names = [None, *(f"{tmp_path / file}.py:{name}" for file in "fg" for name in ("tell", "other"))]
    assert len({RecordedInstrument(rec, name).fingerprint for name in names}) == len(names)
    assert (fusion_hash(None), len(fusion_hash(names[1]))) == ("", 32)
    alone = Exchange(0, (), np.zeros((0, 64, 64), bool))
    view = RecordedInstrument(rec, names[1]).look(frames_of(rec), 0)
    assert view.detect([alone], 0.0)[0].tolist() == box(8.0).tolist()
    for folder, inner in (("one", "a"), ("two", "b")):
        (tmp_path / folder / inner).mkdir(parents=True)
        (tmp_path / folder / inner / "c").write_text("same")
    assert content_hash(tmp_path / "one") != content_hash(tmp_path / "two")


def test_bytes_are_of_all_columns_of_a_cell(tmp_path: Path) -> None:
    """Two columns along a cell's side: a cell is four columns of three numbers of two bytes."""
    fine = [np.zeros((3, 3, 128, 128))] * 3
    path = recorded(tmp_path / "r.npz", [[NONE] * 3] * 3, features=fine, cell_m=1.6, truth=[np.zeros((0, 5))] * 3)
    rec = open_recording(path)
    assert (rec.columns_a_side, rec.cell_bytes, rec.geometry.half_extent_m) == (2, 24, 102.4)
    found = evaluate_recording(path)
    full = found.conditions[-1]
    assert found.payload_bytes[full].tolist() == [2 * 4096 * 24] * 9


def test_received_boxes_lie_in_the_ego_s_frame_and_square_and_came_with_their_cells(tmp_path: Path) -> None:
    """A box beyond the sender's grid has no cell; one beyond the ego's square is not the ego's; headings turn."""
    far = np.concatenate([box(0.0, 40.0), box(5.0, -101.0), box(110.0, 0.0), box(-101.0, -101.0)])
    rec = open_recording(recorded(tmp_path / "r.npz", [[box(8.0), far, NONE]] * 3))
    cells = np.ones((64, 64), bool)
    here, there = (0.0, 0.0, 0.5), (30.0, -20.0, 0.5 + np.pi / 2)
    sent = [Sent(0, 1, cells, there, 0.5)]
    found = received_boxes(rec, (0, 0), here, sent)
    turn = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    middle = turn @ [30.0, -20.0]
    np.testing.assert_allclose(found[0], box(8.0)[0])
    expected = middle + np.array([(-40.0, 0.0), (101.0, 5.0), (101.0, -101.0)])
    inside = expected[np.abs(expected).max(axis=1) < 102.4]
    np.testing.assert_allclose(found[1:, :2], inside)
    assert len(inside) == 1
    assert found[1:, 4] == pytest.approx(0.1 + np.pi / 2)
    assert found[1:, 5] == pytest.approx(0.4)
    assert len(received_boxes(rec, None, here, sent)) == 1
    wide = received_boxes(rec, None, there, [Sent(0, 1, cells, there)])
    assert wide[:, 0].tolist() == [0.0, 5.0, -101.0]


def test_a_recording_flies_without_torch(tmp_path: Path) -> None:
    path = small(tmp_path / "r.npz", features=None)
    code = f"""
import sys
from sortie.perception.detectors import make_detector
from sortie.perception.evaluation import SINGLE, evaluate_recording
from sortie.scenarios.schema import Perception
make_detector(None, Perception(detector="recorded", recording={str(path)!r}), 1)
evaluate_recording(__import__("pathlib").Path({str(path)!r}), [SINGLE])
assert "torch" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
