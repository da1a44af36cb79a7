"""A recording as a sortie's detector, where true and believed poses, times, weights and ages all differ."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from perception_examples import capture, only_target
from recording_examples import score_map, small
from wrong_rows import wrong_rows

from sortie.perception.detectors import DETECTORS, make_detector
from sortie.perception.lateness import map_weight, reach_m, still_right
from sortie.perception.motion import Tracks
from sortie.perception.recordings.detector import RecordedDetector
from sortie.perception.recordings.recording import RecordingError
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception
from sortie.scenarios.schema.base import ModelName

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


def flown(path: Path, **settings: Any) -> RecordedDetector:
    settings = {"score_threshold": 0.05, "join": "nms"} | settings
    return RecordedDetector(Perception(detector="recorded", recording=str(path), **settings))


def at(drone: int, t_s: float = 0.0, **changes: Any) -> Capture:
    x, y, _ = POSE[0, drone]
    return capture(x, y, drone=drone, t_s=t_s)._replace(**changes)


def test_what_was_delivered_decides_what_an_ego_sees(tmp_path: Path) -> None:
    path = small(tmp_path / "r.npz", features=None)
    a, b = (capture(10.0 * i, 0.0, drone=i, t_s=0.0) for i in range(2))

    def count(representation: str = "features", rho: float = 1.0, weight: float = 1.0, **settings: Any) -> int:
        return len(flown(path, **settings).detect([(a, [Share(b, representation, rho, None, weight)])])[0])

    assert len(flown(path).detect([(a, [])])[0]) == 1
    assert [count(), count(rho=1 / 4096), count("raw"), count("detections"), count("tracks")] == [2] * 5
    alone = [count(rho=1e-6), count(weight=0.0), count(fusion="none"), count(score_threshold=0.85)]
    assert alone == [1] * 4
    for missing, comes in (((), True), ((0,), False), ((1, 2, 3), True), (tuple(range(4096)), False)):
        (found,) = flown(path).detect([(a, [Share(b, "features", 1.0, None, 1.0, missing)])])
        assert len(found) == 1 + comes, "the cells that went missing are those of their rank"
    with pytest.raises(ValueError, match="a recording holds no images"):
        flown(path).camera_views(a)


def test_what_cannot_be_flown_is_told(tmp_path: Path) -> None:
    (tmp_path / "f.py").write_text(TELLS)
    fusion = {"recorded_fusion": f"{tmp_path / 'f.py'}:tell"}
    rows = [
        (
            {},
            {},
            r"features are 3 × 64 × 64 of 3\.2 m, must be 80 × 64 × 64 of 3\.2 m, as a sortie's radio carries them",
        ),
        ({"features": None, "cell_m": 1.6}, {}, r"features are 80 × 64 × 64 of 1\.6 m, must be"),
        ({"features": None, "scene": [0, 1]}, {}, "scene names 2 scenes, must be one to be flown"),
        ({"features": None}, fusion, "features are missing, must be there for perception.recorded_fusion"),
    ]

    def check(changes: dict[str, Any], settings: dict[str, Any], message: str) -> None:
        with pytest.raises(RecordingError, match=message):
            flown(small(tmp_path / "r.npz", **changes), **settings)

    assert wrong_rows(rows, check) == {}


def test_every_detector_of_the_schema_is_in_the_table() -> None:
    (named,) = (m for m in Perception.model_fields["detector"].metadata if isinstance(m, ModelName))
    assert set(DETECTORS) == set(named.builtin)
    assert make_detector(only_target(0, 0), Perception(detector="none"), 1) is None


def test_truth_is_about_the_true_pose_and_of_the_time_that_is_asked_for(tmp_path: Path) -> None:
    """At the square's edge of one pose, 3 m from the other's; in the second frame the cars have driven on by 4 m."""
    cars = np.array([(104.0, 0, 4.5, 1.9, 0), (-101.0, 5, 4.5, 1.9, 0)])
    detector = flown(recorded(tmp_path / "r.npz", [[NONE] * 3] * 3, truth=[cars, cars - [4.0, 0, 0, 0, 0], cars]))
    for now_s, seen in ((0.0, [-101.0]), (0.1, [100.0])):
        for look_s in (0.0, 0.1):
            assert detector.truth(now_s, at(0, look_s)).xy_m[:, 0] == pytest.approx(seen)


def test_boxes_stand_by_the_believed_pose_of_the_recording(tmp_path: Path) -> None:
    """Own and received ones. A drone of the sortie may believe something else and fly where the recorded one was."""
    path = recorded(tmp_path / "r.npz", [[box(8.0), box(5.0), NONE]] * 3)
    ego, peer = at(0, est_position_m=(90.0, 0.0, 60.0)), at(1)
    for kind in ("features", "detections"):
        found = flown(path).detect([(ego, [Share(peer, kind, 1.0, None, 1.0)])])[0]
        np.testing.assert_allclose(sorted(found.xy_m.tolist()), [(11.0, 0.0), (25.0, 2.0)], atol=1e-5)
    far = recorded(tmp_path / "f.npz", [[box(8.0), NONE, NONE]] * 3, est_pose=POSE + np.array([30.0, 0.0, 0.0]))
    np.testing.assert_allclose(flown(far).detect([(at(0), [])])[0].xy_m, [(38.0, 0.0)], atol=1e-5)


def test_received_boxes_are_dropped_beyond_the_recorded_square(tmp_path: Path) -> None:
    """The recorded drone believes that it is at x = 3, the sortie's at x = 0: its square ends at 105.4 m."""
    detector = flown(recorded(tmp_path / "r.npz", [[box(8.0), np.concatenate([box(84.0), box(86.0, 9.0)]), NONE]] * 3))
    found = detector.detect([(at(0), [Share(at(1), "detections", 0.0, None, 1.0)])])[0]
    assert sorted(found.xy_m[:, 0].tolist()) == pytest.approx([11.0, 104.0])


@pytest.mark.parametrize(
    ("of_peer", "score"),
    [
        ({"representation": "detections"}, 0.8),
        ({"representation": "tracks", "tracks": Tracks.empty()}, 0.8),
        ({"representation": "detections", "boxes": Boxes.empty()}, 0.4),  # of another network: it flies as the sortie
    ],
)
def test_a_peer_that_sees_nothing_votes_in_the_square_about_its_recorded_pose(
    of_peer: dict[str, Any], score: float, tmp_path: Path
) -> None:
    """The car lies a metre beyond the peer's recorded square, and a metre within the one about the sortie's."""
    path = recorded(tmp_path / "r.npz", [[box(8.0, -101.4), NONE, NONE]] * 3)
    share = Share(at(1), "detections", 0.0, None, 1.0)._replace(**of_peer)
    found = flown(path, join="average").detect([(at(0), [share])])[0]
    assert found.score.tolist() == pytest.approx([score])


def test_only_boxes_above_the_threshold_and_one_of_each_car_are_found_or_sent(tmp_path: Path) -> None:
    several = np.concatenate([box(8.0, score=0.9), box(8.2, score=0.7), box(30.0, score=0.2), box(50.0, score=0.15)])
    path = recorded(tmp_path / "r.npz", [[several, several, NONE]] * 3)
    for threshold, count in ((0.05, 3), (0.18, 2), (0.25, 1)):
        detector = flown(path, score_threshold=threshold)
        assert len(detector.detect([(at(0), [])])[0]) == count
        assert detector.count_boxes(at(1), None) == count
        assert detector.count_boxes(at(1), Disc(20.0, 2.0, 35.0)) == min(count, 2)
        assert len(detector.detect([(at(2), [Share(at(1), "detections", 0.0, None, 1.0)])])[0]) == count
    late = flown(path, score_threshold=0.05, fusion="late")
    assert (late.count_boxes(at(1), None), flown(path).count_boxes(at(1), None)) == (1, 3)


def test_the_join_is_the_one_that_is_asked_for_and_a_fused_look_counts_twice(tmp_path: Path) -> None:
    """One car by two boxes a metre apart: the best box, their mean, or a mean nearer to what a map took part in."""
    frames = [[box(10.0, score=0.8), box(-9.0, 0.0, 0.8), NONE]] * 3
    path = recorded(tmp_path / "r.npz", frames, est_pose=POSE)
    boxes, empty = Share(at(1), "detections", 0.0, None, 1.0), Share(at(2), "features", 1.0, None, 1.0)
    x = [
        float(flown(path, join="average").detect([(at(0), shares)])[0].xy_m[0, 0])
        for shares in ([boxes], [boxes, empty])
    ]
    sure = recorded(tmp_path / "s.npz", [[box(10.0, score=0.8), box(-9.0, 0.0, 0.9), NONE]] * 3, est_pose=POSE)
    assert flown(sure, join="nms").detect([(at(0), [boxes])])[0].xy_m.tolist() == [pytest.approx([11.0, 0.0])]
    assert x == [pytest.approx(10.5), pytest.approx(10.0 + 1 / 3, abs=1e-4)]


def test_without_a_look_of_its_own_a_drone_has_what_its_peers_sent(tmp_path: Path) -> None:
    (tmp_path / "f.py").write_text(TELLS)
    maps = [np.stack([score_map(NONE)] * 3)] * 3
    path = recorded(tmp_path / "r.npz", [[box(8.0), box(5.0), NONE]] * 3, features=maps)
    blind, shares = at(0, looked=False), [Share(at(1), "features", 1.0, None, 1.0)]
    for settings in ({}, {"recorded_fusion": f"{tmp_path / 'f.py'}:tell"}):
        assert flown(path, **settings).detect([(blind, shares)])[0].xy_m.tolist() == [pytest.approx((25.0, 2.0))]
        assert len(flown(path, **settings).detect([(blind, [])])[0]) == 0


@pytest.mark.parametrize("own_fusion", [False, True])
def test_without_a_look_of_its_own_what_a_late_map_brings_loses_by_its_age_once(
    own_fusion: bool, tmp_path: Path
) -> None:
    """A fusion of one's own has no part in it, as there is no own map."""
    (tmp_path / "f.py").write_text(TELLS)
    maps = [np.stack([score_map(NONE)] * 3)] * 3
    path = recorded(tmp_path / "r.npz", [[NONE, box(5.0), box(9.0)]] * 3, features=maps)
    shares = [
        Share(at(1, 0.2), "features", 1.0, None, 1.0, age_s=0.0),
        Share(at(2, 0.0), "features", 1.0, None, 0.5, age_s=0.2),
    ]
    settings = {"recorded_fusion": f"{tmp_path / 'f.py'}:tell"} if own_fusion else {}
    found = flown(path, **settings).detect([(at(0, 0.2, looked=False), shares)])[0]
    left = float(still_right(reach_m(np.array([[4.5, 1.9]])), 0.2)[0])
    assert found.score.tolist() == pytest.approx([0.8, 0.8 * 0.5 * left])
    shares.append(Share(at(1, 0.2), "detections", 0.0, None, 1.0))
    beside = flown(path, **settings).detect([(at(0, 0.2, looked=False), shares[1:])])[0]
    assert beside.score.tolist() == pytest.approx([0.8, 0.8 * 0.5 * left]), "nor once more beside fresh boxes"


def test_a_late_map_s_boxes_lose_what_their_age_leaves_once(tmp_path: Path) -> None:
    """Drone 0 sees nothing: the box of drone 1's map keeps its score times weight and what is left."""
    path = recorded(tmp_path / "r.npz", [[NONE, box(5.0), NONE]] * 3, t_s=[0.0, 0.5, 1.0])
    for join, age_s, weight in product(("nms", "average"), (0.0, 0.1, 0.3, 0.8), (1.0, 0.5)):
        share = Share(at(1, 1.0 - age_s), "features", 1.0, None, weight, age_s=age_s)
        (out,) = flown(path, join=join, score_threshold=0.01).detect([(at(0, 1.0), [share])])
        left = float(still_right(reach_m(np.array([[4.5, 1.9]])), age_s)[0])
        assert out.score.tolist() == [pytest.approx(0.8 * weight * left, rel=1e-5)], (join, age_s, weight)


def test_a_late_map_weighs_less_in_a_fusion_of_one_s_own_beside_the_own_look(tmp_path: Path) -> None:
    """Weights arrive in order, the ego's first; what was not sent takes part as zeros or not, as asked."""
    (tmp_path / "f.py").write_text(TELLS)
    maps = [np.stack([score_map(NONE)] * 3)] * 3
    path = recorded(tmp_path / "r.npz", [[NONE] * 3] * 3, features=maps)
    shares = [
        Share(at(1, 0.0), "features", 0.25, None, 0.8, age_s=0.2),
        Share(at(2, 0.2), "features", 0.25, None, 0.6, age_s=0.0),
    ]
    part = {}
    for unsent in ("masked", "zero"):
        detector = flown(path, recorded_fusion=f"{tmp_path / 'f.py'}:tell", unsent_cells=unsent)
        for age_s in (0.0, 0.1):
            both = [s._replace(age_s=s.age_s + age_s) for s in shares]
            found = detector.detect([(at(0, 0.2), both)])[0]
            score = {round(x): s for x, s in zip(found.xy_m[:, 0].tolist(), found.score.tolist(), strict=True)}
            late = 0.8 * map_weight(0.2 + age_s, age_s)
            assert [score[3], score[13], score[23]] == pytest.approx([1.0, late, 0.6], rel=1e-5)
            part[unsent] = score[-47]
    assert part["masked"] < 0.25 < part["zero"]


def test_ages_count_beside_the_own_look_s(tmp_path: Path) -> None:
    """The ego looked 0.2 s ago: a map as old as its look loses nothing, one that is 0.4 s old by the ratio, a newer one
    nothing either."""
    path = recorded(tmp_path / "r.npz", [[NONE, box(5.0, score=0.9), NONE]] * 3, t_s=[0.0, 0.2, 0.4], est_pose=POSE)
    reach = reach_m(np.array([[4.5, 1.9]]))
    newest = Share(at(2, 0.4), "features", 1.0, None, 1.0, age_s=0.0)
    for age_s, left in ((0.0, 1.0), (0.2, 1.0), (0.4, still_right(reach, 0.4) / still_right(reach, 0.2))):
        share = Share(at(1, 0.4 - age_s), "features", 1.0, None, 1.0, age_s=age_s)
        found = flown(path).detect([(at(0, 0.2), [share, newest])])[0]
        assert found.score == pytest.approx(0.9 * np.reshape(left, -1), rel=1e-5)


def test_without_compensation_a_late_map_lies_where_its_sender_is_now(tmp_path: Path) -> None:
    """The sender has moved on by 2 m a frame; cells that arrive lie where it was, or, uncompensated, where it is."""
    moves = np.array([0.0, 2.0, 4.0])[:, None, None] * np.array([1.0, 0.0, 0.0])
    path = recorded(tmp_path / "r.npz", [[NONE, box(5.0), NONE]] * 3, pose=POSE + moves, est_pose=EST + moves)
    ego, now = at(0, 0.2, position_m=(4.0, 0.0, 60.0)), at(1, 0.2, position_m=(24.0, 0.0, 60.0))
    share = Share(at(1, 0.0), "features", 1.0, None, 1.0)
    for compensated, x in ((True, 25.0), (False, 29.0)):
        detector = flown(path, motion_compensation=compensated)
        found = detector.detect([(ego, [share]), (now, [])])[0]
        assert found.xy_m.tolist() == [pytest.approx((x, 2.0), abs=1e-5)]
        assert detector.detect([(ego, [share])])[0].xy_m[0, 0] == pytest.approx(25.0)  # nobody knows where it is


def test_of_two_frames_as_near_the_earlier_is_taken_and_a_gap_is_not_flown_over(tmp_path: Path) -> None:
    boxes = [[box(10.0 * k), NONE, NONE] for k in range(4)]
    still = dict(pose=POSE[[0] * 4], est_pose=POSE[[0] * 4], truth=[np.zeros((0, 5))] * 4)
    path = recorded(tmp_path / "r.npz", boxes, t_s=[0.0, 0.25, 0.5, 2.0], **still)
    detector = flown(path)
    for t_s, x in ((0.0, 0.0), (0.125, 0.0), (0.13, 10.0), (0.375, 10.0), (0.75, 20.0), (1.75, 30.0)):
        assert detector.detect([(at(0, t_s), [])])[0].xy_m[0, 0] == pytest.approx(x, abs=1e-5)
    for t_s in (0.8, 1.7, 2.3):
        with pytest.raises(RecordingError, match=r"must be within 0\.25 s of a frame"):
            detector.detect([(at(0, t_s), [])])
    for call, message in (
        (lambda: detector.detect([(at(0)._replace(drone=3), [])]), r"drone 3 is not in it, must be one of 0 … 2"),
        (lambda: detector.truth(9.0, at(0)), r"truth is needed at 9 s, must be within 0\.25 s"),
        (
            lambda: detector.detect([(capture(40.0, t_s=0.0), [])]),
            r"drone 0 at 0 s flies 40\.0 m from where it was rec",
        ),
    ):
        with pytest.raises(RecordingError, match=message):
            call()
