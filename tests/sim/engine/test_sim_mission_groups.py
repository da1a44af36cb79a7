"""Missions for groups, and several targets: what drones publish, who is scored where, what the scene has."""

from __future__ import annotations

import math

import numpy as np
import pyarrow.compute as pc
import pytest
from recorded import recorded
from sim_examples import example

from sortie.perception.metrics.ap import average_precision
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.features import Traffic
from sortie.scenarios.schema import Scene, Target
from sortie.sim.engine.mission import MissionPlan
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.accuracy import matched
from sortie.sim.results.mission_outcome import sees_ground
from sortie.sim.results.outcome import outcome
from sortie.sim.results.regions import Regions

FIRST, SECOND = Target(waypoints_m=((0, 0), (30, 0))), Target(waypoints_m=((0, 5), (0, 50)), speed_mps=2.0)
BOUNDS = (-50.0, -50.0, 50.0, 50.0)


def test_each_drone_publishes_its_group_s_phase_and_region() -> None:
    rows = recorded("mission_groups").tables["descriptors"].to_pylist()
    early = {r["drone"]: r["phase"] for r in rows if r["t_s"] < 2.9}
    assert early == {0: "track", 1: "track", 2: "track", 3: "search", 4: "search"}
    assert {r["phase"] for r in rows if r["t_s"] > 3.1} == {"track"}


def test_each_group_has_its_own_phase_region_and_target() -> None:
    phases = "[{phase: search, target: 1}, {at_s: 2, phase: track, target: 1, region: {radius_m: 20}}]"
    others = "{waypoints_m: [[0, 0], [60, 0]], speed_mps: 3}, {waypoints_m: [[0, 50], [0, 90]], speed_mps: 2}"
    second = "{drones: [3], phases: [{phase: track, target: 2, region: {radius_m: 10}}]}"
    groups = f"mission.groups=[{{drones: [1, 2], phases: {phases}}}, {second}]"
    plan = MissionPlan(example(f"mission.more_targets=[{others}]", groups).mission, 5)
    assert plan.group_of == [0, 1, 1, 2, 0]
    for t_s in (0.0, 2.0, 4.0):
        now = plan.at(t_s)
        assert now[0].target_xy == pytest.approx((-60 + 5 * t_s, -1.75))
        assert now[1].target_xy == pytest.approx((3 * t_s, 0.0))
        assert now[2].target_xy == pytest.approx((0.0, 50 + 2 * t_s))
        assert [now[g].target for g in range(3)] == [0, 1, 2]
        assert now[1].phase == ("search" if t_s < 2 else "track")
        assert now[2].region == pytest.approx((0.0, 50 + 2 * t_s, 10.0))
        assert now[1].region == (None if t_s < 2 else pytest.approx((3 * t_s, 0.0, 20.0)))
    plain = MissionPlan(example().mission, 2)
    phases_at = [plain.at(t_s)[0].phase for t_s in (2.9, 3.0 - 1e-12, 3.0)]
    assert phases_at == ["search", "track", "track"], "a phase begins with its frame whatever the clock rounds"


def test_a_mission_for_everyone_in_a_group_is_the_fleet_s_mission() -> None:
    """Two short flights of their own."""
    phases = "[{phase: track, region: {radius_m: 30}}]"
    plain, grouped = (
        outcome(run_sortie(example("duration_s=2", "fleet.drones=3", "perception.detector=surrogate", mission)))
        for mission in (f"mission.phases={phases}", f"mission.groups=[{{drones: [0, 1, 2], phases: {phases}}}]")
    )
    assert [grouped[name] for name in ("ap50", "mission", "bytes")] == [
        plain[name] for name in ("ap50", "mission", "bytes")
    ]


def test_ap_of_the_mission_is_of_each_drone_s_own_region() -> None:
    record = recorded("mission_groups")
    regions = Regions(record.tables["mission"], record.scenario.mission)
    disc = regions.at([2.5, 2.5, 5.0], [0, 4, 4])
    assert disc[1].tolist() == [50, 60, 20]
    assert disc[2] == pytest.approx([0, 45, 25])
    frames = matched(record, mission=True)
    truths = record.tables["truths"]
    for (t_s, drone), match in frames.items():
        x_m, y_m, radius_m = regions.at(t_s, drone)[0]
        own = truths.filter(pc.and_(pc.equal(truths["t_s"], t_s), pc.equal(truths["drone"], drone)))
        away = np.hypot(own["x_m"].to_numpy() - x_m, own["y_m"].to_numpy() - y_m)
        assert match.truths == int((away <= radius_m).sum())
    assert outcome(record)["ap50"]["mission"] == pytest.approx(average_precision(list(frames.values())))


def test_shares_of_targets_are_weighed_by_the_time_in_which_each_is_tracked() -> None:
    """Counted again: of each frame in which its group tracks it, whether some drone has a target in view."""
    record = recorded("mission_groups")
    states = record.tables["states"].to_pandas()
    seen, tracked = 0, [row for row in record.tables["mission"].to_pylist() if row["phase"] == "track"]
    for row in tracked:
        here = states[np.isclose(states.t_s, row["t_s"])]
        places_m = np.tile([[row["target_x_m"], row["target_y_m"]]], (5, 1, 1))
        poses = here[["x_m", "y_m", "z_m"]].to_numpy(), here[["qx", "qy", "qz", "qw"]].to_numpy()
        seen += bool(sees_ground(places_m, *poses).any())
    assert len(tracked) == 60 + 30
    assert outcome(record)["mission"]["target_in_view_share"] == pytest.approx(seen / len(tracked))


def test_a_second_target_is_a_car_of_the_scene_for_every_detector() -> None:
    one, two = SceneModel(Scene(), FIRST, BOUNDS), SceneModel(Scene(), FIRST, BOUNDS, (SECOND,))
    before, after = one.cars_at(10.0), two.cars_at(10.0)
    assert len(after) == len(before) + 1
    assert len(set(after.ids.tolist())) == len(after)
    assert (after.x_m[1], after.y_m[1], after.yaw_rad[1]) == pytest.approx((0.0, 25.0, math.pi / 2))
    assert two.cars_near(10.0, 0.0, 25.0, 0.1) == 1
    assert one.made_of != two.made_of
    traffic = Traffic(two)
    xy, yaw, there = traffic.at(np.array([10.0, 1.0]), np.zeros(0, np.int64))
    assert xy[:, -1].tolist() == [[0.0, 25.0], [0.0, 7.0]]
    assert xy[:, -2].tolist() == [[30.0, 0.0], [5.0, 0.0]]
    assert there[:, -2:].all()
    assert yaw[0, -1] == pytest.approx(math.pi / 2)


def test_a_scene_with_one_target_keeps_its_cars() -> None:
    assert SceneModel(Scene(), FIRST, BOUNDS).parked_cars.ids[0] == 1
    assert SceneModel(Scene(), None, BOUNDS).parked_cars.ids[0] == 1
    assert SceneModel(Scene(), FIRST, BOUNDS, (SECOND,)).parked_cars.ids[0] == 2
