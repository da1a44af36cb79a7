"""What a receiver may conclude of a share: tracks that may have been cut, tentative tracks, cells that went missing, where it lies.

And what is said beforehand, at the moment it is said: how many boxes a drone would send, where false alarms lie.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from perception_examples import capture
from recording_examples import small

from sortie.perception import budget
from sortie.perception.classes import CAR, PERSON
from sortie.perception.joining import source_of
from sortie.perception.motion import Tracks
from sortie.perception.recordings.detector import RecordedDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.thermal import look
from sortie.perception.tracking.following import motion_of_boxes
from sortie.perception.types import Boxes, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception, Scene, Target, Thermal
from sortie.sim.engine.fusing import of_vehicles

BARE = SceneModel(Scene(building_density=0.0, tree_density=0.0), None, (0.0, 0.0, 80.0, 80.0))


def tracks(n: int, confirmed: bool = True, **changes: Any) -> Tracks:
    """n cars on a row, 10 m apart, that drive north."""
    one, number = np.zeros(n), np.arange(n)
    values: dict[str, Any] = {
        "owner": number * 0, "id": number, "t_s": one, "xy_m": np.stack([10.0 * number, one], axis=1),
        "velocity_mps": np.tile([0.0, 8.0], (n, 1)), "covariance": np.tile([0.2, 0.0, 0.1], (n, 1)),
        "size_m": np.tile([4.5, 1.9], (n, 1)), "yaw_rad": one, "score": one + 0.8, "hits": number * 0 + 3,
        "looks": number * 0 + 3, "seen_s": one, "confirmed": np.full(n, confirmed),
    }  # fmt: skip
    return Tracks(**(values | changes))


# --- tracks -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 11, 12])
def test_as_many_tracks_as_a_payload_holds_may_have_been_more(n: int) -> None:
    """Twelve are the most that are sent, so of a full list nobody knows whether it was cut."""
    share = Share(capture(), "tracks", 0.0, None, 0.5, tracks=tracks(n))
    source = source_of(share, None)
    assert len(source.boxes) == n
    assert source.truncated == (n == budget.MAX_TRACKS)


@pytest.mark.parametrize("n", [11, 12])
def test_people_in_a_full_payload_of_tracks_do_not_hide_that_it_was_cut(n: int) -> None:
    """A detector gets the cars alone; that a car is missing among them means nothing where the payload was full."""
    kind = np.where(np.arange(n) < 3, PERSON, CAR).astype(np.int8)
    source = source_of(of_vehicles(Share(capture(), "tracks", 0.0, None, 0.5, tracks=tracks(n, kind=kind))), None)
    assert len(source.boxes) == n - 3
    assert source.truncated == (n == budget.MAX_TRACKS)


def test_only_a_confirmed_track_says_how_a_box_moves() -> None:
    """What a tentative one follows may be a false positive; a confirmed one farther away is taken in its place."""
    box = Boxes(np.array([[10.0, 0.0]]), np.array([[4.5, 1.9]]), np.zeros(1), np.ones(1))
    velocity, _ = motion_of_boxes(box, 0.0, 0.5, tracks(3))
    assert velocity == pytest.approx(np.array([[0.0, 8.0]]))
    velocity, variance = motion_of_boxes(box, 0.0, 0.5, tracks(3, confirmed=False))
    assert np.isnan(velocity).all()
    assert np.isnan(variance).all()
    mixed = tracks(
        2, xy_m=np.array([[10.0, 0.0], [11.0, 0.5]]), velocity_mps=np.array([[9.0, 0.0], [0.0, 8.0]]),
        confirmed=np.array([False, True]),
    )  # fmt: skip
    velocity, _ = motion_of_boxes(box, 0.0, 0.5, mixed)
    assert velocity == pytest.approx(np.array([[0.0, 8.0]]))


# --- a recording in flight --------------------------------------------------------------------------------------------


def recorded(path: Path, **config: Any) -> RecordedDetector:
    return RecordedDetector(Perception(detector="recorded", recording=str(small(path, features=None)), **config))


@pytest.mark.parametrize(
    ("missing", "comes"), [((), True), ((0,), False), ((1, 2, 3), True), (tuple(range(4096)), False)]
)
def test_of_a_whole_map_the_cells_that_went_missing_are_those_of_their_rank(
    missing: tuple[int, ...], comes: bool, tmp_path: Path
) -> None:
    """Also where nothing has to be chosen, because every cell was sent: the best cell is the one with the box."""
    ego, peer = (capture(10.0 * i, 0.0, drone=i, t_s=0.0) for i in range(2))
    (boxes,) = recorded(tmp_path / "r.npz").detect([(ego, [Share(peer, "features", 1.0, None, 1.0, missing)])])
    assert len(boxes) == 1 + comes


@pytest.mark.parametrize("compensated", [True, False])
def test_a_late_record_lies_where_its_sender_was_or_is(compensated: bool, tmp_path: Path) -> None:
    """The fleet flies a metre from one frame to the next, and so does a box that is placed by where its sender is."""
    detector = recorded(tmp_path / "r.npz", motion_compensation=compensated)
    ego, peer = (capture(1.0 + 10.0 * i, 0.0, drone=i, t_s=0.1) for i in range(2))
    was = capture(10.0, 0.0, drone=1, t_s=0.0)
    boxes = detector.detect([(ego, [Share(was, "features", 1.0, None, 1.0)]), (peer, [])])[0]
    (x,) = boxes.xy_m[boxes.xy_m[:, 1] > 10, 0]
    assert x == pytest.approx(10.0 if compensated else 11.0, abs=1e-4)
    alone = detector.detect([(ego, [Share(was, "features", 1.0, None, 1.0)])])[0]  # nobody knows where it is now
    assert alone.xy_m[alone.xy_m[:, 1] > 10, 0] == pytest.approx([10.0], abs=1e-4)


# --- what is said beforehand ------------------------------------------------------------------------------------------


@cache
def certain() -> SurrogateDetector:
    """A surrogate that finds every car and nothing else, alone."""
    scene = SceneModel(Scene(moving_cars_per_km=40), Target(waypoints_m=((0, 0), (100, 0))), (-50.0, -50.0, 50.0, 50.0))
    made = SurrogateDetector(scene, Perception(), 3)
    made._found_alone, made._alarms_alone = 1.0, 0.0
    return made


@pytest.mark.parametrize("roi", [Disc(0.0, 0.0, 40.0), Disc(20.0, -15.0, 25.0), Disc(60.0, 40.0, 70.0)])
def test_boxes_are_announced_of_the_cars_that_are_there_at_the_capture(roi: Disc) -> None:
    """In the disc, and in the drone's square where the disc leaves it."""
    counts = []
    for t_s in (0.0, 7.0, 20.0, 41.0):
        at = capture(5.0, -3.0, t_s=t_s)
        counts.append(certain().count_boxes(at, roi))
        assert counts[-1] == len(certain().truth(t_s, at).inside(roi))
    assert len(set(counts)) > 1


def test_false_alarms_lie_evenly_in_the_cone() -> None:
    """As many in each ring and sector of one area, scored as a person there would be."""
    camera, at = Thermal(false_alarms_per_min=400), capture(40.0, 40.0, 60.0)
    found = [s for k in range(2500) for s in look(camera, np.zeros((0, 2)), BARE.height_field, at, k, 0.1, (1, 0))]
    away = np.array([(s.x_m - 40.0, s.y_m - 40.0) for s in found])
    share = (away**2).sum(axis=1) / (60.0 * math.tan(math.radians(35.0))) ** 2
    assert len(found) > 800
    assert share.max() <= 1.0
    rings = np.histogram(share, bins=8, range=(0, 1))[0]
    sectors = np.histogram(np.arctan2(away[:, 1], away[:, 0]), bins=8, range=(-np.pi, np.pi))[0]
    for counts in (rings, sectors):
        wanted = len(found) / 8
        assert ((counts - wanted) ** 2 / wanted).sum() < 29.9  # chi square, seven degrees: one in ten thousand
