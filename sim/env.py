"""The sortie as a PettingZoo `ParallelEnv`: what learners of sharing policies train in. Needs the extra `env`.

    env = SortieEnv(load("track_target", ["perception.detector=surrogate"]))
    observations, infos = env.reset(seed=1)
    observations, rewards, terminations, truncations, infos = env.step({"drone_0": env.action_space("drone_0").sample(), …})

A step is as many whole frames as come nearest to one simulated second, and never none: exactly a second where
`context.rate_hz` is a whole number, 1.33 s at 1.5 Hz, 2 s at 0.5 Hz; the last step ends with the sortie. Each drone's
action stands for its directives until the next. All that stands between a policy and the gate (checks, staleness,
damping) stands there too. The sortie runs in a thread of its own that takes turns with the caller, so that the same seed
and actions give the same record.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sortie.perception.metrics.ap import average_precision
from sortie.policies.contract import Coverage, Descriptor, Directive, FleetView, LinkState, Representation, TaskPhase
from sortie.scenarios.schema import DroneJoins, Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.identity import code_version
from sortie.sim.results.accuracy import matched
from sortie.sim.results.record import SortieRecord

RUNGS = (Representation.NONE, Representation.DETECTIONS, Representation.FEATURES)
RHOS = (0.02, 0.1, 0.25, 1.0)
RATES_HZ = (2.0, 5.0, 10.0)
CHOICES = (len(RUNGS), len(RHOS), len(RATES_HZ), 2)
"""Choices of an action for each link: representation, ρ (the share of the feature cells), rate, and whether it is confined to the region."""
ROW = 25
"""Numbers of one drone in an observation; `_row` says which."""
LIMIT = 10.0
COST_PER_MB, COST_PER_KJ = 0.01, 0.01

Obs = np.ndarray[Any, np.dtype[np.float32]]


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
    """

    metadata = {"name": "sortie_v0", "render_modes": [], "is_parallelizable": True}  # noqa: RUF012 - the library's own way

    def __init__(self, scenario: Scenario) -> None:
        """Args: `scenario` with at least two drones; its policy is not used.

        Raises:
            ValueError: a lone drone, which has nothing to decide.
        """
        n = scenario.fleet.drones
        if n < 2:
            raise ValueError(f"fleet.drones is {n}, must be at least 2 to share")
        self.scenario, self.render_mode = scenario, None
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

    def observation_space(self, agent: str) -> spaces.Box:
        """The same object for the same agent."""
        return self._spaces[agent][0]

    def action_space(self, agent: str) -> spaces.MultiDiscrete:
        """The same object for the same agent."""
        return self._spaces[agent][1]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Obs], dict[str, dict[str, Any]]]:
        """Begin a sortie; without a seed the scenario's, in another replication each time."""
        self.close()
        replication = self._episodes if seed is None else 0
        self._episodes += 1
        self.agents = list(self.possible_agents)
        self._flight = _Flight(self.scenario, seed, replication)
        self._flight.advance()
        return {a: self._observe(a) for a in self.agents}, {a: {} for a in self.agents}

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Obs], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Fly one step under these actions; one that is missing stays as it was.

        Raises:
            ValueError: no such agent, or an action outside its space; nothing has been flown, the step may be tried again.
        """
        flight = self._flight
        if flight is None or not self.agents:
            return {}, {}, {}, {}, {}
        taken = {agent: self._checked(agent, action) for agent, action in actions.items()}
        flight.actions |= {int(agent.removeprefix("drone_")): action for agent, action in taken.items()}
        flight.advance()
        flying = self.agents
        rewards = {a: flight.reward(int(a.removeprefix("drone_"))) for a in flying}
        landed = {a: flight.is_out(int(a.removeprefix("drone_"))) for a in flying}
        over = dict.fromkeys(flying, flight.done)
        observations = {a: self._observe(a) for a in flying}
        self.agents = [] if flight.done else [a for a in flying if not landed[a]]
        return observations, rewards, landed, over, {a: {} for a in flying}

    def close(self) -> None:
        """End the sortie's thread."""
        if self._flight is not None:
            self._flight.close()
            self._flight = None

    def render(self) -> None:
        """Nothing: `sortie fly --live` draws."""

    def _checked(self, agent: str, action: Any) -> np.ndarray[Any, Any]:
        """The action by link [N - 1, choices], a copy: the sortie's thread would wrap a −1 around and cut a 0.5 off."""
        if agent not in self._spaces:
            raise ValueError(f"actions: {agent!r}, must be of {self.possible_agents[0]} … {self.possible_agents[-1]}")
        space = self.action_space(agent)
        try:
            given = np.array(action)
        except (TypeError, ValueError):  # rows of several lengths
            given = np.array(None)
        if not space.contains(given):
            said = f"{given.tolist() if given.shape else action!r}"
            most = ", ".join(str(n - 1) for n in CHOICES)
            raise ValueError(
                f"{agent}: action {said}, must be {space.shape[0]} whole numbers: "
                f"for each other drone {len(CHOICES)} of at least 0 and at most {most}"
            )
        return given.reshape(-1, len(CHOICES))

    def _observe(self, agent: str) -> Obs:
        assert self._flight is not None  # noqa: S101
        ego, n = int(agent.removeprefix("drone_")), len(self.possible_agents)
        rows = np.zeros((n, ROW), np.float32)
        view = self._flight.views.get(ego)
        me = None if view is None else view.me
        if view is not None and me is not None:
            for k, i in enumerate([ego, *(i for i in range(n) if i != ego)]):
                if i in view.descriptors:
                    rows[k] = _row(me, view.descriptors[i], view.age_s[i])
        return np.clip(rows, -LIMIT, LIMIT)


def _row(me: Descriptor, d: Descriptor, age_s: float) -> list[float]:
    """Heard; age, s; place from the ego, 100 m, and velocity, 10 m/s; footprint, 100 m; charge, headrooms, goodput from
    the ego, 100 Mb/s, and its state (0 unknown, 1/3 silent, 2/3 probed, 1 measured); phase, one-hot; region: there, place
    from the ego, radius, 100 m; share of the grid seen well; whether it reports targets."""
    place = [(a - b) / 100 for a, b in zip(d.position_m, me.position_m, strict=True)]
    phase = [float(d.task_phase == p) for p in TaskPhase]
    region = [0.0] * 4
    if d.region is not None:
        x_m, y_m = d.region.x_m - me.position_m[0], d.region.y_m - me.position_m[1]
        region = [1.0, x_m / 100, y_m / 100, d.region.radius_m / 100]
    cells = np.unpackbits(np.frombuffer(d.coverage_grid, np.uint8), bitorder="little").reshape(-1, 2) @ (1, 2)
    return [
        1.0, age_s, *place, *(v / 10 for v in d.velocity_mps), d.footprint_radius_m / 100, d.battery_soc,
        d.cpu_headroom, d.gpu_headroom, me.goodput_to(d.agent_id) / 100, me.link_state(d.agent_id) / LinkState.MEASURED, *phase, *region,
        float((cells >= Coverage.WELL).mean()), float(bool(d.priority_target_ids)),
    ]  # fmt: skip


class _Flight:
    """A sortie in its own thread; `advance` lets it fly one step (the sortie's "second"). Policy and observer of that sortie."""

    def __init__(self, scenario: Scenario, seed: int | None, replication: int) -> None:
        self.actions: dict[int, np.ndarray[Any, Any]] = {}
        self.views: dict[int, FleetView] = {}
        self.done = False
        self._scenario, self._t_s = scenario, 0.0
        joins = [e for e in scenario.events if isinstance(e, DroneJoins)]
        self._joins_s = {e.drone: e.at_s for e in sorted(joins, key=lambda e: e.at_s)}  # the last time
        self._waiting = {drone for group in scenario.mission.groups for drone in group.reserve}
        self._error: Exception | None = None
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
        self._mine.acquire()
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Stop it where it is."""
        self._closing = True
        if self._started and not self.done:
            self._theirs.release()
        if self._started:
            self._thread.join()

    def _fly(self, seed: int | None, replication: int) -> None:
        try:
            run_sortie(self._scenario, self.decide, seed, replication=replication, observer=self)
        except _Closed:
            pass
        except Exception as error:
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
        if t_s >= self._scenario.duration_s - 1e-9:
            return  # the last one: the end hands over
        self._mine.release()
        self._theirs.acquire()
        if self._closing:
            raise _Closed

    def decide(self, view: FleetView) -> list[Directive]:
        """The standing action of the view's ego as directives; nothing before the first."""
        self.views[view.ego] = view
        action, me = self.actions.get(view.ego), view.me
        directives = []
        for peer in view.peers:
            if action is None or me is None:
                directives.append(Directive(view.ego, peer, reason="no action yet"))
                continue
            rung, cells, rate, confined = (int(c) for c in action[peer - (peer > view.ego)])
            rho = RHOS[cells] if RUNGS[rung] == Representation.FEATURES else 0.0
            roi = me.region if confined else None
            directives.append(Directive(view.ego, peer, RUNGS[rung], rho, roi, RATES_HZ[rate], reason="action"))
        return directives

    # --- results of the last second ------------------------------------------------------------

    def is_out(self, drone: int) -> bool:
        """Whether the drone was on the ground at the last frame, and neither the scenario nor its group calls it again."""
        states = self._new["states"]
        rows = states.filter(pc.equal(states["drone"], drone))
        if rows.num_rows == 0 or rows["airborne"][-1].as_py():
            self._waiting.discard(drone)
            return False
        return drone not in self._waiting and self._t_s >= self._joins_s.get(drone, 0.0)

    def reward(self, drone: int) -> float:
        """AP of its fusions in the second, less what it sent and spent."""
        new = {**self._new, "mission": self._mission}
        fusions = new["fusions"].filter(pc.equal(new["fusions"]["drone"], drone))
        record = SortieRecord(self._scenario, "", 0, 0, code_version(), "", {**new, "fusions": fusions}, {})
        frames = list(matched(record, mission=True).values()) or list(matched(record, mission=False).values())
        ap = average_precision(frames) if frames else 0.0
        sent = new["transmissions"]
        mine = sent.filter(pc.equal(sent["drone"], drone))
        sent_mb = float(pc.sum(mine["payload_bytes"]).as_py() or 0) / 1e6
        return float(np.nan_to_num(ap)) - COST_PER_MB * sent_mb - COST_PER_KJ * self._spent_kj(drone)

    def _spent_kj(self, drone: int) -> float:
        """What left the drone's pack in the step, by the ledger; it is in the states, and at the end in `energy`."""
        table, column = ("energy", "energy_j") if self.done else ("states", "spent_j")
        rows = self._new[table].filter(pc.equal(self._new[table]["drone"], drone))
        spent_j = float(pc.sum(rows[column]).as_py() if self.done else rows[column][-1].as_py())
        before_j, self._spent_j[drone] = self._spent_j.get(drone, 0.0), spent_j
        return (spent_j - before_j) / 1e3
