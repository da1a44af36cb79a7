"""The world of a sortie before it starts: who is there, losses that add up, and what a custom event may do."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from agent_rig import capture
from sim_examples import example

from sortie.perception.types import Boxes
from sortie.policies.contract import Disc
from sortie.scenarios.plugins.reference import PluginError
from sortie.sim.engine.events import Acted, FleetHandle
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import build
from sortie.sim.engine.world import OwnSenses, World


def _world(*sets: str) -> Any:
    scenario = example("duration_s=1", "fleet.drones=3", "mission.phases=[{at_s: 0, phase: search}]", *sets)
    return build(scenario, plan_for(scenario), 1).world


BEGINS: list[tuple[str, list[int]]] = [
    ("{kind: drone_joins, at_s: 0.2, drone: 1}", [1]),
    ("{kind: drone_joins, at_s: 0.3, drone: 1}, {kind: drone_lost, at_s: 0.1, drone: 1}", []),
    ("{kind: drone_leaves, at_s: 0.1, drone: 1}, {kind: drone_joins, at_s: 0.2, drone: 1}", []),
    ("{kind: drone_lost, at_s: 0.3, drone: 1}, {kind: drone_joins, at_s: 0.1, drone: 1}", [1]),
    ("{kind: drone_joins, at_s: 0.2, drone: 2}, {kind: drone_lost, at_s: 0.1, drone: 1}", [2]),
    ("{kind: cell_failure, at_s: 0.1, drone: 1}, {kind: drone_joins, at_s: 0.2, drone: 1}", [1]),
]


def test_a_drone_begins_on_the_ground_where_the_first_that_happens_to_it_is_that_it_joins() -> None:
    for events, on_the_ground in BEGINS:
        world = _world(f"events=[{events}]")
        assert [i for i, status in enumerate(world.drones) if not status.airborne] == on_the_ground, events


def test_a_drone_stays_where_it_was_in_the_frame_in_which_it_left_the_air() -> None:
    for at_s, frame in ((0.2, 2), (0.25, 2), (0.299, 2), (0.3, 3)):
        world = _world()
        world.env.run(until=at_s)
        world.ground(1)
        world.ground(1)  # it is down already
        assert world._down == {1: [(frame, 10)]}


def test_losses_of_events_and_of_a_user_s_events_add_up_and_each_is_taken_back_as_a_whole() -> None:
    world = _world()
    assert world.extra_loss_db is None
    world.weaken(1, 0, 1, 10.1)
    world.weaken(2, 0, 1, 0.2)
    world.set_loss(0, np.full((3, 3), 5.0))
    world.set_loss(4, np.full((3, 3), 2.0))
    world.set_jammer(4, ((0.0, 0.0, 1.0), 3.0))
    assert world.extra_loss_db[[0, 1, 0, 2], [1, 0, 2, 1]].tolist() == [10.1 + 0.2 + 7.0, 10.1 + 0.2 + 7.0, 7.0, 7.0]
    for cause in (4, 1, 0):
        world.lift(cause)
    assert world.jammers == []
    assert world.extra_loss_db.tolist() == [[0.0, 0.2, 0.0], [0.2, 0.0, 0.0], [0.0, 0.0, 0.0]]
    world.lift(2)
    assert world.extra_loss_db is None


def _handle(world: World) -> FleetHandle:
    acted = Acted(world._scenario, world, None, None, (), 0, 0)  # type: ignore[arg-type]
    return FleetHandle(acted, SimpleNamespace(model="mine", kind="own"), 3)  # type: ignore[arg-type]


def test_people_that_are_sent_are_those_within_the_region() -> None:
    world = _world()
    found = Boxes(np.array([[0.0, 0.0], [30.0, 0.0]]), np.ones((2, 2)), np.zeros(2), np.ones(2))
    world.people.found = lambda capture: found
    senses = OwnSenses(world, 0, None)  # type: ignore[arg-type]
    assert len(senses.people_in(capture(0, 0.0), None)) == 2
    assert senses.people_in(capture(0, 0.0), Disc(29.0, 0.0, 5.0)).xy_m.tolist() == [[30.0, 0.0]]


def test_a_custom_event_sees_the_drones_of_the_frame_and_weakens_a_link_one_way() -> None:
    world = _world()
    its = _handle(world)
    for t_s, frame in ((0.27, 2), (0.3, 3)):
        world.env.run(until=t_s)
        np.testing.assert_array_equal(its.positions_m, world.motion[:].position_m[frame])
    one_way = np.zeros((3, 3))
    one_way[0, 2] = 9.0
    its.set_loss_db(one_way)
    one_way[0, 2] = 1.0  # it keeps a copy
    assert world.extra_loss_db[0, 2] == 9.0
    assert world.extra_loss_db.sum() == 9.0
    its.set_loss_db(4.0)
    assert world.extra_loss_db.tolist() == [[0.0, 4.0, 4.0], [4.0, 0.0, 4.0], [4.0, 4.0, 0.0]]


def test_what_an_event_asks_for_adds_up_and_what_cannot_be_is_refused() -> None:
    world = _world()
    its = _handle(world)
    its.weaken(0, 1, 3.0)
    its.weaken(0, None, 4)
    assert world.extra_loss_db.tolist() == [[8.0, 7.0, 4.0], [7.0, 0.0, 0.0], [4.0, 0.0, 0.0]]
    its.lift()
    assert world.extra_loss_db is None
    nobody = "drone -1, must be a whole number, 0 … 2$"
    lie = r"a lie 'speed', 'much', must be one of each: coverage, goodput, battery; much, little$"
    for act, text in (
        (lambda: its.weaken(0, -1, 3.0), nobody),
        (lambda: its.weaken(0, 1, -3.0), r"a loss of -3.0 dB, must be finite and ≥ 0$"),
        (lambda: its.join(-1), nobody),
        (lambda: its.send_home(-1), nobody),
        (lambda: its.block_cameras(-1), nobody),
        (lambda: its.lie(0, "speed", "much"), lie),
        (lambda: its.slow(0, float("nan")), "perception slower by nan s, must be finite and ≥ 0$"),
    ):
        with pytest.raises(PluginError, match=rf"^event mine: {text}"):
            act()


def test_a_custom_event_writes_no_note_that_the_record_cannot_hold() -> None:
    world = _world()
    its = _handle(world)
    for text in (5, None, b"storm"):
        for act in (lambda text=text: its.note(text), lambda text=text: its.lose(0, text)):
            with pytest.raises(PluginError, match=r"^event mine: text .+, must be a str$"):
                act()
    for drone in (-2, 3, 1.5, "a", None):
        with pytest.raises(PluginError, match=rf"^event mine: drone {drone!r}, must be a whole number, -1 … 2$"):
            its.note("x", drone)  # type: ignore[arg-type]
    assert world.drones[0].airborne
    for fits in (-1, 2, np.int64(1)):
        its.note("x", fits)
    assert [row[1] for row in world._recorder.rows["events"]] == [-1, 2, 1]
