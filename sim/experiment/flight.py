"""One flight of an experiment: a task in, a row out, by the same function in every process.

A task has everything that its row depends on, so that its key is the row's place in a file of flights.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sortie.perception.network.memory import keep_freed
from sortie.policies.contract import Policy
from sortie.scenarios.code_digest import installed
from sortie.scenarios.plugins.reference import code_files, package
from sortie.scenarios.plugins.user_code import imported_files
from sortie.scenarios.reading.files import named_files, named_models, placed
from sortie.scenarios.reading.nodes import ScenarioError
from sortie.scenarios.schema import Limits, Scenario
from sortie.scenarios.schema.limits import IN_CAMPAIGNS
from sortie.scenarios.shipped import located
from sortie.sim.engine.sortie import fly_here, run_sortie
from sortie.sim.experiment import files_read
from sortie.sim.experiment.detectors import boxes_of_draws, maker
from sortie.sim.experiment.memory import limited
from sortie.sim.folders import RunError
from sortie.sim.identity import codes_here, file_digest, flight_code, name_of, packages
from sortie.sim.process import own_process
from sortie.sim.results.accuracy import both_matched
from sortie.sim.results.outcome import OutcomeDict, outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.user_errors import in_line

OUTCOME, MATCHED, PROCESSOR_S = "outcome", "matched", "processor_s"
"""What may be asked of a flight beside the outcome's metrics: the whole outcome, the matched boxes of each draw of them
(`accuracy.Both`), and the processor time that it took."""
MAX_ERROR = 300
files_read.watch()  # before any code of a user is loaded


@dataclass(frozen=True, slots=True)
class Task:
    """A flight that is asked for."""

    scenario: str
    """Its sections as JSON text, the policy among them."""
    seed: int
    replication: int
    figures: Sequence[str]
    """What is asked of it: metrics by their names with dots, and `OUTCOME`, `MATCHED`, `PROCESSOR_S`."""
    code: str
    """The version of Sortie that is to fly it, one of `codes_here`."""
    seen_by: str = ""
    """Another detector than the scenario's (`detectors.maker`)."""
    files: Mapping[str, str] = field(default_factory=dict)
    """Digests of the files that the scenario names, by absolute path."""
    packages: Mapping[str, str] = field(default_factory=dict)
    folder: str = ""
    """From which names of files are found, where some are relative."""
    function: Policy | None = None
    """Decides in place of the scenario's policy. Such a flight flies in the process that asks."""
    name: str = ""
    """Of the function, where its name and its file decide what it does; the flight is not kept else."""
    number: int = 0
    """Whatever whoever asks knows it by."""
    group: str = ""
    """Flights of one group share a detector: they fly one after the other, and are kept together."""

    @property
    def is_kept(self) -> bool:
        """Whether its row may be taken from a file of flights."""
        return self.function is None or bool(self.name)

    @property
    def key(self) -> str:
        """32 hex digits of SHA-256 over all that decides what is flown, but for what the files hold."""
        what = [self.code, self.scenario, self.seed, self.replication, self.seen_by, self.group, self.name, self.folder]
        return hashlib.sha256(json.dumps([*what, sorted(self.packages.items())]).encode()).hexdigest()[:32]


@dataclass(frozen=True, slots=True)
class Flight:
    """The row of a flight."""

    error: str
    """Why it failed; empty where it flew to the end."""
    fingerprint: str
    """The first 16 hex digits of the record's."""
    values: Mapping[str, Any]
    """By the names of what was asked; None where the outcome has none, and everywhere where the flight failed."""
    key: str = ""
    files: Mapping[str, str] = field(default_factory=dict)
    """Digests of the files that it read beside Sortie's own, by absolute path."""

    @property
    def outcome(self) -> OutcomeDict:
        """The whole outcome, where it was asked for."""
        return OutcomeDict(self.values[OUTCOME])


class OtherCodeError(RunError):
    """The worker runs other code, or sees other files, than the experiment was begun with."""


def task_of(
    scenario: Scenario,
    figures: Sequence[str],
    *,
    seed: int | None = None,
    replication: int = 0,
    function: Policy | None = None,
    named: bool = False,
    seen_by: str = "",
    group: str = "",
) -> Task:
    """A scenario's flight on this machine; files are found from the working folder.

    Args:
        named: keep the flight of a function too.

    Raises:
        RunError: a file that the scenario names cannot be read, or a function cannot be told from another one.
    """
    sections = scenario.model_dump(mode="json", exclude_none=True)
    text, seed = json.dumps(sections, sort_keys=True), scenario.seed if seed is None else seed
    models, names = named_models(sections), named_files(sections)
    files, folder = [found_file(name) for name in names], "" if all(map(os.path.isabs, names)) else str(Path.cwd())
    code = codes_here()[1] if seen_by.startswith("torch") else flight_code(sections)
    digests = file_digests(files)
    name = ""
    if function is not None and named:
        name, more = _known_by(function)
        digests |= more
    task = Task(text, seed, replication, figures, code, seen_by, digests, packages(models, files))
    return replace(task, function=function, name=name, group=group, folder=folder)


def _known_by(policy: Policy) -> tuple[str, dict[str, str]]:
    """The name by which a function is kept, and the digests of its file and of what that imports."""
    function: Any = policy
    values: list[object] = []
    while isinstance(function, functools.partial):
        values += [*function.args, *function.keywords.values()]
        function = function.func
    plain = inspect.isfunction(function) and all(v is None or isinstance(v, str | int | float) for v in values)
    if not plain or "<" in function.__code__.co_qualname or not Path(function.__code__.co_filename).is_file():
        raise RunError(
            f"policy {name_of(policy)}, in a comparison that is kept: must be a function at the top of a file, or a "
            "functools.partial of one with numbers and texts; name the file (mine.py:mine), or leave out kept"
        )
    files = imported_files(Path(function.__code__.co_filename))
    known = f"{name_of(policy)} {function.__code__.co_qualname} {function.__defaults__} {function.__kwdefaults__}"
    return known, {str(file.resolve()): file_digest(file) for file in files}


def found_file(name: str, folder: Path | None = None) -> str:
    """The absolute path of a file that a scenario names, also one that comes with Sortie."""
    return str(located(Path(placed(name, folder or Path.cwd()))).resolve())


def file_digests(names: Sequence[str]) -> dict[str, str]:
    """Digests of the files that flights read beside the code, by path; of Python files also of those that they import."""
    digests = {}
    for path in map(Path, names):
        inside = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        if path.suffix == ".py" and path.is_file():
            inside = list(code_files(path))
        for file in inside:
            try:
                digests[str(file)] = file_digest(file)
            except OSError as error:
                raise RunError(f"{file}: cannot be read: {error.strerror}") from None
    return digests


def scenario_of_task(task: Task) -> Scenario:
    """A task's scenario.

    Raises:
        ScenarioError: a drawn value that the schema does not allow.
    """
    try:
        return Scenario.model_validate_json(task.scenario, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise ScenarioError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def limits_of(task: Task) -> Limits:
    """The limits of a task's flight in a worker."""
    limits = json.loads(task.scenario)["limits"]
    return Limits(**IN_CAMPAIGNS | {name: value for name, value in limits.items() if value is not None})


def fly(
    task: Task,
    progress: Callable[[float], None] | None = None,
    keep: Callable[[SortieRecord], None] = lambda record: None,
    *,
    in_worker: bool = False,
) -> Flight:
    """One flight's row.

    Args:
        progress: called with the simulated time, s.
        keep: called with the record.
        in_worker: in a process that has the limits, so that the flight needs none of its own.

    Raises:
        ScenarioError, PolicyError, ...: whatever a sortie raises.
    """
    begin_s = time.process_time()
    make, draws = maker(task.seen_by)
    record = (fly_here if in_worker else run_sortie)(
        scenario_of_task(task),
        task.function,
        task.seed,
        replication=task.replication,
        progress=progress,
        detector_of=make,
    )
    for path, digest in task.files.items():
        _check_file(path, digest)
    keep(record)
    result = outcome(record)  # figures that nobody asked for are not computed
    values: dict[str, Any] = {}
    for name in task.figures:
        if name == OUTCOME:
            values[name] = json.loads(json.dumps(result))
        elif name == MATCHED:
            values[name] = [both_matched(one) for one in (record, *boxes_of_draws(record, make, draws))]
        elif name != PROCESSOR_S:
            values[name] = result.number(name)
    if PROCESSOR_S in task.figures:
        values[PROCESSOR_S] = time.process_time() - begin_s
    return Flight("", record.fingerprint[:16], values, task.key, {**files_read.files_read(), **task.files})


def fly_in_worker(task: Task, memory_b: int | None = None) -> Flight:
    """`fly`, in a process of its own; a flight that fails, or needs more than `memory_b`, gives a row that says so.

    Raises:
        OtherCodeError: the row would not be the experiment's.
    """
    if task.code not in (here := codes_here()):
        raise OtherCodeError(f"this worker runs Sortie {here[' torch ' in task.code]}, it is asked for {task.code}")
    for path, digest in task.files.items():
        _check_file(path, digest)
    for named, digest in task.packages.items():
        _check_package(named, digest)
    own_process()
    keep_freed()  # dask's nanny has its workers give back every 64 KiB, which costs a third of a flight
    from threadpoolctl import threadpool_limits

    try:
        # sums in one order: a matrix product on two threads may round differently than on one
        with threadpool_limits(1), limited(memory_b):
            return fly(task, in_worker=True)
    except Exception as error:  # whatever it is, the others go on
        if memory_b is not None and isinstance(error, MemoryError):
            return failed(task, f"MemoryError: more than {memory_b / 1e9:.3g} GB (--worker-memory)")
        return failed(task, in_line(error, MAX_ERROR))


def failed(task: Task, error: str) -> Flight:
    """The row of a flight without a result."""
    return Flight(error, "", dict.fromkeys(task.figures), task.key, task.files)


def _check_file(path: str, digest: str) -> None:
    try:
        same = file_digest(Path(path)) == digest
    except OSError as error:
        raise OtherCodeError(f"{path}: cannot be read by this worker: {error.strerror}") from None
    if not same:
        raise OtherCodeError(f"{path}: is not the file that the experiment was begun with")


def _check_package(named: str, digest: str) -> None:
    """Args: `named` is the package's name and version."""
    name, _, version = named.rpartition(" ")
    if (here := _version_here(name)) != version:
        raise OtherCodeError(f"this worker has {name} {here}, the experiment was begun with {version}")
    if digest and _digest_here(name) != digest:
        raise OtherCodeError(f"{named}: this worker has other files of it than the experiment was begun with")


@functools.cache
def _version_here(name: str) -> str:
    """A package's version as it was when this process first flew with it: its modules stay loaded."""
    return installed(name)


@functools.cache
def _digest_here(name: str) -> str:
    """The same of its files."""
    return package(distribution(name))[1]
