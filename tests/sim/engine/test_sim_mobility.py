"""Mobility models in flight: positions of one's own, and planners that close the loop on the view.

Each test flies its own model; most have one to four drones that share nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sim_examples import example
from typer.testing import CliRunner

from sortie.fleet.flight.steering import GoTo, Velocity, area_m
from sortie.scenarios.errors import SortieError
from sortie.sim.cli.app import app
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import Parts, build, fly, run_sortie
from sortie.sim.results.record import SortieRecord

OWN = Path(__file__).parent / "own_models.py"
GOES, SPIRAL = f"fleet.mobility={OWN}:Goes", f"fleet.mobility={OWN}:spiral"
CALM = "fleet.motion={pose_jitter_m: 0, pose_error_m: 0}"
LINE = "fleet.formation={shape: line, spacing_m: 20}"


def params(**values: Any) -> str:
    return f"fleet.mobility_params={{{', '.join(f'{k}: {v}' for k, v in values.items())}}}"


def flown(*settings: str) -> SortieRecord:
    return run_sortie(example("duration_s=12", CALM, *settings), "silence")


def states(record: SortieRecord, *names: str) -> np.ndarray:
    columns = [record.tables["states"][n].to_numpy() for n in names]
    return np.stack(columns, axis=-1).reshape(-1, record.scenario.fleet.drones, len(names))


def place_m(record: SortieRecord) -> np.ndarray:
    return states(record, "x_m", "y_m", "z_m")


def texts(record: SortieRecord, drone: int) -> list[str]:
    return [r["text"] for r in record.tables["events"].to_pylist() if r["drone"] == drone]


def test_a_function_gives_positions_and_is_named_among_the_files() -> None:
    record = flown(SPIRAL, params(speed_mps=2))
    scenario = example(CALM, "fleet.route.waypoints_m=[[-60, 0]]")
    start = build(scenario, plan_for(scenario), 1).world.motion[:1].position_m[0, 3]
    radius = np.linalg.norm(place_m(record)[:, 3] - start, axis=-1)
    t_s = np.arange(120) / 10
    np.testing.assert_allclose(radius, 2 * np.sqrt(t_s) * 2 * np.abs(np.sin(np.sqrt(t_s) / 4)), atol=1e-9)
    assert [Path(file).name for file in record.own_files] == ["own_models.py"]
    assert record.fingerprint == flown(SPIRAL, params(speed_mps=2)).fingerprint


def test_a_planner_flies_to_places_returns_and_lands() -> None:
    there = params(do='"GoTo Return Land"', x_m=-50, y_m=-10, only=0)
    record = flown(GOES, there, "fleet.drones=2", "duration_s=20", "fleet.steering.speed_mps=4")
    place = place_m(record)
    assert texts(record, 0) == ["Goes: GoTo", "Goes: Return", "Goes: Land", "goes home: Goes lands it"]
    assert place[:, 0, 0].max() > -57  # it was on its way when it was sent back
    np.testing.assert_array_equal(place[:, 1:], np.broadcast_to(place[0, 1:], place[:, 1:].shape))
    assert place[-1, 0, 2] < 60 - 3 * 5  # it descends
    np.testing.assert_allclose(place[-1, 0, :2], place[0, 0, :2], atol=2.5)
    assert np.linalg.norm(states(record, "vx_mps", "vy_mps"), axis=-1).max() <= 4 + 1e-9


def test_a_drone_that_goes_home_no_longer_follows_its_planner() -> None:
    leaves = "events=[{kind: drone_leaves, at_s: 1, drone: 0}]"
    there = params(do='"GoTo Return"', x_m=-50, y_m=-10, only=0)
    record = flown(GOES, there, leaves, "mission.descent_mps=10", "fleet.drones=2")
    assert texts(record, 0)[-2:] == ["goes home: told to", "went home"]
    z_m = states(record, "z_m")[:, 0, 0]
    assert z_m[10] > 50
    assert z_m[80] == pytest.approx(0.0, abs=1e-6)


def test_a_place_is_where_the_drone_believes_it_along_every_axis() -> None:
    """A drone that believes to be 5 m further east stops 5 m further west than it was sent to."""
    for offset_m, stops_m in (([5, 0, 0], (-45, 0, 70)), ([0, -3, 0], (-40, 3, 70)), ([0, 0, 6], (-40, 0, 64))):
        fault = f"events=[{{kind: position_fault, at_s: 0, drone: 0, offset_m: {offset_m}}}]"
        record = flown(GOES, params(x_m=-40, z_m=70), "fleet.drones=1", fault, "duration_s=13")
        np.testing.assert_allclose(place_m(record)[-1, 0], stops_m, atol=0.1)


def test_what_is_not_safe_is_refused_and_noted_once() -> None:
    """All are sent to one place: none comes nearer to another than the separation, and who comes late stays out."""
    record = flown(GOES, params(x_m=0, y_m=0, z_m=60), "fleet.steering.separation_m=8", "duration_s=8")
    place = place_m(record)
    apart = np.linalg.norm(place[:, :, None] - place[:, None], axis=-1)
    assert apart[:, ~np.eye(5, dtype=bool)].min() >= 8 - 1e-6
    refused = [t for i in range(5) for t in texts(record, i) if "refused" in t]
    assert any("it would come too near drone" in t for t in refused)
    assert len(refused) < 25  # not at every decision
    fence = ("fleet.drones=1", "fleet.steering.fence_m=[-90, -60, -20, 60]")
    east_m = states(flown(GOES, params(x_m=100), *fence), "x_m").max()
    assert -25 < east_m <= -20, "a quarter of the way is granted"
    shut = flown(GOES, params(x_m=400), *fence, "duration_s=1")
    assert texts(shut, 0) == ["Goes: GoTo refused, it would leave the fence"]


def test_drones_that_begin_too_near_each_other_may_part() -> None:
    """The separation forbids to come nearer, not to be near."""
    near = ("fleet.drones=2", "fleet.formation={shape: line, spacing_m: 4}", "fleet.steering.separation_m=8")
    record = flown(GOES, params(only=0, x_m=-40, y_m=-30), *near, "duration_s=13")
    assert not [text for text in texts(record, 0) if "refused" in text]
    np.testing.assert_allclose(place_m(record)[-1, 0, :2], (-40, -30), atol=0.1)


PLANS = """
from sortie.fleet.flight.steering import GoTo, Land

class Planner:
    def __init__(self, drone, start_m, rng):
        self.drone, (self.x_m, self.y_m, self.z_m), self.views = drone, start_m, 0

    def command(self, view):
        self.views += 1
        return self.wanted()

class Climbs(Planner):
    def wanted(self):
        if self.drone == 0:
            place = GoTo(self.x_m, self.y_m + 20, self.z_m + 20)
            return [place, Land(), GoTo(self.x_m, self.y_m, self.z_m + 2)][(self.views > 7) + (self.views > 8)]

class Follows(Planner):
    def wanted(self):
        if self.drone == 1:
            return GoTo(self.x_m, self.y_m + 20, self.z_m)
        return GoTo(self.x_m, self.y_m + 20, self.z_m) if self.views > 8 else None
"""
TWO = ("fleet.drones=2", "fleet.formation={shape: line, altitude_m: 20}")


@pytest.mark.parametrize("event", ["drone_lost, at_s: 3.8", "drone_leaves, at_s: 3.2"])
def test_a_drone_with_a_planner_that_joins_again_begins_anew_in_its_slot(event: str, tmp_path: Path) -> None:
    """It climbed, landed or was lost elsewhere; then it rises 2 m from its slot, and does not jump to where it was."""
    (tmp_path / "own.py").write_text(PLANS)
    events = f"events=[{{kind: {event}, drone: 0}}, {{kind: drone_joins, at_s: 8, drone: 0}}]"
    record = flown(f"fleet.mobility={tmp_path / 'own.py'}:Climbs", events, *TWO, "mission.descent_mps=10")
    assert [r["kind"] for r in record.tables["events"].to_pylist()].count("drone_joins") == 1
    place = place_m(record)[:, 0]
    assert np.linalg.norm(place[32] - place[0]) > 3
    np.testing.assert_allclose(place[80], place[0], atol=1e-9)
    assert np.linalg.norm(np.diff(place[80:], axis=0), axis=-1).max() < 0.5
    np.testing.assert_allclose(place[-1], place[0] + (0, 0, 2), atol=0.1)


def test_the_slot_of_a_drone_that_may_come_back_is_kept_free_though_it_was_lost_elsewhere(tmp_path: Path) -> None:
    """Drone 1 is lost 20 m from its slot; drone 0 is then sent to that slot, and keeps its distance from it."""
    (tmp_path / "own.py").write_text(PLANS)
    lost = "{kind: drone_lost, at_s: 4, drone: 1}"
    joins = ", {kind: drone_joins, at_s: 11.5, drone: 1}"
    for comes in (True, False):
        events = f"events=[{lost}{joins if comes else ''}]"
        settings = (f"fleet.mobility={tmp_path / 'own.py'}:Follows", events, "fleet.steering.separation_m=8")
        place = place_m(flown(*settings, *TWO))
        slot = place[0, 1]
        assert np.linalg.norm(place[40, 1] - slot) > 5
        nearest_m = np.linalg.norm(place[:, 0] - slot, axis=-1).min()
        if comes:
            np.testing.assert_allclose(place[115, 1], slot, atol=1e-9)
            assert 8.0 - 1e-6 < nearest_m < 15.0
        else:
            assert nearest_m < 1.0, "kept free for no other"


# --- commands of one frame, without a flight -----------------------------------------------------


def _parts(*sets: str) -> Parts:
    scenario = example("duration_s=20", GOES, params(x_m=0), CALM, LINE, "fleet.drones=4", *sets)
    return build(scenario, plan_for(scenario), 1)


def _command(parts: Parts, **commands: Any) -> list[str]:
    """Give commands by drone in one frame, and return what is noted of them."""
    events = parts.recorder.rows["events"]
    before = len(events)
    for name, command in commands.items():
        parts.planners.request(int(name[1:]), command)
    parts.manoeuvres.renew(0)
    return [f"{row[1]} {row[3]}" for row in events[before:]]


def test_of_two_commands_of_one_frame_the_second_keeps_clear_of_what_the_first_was_granted() -> None:
    parts = _parts("fleet.steering.separation_m=10")
    start_m = parts.world.motion[:1].position_m[0].copy()
    middle_m = (start_m[0] + start_m[1]) / 2
    noted = _command(parts, d1=GoTo(*middle_m.tolist()), d0=GoTo(*middle_m.tolist()))
    end_m = parts.world.motion[-1:].position_m[0]
    np.testing.assert_allclose(end_m[0], middle_m, atol=1e-6)
    assert np.linalg.norm(end_m[1] - end_m[0]) >= 10.0 - 1e-6
    assert noted[0] == "0 Goes: GoTo"
    np.testing.assert_array_equal(end_m[2:], start_m[2:])


def test_who_is_in_the_way_is_named_by_its_number_and_who_is_gone_is_not_in_the_way() -> None:
    parts = _parts("fleet.steering.separation_m=19")
    start_m = parts.world.motion[:1].position_m[0]
    parts.world.remove(0, "drone_lost", "fell silent")
    (noted,) = _command(parts, d1=GoTo(*(start_m[3] + 0.2 * (start_m[1] - start_m[3])).tolist()))
    assert noted == "1 Goes: GoTo refused, it would come too near drone 3"
    assert _command(parts, d1=GoTo(*start_m[0].tolist())) == ["1 Goes: GoTo"]


def test_a_drone_that_goes_home_or_is_down_takes_no_commands() -> None:
    parts = _parts()
    parts.world.homebound.add(0)
    parts.world.remove(1, "drone_lost", "fell silent")
    east = Velocity(1.0, 0.0)
    assert _command(parts, d0=east, d1=east, d2=east) == ["2 Goes: Velocity"]
    moved = parts.world.motion[-1:].position_m[0] - parts.world.motion[:1].position_m[0]
    assert (np.abs(moved).max(axis=1) > 1.0).tolist() == [False, False, True, False]


def test_the_scene_reaches_as_far_as_drones_fly_as_planned_and_as_they_may_be_steered() -> None:
    fleet = example(GOES, params(x_m=0), "fleet.steering.fence_m=[-90, -60, 20, 60]").fleet
    assert area_m(fleet, (-10.0, -500.0, 700.0, 5.0)) == (-90.0, -500.0, 700.0, 60.0)
    assert area_m(example().fleet, (-1.0, -2.0, 3.0, 4.0)) == (-1.0, -2.0, 3.0, 4.0)
    plain, planned = example("duration_s=1"), example("duration_s=1", GOES, "fleet.steering.reach_m=700")
    parts = build(plain, plan_for(plain), 1)
    assert not parts.planners.anyone
    assert parts.scene.made_of[2] == parts.world.motion.nominal.bounds_m()
    assert build(planned, plan_for(planned), 1).scene.made_of[2] == pytest.approx((-780, -720, 660, 720))


def test_planners_read_what_their_policies_read(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = example(GOES, "duration_s=1", "record.views=true", "mission.phases=[{}]")
    parts = build(scenario, plan_for(scenario), 1)
    shown: list[tuple[int, Any]] = []
    read = parts.planners.read
    monkeypatch.setattr(parts.planners, "read", lambda drone, view: (shown.append((drone, view)), read(drone, view)))
    fly(parts)
    assert len(shown) == 5 * 10
    assert all(view.ego == drone for drone, view in shown)
    assert max(len(view.peers) for _, view in shown) == 4
    assert parts.journal is not None
    assert parts.journal.tables()["views"].num_rows == 5 * 10


# --- what is refused -----------------------------------------------------------------------------

ONE_OF = "must be None or one of GoTo, Velocity, Hold, Return, Land with finite numbers and speeds > 0"
SAYS = """
from sortie.fleet.flight.steering import GoTo, Velocity

class Says:
    def __init__(self, drone, start_m, rng, *, given):
        self.given = eval(given)

    def command(self, view):
        return self.given
"""
REFUSED: list[tuple[tuple[str, ...], str]] = [
    ((GOES, params(says="north")), f": returns 'north', {ONE_OF}"),
    *(
        (("fleet.mobility=SAYS", params(given=f"'{given}'")), "must be None or one of GoTo")
        for given in ('GoTo("a", 0)', "GoTo(None, 0)", "GoTo(0, 0, 0, -1)", "Velocity(1, None)")
    ),
    ((GOES, params(wrong=1)), "Goes' has no parameter 'wrong', it has: do, x_m, y_m, z_m, only, says"),
    ((f"fleet.mobility={OWN}:Calm",), "mobility Calm: TypeError"),
    (
        (GOES, "fleet.steering.altitude_m=[70, 90]"),
        "drone 0 begins at a height of 60 m, must be within fleet.steering.altitude_m (70.0, 90.0)",
    ),
    (
        (GOES, "fleet.steering.fence_m=[0, 0, 9, 9]"),
        "drone 0 begins at (-60, 0), must be within fleet.steering.fence_m (0.0, 0.0, 9.0, 9.0)",
    ),
    (
        ("fleet.mobility=random_walk",),
        '"random_walk", must be formation, random_waypoint, gauss_markov or path/to/file.py:Name',
    ),
    (
        ("fleet.groups=[{drones: [1], mobility: gauss_markov, take_off: true}]",),
        "fleet.groups.0.take_off: true, must be left out where mobility is gauss_markov",
    ),
]


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(SAYS)
    wrong = {}
    for settings, words in REFUSED:
        sets = [text.replace("SAYS", f"{tmp_path / 'own.py'}:Says") for text in settings]
        try:
            run_sortie(example("duration_s=1", *sets))
        except SortieError as error:
            if words not in str(error):
                wrong[settings] = str(error)
        else:
            wrong[settings] = "flown"
    assert wrong == {}


def test_the_built_in_models_are_listed() -> None:
    lines = CliRunner().invoke(app, ["list", "mobility"]).output.splitlines()
    assert [line.partition("(")[0].split()[0] for line in lines] == ["formation", "random_waypoint", "gauss_markov"]
    assert "alpha=0.85" in lines[2]
