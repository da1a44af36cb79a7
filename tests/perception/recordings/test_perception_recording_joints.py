"""A flown recording where true and believed poses, times, weights and ages all differ, so that none passes for another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from perception_examples import capture
from recording_examples import score_map, small

from sortie.perception.evaluation import evaluate_recording
from sortie.perception.evaluation.recorded import RecordedInstrument, content_hash, frames_of
from sortie.perception.evaluation.sharing import Exchange
from sortie.perception.lateness import map_weight, reach_m, still_right
from sortie.perception.motion import Tracks
from sortie.perception.recordings.detector import RecordedDetector
from sortie.perception.recordings.exchange import Sent, fusion_hash, received_boxes
from sortie.perception.recordings.recording import RecordingError, open_recording
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception

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


def test_truth_is_about_the_true_pose_and_of_the_time_that_is_asked_for(tmp_path: Path) -> None:
    """At the square's edge of one pose, 3 m from the other's; in the second frame the cars have driven on by 4 m."""
    cars = np.array([(104.0, 0, 4.5, 1.9, 0), (-101.0, 5, 4.5, 1.9, 0)])
    detector = flown(recorded(tmp_path / "r.npz", [[NONE] * 3] * 3, truth=[cars, cars - [4.0, 0, 0, 0, 0], cars]))
    for now_s, seen in ((0.0, [-101.0]), (0.1, [100.0])):
        for look_s in (0.0, 0.1):
            assert detector.truth(now_s, at(0, look_s)).xy_m[:, 0] == pytest.approx(seen)


def test_boxes_stand_by_the_believed_pose_of_the_recording(tmp_path: Path) -> None:
    """Own and received ones; a drone of the sortie believes something else, and may fly where the recorded one truly was."""
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
        (
            {"representation": "detections", "boxes": Boxes.empty()},
            0.4,
        ),  # of another network, which flies as the sortie does
    ],
)
def test_a_peer_that_sees_nothing_votes_in_the_square_about_its_recorded_pose(
    of_peer: dict[str, Any], score: float, tmp_path: Path
) -> None:
    """The car lies a metre beyond the peer's recorded square, and a metre within the one about where the sortie has it."""
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
    """One car by two boxes a metre apart: the best box, the mean of both, or a mean nearer to what a map took part in."""
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
    beside = flown(path, **settings).detect(
        [(at(0, 0.2, looked=False), [s for s in shares if s.weight < 1.0 or not s.is_map])]
    )[0]
    assert beside.score.tolist() == pytest.approx([0.8, 0.8 * 0.5 * left]), "nor once more beside fresh boxes"


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
    path = recorded(
        tmp_path / "r.npz", boxes, t_s=[0.0, 0.25, 0.5, 2.0], pose=POSE[[0] * 4], est_pose=POSE[[0] * 4], truth=[np.zeros((0, 5))] * 4
    )  # fmt: skip
    detector = flown(path)
    for t_s, x in ((0.0, 0.0), (0.125, 0.0), (0.13, 10.0), (0.375, 10.0), (0.75, 20.0), (1.75, 30.0)):
        assert detector.detect([(at(0, t_s), [])])[0].xy_m[0, 0] == pytest.approx(x, abs=1e-5)
    for t_s in (0.8, 1.7, 2.3):
        with pytest.raises(RecordingError, match=r"must be within 0\.25 s of a frame"):
            detector.detect([(at(0, t_s), [])])
    with pytest.raises(RecordingError, match="drone 3 is not in it"):
        detector.detect([(at(0)._replace(drone=3), [])])


def test_a_cell_ranks_by_its_best_box_whichever_comes_last(tmp_path: Path) -> None:
    for order in ([0, 1, 2], [2, 1, 0]):
        boxes = np.concatenate([box(8.0, 1.0, 0.9), box(8.5, 1.5, 0.3), box(500.0, 0.0, 1.0)])[order]
        rank = open_recording(recorded(tmp_path / "r.npz", [[boxes, NONE, NONE]] * 3)).rank(0, 0)
        assert (rank[34, 32], rank.sum()) == (0.9, 0.9)


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
    assert (
        RecordedInstrument(rec, names[1]).look(frames_of(rec), 0).detect([alone], 0.0)[0].tolist() == box(8.0).tolist()
    )
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
    """A box beyond the sender's grid has no cell; one beyond the ego's square is not the ego's; a box turns with its frame."""
    far = np.concatenate([box(0.0, 40.0), box(5.0, -101.0), box(110.0, 0.0), box(-101.0, -101.0)])
    rec = open_recording(recorded(tmp_path / "r.npz", [[box(8.0), far, NONE]] * 3))
    cells = np.ones((64, 64), bool)
    here, there = (0.0, 0.0, 0.5), (30.0, -20.0, 0.5 + np.pi / 2)
    sent = [Sent(0, 1, cells, there, 0.5)]
    found = received_boxes(rec, (0, 0), here, sent)
    turn = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    middle = turn @ [30.0, -20.0]
    np.testing.assert_allclose(found[0], box(8.0)[0])
    expected = [
        (middle[0] - 40.0, middle[1]),
        (middle[0] + 101.0, middle[1] + 5.0),
        (middle[0] + 101.0, middle[1] - 101.0),
    ]
    inside = [at for at in expected if max(map(abs, at)) < 102.4]
    np.testing.assert_allclose(found[1:, :2], inside)
    assert len(inside) == 1
    assert found[1:, 4] == pytest.approx(0.1 + np.pi / 2)
    assert found[1:, 5] == pytest.approx(0.4)
    assert len(received_boxes(rec, None, here, sent)) == 1
    wide = received_boxes(rec, None, there, [Sent(0, 1, cells, there)])
    assert wide[:, 0].tolist() == [0.0, 5.0, -101.0]
