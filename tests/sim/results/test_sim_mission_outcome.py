"""The mission's figures: closed forms, cameras projected in another way, and survivors that do not flatter."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from rich.table import Table
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
from sortie.sim.results.outcome import outcome
from sortie.sim.results.outcome_fields import check_number, open_keys
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.regions import Regions
from sortie.sim.results.report import page
from sortie.sim.results.sightings import sightings
from sortie.sim.results.summary import outcome_table
from sortie.sim.studies.compare import Contender, compare
from sortie.sim.studies.comparison_text import comparison_table

STILL = (
    "fleet.route.waypoints_m=[[0, 0]]",
    "fleet.motion={wind_mps: [0, 0], gust_sigma_mps: 0, pose_jitter_m: 0}",
    "policy={name: silence}",
)
"""Drones that hover level where their slots are, 60 m above the ground."""
SEEING = ("perception.detector=surrogate",)
LOSS = "events=[{kind: drone_lost, at_s: 3, drone: 3}]"
ALL_LOST = "events=[" + ", ".join(f"{{kind: drone_lost, at_s: 2, drone: {i}}}" for i in range(5)) + "]"


def mission(*overrides: str, policy: Any = None) -> dict[str, Any]:
    return outcome(run_sortie(example(*overrides), policy))["mission"]  # type: ignore[no-any-return]


def region(x_m: float, y_m: float, radius_m: float) -> str:
    disc = f"{{centre_m: [{x_m}, {y_m}], radius_m: {radius_m}}}"
    return f"mission.phases=[{{at_s: 0, phase: search, region: {disc}}}]"


# --- who flew ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "share"),
    [((), 1.0), ((LOSS,), 0.9), ((ALL_LOST,), 1 / 3), ((LOSS, "context.rate_hz=7.5"), 1.0 - 0.2 * (6 - 23 / 7.5) / 6)],
)
def test_drone_seconds_flown(overrides: Sequence[str], share: float) -> None:
    """At 7.5 Hz the loss at 3 s is in the frame that begins at 3.07 s."""
    assert mission(*overrides)["flown_share"] == pytest.approx(share, abs=1e-9)


def test_a_fleet_that_is_lost_at_once_flew_no_share_at_all() -> None:
    """Exactly 0, and exactly 1 where all fly: rounding must not lead past either."""
    flying, width_s = np.zeros((120, 5), bool), np.diff(0.1 * np.arange(120), append=12.0)
    assert (_flown_share(flying, width_s), _flown_share(~flying, width_s)) == (0.0, 1.0)


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
    observed = mission(*STILL, "fleet.drones=1", "duration_s=2", region(0, 0, 120))["region_observed_share"]
    assert observed == pytest.approx(expected, abs=0.01)


# --- the region ----------------------------------------------------------------------------------

APART = (*STILL, "fleet.drones=2", "fleet.formation={shape: line, spacing_m: 400}")


@pytest.mark.parametrize(
    ("y_m", "share"),
    [(0, 1.0), (400, 1.0), (200, 0.0)],  # below one, below the other, and between them
)
def test_two_drones_far_apart_observe_what_lies_below_them(y_m: float, share: float) -> None:
    assert mission(*APART, region(0, y_m, 20))["region_observed_share"] == share


def test_each_drone_observes_through_its_own_cameras() -> None:
    """Of two drones far apart one has narrow pictures: below it as in a narrow fleet, below the other as in a usual one."""
    narrow = "{field_of_view_deg: 30}"
    make = f"fleet.makes=[{{name: narrow, drones: [1], camera: {narrow}}}]"
    kinds = {"usual": (), "narrow": (f"fleet.camera={narrow}",), "mixed": (make,)}
    first, second = (
        {
            k: mission(*APART, "duration_s=1", region(0, y_m, 90), *more)["region_observed_share"]
            for k, more in kinds.items()
        }
        for y_m in (0, 400)
    )
    assert first["narrow"] < 0.8 * first["usual"]
    assert (first["mixed"], second["mixed"]) == (first["usual"], second["narrow"])


def test_two_drones_far_apart_observe_twice_the_area_of_one() -> None:
    """The region's disc reaches beyond both of their squares."""
    two = mission(*APART, "duration_s=2", region(0, 200, 350))["region_observed_share"]
    one = mission(*APART, "duration_s=2", region(0, 200, 350), "events=[{kind: drone_lost, at_s: 0, drone: 1}]")
    assert two == pytest.approx(2 * one["region_observed_share"], abs=0.01)


def test_a_hovering_fleet_observes_all_of_a_small_region_while_it_flies() -> None:
    assert mission(*STILL, region(0, 0, 20))["region_observed_share"] == 1.0
    assert mission(*STILL, ALL_LOST, region(0, 0, 20))["region_observed_share"] == pytest.approx(1 / 3)


def test_a_fleet_that_rests_flies_and_observes_nothing() -> None:
    def asleep(view: FleetView) -> list[Directive]:
        return [Directive(view.ego, peer, duty_percent=0, reason="rests") for peer in view.peers]

    figures = mission(*STILL[:2], region(0, 0, 20), policy=asleep)
    assert figures["flown_share"] == 1.0
    assert figures["region_observed_share"] == pytest.approx(1 / 6)  # the look at 0 s: nobody has heard of a peer


def test_one_link_that_asks_for_perception_keeps_the_camera_on() -> None:
    def partly(view: FleetView) -> list[Directive]:
        return [Directive(view.ego, p, duty_percent=50 * (p == min(view.peers)), reason="half") for p in view.peers]

    assert mission(*STILL[:2], region(0, 0, 20), policy=partly)["region_observed_share"] == 1.0


def test_it_is_the_looks_that_count_and_not_what_a_link_asks_for() -> None:
    """A link that stays at 100 % leaves no row in `directives`, and one frame in a hundred is hardly a look."""

    def duty(*percents: int) -> Callable[[FleetView], list[Directive]]:
        return lambda view: [
            Directive(view.ego, p, duty_percent=percents[k % len(percents)], reason="duty")
            for k, p in enumerate(sorted(view.peers))
        ]

    seen = [mission(*STILL[:2], region(0, 0, 20), policy=duty(*d))["region_observed_share"] for d in ((0, 100), (1,))]
    assert seen[0] == 1.0
    assert (seen[1] or 0.0) < 0.5


# --- the target ----------------------------------------------------------------------------------

TRACK = "mission.phases=[{at_s: 0, phase: track}]"


def test_a_target_that_leaves_the_view_leaves_a_gap_of_that_length() -> None:
    """It drives to the side from below a hovering drone at 20 m/s and leaves the map's square after 102.4 m."""
    away = "mission.target={waypoints_m: [[0, 0], [0, 400]], speed_mps: 20}"
    figures = mission(*STILL, "fleet.drones=1", "duration_s=8", away, TRACK)
    gone = round(8 - np.ceil(102.4 / 20 * 10) / 10, 6)
    assert figures["target_longest_out_of_view_s"] == pytest.approx(gone)
    assert figures["target_in_view_share"] == pytest.approx(1 - gone / 8)


def test_the_longest_of_several_gaps_counts_and_the_share_all_of_them() -> None:
    """Out of view to one side for a while, then to the other; only phase `track` counts."""
    there_and_back = "mission.target={waypoints_m: [[0, 0], [0, 142.4], [0, -182.4], [0, 0]], speed_mps: 40}"
    figures = mission(*STILL, "fleet.drones=1", "duration_s=16", there_and_back, TRACK)
    first, second = (2 * (far - 102.4) / 40 for far in (142.4, 182.4))
    assert figures["target_longest_out_of_view_s"] == pytest.approx(second, abs=0.11)
    assert figures["target_in_view_share"] == pytest.approx(1 - (first + second) / 16, abs=0.02)
    later = "mission.phases=[{at_s: 0, phase: track}, {at_s: 5, phase: search}]"
    early = mission(*STILL, "fleet.drones=1", "duration_s=16", there_and_back, later)
    assert early["target_longest_out_of_view_s"] == pytest.approx(first, abs=0.11)


def test_a_target_counts_while_any_group_tracks_it() -> None:
    """One group tracks it for four seconds, then another one; it leaves the view as above."""
    away = "mission.target={waypoints_m: [[0, 0], [0, 400]], speed_mps: 20}"
    first = "{drones: [0], phases: [{at_s: 0, phase: track}, {at_s: 4, phase: search}]}"
    then = "{drones: [1], phases: [{at_s: 0, phase: search}, {at_s: 4, phase: track}]}"
    together = "fleet.formation={shape: line, spacing_m: 1}"
    sets = (*STILL, "fleet.drones=2", together, "duration_s=8", away)
    figures = mission(*sets, f"mission.groups=[{first}, {then}]")
    alone = mission(*sets, TRACK)
    for name in ("target_in_view_share", "target_longest_out_of_view_s"):
        assert figures[name] == pytest.approx(alone[name])
    assert 0.6 < alone["target_in_view_share"] < 0.7


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


def test_the_target_counts_as_detected_while_a_box_holds_it() -> None:
    """Scored at 2 Hz from 3 s on: found in the periods from 3 and 3.5 s on, then missed to the end."""
    record = run_sortie(example(), detector_of=lambda scene, config, seed, replication: Clairvoyant(scene, 3.9))  # type: ignore[arg-type, return-value]
    figures = outcome(record)["mission"]
    missed_s = 6 - 4.0
    assert figures["target_longest_undetected_s"] == pytest.approx(missed_s)
    assert figures["target_detected_share"] == pytest.approx(1 / (1 + missed_s))
    assert figures["target_in_view_share"] == 1.0


def test_nobody_detects_the_target_once_all_are_down() -> None:
    lost = run_sortie(
        example(ALL_LOST, "mission.phases=[{at_s: 0, phase: track, region: {radius_m: 32}}]"),
        detector_of=lambda scene, config, seed, replication: Clairvoyant(scene, 9.0),  # type: ignore[arg-type, return-value]
    )
    figures = outcome(lost)
    assert figures["mission"]["target_longest_undetected_s"] == pytest.approx(6 - 2.0)
    assert figures["mission"]["target_longest_out_of_view_s"] == pytest.approx(4.0)
    assert figures["ap50"]["full_scene"] == pytest.approx(1.0)
    assert figures["ap50"]["grounded_blind"]["full_scene"] == pytest.approx(1 / 3, abs=0.01)


def test_what_is_not_defined_is_none() -> None:
    figures = mission("mission={phases: [{at_s: 0, phase: search}]}")
    assert figures.pop("flown_share") == 1.0
    assert set(figures.values()) == {None}
    searched = mission("mission.phases=[{at_s: 0, phase: search}]", *SEEING)  # there is a target, nobody tracks it
    assert searched["target_in_view_share"] is searched["target_detected_share"] is None


# --- accuracy with grounded drones blind ---------------------------------------------------------


@pytest.fixture(scope="module")
def whole() -> SortieRecord:
    return run_sortie(example(*SEEING))


@pytest.fixture(scope="module")
def thinned() -> SortieRecord:
    return run_sortie(example(*SEEING, LOSS))


def cars(record: SortieRecord, drone: int, from_s: float) -> list[dict[str, Any]]:
    return [r for r in record.tables["truths"].to_pylist() if r["drone"] == drone and r["t_s"] >= from_s]


def test_ap_with_grounded_drones_blind_is_ap_where_all_fly(whole: SortieRecord) -> None:
    accuracy = outcome(whole)["ap50"]
    assert accuracy["grounded_blind"] == {name: accuracy[name] for name in ("full_scene", "mission")}
    assert accuracy["mission"] > 0


def test_a_lost_drone_answers_for_the_cars_that_it_would_have_had(whole: SortieRecord, thinned: SortieRecord) -> None:
    assert cars(thinned, 3, 3.0) == cars(whole, 3, 3.0) != []
    assert not any(r["drone"] == 3 and r["t_s"] >= 3.0 for r in thinned.tables["fusions"].to_pylist())


def test_ap_with_grounded_drones_blind_is_that_of_fusions_without_detections(
    whole: SortieRecord, thinned: SortieRecord
) -> None:
    """Against the curve itself: the lost drone's frames of the sortie in which it flew, with its detections left out."""
    accuracy = outcome(thinned)["ap50"]
    flown, left = both_matched(whole), both_matched(thinned)
    for name in ("full_scene", "mission"):
        missing = [
            Matched(np.zeros(0), np.zeros(0, bool), m.truths)
            for key, m in flown[name].items()  # type: ignore[literal-required]
            if key not in left[name]  # type: ignore[literal-required]
        ]
        assert len(missing) == 6
        expected = average_precision([*left[name].values(), *missing])  # type: ignore[literal-required]
        assert accuracy["grounded_blind"][name] == pytest.approx(expected, rel=1e-12)
        assert accuracy["grounded_blind"][name] < accuracy[name]


def test_what_the_playback_shows_of_survivors_does_not_shift(thinned: SortieRecord) -> None:
    regions = Regions(thinned.tables["mission"], thinned.scenario.mission)
    shown = list(sightings(thinned.tables, regions))
    assert [s.full.truths for s in shown] == thinned.tables["fusions"]["truths"].to_pylist()
    hits = [int(m.hit.sum()) for m in both_matched(thinned)["full_scene"].values()]
    assert [int(s.full.hit.sum()) for s in shown] == hits


# --- where people read it ------------------------------------------------------------------------


def printed(table: Table) -> list[str]:
    console = Console(file=io.StringIO(), width=200)
    console.print(table)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined, no-any-return]


def test_the_share_flown_is_the_first_line_where_it_is_below_one(whole: SortieRecord, thinned: SortieRecord) -> None:
    lines = printed(outcome_table(outcome(thinned)))
    assert "90.0 % of drone-seconds" in lines[2]
    assert any("grounded drones blind" in line for line in lines)
    assert not any("flown" in line or "blind" in line for line in printed(outcome_table(outcome(whole))))
    assert page(thinned).index("of drone-seconds") < page(thinned).index("Accuracy, mission disc")
    assert "of drone-seconds" not in page(whole)


def test_a_comparison_shows_it_first(thinned: SortieRecord) -> None:
    flown = compare([Contender("worked", example(*SEEING, LOSS)), Contender("silence", example(*SEEING))], [1])
    table = comparison_table(flown)
    names = list(table.columns[0].cells)
    assert names[:4] == ["flown", "AP@0.5 full scene", "  gain", "  grounded drones blind"]
    assert [next(iter(column.cells)) for column in table.columns[1:]] == ["90.0 %", "100.0 %"]
    alone = compare([Contender("worked", example("duration_s=1", "mission.phases=[{}]"))], [1])
    assert "flown" not in list(comparison_table(alone).columns[0].cells)


def test_expectations_and_campaigns_name_them(tmp_path: Path) -> None:
    keys = open_keys(5, 2, ["worked"], traced=False)
    for name in outcome(run_sortie(example("duration_s=0.5", "mission.phases=[{}]")))["mission"]:
        check_number(f"mission.{name}", keys)
    check_number("ap50.grounded_blind.mission", keys)


def test_a_failed_expectation_says_who_left_the_air(thinned: SortieRecord) -> None:
    assert explain_metric("mission.flown_share", thinned, outcome(thinned)).startswith(
        "left the air: drone 3 at 3 s (fell silent)"
    )


def test_a_fleet_that_lost_drones_has_a_gain_over_all_drones_too() -> None:
    """Over the fusions that both made, the survivors flatter; counted as blind, the lost drones cost what they cost."""
    lost = "events=[{kind: drone_lost, drone: 0, at_s: 1}, {kind: drone_lost, drone: 1, at_s: 1}]"
    thin = example(*SEEING, lost)
    flown = compare([Contender("stays", example(*SEEING)), Contender("loses", thin)], [1, 2])
    gains = {g.metric: g.gain for g in flown.gains}
    stays, loses = ([s.outcome["ap50"]["grounded_blind"]["full_scene"] for s in flown.sorties[k::2]] for k in (0, 1))
    assert gains["ap50.grounded_blind.full_scene"] == pytest.approx(np.mean(np.subtract(loses, stays)))
    assert gains["ap50.grounded_blind.full_scene"] < gains["ap50.full_scene"] - 0.02
