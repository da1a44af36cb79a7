"""A recording in the harness and as a sortie's detector: what reaches whom, by which bytes, and what is refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from perception_examples import capture, only_target
from places import ROOT
from recording_examples import small

from sortie.perception.detectors import DETECTORS, make_detector
from sortie.perception.evaluation import SINGLE, Settings, Sharing, evaluate, evaluate_recording
from sortie.perception.evaluation.recorded import RecordedInstrument, frames_of
from sortie.perception.evaluation.sharing import Exchange
from sortie.perception.recordings.detector import RecordedDetector
from sortie.perception.recordings.recording import RecordingError, open_recording
from sortie.perception.types import Share
from sortie.scenarios.plugins.reference import PluginError, resolve
from sortie.scenarios.schema import Perception
from sortie.scenarios.schema.base import ModelName

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
WHOLE = dict(features=None)
"""Features left out: the radio's own grid is taken."""


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
    aps = [
        evaluate(RecordedInstrument(rec), frames_of(rec, [f]), [SINGLE], Settings(1), store=tmp_path / "store").ap(
            SINGLE
        )
        for f in (0, 1, 0)
    ]
    assert aps == [1.0, 0.0, 1.0]


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


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wrong", r"the fusion gave shape \[3, 5\], must be boxes \[m, 6\]"),
        ("degrees", r"the fusion gave boxes: yaw in row 0 \(from 0\) is 90, must be within ±12.57 rad, not degrees"),
        ("raises", "the fusion failed, ValueError: no such layer"),
        ("torn", "the fusion failed, RuntimeError: "),
    ],
)
def test_a_fusion_that_fails_is_told(name: str, message: str, tmp_path: Path, fusion: str) -> None:
    rec = open_recording(small(tmp_path / "r.npz"))
    with pytest.raises(RecordingError, match=message):
        RecordedInstrument(rec, fusion.replace("peaks", name)).look(frames_of(rec), 0).detect(
            [Exchange(0, (1,), cells((1, 1)))], 0
        )


def test_a_fusion_that_is_not_in_its_file_is_told(tmp_path: Path, fusion: str) -> None:
    rec = open_recording(small(tmp_path / "r.npz"))
    with pytest.raises(PluginError, match="has no function or class 'missing'"):
        RecordedInstrument(rec, fusion.replace("peaks", "missing"))


def test_a_fusion_file_that_does_not_load_is_told(tmp_path: Path) -> None:
    (tmp_path / "f.py").write_text("1 / 0")
    with pytest.raises(
        PluginError, match=r"recorded_fusion file '.*f\.py' does not load: ZeroDivisionError: division by zero"
    ):
        resolve("recorded_fusion", f"{tmp_path / 'f.py'}:f")
    with pytest.raises(PluginError, match=r"recorded_fusion file '.*g\.py' not found"):
        resolve("recorded_fusion", f"{tmp_path / 'g.py'}:f")


def flown(tmp_path: Path, boxes: Any = None, **settings: Any) -> RecordedDetector:
    path = small(tmp_path / "flown.npz", features=None, **({} if boxes is None else {"boxes": boxes}))
    config = Perception(detector="recorded", recording=str(path), **settings)
    detector = make_detector(only_target(0, 0), config, 1)
    assert isinstance(detector, RecordedDetector)
    return detector


def looks(t_s: float = 0.0) -> list[Any]:
    return [capture(10.0 * i + t_s * 10, 0, drone=i, t_s=t_s) for i in range(2)]


def share(of: Any, representation: str = "features", rho: float = 1.0, weight: float = 1.0) -> Share:
    return Share(of, representation, rho, None, weight)


def test_what_was_delivered_decides_what_an_ego_sees(tmp_path: Path) -> None:
    detector, (a, b) = flown(tmp_path), looks()
    counts = {
        name: len(detector.detect([(a, shares)])[0])
        for name, shares in {
            "alone": [], "full": [share(b)], "one cell": [share(b, rho=1 / 4096)], "starved": [share(b, rho=1e-6)],
            "distrusted": [share(b, weight=0.0)], "raw": [share(b, "raw")], "detections": [share(b, "detections")],
            "tracks": [share(b, "tracks")],
        }.items()
    }  # fmt: skip
    assert counts == {
        "alone": 1, "full": 2, "one cell": 2, "starved": 1, "distrusted": 1, "raw": 2, "detections": 2, "tracks": 2,
    }  # fmt: skip
    found = detector.detect([(a, [share(b)])])[0]
    np.testing.assert_allclose(found.xy_m, [(8, 0), (10, 20)], atol=1e-5)
    assert len(flown(tmp_path, fusion="none").detect([(a, [share(b)])])[0]) == 1
    assert len(flown(tmp_path, score_threshold=0.85).detect([(a, [share(b)])])[0]) == 1
    assert len(detector.truth(0.0, a)) == 2
    assert detector.count_boxes(a, None) == 1
    assert detector.count_boxes(a, (50.0, 0.0, 10.0)) == 0
    unsure = flown(tmp_path, fusion="late", score_threshold=0.1, boxes=[[[(8, 0, 4.5, 1.9, 0.1, 0.2)], []]] * 2)
    assert (len(unsure.detect([(a, [])])[0]), unsure.count_boxes(a, None)) == (1, 0)  # late fusion does not send it
    with pytest.raises(ValueError, match="a recording holds no images"):
        detector.camera_views(a)


def test_the_nearest_frame_is_taken_within_a_step(tmp_path: Path) -> None:
    detector = flown(tmp_path)
    xs = [float(detector.detect([(looks(t_s)[0], [])])[0].xy_m[0, 0]) for t_s in (0.0, 0.04, 0.06, 0.19)]
    assert xs == pytest.approx([8.0] * 4, abs=1e-5)
    assert [detector._frame(looks(t)[0]) for t in (0.0, 0.04, 0.06, 0.19)] == [0, 0, 1, 1]
    with pytest.raises(
        RecordingError,
        match=r"flown\.npz: drone 0 is needed at 0\.3 s, must be within 0\.1 s of a frame \(0 … 0\.1 s\)",
    ):
        detector.detect([(looks(0.3)[0], [])])
    with pytest.raises(RecordingError, match=r"truth is needed at 9 s, must be within 0\.1 s"):
        detector.truth(9.0, looks()[0])
    with pytest.raises(RecordingError, match="drone 2 is not in it, must be one of 0 … 1"):
        detector.count_boxes(capture(drone=2, t_s=0.0), None)
    with pytest.raises(
        RecordingError, match=r"drone 0 at 0 s flies 40\.0 m from where it was recorded, must be within 5 m"
    ):
        detector.detect([(capture(40.0, drone=0, t_s=0.0), [])])


@pytest.mark.parametrize(
    ("changes", "settings", "message"),
    [
        ({}, {}, r"features are 3 × 64 × 64 of 3\.2 m, must be 80 × 64 × 64 of 3\.2 m, as a sortie's radio carries them"),
        (dict(features=None, cell_m=1.6), {}, r"features are 80 × 64 × 64 of 1\.6 m, must be"),
        (dict(features=None, scene=[0, 1]), {}, "scene names 2 scenes, must be one to be flown"),
        (dict(features=None), dict(recorded_fusion="FUSION"), "features are missing, must be there for perception.recorded_fusion"),
    ],
)  # fmt: skip
def test_what_cannot_be_flown_is_told(changes: Any, settings: Any, message: str, tmp_path: Path, fusion: str) -> None:
    path = small(tmp_path / "r.npz", **changes)
    settings = dict.fromkeys(settings, fusion)
    with pytest.raises(RecordingError, match=message):
        RecordedDetector(Perception(detector="recorded", recording=str(path), **settings))


def test_every_detector_of_the_schema_is_in_the_table() -> None:
    (named,) = (m for m in Perception.model_fields["detector"].metadata if isinstance(m, ModelName))
    assert set(DETECTORS) == set(named.builtin)
    assert make_detector(only_target(0, 0), Perception(detector="none"), 1) is None


def test_a_recording_flies_without_torch(tmp_path: Path) -> None:
    path = small(tmp_path / "r.npz", features=None)
    code = f"""
import sys
from sortie.perception.detectors import make_detector
from sortie.perception.evaluation import SINGLE, evaluate_recording
from sortie.scenarios.schema import Perception
make_detector(None, Perception(detector="recorded", recording={str(path)!r}), 1)
evaluate_recording({str(path)!r} and __import__("pathlib").Path({str(path)!r}), [SINGLE])
assert "torch" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_readmes_example_runs(tmp_path: Path) -> None:
    """As it stands there: alone each drone finds one of two cars, with sharing both find both."""
    readme = ROOT / "perception" / "recordings" / "README.md"
    code = readme.read_text("utf-8").split("```python\n")[1].split("```")[0]
    done = subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, capture_output=True, text=True)
    aps = eval(done.stdout)  # noqa: S307 (our own dict)
    assert (aps["single"], aps["all-1@1"]) == (0.5, 1.0)
