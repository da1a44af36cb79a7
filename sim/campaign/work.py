"""A worker flies runs from their tasks alone, with the same function on every engine.

A task is the JSON text of {scenario, seed, replication, metrics, files, packages}; nothing else reaches a run, so that its key,
a hash over the task and the code, says everything that its row depends on.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import time
from collections.abc import Callable, Sequence
from importlib.metadata import distribution
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from sortie.perception.network.memory import keep_freed
from sortie.policies.contract import Policy
from sortie.scenarios.code_digest import installed
from sortie.scenarios.plugins.reference import package
from sortie.scenarios.reading.nodes import ScenarioError
from sortie.scenarios.schema import Limits, Scenario
from sortie.scenarios.schema.limits import IN_CAMPAIGNS
from sortie.sim.apart import LimitError
from sortie.sim.campaign.memory import limited
from sortie.sim.check.expectations import metric
from sortie.sim.engine.sortie import fly_here, run_sortie
from sortie.sim.folders import RunError
from sortie.sim.identity import codes_here, file_digest
from sortie.sim.process import own_process
from sortie.sim.results.outcome import outcome
from sortie.sim.results.outcome_fields import lacking
from sortie.sim.results.record import SortieRecord
from sortie.sim.user_errors import in_line

Task = tuple[int, str]
"""A run's number and its task."""
MAX_ERROR = 300


class RunResult(NamedTuple):
    """A run's row, but for what the plan knows of it."""

    run: int
    key: str
    status: str
    """`done` or `failed`."""
    error: str
    fingerprint: str
    values: tuple[float | None, ...]
    """Of the campaign's metrics."""


class OtherCodeError(RunError):
    """The worker runs other code, or sees other files, than the campaign was begun with."""


def task_key(task: str, code: str) -> str:
    """The key of a run: 32 hex digits of SHA-256 over what the worker receives and the code version."""
    return hashlib.sha256(f"{code}\n{task}".encode()).hexdigest()[:32]


def fly_batch(code: str, tasks: Sequence[Task], memory_b: int | None = None) -> tuple[list[RunResult], float]:
    """Fly some runs one after the other; a run that fails, or needs more than `memory_b`, gives a row that says so.

    Returns:
        The results, and the seconds that they took.

    Raises:
        OtherCodeError: results would not be those of the campaign.
    """
    begin_s = time.perf_counter()
    if code not in (here := codes_here()):
        raise OtherCodeError(f"this worker runs Sortie {here[' torch ' in code]}, the campaign is of {code}")
    from threadpoolctl import threadpool_limits

    # sums in one order: a matrix product on two threads may round differently than on one
    with threadpool_limits(1), limited(memory_b):
        return [_fly(run, task, code, memory_b) for run, task in tasks], time.perf_counter() - begin_s


def fly_in_worker(code: str, tasks: Sequence[Task], memory_b: int | None = None) -> tuple[list[RunResult], float]:
    """`fly_batch`, in a process that is the campaign's alone."""
    own_process()
    keep_freed()  # dask's nanny has its workers give back every 64 KiB, which costs a third of a run
    return fly_batch(code, tasks, memory_b)


def fly_one(code: str, task: Task, memory_b: int | None) -> RunResult:
    """`fly_in_worker` for one run."""
    return fly_in_worker(code, [task], memory_b)[0][0]


def fly_task(task: str) -> SortieRecord:
    """One run's record.

    Raises:
        ScenarioError, PolicyError, ...: whatever a sortie raises.
    """
    scenario, seed, replication = unpack(task)
    return fly_here(scenario, None, seed, replication=replication)


def unpack(task: str) -> tuple[Scenario, int, int]:
    """A task's scenario, seed and replication.

    Raises:
        ScenarioError: a drawn value that the schema does not allow.
    """
    fields = json.loads(task)
    try:
        scenario = Scenario.model_validate_json(json.dumps(fields["scenario"]), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise ScenarioError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    return scenario, fields["seed"], fields["replication"]


def _fly(run: int, task: str, code: str, memory_b: int | None) -> RunResult:
    fields, key = json.loads(task), task_key(task, code)
    for path, digest in fields["files"].items():
        _check_file(path, digest)
    for named, digest in fields["packages"].items():
        _check_package(named, digest)
    return _result(run, key, lambda: fly_task(task), fields["metrics"], memory_b)


def fly_function(scenario: Scenario, policy: Policy, metrics: Sequence[str]) -> RunResult:
    """The row of a sortie in this process, under a policy that is a function and no name; its key is empty."""
    return _result(0, "", lambda: run_sortie(scenario, policy), metrics)


def _result(
    run: int, key: str, flown: Callable[[], SortieRecord], metrics: Sequence[str], memory_b: int | None = None
) -> RunResult:
    try:
        record = flown()
        result = outcome(record)
        values = tuple(number(result, name) for name in metrics)
    except Exception as error:  # whatever it is, the other runs go on
        what = in_line(error, MAX_ERROR)
        if memory_b is not None and isinstance(error, MemoryError):
            what = f"MemoryError: more than {memory_b / 1e9:.3g} GB (--worker-memory)"
        return RunResult(run, key, "failed", what, "", (None,) * len(metrics))
    return RunResult(run, key, "done", "", record.fingerprint[:16], values)


def flies_user_code(task: Task) -> bool:
    """Whether a task's policy is in a file of a user's own."""
    return any(path.endswith(".py") for path in json.loads(task[1])["files"])


def killed(task: Task, code: str) -> RunResult:
    """The row of a run that no worker survived."""
    return _without_result(task, code, "WorkerDied: on every attempt")


def late(task: Task, code: str, error: LimitError) -> RunResult:
    """The row of a run that took longer than its limits."""
    return _without_result(task, code, in_line(error, MAX_ERROR))


def limits_of(task: Task) -> Limits:
    """The limits of a task's run."""
    limits = json.loads(task[1])["scenario"]["limits"]
    return Limits(**IN_CAMPAIGNS | {name: value for name, value in limits.items() if value is not None})


def _without_result(task: Task, code: str, error: str) -> RunResult:
    run, text = task
    nothing = (None,) * len(json.loads(text)["metrics"])
    return RunResult(run, task_key(text, code), "failed", error, "", nothing)


def number(result: dict[str, Any], name: str) -> float | None:
    """A metric's number; None where this run has none, 0 of a count. The plan has seen to it that some run may have one."""
    try:
        value = metric(result, name)
    except KeyError:
        return lacking(name, len(result.get("battery", ())))
    return float(value) if value is not None and math.isfinite(value) else None


def _check_file(path: str, digest: str) -> None:
    try:
        same = file_digest(Path(path)) == digest
    except OSError as error:
        raise OtherCodeError(f"{path}: cannot be read by this worker: {error.strerror}") from None
    if not same:
        raise OtherCodeError(f"{path}: is not the file that the campaign was begun with")


def _check_package(named: str, digest: str) -> None:
    """Args: `named` is the package's name and version."""
    name, _, version = named.rpartition(" ")
    if (here := _version_here(name)) != version:
        raise OtherCodeError(f"this worker has {name} {here}, the campaign was begun with {version}")
    if digest and _digest_here(name) != digest:
        raise OtherCodeError(f"{named}: this worker has other files of it than the campaign was begun with")


@functools.cache
def _version_here(name: str) -> str:
    """A package's version as it was when this process first flew with it: its modules stay loaded."""
    return installed(name)


@functools.cache
def _digest_here(name: str) -> str:
    """The same of its files."""
    return package(distribution(name))[1]
