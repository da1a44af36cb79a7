"""A detector of one's own: what it is made of, and what it computes in the background, is checked as everything else is."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from perception_examples import EMPTY, capture

from sortie.perception.detectors import make_detector
from sortie.perception.motion import Tracks
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Share
from sortie.scenarios.plugins.reference import PluginError
from sortie.scenarios.schema import Perception, Scene

CODE = """
import dataclasses

import numpy as np
from sortie.perception.types import Boxes

KINDS = {
    "one kind": {"kind": np.zeros(1, np.int8)},
    "kind 3": {"kind": np.array([0, 3])},
    "half a kind": {"kind": np.array([0.5, 1.0])},
    "one car": {"car": np.zeros(1, np.int32)},
    "half": {"xy_m": np.array([[np.nan, 0.0], [1.0, 0.0]])},
    "no width": {"size_m": np.array([[4.5, 1.9], [4.5, 0.0]])},
    "negative": {"size_m": np.array([[-4.5, 1.9], [4.5, 1.9]])},
    "no size": {"size_m": np.array([[4.5, 1.9], [np.nan, 1.9]])},
    "millimetres": {"size_m": np.array([[4500.0, 1900.0], [4.5, 1.9]])},
    "degrees": {"yaw_rad": np.array([0.0, 90.0])},
    "no yaw": {"yaw_rad": np.array([np.inf, 0.0])},
    "per cent": {"score": np.array([0.9, 90.0])},
    "a logit": {"score": np.array([-0.1, 0.9])},
    "no score": {"score": np.array([0.9, np.nan])},
}


class Ahead:
    def __init__(self, scene, config, seed, replication, *, what="right"):
        self.made_of, self.what = (scene, config, seed, replication), what

    def detect(self, jobs):
        return self.spoil(jobs) if self.what == "spoils" else [Boxes.empty() for _ in jobs]

    def spoil(self, jobs):
        for _, shares in jobs:
            for share in shares:
                for name in ("tracks", "boxes", "people"):
                    getattr(share, name).xy_m[:] = 99.0
        return [Boxes.empty() for _ in jobs]

    def detect_many(self, moments):
        if self.what == "yields":
            return (1 / 0 for _ in moments)
        found = [boxes for jobs in moments for boxes in self.spoil(jobs)]
        return found[1:] if self.what == "few" else found

    def truth_many(self, t_s, egos):
        return [None for _ in egos]

    calibration = "none"

    def begin(self, jobs):
        def finish():
            if self.what == "fails":
                raise RuntimeError("out of memory")
            found = self.detect(jobs)
            if self.what == "infinite":
                found[0] = Boxes(np.array([[np.inf, 0.0]]), np.ones((1, 2)), np.zeros(1), np.ones(1))
            if self.what in KINDS:
                right = Boxes(np.zeros((2, 2)), np.ones((2, 2)), np.zeros(2), np.ones(2))
                found[0] = dataclasses.replace(right, **KINDS[self.what])
            return found[1:] if self.what == "short" else found

        return finish

    def truth(self, t_s, ego):
        return None if self.what == "truth" else Boxes.empty()

    def count_boxes(self, capture, roi):
        return -1 if self.what == "count" else 0

    def camera_views(self, capture):
        raise ValueError("none")
"""


@pytest.fixture
def made(tmp_path: Path) -> Callable[[str], Any]:
    path = tmp_path / "mine.py"
    path.write_text(CODE)
    scene = SceneModel(EMPTY, None, (-9.0, -9.0, 9.0, 9.0))

    def make(what: str) -> Any:
        config = Perception(detector=f"{path}:Ahead", detector_params={"what": what})
        return make_detector(scene, config, 3, 4)

    return make


def test_it_is_given_scene_section_seed_replication_and_its_parameters(made: Callable[[str], Any]) -> None:
    found = made("right")
    _, config, seed, replication = found.made_of
    assert (seed, replication, found.what) == (3, 4, "right")
    assert config.detector.endswith(":Ahead")
    jobs = [(capture(), []), (capture(drone=1), [])]
    assert [len(b) for b in found.begin(jobs)()] == [len(b) for b in found.detect(jobs)] == [0, 0]
    assert found.count_boxes(capture(), None) == 0
    assert isinstance(found.truth(5.0, capture()), Boxes)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("fails", "out of memory"),
        ("short", "must be Boxes for each of the jobs"),
        ("infinite", r"detect returns boxes: x in row 0 \(from 0\) is inf, must be finite"),
        ("half", r"detect returns boxes: x in row 0 \(from 0\) is nan, must be finite"),
        ("no width", r"detect returns boxes: width in row 1 \(from 0\) is 0, must be 0.001 to 1000 m"),
        ("negative", r"length in row 0 \(from 0\) is -4.5, must be 0.001 to 1000 m"),
        ("no size", r"length in row 1 \(from 0\) is nan, must be 0.001 to 1000 m"),
        ("millimetres", r"length in row 0 \(from 0\) is 4500, must be 0.001 to 1000 m"),
        ("degrees", r"yaw in row 1 \(from 0\) is 90, must be within ±12.57 rad, not degrees"),
        ("no yaw", r"yaw in row 0 \(from 0\) is inf, must be within ±12.57 rad, not degrees"),
        ("per cent", r"score in row 1 \(from 0\) is 90, must be 0 to 1"),
        ("a logit", r"score in row 0 \(from 0\) is -0.1, must be 0 to 1"),
        ("no score", r"score in row 1 \(from 0\) is nan, must be 0 to 1"),
        ("one kind", r"detect returns kind of shape \(1,\), must be \(2,\)"),
        ("kind 3", r"detect returns kind array\(\[0, 3\]\), must be whole numbers from 0 to 2"),
        ("half a kind", "must be whole numbers from 0 to 2"),
        ("one car", r"detect returns car of shape \(1,\), must be \(2,\)"),
    ],
)
def test_what_it_computes_in_the_background_is_checked(made: Callable[[str], Any], what: str, message: str) -> None:
    finish = made(what).begin([(capture(), [])])
    with pytest.raises(PluginError, match=message):
        finish()


@pytest.mark.parametrize(
    ("what", "message"),
    [("few", r"detect_many returns \[\], must be Boxes for each of the jobs"), ("yields", "division by zero")],
)
def test_what_it_computes_of_many_moments_is_checked(made: Callable[[str], Any], what: str, message: str) -> None:
    found = made(what)
    with pytest.raises(PluginError, match=message):
        found.detect_many([[(capture(), [])]])
    with pytest.raises(PluginError, match=r"truth_many returns \[None\], must be Boxes for each of the egos"):
        found.truth_many([5.0], [capture()])


@pytest.mark.parametrize("how", ["detect", "begin", "detect_many"])
def test_it_cannot_change_what_other_drones_received(made: Callable[[str], Any], how: str) -> None:
    found = made("spoils")
    boxes = Boxes(np.zeros((1, 2)), np.ones((1, 2)), np.zeros(1), np.ones(1))
    tracks = dataclasses.replace(Tracks.empty(), xy_m=np.zeros((1, 2)))
    share = Share(capture(drone=1), "boxes", 0.0, None, 1.0, tracks=tracks, boxes=boxes, people=boxes)
    jobs = [(capture(), [share])]
    {"detect": found.detect, "begin": lambda j: found.begin(j)(), "detect_many": lambda j: found.detect_many([j])}[how](
        jobs
    )
    assert not boxes.xy_m.any()
    assert not tracks.xy_m.any()


def test_parked_cars_stay_where_they_are_whatever_a_detector_does_to_them() -> None:
    scene = SceneModel(Scene(), None, (-50.0, -50.0, 50.0, 50.0))
    before = scene.cars_at(0.0)
    parked = scene.parked_cars
    for column in (parked.ids, parked.x_m, parked.y_m, parked.length_m, parked.colour):
        column[:] = 99
    assert len(before)
    np.testing.assert_array_equal(scene.cars_at(0.0).table(), before.table())


def test_its_truth_and_its_count_are_checked(made: Callable[[str], Any]) -> None:
    with pytest.raises(PluginError, match="truth returns None, must be Boxes"):
        made("truth").truth(5.0, capture())
    with pytest.raises(PluginError, match="count_boxes returns -1, must be a whole number from 0 to 1,000,000"):
        made("count").count_boxes(capture(), None)
