"""Missions for groups of drones, and several targets: who is told what, who is scored where, and what the scene holds."""

from __future__ import annotations

import math

import numpy as np
import pyarrow.compute as pc
import pytest
from sim_examples import example

from sortie.perception.metrics.ap import average_precision
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.features import Traffic
from sortie.scenarios.schema import Scene, Target
from sortie.sim.engine.mission import MissionPlan
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.accuracy import matched
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.regions import Regions

TWO = (
    "perception.detector=surrogate",
    "mission.target={waypoints_m: [[-20, -1.75], [200, -1.75]], speed_mps: 4}",
    "mission.more_targets=[{waypoints_m: [[0, 30], [0, 200]], speed_mps: 3}]",
    "mission.phases=[{phase: track, region: {radius_m: 30}}]",
    "mission.groups=[{drones: [3, 4], phases: ["
    "{phase: search, region: {centre_m: [50, 60], radius_m: 20}}, {at_s: 3, phase: track, target: 1, region: {radius_m: 25}}]}]",
)
FIRST, SECOND = Target(waypoints_m=((0, 0), (30, 0))), Target(waypoints_m=((0, 5), (0, 50)), speed_mps=2.0)
BOUNDS = (-50.0, -50.0, 50.0, 50.0)


@pytest.fixture(scope="module")
def record() -> SortieRecord:
    return run_sortie(example(*TWO))


def test_each_drone_publishes_its_groups_phase_and_region(record: SortieRecord) -> None:
    rows = record.tables["descriptors"].to_pylist()
    assert {r["drone"]: r["phase"] for r in rows if r["t_s"] < 2.9} == dict.fromkeys(range(3), "track") | {
        3: "search", 4: "search",
    }  # fmt: skip
    assert {r["phase"] for r in rows if r["t_s"] > 3.1} == {"track"}
    plan = MissionPlan(record.scenario.mission, 5)
    assert plan.group_of == [0, 0, 0, 1, 1]
    now = plan.at(5.0)
    assert (now[0].target, now[1].target) == (0, 1)
    assert now[1].target_xy == pytest.approx((0.0, 45.0))
    assert now[1].region is not None
    assert (now[1].region.x_m, now[1].region.radius_m) == (0.0, 25)


def test_a_mission_for_everyone_in_a_group_is_the_fleets_mission() -> None:
    phases = "[{phase: track, region: {radius_m: 30}}]"
    plain = outcome(run_sortie(example(*TWO[:2], f"mission.phases={phases}")))
    grouped = outcome(run_sortie(example(*TWO[:2], f"mission.groups=[{{drones: [0, 1, 2, 3, 4], phases: {phases}}}]")))
    assert grouped["ap50"] == plain["ap50"]
    assert grouped["mission"] == plain["mission"]
    assert grouped["bytes"] == plain["bytes"]


def test_ap_of_the_mission_is_of_each_drones_own_region(record: SortieRecord) -> None:
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


def test_shares_of_targets_are_weighed_by_the_time_in_which_each_is_tracked(record: SortieRecord) -> None:
    seen = outcome(record)["mission"]
    alone = []
    for k, begin_s in enumerate((0.0, 3.0)):
        target = record.scenario.mission.targets[k]
        points = ", ".join(f"[{x}, {y}]" for x, y in target.waypoints_m)
        one = outcome(
            run_sortie(
                example(
                    *TWO[:1],
                    f"mission.target={{waypoints_m: [{points}], speed_mps: {target.speed_mps}}}",
                    "mission.phases=[{phase: track}]"
                    if begin_s == 0
                    else "mission.phases=[{phase: search}, {at_s: 3, phase: track}]",
                )
            )
        )["mission"]
        alone.append((one["target_in_view_share"], record.scenario.duration_s - begin_s))
    total = sum(lasts for _, lasts in alone)
    assert seen["target_in_view_share"] == pytest.approx(sum(share * lasts for share, lasts in alone) / total)


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
