"""Trackers: who names the target, what the `tracks` rung carries, and that asking does not change the answer."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from agent_rig import capture
from recorded import recorded
from sim_examples import example

from sortie.fleet.coverage import TARGET_FLAG
from sortie.perception import budget, joining
from sortie.perception.detectors import make_detector
from sortie.perception.motion import Tracks
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Directive, FleetView, Representation
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scene, Target
from sortie.sim.engine import tracking as tracking_module
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.engine.tracking import CUE_S, WARM_UP_S, Ahead, FleetTracking, TargetSeen
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

TRACK = "mission.phases=[{at_s: 0, phase: track, region: {radius_m: 32}}]"


def naming(record: SortieRecord) -> list[tuple[float, bool]]:
    rows = record.tables["descriptors"].to_pylist()
    return [(row["t_s"], bool(row["novelty_flags"] & TARGET_FLAG)) for row in rows]


# --- in flight -----------------------------------------------------------------------------------


def test_a_drone_names_the_target_once_it_has_a_confirmed_track_of_it() -> None:
    """Flights of their own: the mission has the target from the first frame on, and three looks confirm a track."""
    sets = ("duration_s=6", "fleet.drones=3", TRACK)
    for detector in ("surrogate", "none"):
        named = naming(run_sortie(load("track_target", [*sets, f"perception.detector={detector}"]), "silence"))
        assert not any(is_ for t_s, is_ in named if t_s < 1.0)
        assert np.mean([is_ for t_s, is_ in named if t_s > 4.0]) > 0.6
    blind = ["perception.detector=surrogate", "perception.score_threshold=0.99"]
    assert not any(is_ for _, is_ in naming(run_sortie(load("track_target", [*sets, *blind]), "silence")))


def test_groups_name_their_own_targets() -> None:
    record = recorded("mission_groups")
    named = {
        (row["drone"], bool(row["novelty_flags"] & TARGET_FLAG)) for row in record.tables["descriptors"].to_pylist()
    }
    assert {(drone, True) for drone in range(5)} <= named
    early = [row for row in record.tables["descriptors"].to_pylist() if row["drone"] > 2 and row["t_s"] < 3.0]
    assert not any(row["novelty_flags"] & TARGET_FLAG for row in early), "their group searches until 3 s"


def tracks_to_all(view: FleetView) -> list[Directive]:
    return [Directive(view.ego, peer, Representation.TRACKS, 0.0, None, 10.0, reason="tracks") for peer in view.peers]


def boxes_each_second(view: FleetView) -> list[Directive]:
    return [Directive(view.ego, peer, Representation.DETECTIONS, 0.0, None, 1.0, reason="boxes") for peer in view.peers]


def test_a_payload_of_tracks_has_twenty_bytes_for_each_confirmed_track() -> None:
    sets = ["perception.detector=surrogate", "duration_s=4", "fleet.drones=3", "mission.phases=[{}]"]
    rows = run_sortie(load("track_target", sets), tracks_to_all).tables["transmissions"].to_pylist()
    assert {row["payload_bytes"] - 76 - budget.TRACK_BYTES * row["boxes"] for row in rows} == {0}
    assert max(row["boxes"] for row in rows) == budget.MAX_TRACKS


@pytest.mark.parametrize("policy", [boxes_each_second, tracks_to_all])
def test_what_arrives_late_is_moved_to_the_receivers_time(policy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Flights of their own: boxes that are a second old find more of the cars that drive when they are moved."""
    late = ["perception.max_age_s=2", "perception.join=average", "perception.compute_delay_s=0.8", "duration_s=16"]
    cars = ["perception.detector=surrogate", "perception.scene.moving_cars_per_km=30", "fleet.drones=4"]
    scenario = load("track_target", [*late, *cars, "mission.phases=[{}]"])

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
    one = recorded("mission_groups")
    made: Any = lambda *arguments: Blind(make_detector(*arguments))  # noqa: E731
    other = run_sortie(one.scenario, detector_of=made)
    assert other.tables["detections"].num_rows == 0
    assert str(one.tables["descriptors"].to_pydict()) == str(other.tables["descriptors"].to_pydict())


# --- trackers, by hand ---------------------------------------------------------------------------


class Driving:
    """Own detections: a car that drives east, found in every capture; and how often they were asked for."""

    def __init__(self) -> None:
        self.asked = 0

    def __call__(self, captures: Sequence[Capture]) -> list[Boxes]:
        self.asked += len(captures)
        return [
            Boxes(np.array([[8.0 * c.t_s, 100.0 * c.drone]]), np.array([[4.6, 1.9]]), np.zeros(1), np.ones(1))
            for c in captures
        ]


def tracker() -> tuple[FleetTracking, Driving]:
    own = Driving()
    return FleetTracking(load("track_target", ["duration_s=10"]), own), own


def test_without_a_detector_a_target_is_found_in_the_pictures_of_the_cameras_alone() -> None:
    """Beyond the map, and in the gap between two side cameras, there is none."""
    bare = Scene(building_density=0, tree_density=0)
    for x_m, y_m, sees in ((10.0, 10.0, True), (70.0, 0.0, True), (150.0, 0.0, False), (60.0, 60.0, False)):
        scene = SceneModel(bare, Target(waypoints_m=((x_m, y_m),)), (-300.0, -300.0, 300.0, 300.0))
        [boxes] = TargetSeen(scene)([capture(0, 1.0)])
        assert (len(boxes) == 1) is sees


def test_tracks_do_not_depend_on_when_they_are_asked_for_nor_on_whose_look_comes_first() -> None:
    (often, _), (once, _) = tracker(), tracker()
    for frame in range(30):
        for drone in (3, 0, 2):
            for tracking in (often, once):
                tracking.perceived(capture(drone, frame * 0.1))
            often.tracks(drone)
    for drone in (0, 2, 3):
        a, b = often.tracks(drone), once.tracks(drone)
        assert [round(y) for _, y in a.xy_m.tolist()] == [100 * drone]
        for name in type(a).__slots__:
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert len(once.tracks(1)) == len(once.tracks(4)) == 0
    before = once.tracks(0)
    assert once.tracks(0) is before
    for frame in range(30, 40):
        once.perceived(capture(0, frame * 0.1))
    assert once.tracks(0) is not before, "after further looks it is asked for anew"


def test_nothing_is_detected_for_trackers_that_nobody_asks_and_old_looks_are_not_made_up_for() -> None:
    tracking, own = tracker()
    for frame in range(100):
        tracking.perceived(capture(0, frame * 0.1))
    assert own.asked == 0
    tracking.tracks(0)
    looks_s = [0.1 * frame for frame in load("track_target", ["duration_s=10"]).tracked_frames]
    assert own.asked == sum(t_s >= looks_s[-1] - WARM_UP_S - 1e-6 for t_s in looks_s) < len(looks_s) / 2


def test_after_a_rest_a_tracker_takes_one_look_and_then_those_that_are_due() -> None:
    scenario = example("duration_s=10", "perception.detector=surrogate")
    looks_s = [frame * scenario.frame_s for frame in scenario.tracked_frames]
    seen: list[float] = []

    def own(captures: Sequence[Capture]) -> list[Boxes]:
        seen.extend(c.t_s for c in captures)
        return [Boxes.empty() for _ in captures]

    tracking = FleetTracking(scenario, own)
    due, last_s = list[float](), -1.0
    for t_s in (0.1 * frame for frame in (*range(5), *range(30, 40))):
        tracking.perceived(capture(0, t_s))
        if any(last_s < look_s <= t_s + 1e-6 for look_s in looks_s):
            due.append(t_s)
            last_s = t_s + 1e-6
    tracking.tracks(0)
    assert seen == due
    assert len(due) < 5


def test_a_target_s_velocity_is_that_of_its_cues_however_rarely_they_come(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[float, Any]] = []
    monkeypatch.setattr(
        tracking_module, "followed", lambda tracks, cues, before, t_s: asked.append((t_s, cues[0])) or {}
    )
    for every_s in (0.1, 0.4, 0.8, 2.0):
        asked.clear()
        tracking, _ = tracker()
        for k in range(round(8 / every_s)):
            t_s = k * every_s
            tracking.follows(0, 0, (8.0 * t_s, -3.0 * t_s), t_s)
        assert len(asked) >= 3
        for t_s, cue in asked:
            assert cue == pytest.approx((8.0 * t_s, -3.0 * t_s, 8.0, -3.0))


def test_two_targets_are_kept_apart_also_in_one_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mission may change its target between two decisions: what was judged of one decides nothing about the other."""
    asked: list[tuple[int, float]] = []

    def followed(tracks: Tracks, cues: dict[int, Any], before: Any, now_s: float) -> dict[int, int]:
        (target,) = cues
        asked.append((target, now_s))
        return {target: 4} if target == 1 else {}

    monkeypatch.setattr(tracking_module, "followed", followed)
    tracking, _ = tracker()
    for k in range(6):
        for target in (0, 1):
            tracking.follows(0, target, (float(k), 0.0), 0.1 * k)
    assert asked == [(0, 0.5), (1, 0.5)]
    assert [tracking.follows(0, target, (5.0, 0.0), 0.5) for target in (1, 0, 1)] == [True, False, True]


def test_a_drone_that_looks_no_more_stops_naming_the_target() -> None:
    tracking, _ = tracker()
    named = {}
    for frame in range(100):
        t_s = frame * 0.1
        if t_s < 4.0:
            tracking.perceived(capture(0, t_s))
        named[frame] = tracking.follows(0, 0, (8.0 * t_s, 0.0), t_s)
    assert not any(named[frame] for frame in range(10))
    assert all(named[frame] for frame in range(20, 50))  # it coasts
    assert not any(named[frame] for frame in range(70, 100))
    assert CUE_S == 0.5


def test_trackers_look_where_accuracy_is_scored_if_that_is_often_enough() -> None:
    for sample, rate in ((2.0, 2.0), (10.0, 2.0), (0.5, 2.0), (3.0, 2.0), (2.0, 10.0)):
        rates = [f"perception.sample_rate_hz={sample}", f"perception.tracking_rate_hz={rate}"]
        scenario = load("track_target", ["duration_s=20", *rates])
        frames = scenario.tracked_frames
        assert len(frames) == round(20 * rate)
        assert frames == sorted(set(frames))
        if sample >= 2.0 * rate or sample == rate:
            assert set(frames) <= set(scenario.scored_frames)


def test_what_trackers_take_in_next_is_of_all_drones_frame_by_frame() -> None:
    scenario = load("track_target", ["duration_s=10"])
    frame_s, n = scenario.frame_s, scenario.fleet.drones
    coming = Ahead(scenario, SimpleNamespace(capture=lambda drone, frame: capture(drone, frame * frame_s))).after
    frames = scenario.tracked_frames
    first = [(c.drone, round(c.t_s / frame_s)) for c in list(coming(-1.0))[: 2 * n]]
    assert first == [(d, f) for f in frames[:2] for d in range(n)]
    after_s = frames[3] * frame_s
    assert next(iter(coming(after_s))).t_s == frames[4] * frame_s
    assert next(iter(coming(after_s - 0.01))).t_s == after_s
    assert list(coming(10.0)) == []
