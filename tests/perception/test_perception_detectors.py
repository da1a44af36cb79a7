"""What every detector does with shares, whose camera noise it is, and what a detector of one's own must return."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from perception_examples import EMPTY, capture, cross, same
from recording_examples import small
from wrong_rows import wrong_rows

from sortie.perception import budget
from sortie.perception.detectors import make_detector
from sortie.perception.ground_truth import ground_truth
from sortie.perception.lateness import map_weight
from sortie.perception.motion import Tracks
from sortie.perception.network.detector import TorchDetector
from sortie.perception.recordings.detector import RecordedDetector
from sortie.perception.scene.render import Renderer
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.plugins.reference import PluginError
from sortie.scenarios.schema import Perception, Scene, Target
from sortie.scenarios.shipped import NETWORKS

BOUNDS = (-50.0, -50.0, 50.0, 50.0)


@cache
def town() -> SceneModel:
    return SceneModel(Scene(moving_cars_per_km=30), Target(waypoints_m=((0, 0), (100, 0))), BOUNDS)


@cache
def surrogate(**config: Any) -> SurrogateDetector:
    return SurrogateDetector(town(), Perception(**config), 3)


@cache
def torch_detector() -> TorchDetector:
    return TorchDetector(town(), Perception(), 1)


DETECTORS: tuple[Callable[[], Any], ...] = (surrogate, torch_detector)


EVERY_KIND = ("features", "raw", "detections", "tracks")


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("late_s", [0.0, 1.5])
def test_truth_is_of_the_time_that_is_asked_for_about_the_true_pose(detector: Any, late_s: float) -> None:
    """Cars move between capture and scoring; the square stays where the drone truly was."""
    ego = capture(10.0, 20.0, yaw=0.4, pitch=0.05, t_s=5.0, est=(14.0, 15.0, 60.0, 0.9))
    cars = town().cars_at(5.0 + late_s)
    wanted = ground_truth(cars.table(), (10.0, 20.0, ego.true_yaw_rad), identity=cars.ids).single()
    found = detector().truth(5.0 + late_s, ego)
    order, wanted_order = np.argsort(found.car), np.argsort(wanted.car)
    np.testing.assert_array_equal(found.car[order], wanted.car[wanted_order])
    np.testing.assert_allclose(found.table()[order], wanted.table()[wanted_order], atol=1e-3)
    if hasattr(detector(), "truth_many"):
        assert same(*detector().truth_many([5.0 + late_s], [ego]), found)


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("shares", [(), ("features",), ("raw",), ("detections",)])
def test_boxes_lie_where_the_drone_believes_it_is(detector: Any, shares: tuple[str, ...]) -> None:
    """Everybody's belief is off by the same: all boxes are, and nothing else changes."""
    off = np.array([7.0, -4.0])

    def found(dx: float, dy: float) -> Boxes:
        fleet = [
            c._replace(est_position_m=(c.position_m[0] + dx, c.position_m[1] + dy, 60.0))
            for c in cross(10.0, 20.0, 0.3)[:3]
        ]
        jobs = [(fleet[0], [Share(c, kind, 0.2, None, 1.0) for kind in shares for c in fleet[1:]])]
        (boxes,) = detector().detect(jobs)
        return boxes

    here, there = found(0.0, 0.0), found(*off.tolist())
    assert len(here) > 3
    assert len(there) == len(here)
    np.testing.assert_allclose(there.xy_m - here.xy_m, np.broadcast_to(off, here.xy_m.shape), atol=2e-2)
    np.testing.assert_allclose(there.score, here.score, atol=2e-3)


@pytest.mark.parametrize("made", DETECTORS)
def test_a_share_of_no_weight_is_as_if_it_had_not_come(made: Any) -> None:
    """Beside others, and alone."""
    ego, a, b = cross(10.0, 20.0, 0.3)[:3]
    for kind, join in product(EVERY_KIND, ("nms", "average") if made is surrogate else ("nms",)):
        detector = made(join=join) if made is surrogate else made()
        nothing, other = Share(a, kind, 0.2, None, 0.0), Share(b, "detections", 0.0, None, 1.0)
        own, with_nothing, with_b, with_both = (
            detector.detect([(ego, shares)])[0] for shares in ([], [nothing], [other], [nothing, other])
        )
        assert same(with_nothing, own), (kind, join)
        assert same(with_both, with_b), (kind, join)


def test_the_weight_of_a_map_matters_to_the_surrogate_and_to_the_network() -> None:
    """Between nothing and one there is more than two."""
    ego, a = cross(10.0, 20.0, 0.3)[:2]
    for detector in (surrogate(), torch_detector()):
        found = [detector.detect([(ego, [Share(a, "features", 0.3, None, w)])])[0] for w in (0.0, 0.3, 1.0)]
        assert not same(found[0], found[1])
        assert not same(found[1], found[2])


@pytest.mark.parametrize("made", ["surrogate", "recorded", "torch"])
def test_a_share_as_old_as_the_ego_s_own_look_counts_as_if_both_were_of_now(made: str, tmp_path: Path) -> None:
    """Lateness is beside the freshest look at hand, and that is the ego's own: nothing is older than it."""
    weight = 0.7913  # with 0.8, a mean of two scores is often half-way between two float32
    path = small(tmp_path / "flown.npz", features=None)
    for kind, join in product(EVERY_KIND, ("nms",) if made == "torch" else ("nms", "average")):
        ego, peer = cross(10.0, 20.0, 0.3)[:2]
        detector: Any = torch_detector() if made == "torch" else surrogate(join=join)
        if made == "recorded":
            detector = RecordedDetector(Perception(detector="recorded", recording=str(path), join=join))
            ego, peer = (capture(10.0 * i, 0.0, drone=i, t_s=0.0) for i in range(2))
        shares = [Share(peer, kind, 0.5, None, weight, (), age_s) for age_s in (0.0, 0.4)]
        now, late = (detector.detect([(ego, [share])])[0] for share in shares)
        assert len(now) > 0
        assert same(now, late), (kind, join)


@pytest.mark.parametrize("made", [surrogate, torch_detector])
def test_a_late_map_is_fused_as_one_of_so_much_less_weight(made: Any) -> None:
    """Beside the ego's own look, which is younger; without one, beside the youngest map."""
    ego, a, b = cross(10.0, 20.0, 0.3, t_s=5.0)[:3]
    old = a._replace(t_s=4.7)

    def found(who: Capture, *shares: Share) -> Boxes:
        return made().detect([(who, shares)])[0]

    late = found(ego, Share(old, "features", 0.3, None, 0.9, (), 0.395))
    assert same(late, found(ego, Share(old, "features", 0.3, None, 0.9 * map_weight(0.395, 0.095))))
    assert not same(late, found(ego, Share(old, "features", 0.3, None, 0.9)))
    blind = ego._replace(looked=False)
    young = Share(b, "features", 0.3, None, 0.9, (), 0.095)
    late = found(blind, young, Share(old, "features", 0.3, None, 0.9, (), 0.395))
    less = Share(old, "features", 0.3, None, 0.9 * map_weight(0.395, 0.095))
    assert same(late, found(blind, young._replace(age_s=0.0), less))


@pytest.mark.parametrize("made", [surrogate, torch_detector])
def test_without_an_own_look_maps_count_beside_the_heaviest_of_them(made: Any) -> None:
    """All weights halved are the same weights: there is no own map against which they would be less."""
    blind, *peers = cross(10.0, 20.0, 0.3)[:4]
    blind = blind._replace(looked=False)
    whole, half = (
        made().detect(
            [(blind, [Share(c, "raw", 1.0, None, part * w) for c, w in zip(peers, (0.6, 1.0, 0.3), strict=True)])]
        )[0]
        for part in (1.0, 0.5)
    )
    assert len(whole) == len(half) > 3
    np.testing.assert_allclose(half.xy_m, whole.xy_m, atol=1e-2)
    np.testing.assert_allclose(half.score, whole.score, atol=1e-3)
    other = made().detect([(blind, [Share(c, "raw", 1.0, None, 1.0) for c in peers])])[0]
    assert not (len(other) == len(whole) and np.allclose(other.score, whole.score, atol=1e-3))


@pytest.mark.parametrize("name", ["disconet", "fine"])
def test_the_surrogate_announces_as_many_boxes_as_the_network_finds(name: str) -> None:
    """False positives among them; of those of the fine network, which are more than 200, the best 200."""
    looks = [capture(10.0 * k, 5.0, drone=k, t_s=2.0 + 0.5 * k) for k in range(4)]
    weights = NETWORKS / f"{name}.safetensors"
    torch, fitted = TorchDetector(town(), Perception(), 1, weights), SurrogateDetector(town(), Perception(), 3, weights)
    found = np.mean([torch.count_boxes(c, None) for c in looks])
    assert np.mean([fitted.count_boxes(c, None) for c in looks]) == pytest.approx(found, rel=0.15)


def test_the_detector_that_a_scenario_names_draws_by_seed_and_replication() -> None:
    def found(seed: int, replication: int):
        detector = make_detector(town(), Perception(detector="surrogate"), seed, replication)
        assert detector is not None
        return detector.detect([(c, ()) for c in cross(0.0, 0.0, 0.3)])

    first = found(3, 0)
    assert all(map(same, found(3, 0), first))
    assert not all(map(same, found(3, 1), first))
    assert not all(map(same, found(4, 0), first))


def test_camera_noise_is_of_each_drone_moment_seed_and_replication() -> None:
    """In the network's pictures as in the renderer's own."""
    here = capture(0.0, 0.0, t_s=5.0)

    def grey(renderer: Renderer, c: Capture) -> np.ndarray:
        return renderer.render([c])[0].astype(int)

    usual = grey(Renderer(town(), 1), here)
    assert np.array_equal(grey(Renderer(town(), 1), here), usual)
    noise = [grey(Renderer(town(), 1), here._replace(drone=1)), grey(Renderer(town(), 2), here)]
    noise += [grey(Renderer(town(), 1, 1), here)]
    for a, b in combinations([usual, *noise], 2):
        assert (a != b).mean() > 0.8
        assert np.abs(a - b).max() <= 40
    for view, key in zip((usual, *noise[1:]), ((1, 0), (2, 0), (1, 1)), strict=True):
        made = make_detector(town(), Perception(), *key)
        assert made is not None
        np.testing.assert_array_equal(made.camera_views(here), view)


@pytest.mark.slow
@pytest.mark.parametrize("made", DETECTORS)
def test_without_its_last_cells_a_map_is_one_of_a_smaller_budget(made: Any) -> None:
    ego, *peers = cross(10.0, 20.0, 0.3)

    def found(rho: float, missing: tuple[int, ...] = ()) -> Boxes:
        return made().detect([(ego, [Share(c, "features", rho, None, 1.0, missing) for c in peers])])[0]

    few = found(205 / budget.CELLS)
    for rho in (1.0, 0.1):
        assert same(found(rho, tuple(range(205, int(rho * budget.CELLS)))), few)
        assert not same(found(rho), few)


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
    "millimetres": {"size_m": np.array([[4500.0, 1900.0], [4.5, 1.9]])},
    "degrees": {"yaw_rad": np.array([0.0, 90.0])},
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
        return -1 if self.what == "count" else round(roi.radius_m) if roi else capture.drone

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
    assert found.count_boxes(capture(drone=4), None) == 4
    assert found.count_boxes(capture(drone=4), Disc(1.0, 2.0, 9.0)) == 9
    assert isinstance(found.truth(5.0, capture()), Boxes)


def test_what_it_computes_in_the_background_is_checked(made: Callable[[str], Any]) -> None:
    rows = [
        ("fails", "out of memory"),
        ("short", "must be Boxes for each of the jobs"),
        ("infinite", r"detect returns boxes: x in row 0 \(from 0\) is inf, must be finite"),
        ("half", r"detect returns boxes: x in row 0 \(from 0\) is nan, must be finite"),
        ("no width", r"detect returns boxes: width in row 1 \(from 0\) is 0, must be 0.001 to 1000 m"),
        ("millimetres", r"length in row 0 \(from 0\) is 4500, must be 0.001 to 1000 m"),
        ("degrees", r"yaw in row 1 \(from 0\) is 90, must be within ±12.57 rad, not degrees"),
        ("a logit", r"score in row 0 \(from 0\) is -0.1, must be 0 to 1"),
        ("no score", r"score in row 1 \(from 0\) is nan, must be 0 to 1"),
        ("one kind", r"detect returns kind of shape \(1,\), must be \(2,\)"),
        ("kind 3", r"detect returns kind array\(\[0, 3\]\), must be whole numbers from 0 to 2"),
        ("half a kind", "must be whole numbers from 0 to 2"),
        ("one car", r"detect returns car of shape \(1,\), must be \(2,\)"),
    ]

    def check(what: str, message: str) -> None:
        finish = made(what).begin([(capture(), [])])
        with pytest.raises(PluginError, match=message):
            finish()

    assert wrong_rows(rows, check) == {}


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
    found.begin(jobs)() if how == "begin" else getattr(found, how)([jobs] if how == "detect_many" else jobs)
    assert not boxes.xy_m.any()
    assert not tracks.xy_m.any()


def test_its_truth_and_its_count_are_checked(made: Callable[[str], Any]) -> None:
    with pytest.raises(PluginError, match="truth returns None, must be Boxes"):
        made("truth").truth(5.0, capture())
    with pytest.raises(PluginError, match="count_boxes returns -1, must be a whole number from 0 to 1,000,000"):
        made("count").count_boxes(capture(), None)
