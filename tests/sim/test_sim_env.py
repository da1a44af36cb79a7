"""The environment for learners: PettingZoo's own tests, and that it is the sortie and nothing else."""

from __future__ import annotations

import copy
import gc
import pickle
import threading
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from sim_examples import example

pettingzoo = pytest.importorskip("pettingzoo")

from pettingzoo.test import parallel_api_test, parallel_seed_test  # noqa: E402

from sortie.policies import observation  # noqa: E402
from sortie.policies.contract import Disc  # noqa: E402
from sortie.policies.observation import CHOICES  # noqa: E402
from sortie.policies.verification.kit.views import draw_view  # noqa: E402
from sortie.sim import env as env_room  # noqa: E402
from sortie.sim.engine.sortie import run_sortie  # noqa: E402
from sortie.sim.env import COST_PER_KJ, Earned, SortieEnv, TeamEnv, _Flight  # noqa: E402
from sortie.sim.results.outcome import outcome  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")
SHORT = ("duration_s=3", "fleet.drones=3", "mission.phases=[{at_s: 0, phase: search}]", "policy.dwell_s=0.3")
SEEN = ("perception.detector=surrogate", *SHORT)
FEATURES, SMALL, FAST = 2, 0, 2
GOOD = [FEATURES, SMALL, FAST, 0] * 2


def env(*sets: str) -> SortieEnv:
    return SortieEnv(example(*(sets or SHORT)))


def all_share(e: SortieEnv, rung: int = FEATURES) -> dict[str, np.ndarray]:
    return {a: np.array([[rung, SMALL, FAST, 0]] * (len(e.possible_agents) - 1)).ravel() for a in e.agents}


def assert_same_step(one: tuple[Any, ...], other: tuple[Any, ...]) -> None:
    assert one[1:] == other[1:]
    assert one[0].keys() == other[0].keys()
    assert all(np.array_equal(one[0][a], other[0][a]) for a in one[0])


def test_pettingzoo_s_own_tests() -> None:
    parallel_api_test(env(), num_cycles=8)
    parallel_seed_test(env, num_cycles=4)


# --- an episode ----------------------------------------------------------------------------------


def test_sharing_shows_in_reward_and_observation_and_infos_are_what_rewards_are_made_of() -> None:
    totals = {}
    for name, rung in (("quiet", 0), ("boxes", 1)):
        e = env(*SEEN)
        _, infos = e.reset(seed=3)
        assert set(map(len, infos.values())) == {0}
        steps = []
        while e.agents:
            seen, rewards, landed, over, infos = e.step(all_share(e, rung))
            assert not any(landed.values())
            for agent, info in infos.items():
                earned = (info["ap50"] or 0.0) - 1e-8 * info["sent_bytes"] - 1e-5 * info["spent_j"]
                assert rewards[agent] == pytest.approx(earned)
                assert info["spent_j"] > 100
            assert (infos["drone_0"]["sent_bytes"] > 0) == (rung > 0)
            steps.append(sum(rewards.values()))
        assert len(steps) == 3
        assert all(over.values())
        assert e.step({}) == ({}, {}, {}, {}, {})
        totals[name] = sum(steps[1:])
        row = seen["drone_1"]
        assert row.shape == (3, 25)
        assert row[:, 0].tolist() == [1, 1, 1], "heard"
        assert row[0, 2:5].tolist() == [0, 0, 0], "the ego is where it is"
        assert 15 < 100 * np.hypot(*row[1, 2:4]) < 45, "a neighbour's slot"
    assert totals["boxes"] > totals["quiet"]


def test_a_lost_drone_terminates_but_not_one_that_may_yet_join() -> None:
    """An agent that terminated may not come back."""
    joins = "{kind: drone_joins, drone: 1, at_s: 1.5}, {kind: drone_lost, drone: 1, at_s: 2.5}"
    reserve = "mission.groups=[{drones: [0, 2], reserve: [2], phases: [{phase: search}]}]"
    for sets, wanted in (
        (["events=[{kind: drone_lost, drone: 1, at_s: 0.5}]"], [["drone_1"], [], []]),
        ([f"events=[{joins}]", reserve], [[], [], ["drone_1"]]),
    ):
        e = env(*SHORT, *sets)
        e.reset()
        gone = []
        while e.agents:
            _, _, landed, _, _ = e.step(all_share(e))
            gone.append([a for a, terminated in landed.items() if terminated])
        assert gone == wanted


def test_a_drone_is_out_once_it_is_down_and_its_last_time_to_join_has_passed() -> None:
    late = "{kind: drone_joins, at_s: 5, drone: 1}, {kind: drone_joins, at_s: 2, drone: 1}"
    flight = begun_not(f"events=[{late}, {{kind: drone_lost, at_s: 3, drone: 1}}]")
    tell(flight, 4.0, {0: [True, True], 1: [True, False], 2: [True, False]})
    assert [flight.is_out(d) for d in range(3)] == [False, False, True]
    tell(flight, 5.0, {0: [True], 1: [False], 2: [False]})
    assert [flight.is_out(d) for d in range(3)] == [False, True, True]
    tell(flight, 5.0, {0: [False, True], 1: [False, True]})
    assert [flight.is_out(d) for d in range(3)] == [False, False, False], "up again, and one without rows"
    waits = begun_not("mission.groups=[{drones: [0, 2], reserve: [2], phases: [{phase: search}]}]")
    for up, out in (([False], False), ([False, False], False), ([False, True], False), ([True, False], True)):
        tell(waits, 1.0, {2: up})
        assert waits.is_out(2) is out, "a reserve that waits is not out until it has flown"


def begun_not(*sets: str) -> _Flight:
    """A flight that is not begun."""
    return _Flight(example("fleet.drones=3", *sets), 1, 0)


def tell(flight: _Flight, t_s: float, airborne: dict[int, list[bool]], **spent_j: float) -> None:
    """The tables of a step."""
    rows = [(d, is_up, spent_j.get(f"of_{d}", 0.0)) for d, each in airborne.items() for is_up in each]
    drone, up, spent = zip(*rows, strict=True) if rows else ((), (), ())
    columns = {"drone": (drone, pa.int32()), "airborne": (up, pa.bool_()), "spent_j": (spent, pa.float64())}
    flight._new = {"states": pa.table({name: pa.array(values, kind) for name, (values, kind) in columns.items()})}
    flight._t_s = t_s


@pytest.mark.parametrize(("rate_hz", "frames", "steps"), [(10.0, 10, 3), (1.5, 2, 3), (0.5, 1, 2)])
def test_a_step_is_the_whole_frames_nearest_to_a_second(rate_hz: float, frames: int, steps: int) -> None:
    e = env(*SHORT, f"context.rate_hz={rate_hz}")
    e.reset(seed=3)
    flown = []
    while e.agents:
        e.step({})
        assert e._flight is not None
        flown.append(e._flight._new["states"].num_rows // 3)
    assert (len(flown), set(flown[:-1])) == (steps, {frames})


def test_without_a_seed_episodes_differ_and_with_one_they_do_not() -> None:
    def flight(e: SortieEnv, seed: int | None) -> np.ndarray:
        e.reset(seed=seed)
        return e.step(all_share(e))[0]["drone_0"]

    e = env()
    assert not np.array_equal(flight(e, None), flight(e, None))
    assert np.array_equal(flight(e, 5), flight(e, 5))
    e.close()


@pytest.mark.parametrize("asks", ["policy.invariants=rate_hz <= fresh.rate_hz", "record.disagreement=true"])
def test_a_drone_observes_what_it_heard_also_where_its_policy_is_asked_about_other_views(asks: str) -> None:
    def last_seen(*more: str) -> np.ndarray:
        e = env(*SHORT, "duration_s=1", *more)
        e.reset(seed=3)
        seen = e.step(all_share(e, 1))[0]
        e.close()
        return np.stack(list(seen.values()))

    assert np.array_equal(last_seen(asks), last_seen())


# --- its end and its copies ----------------------------------------------------------------------


def test_an_environment_that_nobody_holds_or_that_is_closed_ends_its_sortie() -> None:
    """Otherwise `while env.agents` and `while not terminated` go on for ever."""
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
    closed, team = env(), TeamEnv(example(*SHORT))
    for each in (closed, team):
        each.reset(seed=3)
        each.close()
    assert closed.agents == []
    assert team.step(np.zeros(24, int))[1:4] == (0.0, True, False)


@pytest.mark.parametrize("how", ["deepcopy", "pickle"])
def test_a_copy_goes_on_as_the_environment_does(how: str) -> None:
    """Also after a drone has left, and the other is not moved by it."""

    def copied(e: SortieEnv) -> SortieEnv:
        found = copy.deepcopy(e) if how == "deepcopy" else pickle.loads(pickle.dumps(e))  # noqa: S301 - our own
        assert isinstance(found, SortieEnv)
        return found

    e = env(*SEEN, "events=[{kind: drone_lost, drone: 1, at_s: 0.5}]")
    assert copied(e).agents == [], "before any episode"
    e.reset(seed=3)
    fresh = copied(e)
    first = e.step(all_share(e))
    other = copied(e)
    assert_same_step(fresh.step(all_share(fresh)), first)
    assert_same_step(other.step(all_share(other, 1)), e.step(all_share(e, 1)))
    assert other.agents == e.agents == ["drone_0", "drone_2"]
    for each in (e, fresh, other):
        each.close()
        assert each.step({}) == ({}, {}, {}, {}, {})


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
    e._flight._spent_j = dict(other._flight._spent_j)  # type: ignore[union-attr]
    for _ in range(2):
        assert_same_step(e.step(all_share(e, 1)), other.step(all_share(other, 1)))


@pytest.mark.parametrize("error", [RuntimeError, SystemExit])
def test_what_went_wrong_in_the_sortie_is_raised_each_time(
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


# --- actions -------------------------------------------------------------------------------------

BAD_ACTIONS: list[object] = [
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
]


def test_a_wrong_action_flies_nothing_and_the_step_may_be_tried_again() -> None:
    """The other drone's good action of the refused step is not taken up either."""
    e, untouched = env(), env()
    for each in (e, untouched):
        each.reset(seed=3)
        each.step({"drone_1": np.zeros(8, int)})
    for action in BAD_ACTIONS:
        words = r"^drone_0: action .*, must be 8 whole numbers: .* 0 and at most 3, 3, 2, 1$"
        with pytest.raises(ValueError, match=words):
            e.step({"drone_1": np.array(GOOD), "drone_0": action})
    for agent in ("drone_3", "", 0):
        with pytest.raises(ValueError, match=rf"^actions: {agent!r}, must be of drone_0 … drone_2$"):
            e.step({agent: GOOD})  # type: ignore[dict-item]
    for _ in range(2):
        tried, other = (each.step({"drone_0": GOOD}) for each in (e, untouched))
        assert_same_step(tried, other)
    assert not e.agents


def test_a_standing_action_is_the_environment_s_own_and_stays_where_none_is_given() -> None:
    """Else a learner that fills one array anew each time changes actions that it did not give."""
    flown = []
    for overwrite in (False, True):
        e, action = env(), np.zeros(8, int)
        e.reset(seed=3)
        e.step({"drone_0": action})
        if overwrite:
            action[:] = GOOD
        flown.append([e.step({})[1]["drone_0"] for _ in range(2)])
    assert flown[0] == flown[1]
    flight = begun_not()
    flight.advance = lambda: tell(flight, 1.0, {})  # type: ignore[method-assign]
    for actions in ({0: np.zeros((2, 4), int)}, {1: np.ones((2, 4), int)}):
        flight.fly(actions, [])
    assert {d: int(a.sum()) for d, a in flight.actions.items()} == {0: 0, 1: 8}


def test_spaces_and_a_lone_drone() -> None:
    e = env()
    assert e.action_space("drone_0") is e.action_space("drone_0")
    assert e.action_space("drone_0").nvec.tolist() == [*CHOICES, *CHOICES]
    with pytest.raises(ValueError, match=r"fleet\.drones is 1, must be at least 2"):
        env("fleet.drones=1")


# --- rewards -------------------------------------------------------------------------------------


def test_a_reward_is_the_ap_less_a_hundredth_a_megabyte_and_a_kilojoule() -> None:
    assert Earned(0.5, 3_000_000, 4000.0).reward == pytest.approx(0.5 - 0.03 - 0.04)
    assert Earned(None, 1_000_000, 0.0).reward == pytest.approx(-0.01)


def test_what_a_step_spent_is_what_came_since_the_step_before() -> None:
    flight = begun_not()
    spent = []
    for total_j in (100.0, 130.0, 190.0):
        tell(flight, 1.0, {0: [True, True], 1: [True]}, of_0=total_j, of_1=2 * total_j)
        spent.append((flight._spent_of(0), flight._spent_of(1)))
    assert spent == [(100.0, 200.0), (30.0, 60.0), (60.0, 120.0)]
    flight.done = True
    flight._new = {"energy": pa.table({"drone": [0, 1, 0], "energy_j": [150.0, 400.0, 50.0]})}
    assert (flight._spent_of(0), flight._spent_of(1)) == (10.0, 20.0)


def test_rewards_charge_for_what_the_ledger_says() -> None:
    """Nobody shares and nothing is scored, so energy alone is rewarded; ohmic loss and a fault are part of it."""
    sets = (
        *SHORT,
        "fleet.battery.cell_resistance_mohm=40",
        "fleet.battery.polarisation.resistance_mohm=20",
        "context.rate_hz=1.5",
        "events=[{kind: battery_fault, drone: 1, at_s: 1.2, lost_fraction: 0.01}]",
    )
    e, totals = env(*sets), dict.fromkeys(range(3), 0.0)
    e.reset(seed=3)
    while e.agents:
        for agent, reward in e.step({})[1].items():
            totals[int(agent[-1])] -= reward / COST_PER_KJ
    spent = outcome(run_sortie(example(*sets), "silence", 3))
    assert spent["energy_j"]["ohmic"] > 0.05 * spent["energy_j"]["total"]
    assert [1e3 * totals[i] for i in range(3)] == pytest.approx([d["energy_j"] for d in spent["drones"].values()])


def test_a_region_lies_where_the_ego_sees_it_whoever_publishes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """And a drone pays for what it sent, not for what it was sent."""
    peer = next(iter(draw_view(1, 1).descriptors.values()))._replace(
        agent_id=1, position_m=(300.0, 0.0, 60.0), region=Disc(50.0, 20.0, 32.0)
    )
    me = peer._replace(agent_id=0, position_m=(10.0, -20.0, 60.0))
    for d in (me, peer):
        assert observation._row(me, d, 0.0)[-6:-2] == pytest.approx([1.0, 0.4, 0.4, 0.32])
    flight = object.__new__(_Flight)
    fusions = pa.table({"drone": pa.array([], pa.int32())})
    sent = pa.table({"drone": [0, 0, 1], "peer": [1, 1, 0], "payload_bytes": [10**6, 2 * 10**6, 7 * 10**6]})
    flight._new, flight._mission = {"fusions": fusions, "transmissions": sent}, None
    flight._scenario = None  # type: ignore[assignment]
    monkeypatch.setattr(env_room, "matched", lambda record, mission: {})
    monkeypatch.setattr(flight, "_spent_of", lambda drone: 0.0)
    assert flight.earned(0).reward == pytest.approx(-3 * env_room.COST_PER_MB)
    assert flight.earned(1).reward == pytest.approx(-7 * env_room.COST_PER_MB)
