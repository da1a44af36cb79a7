"""The environment for learners: PettingZoo's own tests, and that it is the sortie and nothing else."""

from __future__ import annotations

import copy
import gc
import pickle
import re
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from sim_examples import example

pettingzoo = pytest.importorskip("pettingzoo")

from pettingzoo.test import parallel_api_test, parallel_seed_test  # noqa: E402

from sortie.policies.observation import CHOICES  # noqa: E402
from sortie.sim.engine.sortie import run_sortie  # noqa: E402
from sortie.sim.env import COST_PER_KJ, SortieEnv, TeamEnv  # noqa: E402
from sortie.sim.results.outcome import outcome  # noqa: E402

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
        assert row.shape == (3, 25)
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


def test_a_drone_that_may_yet_join_stays_an_agent() -> None:
    """An agent that terminated may not come back."""
    events = "{kind: drone_joins, drone: 1, at_s: 2.5}, {kind: drone_lost, drone: 1, at_s: 3.5}"
    group = "mission.groups=[{drones: [0, 2], reserve: [2], phases: [{phase: search}]}]"
    e = env(*SHORT, f"events=[{events}]", group)
    e.reset()
    gone = []
    while e.agents:
        _, _, landed, _, _ = e.step(all_share(e))
        gone.append([a for a, terminated in landed.items() if terminated])
    assert gone == [[], [], [], ["drone_1"]]


def test_without_a_seed_episodes_differ_and_with_one_they_do_not() -> None:
    def flight(e: SortieEnv, seed: int | None) -> np.ndarray:
        e.reset(seed=seed)
        return e.step(all_share(e))[0]["drone_0"]

    e = env()
    assert not np.array_equal(flight(e, None), flight(e, None))
    assert np.array_equal(flight(e, 5), flight(e, 5))
    e.close()


def test_an_environment_that_nobody_holds_ends_its_sortie() -> None:
    before = set(threading.enumerate())
    e = env()
    e.reset(seed=1)
    copied = copy.deepcopy(e)
    copied.step({})
    begun = [thread for thread in threading.enumerate() if thread not in before]
    assert begun
    del e, copied
    gc.collect()
    assert not [thread.name for thread in begun if thread.is_alive()]


def test_a_closed_environment_has_no_agents_and_a_closed_fleet_is_over() -> None:
    """Otherwise `while env.agents` and `while not terminated` go on for ever."""
    e, team = env(), TeamEnv(example(*SHORT))
    for each in (e, team):
        each.reset(seed=3)
        each.close()
    assert e.agents == []
    assert team.step(np.zeros(24, int))[1:4] == (0.0, True, False)


def test_an_interrupted_step_is_flown_and_the_next_one_is_that_of_an_uninterrupted_flight() -> None:
    """Otherwise each later step would return the one before it, while the sortie flies on beside the caller."""

    class Interrupted(threading.Semaphore):
        pressed = False

        def acquire(self, *how: Any, **more: Any) -> bool:
            if not self.pressed:
                self.pressed = True
                raise KeyboardInterrupt
            return super().acquire(*how, **more)

    e, other = env(*SEEN), env(*SEEN)
    for each in (e, other):
        each.reset(seed=3)
    assert e._flight is not None
    e._flight._mine = Interrupted(0)
    with pytest.raises(KeyboardInterrupt):
        e.step(all_share(e, 1))
    other.step(all_share(other, 1))
    e._flight._spent_j = dict(other._flight._spent_j)  # type: ignore[union-attr] # its energy would count in the next step
    for _ in range(2):
        one, two = e.step(all_share(e, 1)), other.step(all_share(other, 1))
        assert one[1:] == two[1:]
        assert all(np.array_equal(one[0][a], two[0][a]) for a in one[0])
    for each in (e, other):
        each.close()


@pytest.mark.parametrize("asks", ["policy.invariants=rate_hz <= fresh.rate_hz", "record.disagreement=true"])
def test_a_drone_observes_what_it_heard_also_where_its_policy_is_asked_about_other_views(asks: str) -> None:
    def last_seen(*more: str) -> np.ndarray:
        e = env(*SHORT, "duration_s=1", *more)
        e.reset(seed=3)
        seen = e.step(all_share(e, 1))[0]
        e.close()
        return np.stack(list(seen.values()))

    assert np.array_equal(last_seen(asks), last_seen())


GOOD = [FEATURES, SMALL, FAST, 0] * 2


@pytest.mark.parametrize(
    "action",
    [
        [-1, *GOOD[1:]],
        [4, *GOOD[1:]],
        [*GOOD[:-1], 2],
        [0.5, *GOOD[1:]],
        np.array(GOOD, float),
        GOOD[:4],
        [GOOD[:4], GOOD[4:]],
        [GOOD[:4], [0]],
        [],
        7,
        None,
        "boxes",
        [2**70, *GOOD[1:]],
    ],
    ids=lambda a: str(a)[:30],
)
def test_an_action_outside_its_space_flies_nothing_and_the_step_may_be_tried_again(action: object) -> None:
    """The other drone's good action of the refused step is not taken up either."""
    e, untouched = env(), env()
    for each in (e, untouched):
        each.reset(seed=3)
        each.step({"drone_1": np.zeros(8, int)})
    with pytest.raises(ValueError, match=r"^drone_0: action .*, must be 8 whole numbers: .* 0 and at most 3, 3, 2, 1$"):
        e.step({"drone_1": np.array(GOOD), "drone_0": action})
    for steps in range(1, 4):
        tried, other = (each.step({"drone_0": GOOD}) for each in (e, untouched))
        assert tried[1:] == other[1:], steps
        assert all(np.array_equal(tried[0][a], other[0][a]) for a in other[0])
    assert not e.agents


@pytest.mark.parametrize("agent", ["drone_3", "", 0])
def test_an_action_of_nobody_is_refused(agent: object) -> None:
    e = env()
    e.reset()
    with pytest.raises(ValueError, match=rf"^actions: {agent!r}, must be of drone_0 … drone_2$"):
        e.step({agent: GOOD})  # type: ignore[dict-item]
    e.close()


def test_a_standing_action_is_the_environments_own() -> None:
    """Else a learner that fills one array anew each time changes actions that it did not give."""
    flown = []
    for overwrite in (False, True):
        e, action = env(), np.zeros(8, int)
        e.reset(seed=3)
        e.step({"drone_0": action})
        if overwrite:
            action[:] = GOOD
        flown.append([e.step({})[1]["drone_0"] for _ in range(3)])
    assert flown[0] == flown[1]


@pytest.mark.parametrize(
    ("rate_hz", "frames", "steps"), [(10.0, 10, 4), (3.0, 3, 4), (1.5, 2, 3), (2.5, 2, 5), (0.5, 1, 2)]
)
def test_a_step_is_the_whole_frames_nearest_to_a_second(rate_hz: float, frames: int, steps: int) -> None:
    e = env(*SHORT, f"context.rate_hz={rate_hz}")
    e.reset(seed=3)
    flown = []
    while e.agents:
        e.step({})
        assert e._flight is not None
        flown.append(e._flight._new["states"].num_rows // 3)
    assert (len(flown), set(flown[:-1])) == (steps, {frames})


@pytest.mark.parametrize("rate_hz", [10.0, 1.5])
def test_rewards_charge_for_what_the_ledger_says(rate_hz: float) -> None:
    """Nobody shares and nothing is scored, so that energy alone is rewarded; ohmic loss and a fault are part of it."""
    pack = (
        "fleet.battery.cell_resistance_mohm=40",
        "fleet.battery.polarisation.resistance_mohm=20",
        f"context.rate_hz={rate_hz}",
    )
    sets = (*SHORT, *pack, "events=[{kind: battery_fault, drone: 1, at_s: 1.2, lost_fraction: 0.01}]")
    e, totals = env(*sets), dict.fromkeys(range(3), 0.0)
    e.reset(seed=3)
    while e.agents:
        for agent, reward in e.step({})[1].items():
            totals[int(agent[-1])] -= reward / COST_PER_KJ
    spent = outcome(run_sortie(example(*sets), "silence", 3))
    assert spent["energy_j"]["ohmic"] > 0.05 * spent["energy_j"]["total"]
    assert [1e3 * totals[i] for i in range(3)] == pytest.approx([d["energy_j"] for d in spent["drones"].values()])


@pytest.mark.parametrize("error", [RuntimeError, SystemExit])
def test_what_went_wrong_in_the_sortie_is_said_each_time(
    monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise error("planted")

    monkeypatch.setattr("sortie.sim.env.fly_here", broken)
    e = env()
    for fly in (e.reset, lambda: e.step({})):
        with pytest.raises(error, match="planted"):
            fly()
    e.close()


def test_the_time_that_the_learner_takes_is_no_part_of_the_flight_s() -> None:
    e = env("limits.run_s=1e-6")
    e.reset(seed=1)
    assert e.step({})[0]
    e.close()


def test_spaces_and_a_lone_drone() -> None:
    e = env()
    assert e.action_space("drone_0") is e.action_space("drone_0")
    assert e.action_space("drone_0").nvec.tolist() == [*CHOICES, *CHOICES]
    with pytest.raises(ValueError, match=r"fleet\.drones is 1, must be at least 2"):
        env("fleet.drones=1")


def test_a_region_lies_where_the_ego_sees_it_whoever_publishes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """And a drone pays for what it sent, not for what it was sent."""
    from sortie.policies import observation
    from sortie.policies.contract import Disc
    from sortie.policies.verification.kit.views import draw_view
    from sortie.sim import env as env_room

    peer = next(iter(draw_view(1, 1).descriptors.values()))._replace(
        agent_id=1, position_m=(300.0, 0.0, 60.0), region=Disc(50.0, 20.0, 32.0)
    )
    me = peer._replace(agent_id=0, position_m=(10.0, -20.0, 60.0))
    for d in (me, peer):
        assert observation._row(me, d, 0.0)[-6:-2] == pytest.approx([1.0, 0.4, 0.4, 0.32])
    flight = object.__new__(env_room._Flight)
    fusions = pa.table({"drone": pa.array([], pa.int32())})
    sent = pa.table({"drone": [0, 0, 1], "peer": [1, 1, 0], "payload_bytes": [10**6, 2 * 10**6, 7 * 10**6]})
    flight._new, flight._mission, flight._scenario = {"fusions": fusions, "transmissions": sent}, None, None  # type: ignore[assignment]
    monkeypatch.setattr(env_room, "matched", lambda record, mission: {})
    monkeypatch.setattr(flight, "_spent_of", lambda drone: 0.0)
    assert flight.earned(0).reward == pytest.approx(-3 * env_room.COST_PER_MB)
    assert flight.earned(1).reward == pytest.approx(-7 * env_room.COST_PER_MB)


def test_infos_are_what_rewards_are_made_of_and_what_the_outcome_says() -> None:
    e = env(*SEEN)
    _, infos = e.reset(seed=3)
    assert set(map(len, infos.values())) == {0}
    sent, spent = 0, dict.fromkeys(e.possible_agents, 0.0)
    while e.agents:
        _, rewards, _, _, infos = e.step(all_share(e, 1))
        for agent, info in infos.items():
            sent += info["sent_bytes"]
            spent[agent] += info["spent_j"]
            assert rewards[agent] == pytest.approx(
                (info["ap50"] or 0.0) - 1e-8 * info["sent_bytes"] - 1e-5 * info["spent_j"]
            )
    assert any(0 < info["ap50"] <= 1 for info in infos.values())
    assert sent > 0
    assert min(spent.values()) > 100
    e.close()


def pickled(e: SortieEnv) -> SortieEnv:
    found = pickle.loads(pickle.dumps(e))  # noqa: S301 - our own
    assert isinstance(found, SortieEnv)
    return found


@pytest.mark.parametrize("copied", [copy.deepcopy, pickled])
def test_a_copy_goes_on_as_the_environment_does(copied: Callable[[SortieEnv], SortieEnv]) -> None:
    """Also after a drone has left, and the other is not moved by it."""
    e = env(*SEEN, "events=[{kind: drone_lost, drone: 1, at_s: 0.5}]")
    assert copied(e).agents == [], "before any episode"
    e.reset(seed=3)
    fresh = copied(e)
    first = e.step(all_share(e))
    other = copied(e)
    for one, two in ((fresh.step(all_share(fresh)), first), (other.step(all_share(other, 1)), e.step(all_share(e, 1)))):
        assert one[1:] == two[1:]
        assert one[0].keys() == two[0].keys()
        assert all(np.array_equal(one[0][a], two[0][a]) for a in one[0])
    assert other.agents == e.agents == ["drone_0", "drone_2"]
    for each in (e, fresh, other):
        each.close()
        assert each.step({}) == ({}, {}, {}, {}, {})


def test_the_fleet_as_one_agent() -> None:
    from gymnasium.utils.env_checker import check_env

    check_env(TeamEnv(example(*SHORT, "duration_s=2")), skip_render_check=True, skip_close_check=True)
    team = TeamEnv(example(*SEEN))
    seen, _ = team.reset(seed=3)
    drones = env(*SEEN)
    each, _ = drones.reset(seed=3)
    assert np.array_equal(seen, np.stack(list(each.values())))
    action = np.tile(all_share(drones, 1)["drone_0"], 3)
    for step in range(1, 5):
        seen, reward, terminated, truncated, info = team.step(action)
        each, rewards, _, _, infos = drones.step(all_share(drones, 1))
        assert reward == pytest.approx(np.mean(list(rewards.values())))
        assert info["sent_bytes"] == sum(i["sent_bytes"] for i in infos.values())
        assert (terminated, truncated) == (False, step == 4)
    team.reset()
    next_one = team.step(action)[1]
    team.reset(seed=3)
    team.reset()
    assert team.step(action)[1] == next_one, "without a seed: drawn from the last one given"
    team.close()


@pytest.mark.parametrize("action", [[0] * 5, None])
def test_an_action_of_another_length_than_the_fleet_s_is_refused(action: Any) -> None:
    team = TeamEnv(example(*SHORT))
    with pytest.raises(
        ValueError, match=rf"^action: {re.escape(str(action))}, must be 24 whole numbers: those of each drone"
    ):
        team.step(action)


def test_many_fleets_fly_at_once() -> None:
    from gymnasium.vector import SyncVectorEnv

    fleets = SyncVectorEnv([lambda: TeamEnv(example(*SEEN, "duration_s=2"))] * 2)
    seen, _ = fleets.reset(seed=3)
    assert seen.shape == (2, 3, 3, 25)
    _, rewards, _, _, _ = fleets.step(np.zeros((2, 24), int))
    assert rewards[0] != rewards[1], "each with its own draws"
    fleets.close()
