"""The fleet as one agent: the environment of single drones, stacked and averaged."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from sim_examples import example

pytest.importorskip("pettingzoo")

from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv

from sortie.sim.env import SortieEnv, TeamEnv

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")
SHORT = (
    "perception.detector=surrogate",
    "duration_s=2",
    "fleet.drones=3",
    "mission.phases=[{at_s: 0, phase: search}]",
    "policy.dwell_s=0.3",
)
BOXES_TO_ALL = np.tile([1, 0, 2, 0], 6)


def test_the_fleet_as_one_agent_is_the_drones_together() -> None:
    check_env(TeamEnv(example(*SHORT)), skip_render_check=True, skip_close_check=True)
    team, drones = TeamEnv(example(*SHORT)), SortieEnv(example(*SHORT))
    seen, _ = team.reset(seed=3)
    each, _ = drones.reset(seed=3)
    assert np.array_equal(seen, np.stack(list(each.values())))
    for step in (1, 2):
        seen, reward, terminated, truncated, info = team.step(BOXES_TO_ALL)
        each, rewards, _, _, infos = drones.step(dict.fromkeys(drones.agents, BOXES_TO_ALL[:8]))
        assert reward == pytest.approx(np.mean(list(rewards.values())))
        assert info["sent_bytes"] == sum(i["sent_bytes"] for i in infos.values())
        assert (terminated, truncated) == (False, step == 2)
    team.reset()
    next_one = team.step(BOXES_TO_ALL)[1]
    team.reset(seed=3)
    team.reset()
    assert team.step(BOXES_TO_ALL)[1] == next_one, "without a seed: drawn from the last one given"
    team.close()


def test_an_action_of_another_length_than_the_fleet_s_is_refused() -> None:
    team = TeamEnv(example(*SHORT))
    for action in ([0] * 5, None):
        words = rf"^action: {re.escape(str(action))}, must be 24 whole numbers: those of each drone"
        with pytest.raises(ValueError, match=words):
            team.step(action)  # type: ignore[arg-type]


def test_many_fleets_fly_at_once_each_with_its_own_draws() -> None:
    fleets = SyncVectorEnv([lambda: TeamEnv(example(*SHORT, "duration_s=1"))] * 2)
    seen, _ = fleets.reset(seed=3)
    assert seen.shape == (2, 3, 3, 25)
    _, rewards, _, _, _ = fleets.step(np.zeros((2, 24), int))
    assert rewards[0] != rewards[1]
    fleets.close()


class DroneOneIsGone:
    """Stands for the environment of single drones."""

    possible_agents = ("drone_0", "drone_1", "drone_2")
    agents = ("drone_0", "drone_2")

    def __init__(self, action_space: object) -> None:
        self.action_space = action_space

    def step(self, given: dict[str, np.ndarray]) -> tuple[Any, ...]:
        assert {a: row.tolist() for a, row in given.items()} == {"drone_0": [*range(8)], "drone_2": [*range(16, 24)]}
        seen = {a: np.full((3, 25), float(a[-1]), np.float32) for a in self.agents}
        infos = {
            "drone_0": {"ap50": 0.5, "sent_bytes": 10, "spent_j": 1.0},
            "drone_2": {"ap50": None, "sent_bytes": 30, "spent_j": 2.0},
        }
        return seen, {"drone_0": 0.6, "drone_2": 0.3}, {}, dict.fromkeys(self.agents, False), infos


def test_a_team_s_figures_are_of_those_that_fly_and_its_reward_is_a_mean_over_all() -> None:
    team = TeamEnv(example("fleet.drones=3"))
    team.drones = DroneOneIsGone(team.drones.action_space)  # type: ignore[assignment]
    seen, reward, landed, over, info = team.step(np.arange(24))
    assert [float(seen[k].max()) for k in range(3)] == [0.0, 0.0, 2.0]
    assert reward == pytest.approx(0.3)
    assert (landed, over) == (False, False)
    assert info == {"sent_bytes": 40, "spent_j": 3.0, "ap50": 0.5}
