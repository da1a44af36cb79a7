"""Mobility models in flight: random ones, positions of one's own, and planners that close the loop on the view."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sim_examples import example
from typer.testing import CliRunner

from sortie.scenarios.errors import SortieError
from sortie.sim.cli.app import app
from sortie.sim.engine.sortie import build, run_sortie
from sortie.sim.results.record import SortieRecord

OWN = Path(__file__).parent / "own_models.py"
GOES, SPIRAL = f"fleet.mobility={OWN}:Goes", f"fleet.mobility={OWN}:spiral"
CALM = "fleet.motion={pose_jitter_m: 0, pose_error_m: 0}"


def params(**values: Any) -> str:
    return f"fleet.mobility_params={{{', '.join(f'{k}: {v}' for k, v in values.items())}}}"


def flown(*settings: str) -> SortieRecord:
    return run_sortie(example("duration_s=12", CALM, *settings))


def states(record: SortieRecord, *names: str) -> np.ndarray:
    columns = [record.tables["states"][n].to_numpy() for n in names]
    return np.stack(columns, axis=-1).reshape(-1, record.scenario.fleet.drones, len(names))


def texts(record: SortieRecord, drone: int) -> list[str]:
    rows = record.tables["events"].to_pylist()
    return [r["text"] for r in rows if r["drone"] == drone]


def test_a_function_gives_positions_and_is_named_among_the_files() -> None:
    record = flown(SPIRAL, params(speed_mps=2))
    place, start = (
        states(record, "x_m", "y_m", "z_m"),
        states(flown("fleet.route.waypoints_m=[[-60, 0]]"), "x_m", "y_m", "z_m"),
    )
    t_s = np.arange(120) / 10
    radius = np.linalg.norm(place[:, 3] - start[0, 3], axis=-1)
    np.testing.assert_allclose(radius, 2 * np.sqrt(t_s) * 2 * np.abs(np.sin(np.sqrt(t_s) / 4)), atol=1e-9)
    assert [Path(file).name for file in record.own_files] == ["own_models.py"]
    assert record.fingerprint == flown(SPIRAL, params(speed_mps=2)).fingerprint


def test_a_planner_flies_to_places_returns_and_lands() -> None:
    record = flown(
        GOES, params(do='"GoTo Return Land"', x_m=-50, y_m=-10, only=0), "duration_s=20", "fleet.steering.speed_mps=4"
    )
    place = states(record, "x_m", "y_m", "z_m")
    assert texts(record, 0) == ["Goes: GoTo", "Goes: Return", "Goes: Land", "goes home: Goes lands it"]
    assert place[:, 0, 0].max() > -57  # it was on its way when it was told to return
    np.testing.assert_array_equal(place[:, 1:], np.broadcast_to(place[0, 1:], place[:, 1:].shape))
    assert place[-1, 0, 2] < 60 - 3 * 5  # it descends
    np.testing.assert_allclose(place[-1, 0, :2], (-60, 0), atol=2.5)
    speed = np.linalg.norm(states(record, "vx_mps", "vy_mps"), axis=-1)
    assert speed.max() <= 4 + 1e-9


def test_a_drone_that_goes_home_no_longer_follows_its_planner() -> None:
    leaves = "events=[{kind: drone_leaves, at_s: 1, drone: 0}]"
    record = flown(GOES, params(do='"GoTo Return"', x_m=-50, y_m=-10, only=0), leaves, "mission.descent_mps=10")
    assert texts(record, 0)[-2:] == ["goes home: told to", "went home"]
    z_m = states(record, "z_m")[:, 0, 0]
    assert z_m[10] > 50
    assert z_m[80] == pytest.approx(0.0, abs=1e-6)


def test_a_place_is_reached_in_spite_of_what_the_drone_believes() -> None:
    """It believes to be 5 m further east, so it stops 5 m further west than it was told."""
    settings = (GOES, params(x_m=-30, only=2), "fleet.drones=3", "fleet.formation.shape=line", "duration_s=25")
    right = states(flown(*settings), "x_m", "y_m")[-1, 2]
    fault = "events=[{kind: position_fault, at_s: 0, drone: 2, offset_m: [5, 0, 0]}]"
    wrong = states(flown(*settings, fault), "x_m", "y_m")[-1, 2]
    np.testing.assert_allclose(right, (-30, 0), atol=0.1)
    np.testing.assert_allclose(wrong, (-35, 0), atol=0.1)


@pytest.mark.parametrize(
    ("offset_m", "stops_m"), [([5, 0, 0], (-45, 0, 70)), ([0, -3, 0], (-40, 3, 70)), ([0, 0, 6], (-40, 0, 64))]
)
def test_a_place_is_where_the_drone_believes_it_along_every_axis(
    offset_m: list[float], stops_m: tuple[float, ...]
) -> None:
    fault = f"events=[{{kind: position_fault, at_s: 0, drone: 0, offset_m: {offset_m}}}]"
    record = flown(GOES, params(x_m=-40, z_m=70), "fleet.drones=1", fault, "duration_s=13")
    np.testing.assert_allclose(states(record, "x_m", "y_m", "z_m")[-1, 0], stops_m, atol=0.1)


@pytest.mark.parametrize("comes", [True, False])
def test_a_place_is_kept_free_for_a_drone_that_will_come_and_for_no_other(comes: bool) -> None:
    """Drone 1 waits on the ground in its slot, or was lost there; drone 0 is sent to that slot."""
    what = "{kind: drone_joins, at_s: 11, drone: 1}" if comes else "{kind: drone_lost, at_s: 0, drone: 1}"
    settings = ("fleet.drones=2", "fleet.formation.shape=line", f"events=[{what}]", "fleet.steering.separation_m=6")
    slot = states(flown(GOES, params(only=0, do="Hold"), *settings), "x_m", "y_m", "z_m")[0, 1]
    x_m, y_m, z_m = slot.tolist()
    place = states(flown(GOES, params(only=0, x_m=x_m, y_m=y_m, z_m=z_m), *settings), "x_m", "y_m", "z_m")[:, 0]
    nearest_m = np.linalg.norm(place - slot, axis=-1).min()
    assert nearest_m >= 6.0 if comes else nearest_m < 0.5


def test_what_is_not_safe_is_refused_and_said_once() -> None:
    """All five are sent to one place: none comes nearer to another than the separation, and who comes late stays out."""
    record = flown(GOES, params(x_m=0, y_m=0, z_m=60), "fleet.steering.separation_m=8", "duration_s=8")
    place = states(record, "x_m", "y_m", "z_m")
    apart = np.linalg.norm(place[:, :, None] - place[:, None], axis=-1)
    assert apart[:, ~np.eye(5, dtype=bool)].min() >= 8 - 1e-6
    refused = [t for i in range(5) for t in texts(record, i) if "refused" in t]
    assert any("it would come too near drone" in t for t in refused)
    assert len(refused) < 25  # not at every decision
    fenced = flown(GOES, params(x_m=100), "fleet.drones=1", "fleet.steering.fence_m=[-90, -60, -20, 60]")
    assert states(fenced, "x_m").max() <= -20
    assert states(fenced, "x_m").max() > -25  # a quarter of the way is granted
    shut = flown(GOES, params(x_m=400), "fleet.steering.fence_m=[-90, -60, -20, 60]", "fleet.drones=1")
    assert texts(shut, 0) == ["Goes: GoTo refused, it would leave the fence"]


@pytest.mark.parametrize(("mover", "other"), [(0, 3), (2, 3)])
def test_a_refusal_names_the_drone_that_is_in_the_way(mover: int, other: int) -> None:
    """One of four is sent to where another stands. Drone 1 is gone for good, and shifts nobody's number."""
    settings = (
        "fleet.drones=4",
        "fleet.formation={shape: grid, spacing_m: 10}",
        "fleet.steering.separation_m=9.5",
        "duration_s=2",
    )
    lost = "events=[{kind: drone_lost, at_s: 0, drone: 1}]"
    x_m, y_m, z_m = states(flown(GOES, params(only=mover, do="Hold"), *settings), "x_m", "y_m", "z_m")[
        0, other
    ].tolist()
    record = flown(GOES, params(only=mover, x_m=x_m, y_m=y_m, z_m=z_m), *settings, lost)
    assert texts(record, mover)[0] == f"Goes: GoTo refused, it would come too near drone {other}"


def test_planners_read_what_their_policies_read(monkeypatch: pytest.MonkeyPatch) -> None:
    from sortie.sim.engine.pilot import plan_for
    from sortie.sim.engine.sortie import fly

    scenario = example(GOES, "duration_s=2", "record.views=true")
    parts = build(scenario, plan_for(scenario), 1)
    shown: list[tuple[int, Any]] = []
    read = parts.steering.read
    for pilot in parts.pilots:
        monkeypatch.setattr(pilot, "_steer", lambda drone, view: (shown.append((drone, view)), read(drone, view)))
    fly(parts)
    assert len(shown) == 5 * 20
    assert all(view.ego == drone for drone, view in shown)
    assert max(len(view.peers) for _, view in shown) == 4
    assert parts.journal is not None
    assert sum(table.num_rows for name, table in parts.journal.tables().items() if name == "views") == 5 * 20


def test_a_scenario_without_planners_has_none() -> None:
    from sortie.sim.engine.pilot import plan_for

    scenario = example("duration_s=1")
    parts = build(scenario, plan_for(scenario), 1)
    assert not parts.steering.anyone
    assert parts.scene.made_of[2] == parts.world.motion.bounds_m()
    planned = example("duration_s=1", GOES, "fleet.steering.reach_m=700")
    assert build(planned, plan_for(planned), 1).scene.made_of[2] == pytest.approx((-780, -720, 660, 720))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            (GOES, params(says="north")),
            ": returns 'north', must be None or one of GoTo, Velocity, Hold, Return, Land with "
            "finite numbers and speeds > 0",
        ),
        (
            (GOES, params(wrong=1)),
            f"mobility '{OWN}:Goes' has no parameter 'wrong', it has: do, x_m, y_m, z_m, only, says",
        ),
        ((f"fleet.mobility={OWN}:Calm",), "mobility Calm: TypeError"),
        (
            (GOES, "fleet.steering.altitude_m=[70, 90]"),
            "mobility Goes: drone 0 begins at a height of 60 m, must be within fleet.steering.altitude_m (70.0, 90.0)",
        ),
        (
            (GOES, "fleet.steering.fence_m=[0, 0, 9, 9]"),
            "mobility Goes: drone 0 begins at (-60, 0), must be within fleet.steering.fence_m (0.0, 0.0, 9.0, 9.0)",
        ),
        (
            ("fleet.mobility=random_walk",),
            'fleet.mobility: "random_walk", must be formation, random_waypoint, gauss_markov or path/to/file.py:Name',
        ),
        (
            ("fleet.mobility_params={a: 1}",),
            "fleet.mobility_params: {'a': 1}, must be left out where mobility is formation",
        ),
        (
            ("fleet.groups=[{drones: [1], mobility: gauss_markov, take_off: true}]",),
            "fleet.groups.0.take_off: true, must be left out where mobility is gauss_markov",
        ),
    ],
)
def test_what_does_not_fit_is_refused(settings: tuple[str, ...], said: str) -> None:
    with pytest.raises(SortieError) as refused:
        run_sortie(example("duration_s=1", *settings))
    assert said in str(refused.value)


@pytest.mark.parametrize("given", ['GoTo("a", 0)', "GoTo(None, 0)", "GoTo(0, 0, 0, -1)", "Velocity(1, None)"])
def test_a_command_without_numbers_is_refused(given: str, tmp_path: Path) -> None:
    own = tmp_path / "own.py"
    own.write_text(
        "from sortie.fleet.flight.steering import GoTo, Velocity\n\n"
        "class Says:\n    def __init__(self, drone, start_m, rng): pass\n"
        f"    def command(self, view): return {given}\n"
    )
    with pytest.raises(SortieError, match=r"^mobility Says on drone \d: returns .*, must be None or one of GoTo"):
        run_sortie(example("duration_s=1", f"fleet.mobility={own}:Says"))


def test_the_built_in_models_are_listed() -> None:
    lines = CliRunner().invoke(app, ["list", "mobility"]).output.splitlines()
    assert [line.partition("(")[0].split()[0] for line in lines] == ["formation", "random_waypoint", "gauss_markov"]
    assert "alpha=0.85" in lines[2]


def test_drones_that_begin_too_near_each_other_may_part() -> None:
    """The separation forbids to come nearer, not to be near."""
    settings = ("fleet.drones=2", "fleet.formation={shape: line, spacing_m: 4}", "fleet.steering.separation_m=8")
    record = flown(GOES, params(only=0, x_m=-40, y_m=-30), *settings, "duration_s=13")
    assert not [text for text in texts(record, 0) if "refused" in text]
    np.testing.assert_allclose(states(record, "x_m", "y_m")[-1, 0], (-40, -30), atol=0.1)


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
    place = states(record, "x_m", "y_m", "z_m")[:, 0]
    assert np.linalg.norm(place[32] - place[0]) > 3
    np.testing.assert_allclose(place[80], place[0], atol=1e-9)
    assert np.linalg.norm(np.diff(place[80:], axis=0), axis=-1).max() < 0.5
    np.testing.assert_allclose(place[-1], place[0] + (0, 0, 2), atol=0.1)


def test_the_slot_of_a_drone_that_may_come_back_is_kept_free_though_it_was_lost_elsewhere(tmp_path: Path) -> None:
    """Drone 1 is lost 20 m from its slot; drone 0 is then sent to that slot, and keeps its distance from it."""
    (tmp_path / "own.py").write_text(PLANS)
    events = "events=[{kind: drone_lost, at_s: 4, drone: 1}, {kind: drone_joins, at_s: 11.5, drone: 1}]"
    settings = (f"fleet.mobility={tmp_path / 'own.py'}:Follows", events, "fleet.steering.separation_m=8")
    place = states(flown(*settings, *TWO), "x_m", "y_m", "z_m")
    slot = place[0, 1]
    assert np.linalg.norm(place[40, 1] - slot) > 5
    np.testing.assert_allclose(place[115, 1], slot, atol=1e-9)
    assert 8.0 - 1e-6 < np.linalg.norm(place[:, 0] - slot, axis=-1).min() < 15.0
