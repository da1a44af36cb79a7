"""The mission's figures: closed forms, cameras projected in another way, and survivors that do not flatter."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recorded import recorded
from scipy.spatial.transform import Rotation
from shapely.geometry import Point, Polygon, box
from sim_examples import example

from sortie.perception.geometry import FULL, HALF_H, HALF_V
from sortie.perception.metrics.ap import Matched, average_precision
from sortie.perception.scene.render import AXES
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Directive, FleetView
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.accuracy import both_matched
from sortie.sim.results.explain import explain_metric
from sortie.sim.results.mission_outcome import _flown_share, sees_ground
from sortie.sim.results.outcome import check_number, open_keys, outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.regions import Regions
from sortie.sim.results.report import page
from sortie.sim.results.sightings import sightings
from sortie.sim.results.summary import Summary, outcome_table

STILL = ("fleet.route.waypoints_m=[[0, 0]]", "fleet.motion={wind_mps: [0, 0], gust_sigma_mps: 0, pose_jitter_m: 0}")
"""Drones that hover level where their slots are, 60 m above the ground."""
ONE = (*STILL, "fleet.drones=1")
APART = (*STILL, "fleet.drones=2", "fleet.formation={shape: line, spacing_m: 400}")
ALL_LOST = "events=[" + ", ".join(f"{{kind: drone_lost, at_s: 1, drone: {i}}}" for i in range(5)) + "]"


def mission(*overrides: str, policy: Any = "silence") -> dict[str, Any]:
    """Of a flight of its own: the figures have closed forms for drones that hover, and no recorded fleet does."""
    return outcome(run_sortie(example(*overrides), policy))["mission"]  # type: ignore[no-any-return]


def regions(radius_m: float, *y_m: float) -> str:
    """One disc a second at these places north of the origin."""
    discs = [
        f"{{at_s: {k}, phase: search, region: {{centre_m: [0, {y}], radius_m: {radius_m}}}}}" for k, y in enumerate(y_m)
    ]
    return f"mission.phases=[{', '.join(discs)}]"


# --- the cameras ---------------------------------------------------------------------------------


def corners_m(axes: np.ndarray, height_m: float) -> list[tuple[float, float]]:
    """Where the corners of a level camera's picture meet the ground, about the point below the drone."""
    out = []
    for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        ray = u * HALF_H * axes[0] + v * HALF_V * axes[1] + axes[2]
        out.append((float(-ray[0] / ray[2] * height_m), float(-ray[1] / ray[2] * height_m)))
    return out


@given(
    height_m=st.floats(20, 120),
    euler_deg=st.tuples(st.floats(-180, 180), st.floats(-25, 25), st.floats(-25, 25)),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_place_is_in_view_where_a_pinhole_camera_has_it(
    height_m: float, euler_deg: tuple[float, float, float], seed: int
) -> None:
    """Against the renderer's five cameras, one by one, on tilted drones."""
    places = np.random.default_rng(seed).uniform(-90, 90, (200, 2))
    turn = Rotation.from_euler("ZYX", euler_deg, degrees=True)
    position = np.array([3.0, -7.0, height_m])
    seen = sees_ground(places[None], position[None], turn.as_quat()[None])[0]
    rays = np.column_stack([places - position[:2], np.full(len(places), -height_m)])
    margins = np.full(len(places), -np.inf)
    for axes in AXES:
        right, down, forward = axes @ turn.inv().apply(rays).T
        ahead = np.maximum(forward, 1e-9)
        margin = 1 - np.maximum(np.abs(right) / (HALF_H * ahead), np.abs(down) / (HALF_V * ahead))
        margins = np.maximum(margins, np.where(forward > 0.1, margin, -np.inf))
    matrix = turn.as_matrix()
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    cos, sin = np.cos(yaw), np.sin(yaw)
    level = np.abs((places - position[:2]) @ np.array([[cos, -sin], [sin, cos]])).max(axis=1)
    clear = (np.abs(margins) > 1e-6) & (np.abs(level - FULL.half_extent_m) > 1e-6)
    assert np.array_equal(seen[clear], ((margins > 0) & (level < FULL.half_extent_m))[clear])


def test_the_observed_share_is_that_of_the_cameras_pictures_on_the_ground() -> None:
    """One drone in hover and a large region: the pictures' polygons, in the square of the feature map."""
    pictures = Polygon()
    for axes in AXES:
        pictures = pictures.union(Polygon(corners_m(axes, 60.0)))
    half = FULL.half_extent_m
    disc = Point(0, 0).buffer(120.0, quad_segs=256)
    expected = pictures.intersection(box(-half, -half, half, half)).intersection(disc).area / disc.area
    observed = mission(*ONE, "duration_s=1", regions(120, 0))["region_observed_share"]
    assert observed == pytest.approx(expected, abs=0.01)


# --- the region ----------------------------------------------------------------------------------


def test_two_drones_far_apart_observe_what_lies_below_them_each_through_its_own_cameras() -> None:
    """Below one, below the other, and between them; then one of them, or both, has narrow pictures."""
    assert mission(*APART, "duration_s=3", regions(20, 0, 400, 200))["region_observed_share"] == pytest.approx(2 / 3)
    narrow = "{field_of_view_deg: 30}"
    usual, mixed, both = (
        mission(*APART, "duration_s=2", regions(90, 0, 400), *more)["region_observed_share"]
        for more in ((), (f"fleet.makes=[{{name: n, drones: [1], camera: {narrow}}}]",), (f"fleet.camera={narrow}",))
    )
    assert both < 0.8 * usual
    assert mixed == pytest.approx((usual + both) / 2)


def test_two_drones_far_apart_observe_twice_the_area_of_one() -> None:
    """The region's disc reaches beyond both of their squares."""
    sets = (*APART, "duration_s=1", regions(350, 200))
    two, one = (mission(*sets, f"events=[{lost}]") for lost in ("", "{kind: drone_lost, at_s: 0, drone: 1}"))
    assert two["region_observed_share"] == pytest.approx(2 * one["region_observed_share"], abs=0.01)


def test_a_fleet_flies_and_observes_a_small_region_until_all_are_lost() -> None:
    figures = mission(*STILL, ALL_LOST, "duration_s=3", regions(20, 0))
    assert (figures["flown_share"], figures["region_observed_share"]) == pytest.approx((1 / 3, 1 / 3))
    late = mission(
        "fleet.drones=2", "context.rate_hz=7.5", "duration_s=3", "events=[{kind: drone_lost, at_s: 2, drone: 1}]"
    )
    assert late["flown_share"] == pytest.approx(0.5 + 0.5 * 2 / 3), "2 s is the begin of a frame at 7.5 Hz"
    flying, width_s = np.zeros((120, 5), bool), np.diff(0.1 * np.arange(120), append=12.0)
    assert (_flown_share(flying, width_s), _flown_share(~flying, width_s)) == (0.0, 1.0), "rounding leads past neither"


@pytest.mark.parametrize(
    ("duties", "observed"), [((0,), (0.3, 0.35)), ((50, 0), (1, 1)), ((0, 100), (1, 1)), ((1,), (0, 0.5))]
)
def test_it_is_the_looks_that_count_and_not_what_a_link_asks_for(
    duties: Sequence[int], observed: tuple[float, float]
) -> None:
    """One link that asks for perception keeps the camera on. A fleet that rests flies all the same, and looked once."""

    def policy(view: FleetView) -> list[Directive]:
        return [
            Directive(view.ego, p, duty_percent=duties[k % len(duties)], reason="duty")
            for k, p in enumerate(sorted(view.peers))
        ]

    figures = mission(*STILL, "fleet.drones=3", "duration_s=3", regions(20, 0, 0, 0), policy=policy)
    assert figures["flown_share"] == 1.0
    assert observed[0] <= figures["region_observed_share"] <= observed[1]


# --- the target ----------------------------------------------------------------------------------

TRACK = "mission.phases=[{at_s: 0, phase: track}]"
AWAY = "mission.target={waypoints_m: [[0, 0], [0, 400]], speed_mps: 20}"
"""To the side from below the drone: it leaves the map's square after 102.4 m."""


def test_a_target_that_leaves_the_view_leaves_a_gap_of_that_length_also_where_groups_track_it_in_turn() -> None:
    gone_s = round(8 - np.ceil(102.4 / 20 * 10) / 10, 6)
    first = "{drones: [0], phases: [{at_s: 0, phase: track}, {at_s: 4, phase: search}]}"
    then = "{drones: [1], phases: [{at_s: 0, phase: search}, {at_s: 4, phase: track}]}"
    together = ("fleet.drones=2", "fleet.formation={shape: line, spacing_m: 1}")
    for sets in ((TRACK,), (f"mission.groups=[{first}, {then}]", *together)):
        figures = mission(*ONE, "duration_s=8", AWAY, *sets)
        assert figures["target_longest_out_of_view_s"] == pytest.approx(gone_s)
        assert figures["target_in_view_share"] == pytest.approx(1 - gone_s / 8)


def test_the_longest_of_several_gaps_counts_and_the_share_all_of_them() -> None:
    """Out of view to one side for a while, then to the other; only phase `track` counts."""
    there_and_back = "mission.target={waypoints_m: [[0, 0], [0, 142.4], [0, -182.4], [0, 0]], speed_mps: 40}"
    figures = mission(*ONE, "duration_s=16", there_and_back, TRACK)
    first_s, second_s = (2 * (far - 102.4) / 40 for far in (142.4, 182.4))
    assert figures["target_longest_out_of_view_s"] == pytest.approx(second_s, abs=0.11)
    assert figures["target_in_view_share"] == pytest.approx(1 - (first_s + second_s) / 16, abs=0.02)
    later = "mission.phases=[{at_s: 0, phase: track}, {at_s: 5, phase: search}]"
    early = mission(*ONE, "duration_s=16", there_and_back, later)
    assert early["target_longest_out_of_view_s"] == pytest.approx(first_s, abs=0.11)


class Clairvoyant:
    """Finds every car, until a time."""

    def __init__(self, scene: SceneModel, until_s: float) -> None:
        self._scene, self._until_s = scene, until_s

    def detect(self, jobs: Sequence[tuple[Capture, Any]]) -> list[Boxes]:
        return [self.truth(ego.t_s + 0.095, ego) if ego.t_s < self._until_s else Boxes.empty() for ego, _ in jobs]

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        cars = self._scene.cars_at(t_s).table()
        return Boxes(cars[:, :2], cars[:, 2:4], cars[:, 4], np.ones(len(cars))).single()

    def count_boxes(self, capture: Capture, roi: Any) -> int:
        return 0


@pytest.mark.parametrize("all_lost", [False, True])
def test_the_target_counts_as_detected_while_a_box_holds_it_and_never_once_all_are_down(all_lost: bool) -> None:
    """Tracked from 1 s on, and scored at 2 Hz: found in the periods from 1 and 1.5 s on, then missed to the end."""
    phases = "mission.phases=[{at_s: 0, phase: search}, {at_s: 1, phase: track, region: {radius_m: 32}}]"
    sets = ("duration_s=4", phases, *([ALL_LOST.replace("at_s: 1", "at_s: 2")] if all_lost else ()))
    made: Any = lambda scene, *_: Clairvoyant(scene, 9.0 if all_lost else 1.95)  # noqa: E731
    result = outcome(run_sortie(example(*sets), "silence", detector_of=made))
    figures, missed_s = result["mission"], 4 - 2.0
    assert figures["target_longest_undetected_s"] == pytest.approx(missed_s)
    assert figures["target_detected_share"] == pytest.approx(1 / (1 + missed_s))
    assert figures["target_in_view_share"] == pytest.approx(1 / 3 if all_lost else 1.0)
    if all_lost:
        assert result["ap50"]["full_scene"] == pytest.approx(1.0)
        assert result["ap50"]["grounded_blind"]["full_scene"] == pytest.approx(1 / 2, abs=0.01)


def test_what_is_not_defined_is_none_and_all_may_be_named() -> None:
    figures = mission("mission={phases: [{at_s: 0, phase: search}]}", "duration_s=0.5")
    keys = open_keys(5, 2, ["worked"], traced=False)
    for name in (*(f"mission.{name}" for name in figures), "ap50.grounded_blind.mission"):
        check_number(name, keys)
    assert figures["flown_share"] == 1.0
    assert {figures[name] for name in figures if name.startswith(("region", "target"))} == {None}
    searched = outcome(recorded("makes"))["mission"]  # there is a target, and nobody tracks it
    assert searched["target_in_view_share"] is searched["target_detected_share"] is None


# --- accuracy with grounded drones blind ---------------------------------------------------------


@functools.cache
def thinned() -> SortieRecord:
    """The recorded flight `surrogate`, flown again with drone 3 lost at 3 s, so that the two can be compared."""
    return run_sortie(example("perception.detector=surrogate", "events=[{kind: drone_lost, at_s: 3, drone: 3}]"))


def test_a_lost_drone_answers_for_the_cars_that_it_would_have_had() -> None:
    """AP with grounded drones blind is that of its frames in the flight in which it flew, without their detections."""
    whole, few = recorded("surrogate"), thinned()

    def cars(record: SortieRecord) -> list[dict[str, Any]]:
        return [r for r in record.tables["truths"].to_pylist() if r["drone"] == 3 and r["t_s"] >= 3.0]

    assert cars(few) == cars(whole) != []
    assert not any(r["drone"] == 3 and r["t_s"] >= 3.0 for r in few.tables["fusions"].to_pylist())
    all_fly, accuracy = outcome(whole)["ap50"], outcome(few)["ap50"]
    assert all_fly["grounded_blind"] == {name: all_fly[name] for name in ("full_scene", "mission")}
    flown, left = both_matched(whole), both_matched(few)
    for name in ("full_scene", "mission"):
        gone = [m for key, m in flown[name].items() if key not in left[name]]  # type: ignore[literal-required]
        missing = [Matched(np.zeros(0), np.zeros(0, bool), m.truths) for m in gone]
        assert len(missing) == 6
        expected = average_precision([*left[name].values(), *missing])  # type: ignore[literal-required]
        assert accuracy["grounded_blind"][name] == pytest.approx(expected, rel=1e-12)
        assert accuracy["grounded_blind"][name] < accuracy[name]


def test_people_read_of_survivors_who_left_and_what_that_costs() -> None:
    few = thinned()
    shown = list(sightings(few.tables, Regions(few.tables["mission"], few.scenario.mission)))
    assert [s.full.truths for s in shown] == few.tables["fusions"]["truths"].to_pylist()
    hits = [int(m.hit.sum()) for m in both_matched(few)["full_scene"].values()]
    assert [int(s.full.hit.sum()) for s in shown] == hits, "the playback's accuracy does not shift"
    lines = str(Summary(outcome_table(outcome(few)))).splitlines()
    assert "90.0 % of drone-seconds" in lines[2]
    assert any("grounded drones blind" in line for line in lines)
    assert page(few).index("of drone-seconds") < page(few).index("Accuracy, mission disc")
    assert explain_metric("mission.flown_share", few, outcome(few)).startswith(
        "left the air: drone 3 at 3 s (fell silent)"
    )
