"""Who is out of an environment for learners, and what a step cost, from tables of a few rows."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest
from sim_examples import example

pytest.importorskip("pettingzoo")

from sortie.sim.env import Earned, TeamEnv, _Flight

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")
LATE = "events=[{kind: drone_joins, at_s: 5, drone: 1}, {kind: drone_joins, at_s: 2, drone: 1}, {kind: drone_lost, at_s: 3, drone: 1}]"
RESERVE = "mission.groups=[{drones: [0, 2], reserve: [2], phases: [{phase: search}]}]"


def flight(*sets: str) -> _Flight:
    """A flight that is not begun."""
    return _Flight(example("fleet.drones=3", *sets), 1, 0)


def told(its: _Flight, t_s: float, airborne: dict[int, list[bool]], **spent_j: float) -> None:
    """The tables of a step."""
    rows = [(d, is_up, spent_j.get(f"of_{d}", 0.0)) for d, each in airborne.items() for is_up in each]
    drone, up, spent = zip(*rows, strict=True) if rows else ((), (), ())
    states = {"drone": pa.array(drone, pa.int32()), "airborne": pa.array(up, pa.bool_()), "spent_j": pa.array(spent, pa.float64())}  # fmt: skip
    its._new, its._t_s = {"states": pa.table(states)}, t_s


def test_a_drone_is_out_once_it_is_down_and_its_last_time_to_join_has_passed() -> None:
    its = flight(LATE)
    told(its, 4.0, {0: [True, True], 1: [True, False], 2: [True, False]})
    assert [its.is_out(d) for d in range(3)] == [False, False, True]
    told(its, 5.0, {0: [True], 1: [False], 2: [False]})
    assert [its.is_out(d) for d in range(3)] == [False, True, True]
    told(its, 5.0, {0: [False, True], 1: [False, True]})
    assert [its.is_out(d) for d in range(3)] == [False, False, False], "up again, and one without rows"


def test_a_reserve_that_waits_is_not_out_until_it_has_flown() -> None:
    its = flight(RESERVE)
    for up, out in (([False], False), ([False, False], False), ([False, True], False), ([True, False], True)):
        told(its, 1.0, {2: up})
        assert its.is_out(2) is out


def test_what_a_step_spent_is_what_came_since_the_step_before() -> None:
    its = flight()
    spent = []
    for total_j in (100.0, 130.0, 190.0):
        told(its, 1.0, {0: [True, True], 1: [True]}, of_0=total_j, of_1=2 * total_j)
        spent.append((its._spent_of(0), its._spent_of(1)))
    assert spent == [(100.0, 200.0), (30.0, 60.0), (60.0, 120.0)]
    its.done = True
    its._new = {"energy": pa.table({"drone": [0, 1, 0], "energy_j": [150.0, 400.0, 50.0]})}
    assert (its._spent_of(0), its._spent_of(1)) == (10.0, 20.0)


def test_a_reward_is_the_ap_less_a_hundredth_a_megabyte_and_a_kilojoule() -> None:
    assert Earned(0.5, 3_000_000, 4000.0).reward == pytest.approx(0.5 - 0.03 - 0.04)
    assert Earned(None, 1_000_000, 0.0).reward == pytest.approx(-0.01)


def test_standing_actions_stay_where_none_is_given() -> None:
    its = flight()
    its.advance = lambda: told(its, 1.0, {})  # type: ignore[method-assign]
    for actions in ({0: np.zeros((2, 4), int)}, {1: np.ones((2, 4), int)}):
        its.fly(actions, [])
    assert {d: int(a.sum()) for d, a in its.actions.items()} == {0: 0, 1: 8}


class _Told:
    """Stands for the environment of single drones: drone 1 of three is gone."""

    possible_agents = ["drone_0", "drone_1", "drone_2"]  # noqa: RUF012
    agents = ["drone_0", "drone_2"]  # noqa: RUF012

    def __init__(self, action_space: object) -> None:
        self.action_space = action_space

    def step(self, given: dict[str, np.ndarray]) -> tuple:
        assert {a: row.tolist() for a, row in given.items()} == {"drone_0": [*range(8)], "drone_2": [*range(16, 24)]}
        seen = {a: np.full((3, 25), float(a[-1]), np.float32) for a in self.agents}
        infos = {
            "drone_0": {"ap50": 0.5, "sent_bytes": 10, "spent_j": 1.0},
            "drone_2": {"ap50": None, "sent_bytes": 30, "spent_j": 2.0},
        }
        return seen, {"drone_0": 0.6, "drone_2": 0.3}, {}, dict.fromkeys(self.agents, False), infos


def test_a_team_s_figures_are_of_those_that_fly_and_its_reward_is_a_mean_over_all() -> None:
    team = TeamEnv(example("fleet.drones=3"))
    team.drones = _Told(team.drones.action_space)  # type: ignore[assignment]
    seen, reward, landed, over, info = team.step(np.arange(24))
    assert [float(seen[k].max()) for k in range(3)] == [0.0, 0.0, 2.0]
    assert reward == pytest.approx(0.3)
    assert (landed, over) == (False, False)
    assert info == {"sent_bytes": 40, "spent_j": 3.0, "ap50": 0.5}
