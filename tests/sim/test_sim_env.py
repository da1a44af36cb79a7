"""The environment for learners: PettingZoo's own tests, and that it is the sortie and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from sim_examples import example

pettingzoo = pytest.importorskip("pettingzoo")

from pettingzoo.test import parallel_api_test, parallel_seed_test  # noqa: E402

from sim.env import CHOICES, SortieEnv  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")
SHORT = ("duration_s=4", "fleet.drones=3", "mission.phases=[{at_s: 0, phase: search}]", "policy.dwell_s=0.3")
SEEN = ("perception.detector=surrogate", *SHORT)
FEATURES, SMALL, FAST = 2, 0, 2


def env(*sets: str) -> SortieEnv:
    return SortieEnv(example(*(sets or SHORT)))


def all_share(e: SortieEnv, rung: int = FEATURES) -> dict[str, np.ndarray]:
    return {a: np.array([[rung, SMALL, FAST, 0]] * (len(e.possible_agents) - 1)).ravel() for a in e.agents}


def test_pettingzoos_api_test() -> None:
    parallel_api_test(env(), num_cycles=12)


def test_pettingzoos_seed_test() -> None:
    parallel_seed_test(env, num_cycles=6)


def test_an_episode_is_the_sorties_seconds_and_then_over() -> None:
    e = env()
    e.reset(seed=3)
    steps = 0
    while e.agents:
        _, _, landed, over, _ = e.step(all_share(e))
        steps += 1
        assert not any(landed.values())
    assert steps == 4
    assert all(over.values())
    assert e.step({}) == ({}, {}, {}, {}, {})
    e.close()


def test_sharing_shows_in_reward_and_observation() -> None:
    totals = {}
    for name, rung in (("quiet", 0), ("boxes", 1)):
        e = env(*SEEN)
        e.reset(seed=3)
        rewards = []
        while e.agents:
            seen, reward, _, _, _ = e.step(all_share(e, rung))
            rewards.append(sum(reward.values()))
        totals[name] = sum(rewards[1:])
        row = seen["drone_1"]
        assert row.shape == (3, 24)
        assert row[:, 0].tolist() == [1, 1, 1], "heard"
        assert row[0, 2:5].tolist() == [0, 0, 0], "the ego is where it is"
        assert 15 < 100 * np.hypot(*row[1, 2:4]) < 45, "a neighbour's slot"
    assert totals["boxes"] > totals["quiet"]


def test_a_lost_drone_terminates_and_the_others_fly_on() -> None:
    e = env(*SHORT, "events=[{kind: drone_lost, drone: 1, at_s: 1.5}]")
    e.reset()
    gone = []
    while e.agents:
        _, _, landed, _, _ = e.step(all_share(e))
        gone.append([a for a, terminated in landed.items() if terminated])
    assert gone == [[], ["drone_1"], [], []]


def test_without_a_seed_episodes_differ_and_with_one_they_do_not() -> None:
    def flight(e: SortieEnv, seed: int | None) -> np.ndarray:
        e.reset(seed=seed)
        return e.step(all_share(e))[0]["drone_0"]

    e = env()
    assert not np.array_equal(flight(e, None), flight(e, None))
    assert np.array_equal(flight(e, 5), flight(e, 5))
    e.close()


def test_spaces_and_a_lone_drone() -> None:
    e = env()
    assert e.action_space("drone_0") is e.action_space("drone_0")
    assert e.action_space("drone_0").nvec.tolist() == [*CHOICES, *CHOICES]
    with pytest.raises(ValueError, match=r"fleet\.drones is 1, must be at least 2"):
        env("fleet.drones=1")
