"""The sortie as a PettingZoo `ParallelEnv`: what learners of sharing policies train in. Needs the extra `env`.

    env = SortieEnv(load("track_target", ["perception.detector=surrogate"]))
    observations, infos = env.reset(seed=1)
    observations, rewards, terminations, truncations, infos = env.step({"drone_0": env.action_space("drone_0").sample(), …})

A step is as many whole frames as come nearest to one simulated second, and never none: exactly a second where
`context.rate_hz` is a whole number, 1.33 s at 1.5 Hz, 2 s at 0.5 Hz; the last step ends with the sortie. Each drone's
action stands for its directives until the next. All that stands between a policy and the gate (checks, staleness,
damping) stands there too. The sortie runs in a thread of its own that takes turns with the caller, so that the same seed
and actions give the same record. A copy of an environment, by `copy.deepcopy` or by pickle, flies the steps taken so far
again before its next one, and goes on from there.

`TeamEnv` is the whole fleet as one agent, for libraries without multi-agent environments and for `gymnasium.vector`.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sortie.perception.metrics.ap import average_precision
from sortie.policies.contract import Directive, FleetView
from sortie.policies.observation import CHOICES, LIMIT, ROW, Obs, directives, observe
from sortie.scenarios.frames import instant
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.schema import MemberEvent, Scenario
from sortie.scenarios.whole import whole
from sortie.sim.engine.sortie import fly_here
from sortie.sim.folders import RunError
from sortie.sim.identity import code_version
from sortie.sim.results.accuracy import matched
from sortie.sim.results.record import SortieRecord

COST_PER_MB, COST_PER_KJ = 0.01, 0.01


class Earned(NamedTuple):
    """What a drone gained and paid in a step."""

    ap50: float | None
    """AP@0.5 of its own fusions (mission disc where there is one); None where nothing was scored."""
    sent_bytes: int
    """Payloads that it handed to the radio."""
    spent_j: float
    """Energy that left its pack, J."""

    @property
    def reward(self) -> float:
        """The AP, less `COST_PER_MB` and `COST_PER_KJ`."""
        return (self.ap50 or 0.0) - COST_PER_MB * self.sent_bytes / 1e6 - COST_PER_KJ * self.spent_j / 1e3


class _Closed(BaseException):
    """Ends the sortie's thread."""


class SortieEnv(ParallelEnv):  # type: ignore[misc]
    """One sortie an episode, one agent a drone.

    | | |
    |---|---|
    | agents | `drone_0` …; one that lands or is lost terminates unless it may join again, at the scenario's end all are truncated |
    | observation | float32 [N, 25]: the ego's row first, then the others by ascending id, as the ego last heard them; zeros where it heard nothing |
    | action | for each other drone by ascending id: rung, ρ, rate, region (`CHOICES`) |
    | reward | AP@0.5 of the drone's own fusions in the step (mission disc where there is one), less 0.01 a MB that it sent and 0.01 a kJ that it spent |
    | info | after a step: the parts of the reward, `ap50` (None where nothing was scored), `sent_bytes` and `spent_j` |
    """

    metadata = {"name": "sortie_v0", "render_modes": [], "is_parallelizable": True}  # noqa: RUF012 - the library's own way

    def __init__(self, scenario: Scenario) -> None:
        """Args: `scenario` with at least two drones; its policy and its `limits` are not used.

        Raises:
            RunError: a lone drone, which has nothing to decide.
        """
        n = scenario.fleet.drones
        if n < 2:
            raise RunError(f"fleet.drones is {n}, must be at least 2 to share")
        scored = scenario.perception.model_copy(
            update={"egos": max(n, scenario.perception.egos)}
        )  # each drone is rewarded for its own boxes
        self.scenario, self.render_mode = scenario.model_copy(update={"perception": scored}), None
        self.possible_agents = [f"drone_{i}" for i in range(n)]
        self.agents: list[str] = []
        self._spaces = {
            a: (
                spaces.Box(-LIMIT, LIMIT, (n, ROW), np.float32),
                spaces.MultiDiscrete(np.array([CHOICES] * (n - 1)).ravel()),
            )
            for a in self.possible_agents
        }
        self._episodes = 0
        self._flight: _Flight | None = None
        self._end: weakref.finalize[..., SortieEnv] | None = None
        self._begun: tuple[int | None, int] | None = None
        self._steps: list[tuple[dict[int, np.ndarray[Any, Any]], list[str]]] = []
        """Actions and agents of each step of the episode, from which a copy flies it again."""

    def observation_space(self, agent: str) -> spaces.Box:
        """The same object for the same agent."""
        return self._spaces[agent][0]

    def action_space(self, agent: str) -> spaces.MultiDiscrete:
        """The same object for the same agent."""
        return self._spaces[agent][1]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Obs], dict[str, dict[str, Any]]]:
        """Begin a sortie; without a seed the scenario's, in another replication each time.

        Raises:
            ScenarioError: the seed is no whole number from 0 to 2^63 - 1.
        """
        seed = whole("seed", seed)
        self.close()
        replication = self._episodes if seed is None else 0
        self._episodes += 1
        self.agents = list(self.possible_agents)
        self._begun, self._steps = (seed, replication), []
        self._begin(seed, replication)
        return {a: self._observe(a) for a in self.agents}, {a: {} for a in self.agents}

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Obs], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Fly one step under these actions; one that is missing stays as it was.

        Raises:
            RunError: no such agent, or an action outside its space; nothing has been flown, the step may be tried again.
        """
        flight = self._resumed() if self.agents else None
        if flight is None:
            return {}, {}, {}, {}, {}
        taken = {agent: self._checked(agent, action) for agent, action in actions.items()}
        step = {int(agent.removeprefix("drone_")): action for agent, action in taken.items()}, self.agents
        self._steps.append(step)
        earned, landed = flight.fly(*step)
        flying = self.agents
        over = dict.fromkeys(flying, flight.done)
        observations = {a: self._observe(a) for a in flying}
        self.agents = [] if flight.done else [a for a in flying if not landed[a]]
        infos = {a: earned[a]._asdict() for a in flying}
        return observations, {a: earned[a].reward for a in flying}, landed, over, infos

    def _resumed(self) -> _Flight | None:
        """The flight; of a copy one that has flown the same steps."""
        if self._flight is None and self._begun is not None:
            flight = self._begin(*self._begun)
            for step in self._steps:
                flight.fly(*step)
        return self._flight

    def _begin(self, seed: int | None, replication: int) -> _Flight:
        self._flight = flight = _Flight(self.scenario, seed, replication)
        self._end = weakref.finalize(self, flight.close)  # also where nobody closes the environment
        flight.advance()
        return flight

    def __getstate__(self) -> dict[str, Any]:
        """All but the flight, which runs in a thread."""
        return {**self.__dict__, "_flight": None, "_end": None}

    def close(self) -> None:
        """End the sortie's thread, and with it the episode."""
        if self._end is not None:
            self._end()
        self._flight = self._begun = self._end = None
        self.agents = []

    def render(self) -> None:
        """Nothing: `sortie fly --live` draws."""

    def _checked(self, agent: str, action: Any) -> np.ndarray[Any, Any]:
        """The action by link [N - 1, choices], a copy: the sortie's thread would wrap a −1 around and cut a 0.5 off."""
        if agent not in self._spaces:
            raise RunError(f"actions: {agent!r}, must be of {self.possible_agents[0]} … {self.possible_agents[-1]}")
        space = self.action_space(agent)
        try:
            given = np.array(action)
        except (TypeError, ValueError):  # rows of several lengths
            given = np.array(None)
        if not space.contains(given):
            said = f"{given.tolist() if given.shape else action!r}"
            most = ", ".join(str(n - 1) for n in CHOICES)
            raise RunError(
                f"{agent}: action {said}, must be {space.shape[0]} whole numbers: "
                f"for each other drone {len(CHOICES)} of at least 0 and at most {most}"
            )
        return given.reshape(-1, len(CHOICES))

    def _observe(self, agent: str) -> Obs:
        assert self._flight is not None  # noqa: S101
        ego = int(agent.removeprefix("drone_"))
        return observe(self._flight.views.get(ego), self._others(ego))

    def _others(self, ego: int) -> list[int]:
        return [i for i in range(len(self.possible_agents)) if i != ego]


class _Flight:
    """A sortie in its own thread; `advance` lets it fly one step (the sortie's "second"). Policy and observer of that sortie."""

    def __init__(self, scenario: Scenario, seed: int | None, replication: int) -> None:
        self.actions: dict[int, np.ndarray[Any, Any]] = {}
        self.views: dict[int, FleetView] = {}
        self.done = self._flown = False
        self._scenario, self._t_s = scenario, 0.0
        joins = [e for e in scenario.events if isinstance(e, MemberEvent) and e.presence == "in"]
        self._joins_s = {e.drone: e.at_s for e in sorted(joins, key=lambda e: e.at_s)}  # the last time
        self._waiting = {drone for group in scenario.mission.groups for drone in group.reserve}
        self._error: BaseException | None = None
        self._new: dict[str, pa.Table] = {}
        self._mission: pa.Table | None = None
        self._spent_j: dict[int, float] = {}
        self._mine, self._theirs = threading.Semaphore(0), threading.Semaphore(0)
        self._closing = False
        self._thread = threading.Thread(target=self._fly, args=(seed, replication), daemon=True)
        self._started = False

    def advance(self) -> None:
        """Let the sortie fly until its next second or its end; an error of the sortie is raised here, at each call."""
        if self._error is not None:
            raise self._error
        if self.done:
            return
        if self._started:
            self._theirs.release()
        else:
            self._started = True
            self._thread.start()
        try:
            self._mine.acquire()
        except BaseException:  # Ctrl-C; the sortie still ends its step, before the caller may ask for the next
            self._mine.acquire()
            raise
        if self._error is not None:
            raise self._error

    def fly(
        self, actions: Mapping[int, np.ndarray[Any, Any]], flying: list[str]
    ) -> tuple[dict[str, Earned], dict[str, bool]]:
        """Fly one step under these actions; what each of these agents earned in it, and whether it is out."""
        self.actions |= actions
        self.advance()
        drones = {a: int(a.removeprefix("drone_")) for a in flying}
        return {a: self.earned(i) for a, i in drones.items()}, {a: self.is_out(i) for a, i in drones.items()}

    def close(self) -> None:
        """Stop it where it is."""
        self._closing = True
        if self._started and not self.done:
            self._theirs.release()
        if self._started and threading.current_thread() is not self._thread:  # which may collect what nobody holds
            self._thread.join()

    def _fly(self, seed: int | None, replication: int) -> None:
        try:
            fly_here(
                self._scenario, self.decide, seed, replication=replication, observer=self
            )  # it waits for the learner
        except _Closed:
            pass
        except BaseException as error:  # whatever ends the thread, or the caller would wait for ever
            self._error = error
        self.done = True
        self._mine.release()

    # --- in the sortie's thread --------------------------------------------------------------

    def begin(self, scenario: Scenario, scene: object) -> None:
        """Nothing to prepare."""

    def second(self, t_s: float, new: dict[str, pa.Table]) -> None:
        """A second is over: hand over, and wait for the next actions."""
        self._new, self._t_s = new, t_s
        mission = new["mission"]
        self._mission = mission if self._mission is None else pa.concat_tables([self._mission, mission])
        if instant(t_s) >= instant(self._scenario.duration_s):
            self._flown = True
            return  # the last one: the end hands over
        self._mine.release()
        self._theirs.acquire()
        if self._closing:
            raise _Closed

    def decide(self, view: FleetView) -> list[Directive]:
        """The standing action of the view's ego as directives; nothing before the first.

        Only the views of the flight's own decisions are kept. An invariant with `fresh.` asks again about the same view at
        age 0, and `record.disagreement` asks after the flight about the views of others.
        """
        kept = self.views.get(view.ego)
        if not self._flown and (kept is None or kept.descriptors is not view.descriptors):
            self.views[view.ego] = view
        others = [i for i in range(self._scenario.fleet.drones) if i != view.ego]
        return directives(view, others, self.actions.get(view.ego))

    # --- results of the last second ------------------------------------------------------------

    def is_out(self, drone: int) -> bool:
        """Whether the drone was on the ground at the last frame, and neither the scenario nor its group calls it again."""
        states = self._new["states"]
        rows = states.filter(pc.equal(states["drone"], drone))
        if rows.num_rows == 0 or rows["airborne"][-1].as_py():
            self._waiting.discard(drone)
            return False
        return drone not in self._waiting and self._t_s >= self._joins_s.get(drone, 0.0)

    def earned(self, drone: int) -> Earned:
        """AP of its fusions in the step, what it sent and what it spent."""
        new = {**self._new, "mission": self._mission}
        fusions = new["fusions"].filter(pc.equal(new["fusions"]["drone"], drone))
        record = SortieRecord(self._scenario, "", 0, 0, code_version(), "", {**new, "fusions": fusions}, {})
        frames = list(matched(record, mission=True).values()) or list(matched(record, mission=False).values())
        ap = average_precision(frames) if frames else np.nan
        seen = None if np.isnan(ap) else float(ap)
        sent = new["transmissions"]
        mine = sent.filter(pc.equal(sent["drone"], drone))
        return Earned(seen, int(pc.sum(mine["payload_bytes"]).as_py() or 0), self._spent_of(drone))

    def _spent_of(self, drone: int) -> float:
        """What left the drone's pack in the step, J, by the ledger; it is in the states, and at the end in `energy`."""
        table, column = ("energy", "energy_j") if self.done else ("states", "spent_j")
        rows = self._new[table].filter(pc.equal(self._new[table]["drone"], drone))
        spent_j = float(pc.sum(rows[column]).as_py() if self.done else rows[column][-1].as_py())
        before_j, self._spent_j[drone] = self._spent_j.get(drone, 0.0), spent_j
        return spent_j - before_j


class TeamEnv(gymnasium.Env[Obs, np.ndarray[Any, Any]]):
    """The fleet as one agent: a `gymnasium.Env`, so that `gymnasium.vector` flies many at once.

    | | |
    |---|---|
    | observation | float32 [N, N, 25]: what each drone observes in `SortieEnv`; zeros of a drone that has left |
    | action | the actions of all drones by ascending id, one after the other |
    | reward | the mean of the drones' rewards; 0 of a drone that has left |
    | info | `sent_bytes` and `spent_j`, sums of all drones; `ap50`, mean of the drones that were scored, if there are any |
    """

    def __init__(self, scenario: Scenario) -> None:
        """Args: `scenario` with at least two drones; its policy is not used."""
        self.drones = SortieEnv(scenario)
        n = scenario.fleet.drones
        one = self.drones.action_space("drone_0")
        self.observation_space = spaces.Box(-LIMIT, LIMIT, (n, n, ROW), np.float32)
        self.action_space = spaces.MultiDiscrete(np.tile(one.nvec, n))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin a sortie with this seed; without one, with a seed drawn from the generator of the last seed given."""
        seed = whole("seed", seed)
        super().reset(seed=seed)
        flown = int(self.np_random.integers(2**31)) if seed is None else seed
        observations, _ = self.drones.reset(seed=flown)
        return self._stacked(observations), {}

    def step(self, action: np.ndarray[Any, Any]) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Fly one step under these actions.

        Raises:
            RunError: an action outside its space; nothing has been flown, the step may be tried again.
        """
        n, each = len(self.drones.possible_agents), self.drones.action_space("drone_0").shape[0]
        if np.size(action) != n * each:
            must = f"must be {n * each} whole numbers: those of each drone, one after the other"
            raise RunError(f"action: {np.asarray(action).tolist()}, {must}")
        rows = np.reshape(action, (n, each))
        given = {a: rows[int(a.removeprefix("drone_"))] for a in self.drones.agents}
        observations, rewards, _, over, infos = self.drones.step(given)
        seen = [i["ap50"] for i in infos.values() if i["ap50"] is not None]
        info: dict[str, Any] = {name: plain_sum(i[name] for i in infos.values()) for name in ("sent_bytes", "spent_j")}
        if seen:
            info["ap50"] = float(np.mean(seen))
        reward = plain_sum(rewards.values()) / len(self.drones.possible_agents)
        done = any(over.values())
        return self._stacked(observations), reward, not self.drones.agents and not done, done, info

    def close(self) -> None:
        """End the sortie's thread."""
        self.drones.close()

    def _stacked(self, observations: Mapping[str, Obs]) -> Obs:
        empty = np.zeros(self.observation_space.shape[1:], np.float32)  # type: ignore[index]
        return np.stack([observations.get(a, empty) for a in self.drones.possible_agents])
