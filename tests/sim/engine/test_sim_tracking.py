"""Trackers in flight: who names the target, what the `tracks` rung carries, and that asking does not change the answer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sortie.fleet.coverage import TARGET_FLAG
from sortie.perception import budget, joining
from sortie.perception.detectors import make_detector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Directive, FleetView, Representation
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scene, Target
from sortie.sim.engine import tracking as tracking_module
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.engine.tracking import CUE_S, WARM_UP_S, FleetTracking, TargetSeen
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

TRACKING = ["duration_s=12", "mission.phases=[{at_s: 0, phase: track, region: {radius_m: 32}}]"]
LEVEL = (0.0, 0.0, 0.0, 1.0)


def looking_down(drone: int, t_s: float, x_m: float = 0.0, y_m: float = 0.0) -> Capture:
    return Capture(drone, t_s, (x_m, y_m, 60.0), LEVEL, (x_m, y_m, 60.0), 0.0)


def naming(record: SortieRecord) -> list[tuple[float, bool]]:
    rows = record.tables["descriptors"].to_pylist()
    return [(row["t_s"], bool(row["novelty_flags"] & TARGET_FLAG)) for row in rows]


@pytest.mark.parametrize("detector", ["surrogate", "none"])
def test_a_drone_names_the_target_once_it_has_a_confirmed_track_of_it(detector: str) -> None:
    """Three looks half a second apart confirm a track; the mission says from the first frame on where the target is."""
    named = naming(run_sortie(load("track_target", [*TRACKING, f"perception.detector={detector}"])))
    assert not any(is_ for t_s, is_ in named if t_s < 1.0)
    assert np.mean([is_ for t_s, is_ in named if t_s > 6.0]) > 0.7


def test_what_a_drone_cannot_see_it_does_not_name() -> None:
    blind = ["perception.detector=surrogate", "perception.score_threshold=0.99"]
    assert not any(is_ for _, is_ in naming(run_sortie(load("track_target", [*TRACKING, *blind]))))


def test_without_a_detector_a_target_is_found_in_the_pictures_of_the_cameras_alone() -> None:
    """Beyond the map, and in the gap between two side cameras, there is none."""
    bare = Scene(building_density=0, tree_density=0)

    def sees(x_m: float, y_m: float) -> bool:
        scene = SceneModel(bare, Target(waypoints_m=((x_m, y_m),)), (-300.0, -300.0, 300.0, 300.0))
        [boxes] = TargetSeen(scene)([looking_down(0, 1.0)])
        return len(boxes) == 1

    assert sees(10.0, 10.0)
    assert sees(70.0, 0.0)
    assert not sees(150.0, 0.0)
    assert not sees(60.0, 60.0)


class Driving:
    """Own detections: a car that drives east, found in every capture; and how often they were asked for."""

    def __init__(self) -> None:
        self.asked = 0

    def __call__(self, captures: list[Capture]) -> list[Boxes]:
        self.asked += len(captures)
        return [
            Boxes(np.array([[8.0 * c.t_s, float(c.drone)]]), np.array([[4.6, 1.9]]), np.zeros(1), np.ones(1))
            for c in captures
        ]


def tracker(*sets: str) -> tuple[FleetTracking, Driving]:
    own = Driving()
    return FleetTracking(load("track_target", ["duration_s=10", *sets]), own), own


def test_tracks_do_not_depend_on_when_they_are_asked_for() -> None:
    (often, _), (once, _) = tracker(), tracker()
    for frame in range(30):
        for drone in range(5):
            for tracking in (often, once):
                tracking.perceived(looking_down(drone, frame * 0.1))
            often.tracks(drone)
    for drone in range(5):
        a, b = often.tracks(drone), once.tracks(drone)
        assert len(a) == 1
        for name in type(a).__slots__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_nothing_is_detected_for_trackers_that_nobody_asks_and_old_looks_are_not_made_up_for() -> None:
    tracking, own = tracker()
    for frame in range(100):
        tracking.perceived(looking_down(0, frame * 0.1))
    assert own.asked == 0
    tracking.tracks(0)
    looks_s = [0.1 * frame for frame in load("track_target", ["duration_s=10"]).tracked_frames]
    assert own.asked == sum(t_s >= looks_s[-1] - WARM_UP_S - 1e-6 for t_s in looks_s) < len(looks_s) / 2


@pytest.mark.parametrize("every_s", [0.1, 0.4, 0.8, 2.0])
def test_a_target_s_velocity_is_that_of_its_cues_however_rarely_they_come(
    every_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracking, _ = tracker()
    asked = []
    monkeypatch.setattr(
        tracking_module, "followed", lambda tracks, cues, before, t_s: asked.append((t_s, cues[0])) or {}
    )
    for k in range(round(8 / every_s)):
        t_s = k * every_s
        tracking.follows(0, 0, (8.0 * t_s, -3.0 * t_s), t_s)
    assert len(asked) >= 3
    for t_s, cue in asked:
        assert cue == pytest.approx((8.0 * t_s, -3.0 * t_s, 8.0, -3.0))


def test_a_drone_that_looks_no_more_stops_naming_the_target() -> None:
    tracking, _ = tracker()

    def follows(t_s: float) -> bool:
        return tracking.follows(0, 0, (8.0 * t_s, 0.0), t_s)

    named = {}
    for frame in range(100):
        t_s = frame * 0.1
        if t_s < 4.0:
            tracking.perceived(looking_down(0, t_s))
        named[frame] = follows(t_s)
    assert not any(named[frame] for frame in range(10))
    assert all(named[frame] for frame in range(20, 50))  # it coasts
    assert not any(named[frame] for frame in range(70, 100))
    assert CUE_S == 0.5


@pytest.mark.parametrize(("sample", "tracking"), [(2.0, 2.0), (10.0, 2.0), (0.5, 2.0), (3.0, 2.0), (2.0, 10.0)])
def test_trackers_look_where_accuracy_is_scored_if_that_is_often_enough(sample: float, tracking: float) -> None:
    rates = [f"perception.sample_rate_hz={sample}", f"perception.tracking_rate_hz={tracking}"]
    scenario = load("track_target", ["duration_s=20", *rates])
    frames = scenario.tracked_frames
    assert len(frames) == round(20 * tracking)
    assert frames == sorted(set(frames))
    if sample >= 2.0 * tracking or sample == tracking:
        assert set(frames) <= set(scenario.scored_frames)


def tracks_to_all(view: FleetView) -> list[Directive]:
    return [
        Directive(view.ego, peer, Representation.TRACKS, 0.0, None, 10.0, reason="tracks to all") for peer in view.peers
    ]


def test_a_payload_of_tracks_has_twenty_bytes_for_each_confirmed_track() -> None:
    rows: list[dict[str, Any]] = run_sortie(
        load("track_target", ["perception.detector=surrogate", "duration_s=6"]), tracks_to_all
    ).tables["transmissions"].to_pylist()  # fmt: skip
    assert {row["payload_bytes"] - 76 - budget.TRACK_BYTES * row["boxes"] for row in rows} == {0}
    assert max(row["boxes"] for row in rows) == budget.MAX_TRACKS


def detections_each_second(view: FleetView) -> list[Directive]:
    return [
        Directive(view.ego, peer, Representation.DETECTIONS, 0.0, None, 1.0, reason="boxes to all")
        for peer in view.peers
    ]


@pytest.mark.parametrize("policy", [detections_each_second, tracks_to_all])
def test_what_arrives_late_is_moved_to_the_receivers_time(policy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Boxes that are a second old find more of the cars that drive when they are moved."""
    late = ["perception.detector=surrogate", "duration_s=16", "perception.max_age_s=2", "perception.join=average"]
    scenario = load("track_target", [*late, "perception.scene.moving_cars_per_km=30", "perception.compute_delay_s=0.8"])

    def found() -> float:
        return outcome(run_sortie(scenario, policy))["ap50"]["full_scene"]

    moved = found()
    monkeypatch.setattr(joining, "motion_of", lambda tracks, age_s: (None, None))
    monkeypatch.setattr(joining, "motion_of_boxes", lambda boxes, t_s, age_s, tracks: (None, None))
    assert moved > found() + 0.03


class Blind:
    """A detector that finds nothing, and leaves what trackers take in to another."""

    name = "blind"

    def __init__(self, looks: Any) -> None:
        self.looks, self.truth, self.count_boxes = looks, looks.truth, looks.count_boxes

    def detect(self, jobs: list[Any]) -> list[Boxes]:
        return [Boxes.empty() for _ in jobs]

    def camera_views(self, capture: Capture) -> Any:
        raise NotImplementedError


def test_a_detector_may_leave_the_trackers_to_another() -> None:
    """So a flight scored by another detector decides as the first one's."""
    scenario = load("track_target", [*TRACKING, "duration_s=5", "perception.detector=surrogate"])

    def made(*arguments: Any) -> Any:
        return Blind(make_detector(*arguments))

    one, other = run_sortie(scenario), run_sortie(scenario, detector_of=made)
    assert other.tables["detections"].num_rows == 0
    assert one.tables["descriptors"].equals(other.tables["descriptors"])
    assert any(is_ for _, is_ in naming(other))


def test_groups_name_their_own_targets() -> None:
    second = "mission.more_targets=[{waypoints_m: [[-240, 1.75], [200, 1.75]], speed_mps: 4}]"
    groups = "mission.groups=[{drones: [1, 2], phases: [{phase: track, target: 1, region: {radius_m: 32}}]}]"
    scenario = load("track_target", [*TRACKING, second, groups, "perception.detector=none", "record.views=true"])
    rows = run_sortie(scenario).tables["view_descriptors"].to_pylist()
    named = {(row["agent_id"], target) for row in rows for target in row["priority_target_ids"]}
    assert named == {(0, 0), (3, 0), (4, 0), (1, 1), (2, 1)}
