"""Flights of policies on a suite: each policy once in each condition, kept as they come, so that an interruption loses nothing."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from sortie.policies.contract import Policy
from sortie.policies.registry import within_budget
from sortie.scenarios.reading.files import named_files, named_models, placed, with_files
from sortie.scenarios.schema.conditions import Condition, ConditionSet
from sortie.scenarios.shipped import located
from sortie.sim.campaign.engine import open_engine
from sortie.sim.campaign.plan import file_digests
from sortie.sim.campaign.work import RunResult, fly_function, task_key
from sortie.sim.folders import RunError
from sortie.sim.identity import flight_code, packages
from sortie.sim.studies.conditions import scenario_of

METRICS = (
    "ap50.mission",
    "ap50.full_scene",
    "tracking.hota",
    "bytes.data_sent",
    "bytes.context_sent",
    "energy_j.total",
    "energy_j.fault",
    "energy_j.radio",
    "deadline_miss_rate",
    "mission.target_detected_share",
    "mission.target_in_view_share",
    "mission.region_observed_share",
    "mission.flown_share",
    "policies.violated_ticks",
    "policies.invariant_violations",
    "switches",
    "age_s.p99",
    "policy_eval_us.p50",
    "policy_eval_us.p99",
)
"""What is kept of each flight: numbers of its outcome, by their names."""
KEPT = "flights.jsonl"
BY_TORCH = ("perception.detector=torch", "perception.sample_rate_hz=0.5")
"""What makes a suite fly with the neural detector, which takes most of a second for each scored instant."""


@dataclass(frozen=True, slots=True)
class Flight:
    """One policy in one condition."""

    error: str
    """Why the policy failed there; empty where it flew to the end."""
    fingerprint: str
    """The first 16 hex digits of the record's."""
    values: Mapping[str, float | None]
    """By the names of `METRICS`; None where the outcome has none, and everywhere where the policy failed."""


Flights = dict[str, dict[str, Flight]]
"""By policy and condition."""


def fly(
    suite: ConditionSet,
    policies: Iterable[str],
    folder: Path,
    *,
    workers: int = 1,
    progress: Callable[[int], None] = lambda done: None,
) -> Flights:
    """Fly policies by name in every condition of a suite, in processes of their own.

    Each flight is on disk, in `folder`, before it is counted. The next call takes those that it finds there, as long as
    neither Sortie nor the policy's files changed. Flights that failed are flown again.

    Args:
        policies: names, `name(key=value)` or `path/to/file.py:function`.
        workers: how many processes.
        progress: called with how many flights there are.

    Raises:
        ScenarioError, PolicyError: a policy or its parameters are wrong; raised before anything flies.
        RunError: the folder cannot be used, or files changed meanwhile.
    """
    read = functools.cache(_read_from)  # most conditions name the same models and files
    asked = [(p, c.name, _task(suite, c, p, read)) for p in policies for c in suite.conditions]
    code = flight_code([json.loads(task) for _, _, task in asked])
    kept = _Kept(folder / KEPT)
    found = {
        k: kept.flights[key] for k, (_, _, task) in enumerate(asked) if (key := task_key(task, code)) in kept.flights
    }
    progress(len(found))
    todo = [(k, task) for k, (_, _, task) in enumerate(asked) if k not in found]
    if todo:
        with open_engine(min(workers, len(todo))) as engine:
            for results in engine.results(code, iter(todo)):
                for result in results:
                    found[result.run] = _flight(result)
                    kept.add(result.key, found[result.run])
                progress(len(found))
    flights: Flights = {p: {} for p in policies}
    for k, (policy, condition, _) in enumerate(asked):
        flights[policy][condition] = found[k]
    return flights


def fly_callable(
    suite: ConditionSet, policy: Policy, *, progress: Callable[[int], None] = lambda done: None
) -> dict[str, Flight]:
    """Fly a policy that is no name but a function of this process; by condition. Nothing of it is kept on disk.

    A budget reaches the function by its parameter `received_budget`, `sent_budget` or `rho`, where it has one.
    """
    flights = {}
    for k, condition in enumerate(suite.conditions):
        scenario = scenario_of(suite, condition, "silence")
        budget = within_budget(policy, condition.budget)
        result = fly_function(scenario, functools.partial(policy, **budget) if budget else policy, METRICS)
        flights[condition.name] = _flight(result)
        progress(k + 1)
    return flights


def _task(suite: ConditionSet, condition: Condition, policy: str, read: Callable[..., Mapping[str, object]]) -> str:
    """What a worker receives; it may stand in another folder. `read` is `_read_from`."""
    scenario = scenario_of(suite, condition, policy)

    def place(name: str) -> str:
        return str(located(Path(placed(name, Path.cwd()))).resolve())

    sections = with_files(scenario.model_dump(mode="json", exclude_none=True), place)
    task = {
        "scenario": sections,
        "seed": scenario.seed,
        "replication": 0,
        "metrics": METRICS,
        **read(tuple(named_models(sections)), tuple(named_files(sections))),
    }
    return json.dumps(task, sort_keys=True)


def _read_from(models: Sequence[tuple[str, str]], files: Sequence[str]) -> dict[str, object]:
    """The digests of a task's files, and the packages of its models."""
    return {"files": file_digests(files), "packages": packages(models, files)}


def _flight(result: RunResult) -> Flight:
    return Flight(result.error, result.fingerprint, dict(zip(METRICS, result.values, strict=True)))


class _Kept:
    """A file of flights, a line each by its key. Flights that failed are not among them: they are flown again.

    Raises:
        RunError: the file cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.flights: dict[str, Flight] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lines = path.read_bytes().split(b"\n") if path.exists() else []
        except OSError as error:
            raise RunError(f"{path}: cannot be used: {error.strerror}") from error
        for key, flight in _read(lines):
            if not flight.error:
                self.flights[key] = flight

    def add(self, key: str, flight: Flight) -> None:
        """Write one at the end, durably."""
        line = json.dumps([key, flight.error, flight.fingerprint, list(flight.values.values())])
        try:
            with closing(self._path.open("ab", buffering=0)) as file:
                file.write(f"\n{line}".encode())  # a line that was cut off ends here
                os.fsync(file.fileno())
        except OSError as error:
            raise RunError(f"{self._path}: cannot be written: {error.strerror}") from error


def _read(lines: Sequence[bytes]) -> Iterator[tuple[str, Flight]]:
    """The lines that are whole."""
    for line in lines:
        try:
            key, error, fingerprint, values = json.loads(line)
            yield key, Flight(error, fingerprint, dict(zip(METRICS, values, strict=True)))
        except (ValueError, TypeError):
            continue
