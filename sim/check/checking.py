"""Fly a scenario as often as its expectations need, and compare the outcomes with them. For the command line and pytest."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sortie.scenarios.reading.files import named_files
from sortie.scenarios.reading.load import library, load
from sortie.scenarios.schema import Scenario
from sortie.sim.check.expectations import Verdict, check
from sortie.sim.check.golden import differences, golden_path, told, with_relative_files, write_golden
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.experiment.flight import OUTCOME, Task, task_of
from sortie.sim.experiment.flight_file import fly_all, users_file
from sortie.sim.folders import RunError
from sortie.sim.policy_text import flown_by
from sortie.sim.results.explain import explain_metric
from sortie.sim.results.outcome import OutcomeDict, outcome
from sortie.sim.results.record import SortieRecord


@dataclass(frozen=True, slots=True)
class Checked:
    """A scenario's verdicts, golden outcome included, each failed one with its reason from the record."""

    scenario: Scenario
    verdicts: tuple[Verdict, ...]
    command: tuple[str, ...]
    """The command that flies it."""
    written: str = ""
    """A line that names the golden outcome that was written; empty if none was."""

    @property
    def failed(self) -> list[Verdict]:
        return [v for v in self.verdicts if not v.holds]

    def replay(self, verdict: Verdict) -> str:
        """The command that plays the replication that shows a verdict best."""
        option = ["--replication", str(verdict.replication)] if verdict.replication else []
        return shlex.join([*self.command, *option, "--view"])


def check_scenario(
    path_or_name: str,
    overrides: Sequence[str] = (),
    *,
    update: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Checked:
    """Fly a scenario and its replications, and check them.

    Args:
        path_or_name: a file, or a library scenario's name.
        update: write the golden outcome anew instead of comparing; not with overrides.
        progress: called with simulated seconds over all replications.

    Raises:
        ScenarioError, PolicyError, RunError: what is wrong with the scenario, its policy or its golden outcome.
    """
    ensure_own(overrides, update=update)
    scenario = load(path_or_name, overrides)
    others = {policy: flown_by(scenario, policy) for policy in _counts(scenario)}  # unknown policies stop it here
    record = run_sortie(scenario, progress=progress)
    result = outcome(record)
    rest = _Flights(scenario.duration_s, progress)
    results = [result, *rest.fly(scenario, range(1, _own(scenario)))]
    theirs = {policy: rest.fly(others[policy], range(count)) for policy, count in _counts(scenario).items()}
    verdicts = check(scenario, record, result, results, theirs)
    verdicts = [_with_explanation(v, scenario, record, results) for v in verdicts]
    golden = golden_path(library().get(path_or_name, Path(path_or_name)))
    portable = with_relative_files(golden.parent, result, named_files(scenario.model_dump(mode="json")))
    written = write_golden(golden, portable) if update else ""
    if golden.is_file() and not overrides and not update:
        verdicts.append(_golden(golden, portable))
    command = ("sortie", "fly", path_or_name, *(x for o in overrides for x in ("--set", o)))
    return Checked(scenario, tuple(verdicts), command, written)


def ensure_own(overrides: Sequence[str], *, update: bool) -> None:
    """Refuse to write the outcome of another sortie than the scenario's own as its golden one.

    Raises:
        RunError: the first override.
    """
    if update and overrides:
        raise RunError(f"{overrides[0]}: a golden outcome is written of the scenario as its file has it, set nothing")


def flights(scenario: Scenario) -> int:
    """How many sorties its expectations need, those by other policies included."""
    return _own(scenario) + sum(_counts(scenario).values())


def _own(scenario: Scenario) -> int:
    return max([1, *(e.replications for e in scenario.expect if e.replications is not None)])


def _counts(scenario: Scenario) -> dict[str, int]:
    """How many sorties each policy flies that expectations are over: replications 0, 1, … as its expectations ask for."""
    counts: dict[str, int] = {}
    for e in scenario.expect:
        if e.over is not None:
            counts[e.over] = max(counts.get(e.over, 1), e.replications or 1)
    return counts


class _Flights:
    """The outcomes of the sorties after the first one, with one progress over all."""

    def __init__(self, duration_s: float, progress: Callable[[float], None] | None) -> None:
        self._begin_s, self._duration_s, self._progress = 0.0, duration_s, progress

    def fly(self, scenario: Scenario, replications: range) -> list[OutcomeDict]:
        tasks = [task_of(scenario, (OUTCOME,), replication=k) for k in replications]
        flights = fly_all(tasks, kept=users_file(), watch=self._at)
        self._begin_s += len(tasks) * self._duration_s
        return [flight.outcome for flight in flights]

    def _at(self, task: Task, t_s: float) -> None:
        if self._progress is not None:
            self._progress(self._begin_s + (task.number + 1) * self._duration_s + min(t_s, self._duration_s))


def _with_explanation(
    verdict: Verdict, scenario: Scenario, record: SortieRecord, results: Sequence[OutcomeDict]
) -> Verdict:
    """A failed verdict with facts from the record of its replication. Only the first replication's record is kept, so
    another one is flown once more."""
    if verdict.holds or not verdict.metric:
        return verdict
    k = verdict.replication
    flight = record if k == 0 else run_sortie(scenario, replication=k)
    return replace(verdict, explanation=explain_metric(verdict.metric, flight, results[k]))


def _golden(path: Path, result: dict[str, Any]) -> Verdict:
    moved = differences(path, result)
    got, whole = told(moved) if moved else ("the same", "")
    renew = "-v lists all; renew it with --update (pytest: --sortie-update) where it was meant to move"
    return Verdict(f"the outcome in {path.name}", got, not moved, renew, whole=whole)
