"""The public functions: load, fly, compare, replay, campaign, check, env, open_run, open_campaign."""

from __future__ import annotations

import inspect
import math
import operator
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from sortie._run import Run, as_path
from sortie.policies.contract import Policy, PolicyError
from sortie.scenarios.reading import load as reading
from sortie.scenarios.reading.load import Overrides
from sortie.scenarios.reading.nodes import ScenarioError
from sortie.scenarios.schema import Scenario
from sortie.scenarios.whole import whole
from sortie.sim.experiment import files_read
from sortie.sim.folders import RunError
from sortie.sim.policy_text import flown_by
from sortie.sim.user_errors import user_errors

files_read.watch()  # before any code of a user is loaded

if TYPE_CHECKING:
    import pyarrow as pa

    from sortie.sim.check.checking import Checked
    from sortie.sim.engine.sortie import Observer
    from sortie.sim.env import SortieEnv, TeamEnv
    from sortie.sim.experiment.compare import Compared, Gain
    from sortie.sim.experiment.half_width import Precision, Settings
    from sortie.sim.results.summary import Summary
    from sortie.sim.studies.replayed import Replay

ScenarioLike = str | Path | Mapping[str, object] | Scenario
"""A library scenario's name, a file, plain sections, or a scenario that was loaded before."""
PolicyLike = str | Policy
"""A name, `name(key=value)`, `path/to/file.py:function`, or any callable of one FleetView."""


def load(scenario: ScenarioLike, overrides: Overrides = ()) -> Scenario:
    """Read and check a scenario.

    Args:
        scenario: the name of a library scenario (`sortie list scenarios` prints them), the path of a YAML file, the
            sections of a scenario as a dict, or a `Scenario`.
        overrides: fields to change, as a dict, `{"fleet.drones": 7}`, or as a list of texts, `["fleet.drones=7"]`.

    Returns:
        A frozen `Scenario` with every default filled in. Field names end with their units.

    Raises:
        ScenarioError: one line that names the file, the field, the value and what is allowed.

    Example:
        >>> sortie.load("track_target", {"fleet.drones": 7}).fleet.drones
        7
        >>> sortie.load({"name": "mine", "duration_s": 5}).frames
        50
    """
    _ensure_overrides(overrides)
    if isinstance(scenario, str | os.PathLike):
        return reading.load(os.fspath(scenario), overrides)
    if isinstance(scenario, Scenario):
        if not overrides:
            return scenario
        return reading.build(scenario.model_dump(mode="json", exclude_none=True), overrides, scenario.name)
    if isinstance(scenario, Mapping):
        return reading.build(scenario, overrides)
    raise ScenarioError(f"scenario: {scenario!r}, must be a name, a path, a dict or a Scenario")


def fly(
    scenario: ScenarioLike,
    overrides: Overrides = (),
    *,
    policy: PolicyLike | None = None,
    seed: int | None = None,
    replication: int = 0,
    progress: Callable[[float], None] | Literal[True] | None = None,
    observer: Observer | None = None,
) -> Run:
    """Fly one sortie.

    Args:
        scenario, overrides: as for `sortie.load`.
        policy: the policy that decides on every drone; None uses the scenario's own. A policy given here decides until
            the end: the scenario's changes of policy and its commands are ignored.
        seed: determines every random draw; None uses the scenario's own.
        replication: the number of the repetition. Each has other random draws under the same seed.
        progress: called with the simulated time (s) once a simulated second; True shows a bar, or a line a minute
            where there is no terminal.
        observer: gets the new rows of the record once a simulated second.

    Returns:
        The `Run`. Equal scenario, policy, seed, replication and version give equal runs.

    Raises:
        ScenarioError, PolicyError: the scenario or the policy is wrong; raised before anything flies.
        PolicyError: also in flight, when the policy fails or breaks its contract.

    Example:
        >>> short = {"duration_s": 2, "perception.detector": "none"}
        >>> sortie.fly("track_target", short, policy="best-2(received_budget=0.1)").policy
        'best-2'
        >>> def quiet(view):
        ...     return [sortie.Directive(view.ego, peer, reason="quiet") for peer in view.peers]
        >>> sortie.fly("track_target", short, policy=quiet).outcome["bytes"]["data_sent"]
        0
    """
    from sortie.sim.engine.sortie import run_sortie

    chosen, function = _with_policy(load(scenario, overrides), policy)
    seed, replication = whole("seed", seed), whole("replication", replication, 32) or 0
    if observer is not None and not all(callable(getattr(observer, name, None)) for name in ("begin", "second")):
        raise ScenarioError(f"observer: {observer!r}, must have the methods begin and second")
    with _shown(progress, chosen.name, chosen.duration_s) as watch:
        record = run_sortie(chosen, function, seed, replication=replication, progress=watch, observer=observer)
    return Run(record)


def open_run(path: str | Path) -> Run:
    """Read a run from its folder, as `Run.save` or `sortie fly` wrote it.

    Raises:
        RunError: the folder has no run, or the run is damaged.

    Example:
        >>> run = sortie.fly("track_target", {"duration_s": 1, "perception.detector": "none"})
        >>> sortie.open_run(run.save(folder / "a", recording=False)).fingerprint == run.fingerprint
        True
    """
    from sortie.sim.results import run_folder

    folder = as_path("path", path)
    return Run(run_folder.load(folder), folder)


@dataclass(frozen=True, eq=False)
class Comparison:
    """The result of `sortie.compare`: sorties under several policies with the same scenario, seeds and random draws."""

    sorties: tuple[Compared, ...]
    """One for each policy and seed: seed by seed, policies in the order in which they were named."""
    gains: tuple[Gain, ...]
    """AP@0.5 (average precision) of every policy minus that of the first, with a paired 95 % interval. With several
    seeds a gain is the mean of the sorties' differences, and the interval covers sorties (`Gain.over`). Empty if
    `perception.detector` is none, because nothing is scored then; `table` still has bytes, energy and delays."""
    precision: Precision | None = None
    """With `half_width`: how many seeds each detector flew, their correlation, and what it cost relative to the torch
    detector alone."""

    @cached_property
    def table(self) -> pa.Table:
        """One row for each sortie: `policy`, `seed`, `town_seed` (its `perception.scene.seed`), then every metric of the
        outcome by its name with dots, such as `ap50.mission`; null where a sortie has none, 0 where it counted none."""
        import pyarrow as pa

        from sortie.sim.results.outcome import lacking

        rows = [
            {"policy": s.policy, "seed": s.seed, "town_seed": s.town_seed, **s.outcome.flat()} for s in self.sorties
        ]
        names = list(dict.fromkeys(name for row in rows for name in row))
        fleets = [len(s.outcome["battery"]) for s in self.sorties]
        return pa.table(
            {name: [row.get(name, lacking(name, n)) for row, n in zip(rows, fleets, strict=True)] for name in names}
        )

    def summary(self) -> Summary:
        """The policies side by side, and why their figures differ, as `sortie compare` prints it.

        A notebook and `rich` show it as a table; `str` returns plain text.
        """
        from sortie.sim.experiment.compare import Flown
        from sortie.sim.experiment.comparison_text import comparison_table, explanations, precision_lines
        from sortie.sim.results.summary import Summary

        flown = Flown(self.sorties, self.gains)
        more = [] if self.precision is None else precision_lines(self.precision)
        return Summary(comparison_table(flown), *explanations(flown), *more)

    @user_errors()
    def report(self, path: str | Path) -> Path:
        """Write the comparison as one self-contained HTML page: the table, and figures of all policies.

        Raises:
            RunError: the file cannot be written, or matplotlib (extra `report`) is not installed.
        """
        from sortie.sim.experiment.compare import Flown
        from sortie.sim.experiment.comparison_page import save_comparison_page

        place = as_path("path", path)
        save_comparison_page(Flown(self.sorties, self.gains), place, self.precision)
        return place

    @user_errors()
    def save_recording(self, path: str | Path) -> Path:
        """Save the policies' sorties of the first seed side by side as one Rerun recording.

        Raises:
            RunError: the file cannot be written, Rerun is missing (extra `view`), or the comparison was to a half-width,
                which keeps no records.
        """
        from sortie.sim.playback.recording import save_comparison

        place = as_path("path", path)
        if self.precision is not None:
            raise RunError(f"{place}: a comparison to a half-width keeps no records; compare with seeds instead")
        save_comparison([(s.policy, s.record) for s in self.sorties if s.record is not None], place)
        return place


def compare(
    scenario: ScenarioLike,
    policies: Iterable[PolicyLike],
    overrides: Overrides = (),
    *,
    seeds: int | Iterable[int] | None = None,
    own_fusion: bool = False,
    progress: Callable[[str, int, float], None] | Literal[True] | None = None,
    half_width: float | None = None,
    metric: str | None = None,
    pilot: int | None = None,
    most_seeds: int | None = None,
    workers: int = 1,
    kept: str | Path | bool | None = None,
) -> Comparison:
    """Fly a scenario under several policies, with the same seeds and draws.

    With `half_width`, it flies seeds with the torch detector until the intervals are narrow enough. Sorties of the surrogate
    serve as control variates (cheap measurements that correct the mean) where this saves time. `docs/site/statistics.md`
    explains the method.

    Args:
        scenario, overrides: as for `sortie.load`.
        policies: one or more; gains are over the first.
        seeds: a list of seeds, or the number of seeds, beginning with the scenario's own. None flies eight with the
            surrogate, which is fast, and one with any other detector. With several seeds, each has its own town and
            random draws, the same for all policies; intervals then cover sorties. With one seed, the flight is over
            the scenario's own town, and intervals cover that flight alone: they resample its blocks of 5 s.
        own_fusion: fly published methods with the fusion that they were published with, not `perception.fusion`.
        progress: called with the policy's label, the seed and the simulated time (s). With `half_width`: called with the
            stage, the number of seeds flown in it, and the number of all its seeds. True shows a bar.
        half_width: fly until the 95 % interval of every gain in `metric` reaches at most this far to each side, in AP: 0.01
            is one AP point. Scored by the scenario's detector, or by torch if that is the surrogate. Not with `seeds`.
        metric: `ap50.full_scene` (None) or `ap50.mission`.
        pilot: the seeds that both detectors fly before the rest is planned; None is 12.
        most_seeds: the seeds that the torch detector flies at most; None is 200. `precision.reached` says whether that
            was enough.
        workers: the number of processes that fly policies given by name; with `half_width` one process flies.
        kept: flights are kept, so that after an interruption the same call goes on, and what was flown once is not flown
            again by this version of Sortie. None keeps the flights of policies given by name in the user's cache folder
            (`sim/experiment/README.md`), False keeps nothing, and a path names another file. With True or a path, flights of
            callables are kept too; each must be a function at the top of a file, or a `functools.partial` of one with
            numbers and texts, so that another one is not taken for it.

    Raises:
        ScenarioError, PolicyError: the scenario or a policy is wrong; raised before anything flies.
        RunError: with `half_width`: torch is missing, the surrogate cannot fly the scenario, or the file cannot be used.

    Example:
        >>> short = {"duration_s": 2, "perception.detector": "surrogate"}
        >>> compared = sortie.compare("track_target", ["worked", "silence"], short, seeds=2)
        >>> compared.table.select(["policy", "seed", "town_seed"]).to_pylist()[2:]
        [{'policy': 'worked', 'seed': 2, 'town_seed': 8}, {'policy': 'silence', 'seed': 2, 'town_seed': 8}]
    """
    from sortie.sim.experiment.compare import Contender, chosen_seeds
    from sortie.sim.experiment.compare import compare as compare_policies
    from sortie.sim.experiment.half_width import compare_to

    base = load(scenario, overrides)
    if isinstance(policies, str) or not isinstance(policies, Iterable):
        raise PolicyError(f"policies: {policies!r}, must be a list of policies: ['worked', 'silence']")
    flown = [Contender(label(policy), *_with_policy(base, policy)) for policy in policies]
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise RunError(f"workers: {workers!r}, must be a whole number from 1 on")
    if own_fusion:
        flown = [contender.with_own_fusion() for contender in flown]
    labels = [contender.label for contender in flown]
    if not flown or len(set(labels)) < len(labels):
        how = "; give functions of one name, such as lambdas, a __name__ of their own"
        raise PolicyError(f"policies: {', '.join(labels) or 'none'}, must be one or more, each named once{how}")
    path, named = _kept(kept)
    flown = [contender._replace(named=named) for contender in flown]
    if half_width is not None:
        settings = _precision_settings(half_width, seeds, metric, pilot, most_seeds)
        with _stages_shown(progress) as watch:
            return Comparison(*compare_to(flown, settings, path, watch))
    for name, value in (("metric", metric), ("pilot", pilot), ("most_seeds", most_seeds)):
        if value is not None:
            raise RunError(f"{name}: goes with half_width, which is missing")
    if isinstance(seeds, Iterable):
        listed: Sequence[int] = [*seeds]
    elif seeds is None or (hasattr(seeds, "__index__") and not isinstance(seeds, bool) and operator.index(seeds) > 0):
        listed = chosen_seeds(base, count=None if seeds is None else operator.index(seeds))
    else:
        raise ScenarioError(f"seeds: {seeds!r}, must be a list of seeds or how many, 1 or more")
    chosen = [whole("seeds", seed) or 0 for seed in listed]
    if not chosen or len(set(chosen)) < len(chosen):
        raise ScenarioError(f"seeds: {chosen}, must be one or more, each named once")
    with _shown(progress, base.name, len(flown) * len(chosen) * base.duration_s) as watch:
        shown = _summed(watch) if progress is True else watch
        return Comparison(*compare_policies(flown, chosen, progress=shown, workers=workers, kept=path))


def _kept(kept: str | Path | bool | None) -> tuple[Path | None, bool]:
    """The file of flights, and whether those of callables are kept too."""
    from sortie.sim.experiment.flight_file import users_file

    if kept is None or isinstance(kept, bool):
        return None if kept is False else users_file(), kept is True
    return as_path("kept", kept), True


def replay(run: Run, policy: PolicyLike | None = None, *, disagreement: bool = False) -> Replay:
    """Repeat the decisions of a run with the same or another policy, and compare them with those in flight.

    The policy reads the views that the run kept. A different decision does not change later views. What policies return
    is compared, before staleness rules and damping.

    Args:
        run: a run that was flown with `record.views`.
        policy: the policy that decides; None uses the policies that decided in flight, each where it did. Their
            decisions must then be the same, unless they depend on more than the view. A run that was opened names files,
            and does not run them: name a policy that is a file.
        disagreement: also measure how often two drones' views lead to different choices about one link. The time for
            this grows with the third power of the number of drones.

    Raises:
        RunError: the run kept no views, or a function that the scenario does not name decided in flight; or a file did,
            and the run was opened from a folder.
        PolicyError: the policy is unknown, fails on a view or breaks its contract.

    Example:
        >>> run = sortie.fly("track_target", {"duration_s": 2, "perception.detector": "none", "record.views": True})
        >>> sortie.replay(run).same
        True
        >>> sortie.replay(run, "silence").table.column_names[:5]
        ['t_s', 'drone', 'decision', 'peer', 'fields']
    """
    from sortie.scenarios.plugins.user_calls import guarded
    from sortie.sim.engine.pilot import NamedPolicy, PolicyPlan, plan_for
    from sortie.sim.identity import name_of, policy_files
    from sortie.sim.studies.replay import replay as decide_again

    if not isinstance(run, Run):
        raise RunError(f"run: {run!r}, must be a Run, as sortie.open_run gives it")
    if policy is None and run.path is not None and (files := policy_files(run.scenario)):
        raise RunError(f"{run.path}: {files[0]} decided in flight; name it as the policy to run that file again")
    chosen, function = _with_policy(run.scenario, policy)
    plan = plan_for(chosen) if function is None else PolicyPlan(NamedPolicy(name_of(function), guarded(function)))
    return decide_again(run.record, plan, as_flown=policy is None, disagreement=disagreement)


@dataclass(frozen=True, eq=False)
class CampaignResult:
    """The finished runs of a campaign, as `sortie.campaign` and `sortie.open_campaign` return them."""

    path: Path
    """The campaign's folder."""
    finished: int
    """Number of runs with a row on disk."""
    failed: int
    """Number of these that failed; their rows have the error."""
    flown: int
    """Number of runs that this call flew."""
    seconds: float
    """Wall-clock time of this call, s."""

    @cached_property
    def rows(self) -> pa.Table:
        """One row for each run: its varied fields, policy, seed, status and the campaign's metrics.

        Raises:
            RunError: nothing is finished, or the file of the rows is damaged.
        """
        from sortie.sim.experiment.rows import read_rows

        return read_rows(self.path).all

    def report(self) -> Path:
        """Write `report.md` and `report.html` with their figures into the folder; returns the path of the first.

        Raises:
            RunError: nothing is finished, matplotlib is missing, or the files cannot be written.
        """
        from sortie.sim.experiment.report import write_report

        with user_errors():
            return write_report(self.path)


def campaign(
    campaign: str | Path,
    *,
    out: str | Path | None = None,
    workers: int | None = 0,
    scheduler: str | None = None,
    security: tuple[str | Path, str | Path, str | Path] | None = None,
    worker_memory_gb: float | None = None,
    wait_for_workers_s: float = 300.0,
    by_torch: int | None = None,
    resume: bool = False,
    retry_failed: bool = False,
    progress: Callable[[Any], None] | Literal[True] | None = None,
    notice: Callable[[str], None] | None = None,
) -> CampaignResult:
    """Fly a campaign: many sorties over the fields that its file varies.

    After an interruption, the same call continues the campaign.

    Args:
        campaign: a campaign file, or the name of a library campaign.
        out: the campaign's folder; None uses `runs/campaign-NAME`.
        workers: number of worker processes, at least one; None uses one for each core. Nothing flies in this process.
        scheduler: the address of a running dask cluster, `tcp://host:8786`.
        security: PEM files for TLS with the cluster: the authority's certificate, your certificate, its key.
        worker_memory_gb: memory limit of a worker, GB; a run that needs more is recorded as failed. None divides the
            machine's memory among the workers; on a cluster, the workers' own limits apply.
        wait_for_workers_s: how long to wait while a cluster has no workers, s.
        by_torch: so many draws (replications if nothing is drawn) are flown by the torch detector as well, into the folder
            `by_torch` within the campaign's. The report then estimates what torch would find over all of them.
        resume: only continue; raise an error if the folder has no campaign.
        retry_failed: fly failed runs once more.
        progress: called with a `sortie.sim.experiment.drive.Progress` after each batch; True shows a bar.
        notice: called with a line when a cluster has no workers; None issues warnings.

    Raises:
        ScenarioError, PolicyError: the campaign is wrong; raised before anything flies.
        RunError: the folder cannot be used, or the cluster cannot be reached.

    Example:
        >>> done = sortie.campaign("link_battery", out="runs/c", workers=2)    # doctest: +SKIP
        >>> done.rows.group_by("policy").aggregate([("ap50.mission", "mean")])    # doctest: +SKIP
    """
    from sortie.scenarios.reading.campaign import load_campaign
    from sortie.sim.experiment.by_torch import FOLDER, plan_by_torch
    from sortie.sim.experiment.drive import open_pool, run_campaign
    from sortie.sim.experiment.plan import make_plan
    from sortie.sim.experiment.store import ensure_usable

    if scheduler is not None and not isinstance(scheduler, str):
        raise RunError(f"scheduler: {scheduler!r}, must be an address: 'tcp://host:8786'")
    if scheduler is not None and workers:
        raise RunError("workers and scheduler: name one of them")
    if workers is not None and (isinstance(workers, bool) or not isinstance(workers, int) or workers < 0):
        raise RunError(f"workers: {workers!r}, must be a whole number from 0 on, or None")
    if worker_memory_gb is not None and not (_is_number(worker_memory_gb) and 0 < worker_memory_gb < math.inf):
        raise RunError(f"worker_memory_gb: {worker_memory_gb!r}, must be a number above 0, or None")
    if progress is not True:
        _ensure_callable("progress", progress)
    _ensure_callable("notice", notice)
    tell = _warn if notice is None else notice
    files = None if security is None else _certificates(security)
    units = whole("by_torch", by_torch)
    study = load_campaign(as_path("campaign", campaign))
    folder = campaign_folder(study.campaign.campaign) if out is None else as_path("out", out)
    count = len(os.sched_getaffinity(0)) if workers is None else workers
    with user_errors():
        plan = make_plan(study)
        ensure_usable(folder, plan)
        if units is not None:
            by_torch_plan = plan_by_torch(study, units, plan)
            ensure_usable(folder / FOLDER, by_torch_plan)
        with (
            _stages_shown(progress) as shown,
            open_pool(
                count,
                scheduler,
                security=files,
                wait_s=wait_for_workers_s,
                notice=tell,
                memory_b=None if worker_memory_gb is None else round(worker_memory_gb * 1e9),
            ) as pool,
        ):
            watch = _of_campaign(shown) if progress is True else shown or (lambda p: None)
            how: dict[str, Any] = {"retry_failed": retry_failed, "progress": watch, "notice": tell}
            done = [run_campaign(plan, folder, pool, resume_only=resume, **how)]
            if units is not None:  # of those that stop_when left
                units = min(units, done[0].of // plan.unit_runs)
                if units < 2:
                    tell(f"by_torch: stop_when left {units} {plan.unit}s, must be at least 2; torch flies none")
                else:
                    done.append(run_campaign(by_torch_plan, folder / FOLDER, pool, units=units, **how))
    total = (sum(getattr(p, name) for p in done) for name in ("finished", "failed", "flown", "seconds"))
    return CampaignResult(folder, *total)


def open_campaign(folder: str | Path) -> CampaignResult:
    """Open a campaign's folder, to read its finished runs.

    Raises:
        RunError: the folder has no campaign, or the file of its rows is damaged.

    Example:
        >>> sortie.open_campaign("runs/campaign-link_battery").rows    # doctest: +SKIP
    """
    from sortie.sim.experiment.store import CampaignTable

    path = as_path("folder", folder)
    with user_errors(), closing(CampaignTable(path)) as store:
        finished, failed = store.count()
    return CampaignResult(path, finished, failed, 0, 0.0)


def _certificates(security: Sequence[str | Path]) -> tuple[Path, Path, Path]:
    if isinstance(security, str) or not isinstance(security, Sequence) or len(security) != 3:
        raise RunError(f"security: {security!r}, must be three paths: CA, certificate, key")
    ca, cert, key = (as_path("security", file) for file in security)
    return ca, cert, key


def _warn(line: str) -> None:
    warnings.warn(line, stacklevel=3)


def campaign_folder(name: str) -> Path:
    """The default folder of a campaign."""
    return Path("runs") / f"campaign-{name}"


def check(
    scenarios: str | Path | Sequence[str | Path],
    overrides: Overrides = (),
    *,
    update: bool = False,
    progress: Callable[[float], None] | Literal[True] | None = None,
) -> tuple[Checked, ...]:
    """Fly scenarios and test the expectations that they state.

    Args:
        scenarios: a file, the name of a library scenario, a folder, or a list of these. Of a folder, every scenario
            file below it that has expectations is flown.
        overrides: fields to change in every scenario, as for `sortie.load`.
        update: write golden (stored) outcomes instead of comparing with them.
        progress: called with the simulated time of the scenario that flies, s; True shows a bar for each.

    Returns:
        One `Checked` for each scenario, with `.verdicts`, `.failed`, and `.replay(verdict)`: the command that shows
        a failure.

    Raises:
        ScenarioError, PolicyError, RunError: a scenario, its policy or its golden outcome is wrong.

    Example:
        >>> text = "name: mine\\nduration_s: 1\\nperception: {detector: none}\\n"
        >>> _ = (folder / "mine.yaml").write_text(text + "expect: [{metric: bytes.data_sent, at_least: 0}]\\n")
        >>> [checked.failed for checked in sortie.check(folder)]
        [[]]
    """
    from sortie.sim.check.checking import check_scenario, flights
    from sortie.sim.check.discovery import scenario_files

    if progress is not True:
        _ensure_callable("progress", progress)
    chosen = scenarios if isinstance(scenarios, Sequence) and not isinstance(scenarios, str) else [scenarios]
    names = [name for one in chosen for name in scenario_files(as_path("scenarios", one))]
    _ensure_overrides(overrides)
    loaded = [(name, reading.load(name, overrides)) for name in names]  # all of them, before the first one flies
    texts, checked = reading.as_texts(overrides), []
    for name, flown in loaded:
        with _shown(progress, flown.name, flown.duration_s * flights(flown)) as watch:
            checked.append(check_scenario(name, texts, update=update, progress=watch))
    return tuple(checked)


@overload
def env(scenario: ScenarioLike, overrides: Overrides = (), *, team: Literal[False] = False) -> SortieEnv: ...
@overload
def env(scenario: ScenarioLike, overrides: Overrides = (), *, team: Literal[True]) -> TeamEnv: ...
def env(scenario: ScenarioLike, overrides: Overrides = (), *, team: bool = False) -> SortieEnv | TeamEnv:
    """Return an environment to train policies in: a PettingZoo `ParallelEnv` in which each drone is an agent.

    Args:
        scenario, overrides: as for `sortie.load`, with at least two drones. The scenario's policy is not used.
        team: return a `gymnasium.Env` in which the whole fleet is one agent. `gymnasium.vector` flies many of these at once.

    Returns:
        The environment. It can be copied by `copy.deepcopy` and by pickle at any step; a copy repeats the steps so far.

    Raises:
        ScenarioError: the scenario is wrong.
        RunError: the fleet has a single drone, or the extra `env` is not installed.

    Example:
        >>> env = sortie.env("track_target", {"duration_s": 2, "perception.detector": "surrogate"})
        >>> observations, infos = env.reset(seed=1)
        >>> sorted(observations)[:2]
        ['drone_0', 'drone_1']
        >>> env.close()
    """
    with user_errors():
        from sortie.sim.env import SortieEnv, TeamEnv

        chosen = load(scenario, overrides)
        return TeamEnv(chosen) if team else SortieEnv(chosen)


def _ensure_overrides(overrides: Any) -> None:
    if (
        isinstance(overrides, str)
        or not isinstance(overrides, Mapping | Sequence)
        or (not isinstance(overrides, Mapping) and not all(isinstance(entry, str) for entry in overrides))
    ):
        raise ScenarioError(f"overrides: {overrides!r}, must be a map or a list: {{'fleet.drones': 3}}")


def _with_policy(scenario: Scenario, policy: PolicyLike | None) -> tuple[Scenario, Policy | None]:
    """The scenario to fly, and the callable that decides in place of its policy; None where the scenario's own does."""
    if policy is None:
        return scenario, None
    if isinstance(policy, str):
        return flown_by(scenario, policy), None
    if not callable(policy):
        raise PolicyError(f"policy: {policy!r}, must be a name, file.py:function or a callable of one FleetView")
    try:
        inspect.signature(policy).bind(object())
    except TypeError as error:
        raise PolicyError(f"policy {label(policy)!r}: {error}, must take one FleetView") from None
    except ValueError:  # some callables written in C name no parameters
        pass
    return scenario, policy


def label(policy: PolicyLike) -> str:
    """How a policy is called in tables: as it was named, or by the function's own name."""
    return policy if isinstance(policy, str) else getattr(policy, "__name__", type(policy).__name__)


def _precision_settings(half_width: Any, seeds: object, metric: Any, pilot: Any, most_seeds: Any) -> Settings:
    """The arguments of a comparison to a half-width, checked."""
    from sortie.sim.experiment.half_width import METRICS, MOST, PILOT, Settings

    if seeds is not None:
        raise RunError("seeds and half_width: name one of them; a half-width chooses its number of seeds")
    if not _is_number(half_width):
        raise RunError(f"half_width: {half_width!r}, must be a number above 0 and below 1; 0.01 is one AP point")
    first, most = whole("pilot", pilot), whole("most_seeds", most_seeds)
    most = MOST if most is None else most
    metric = METRICS[0] if metric is None else metric
    return Settings(float(half_width), metric, min(PILOT, most) if first is None else first, most)


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _summed(update: Callable[[float], None]) -> Callable[[str, int, float], None]:
    """A comparison's progress as the simulated time of all its flights together."""
    times_s: dict[tuple[str, int], float] = {}

    def watch(policy: str, seed: int, t_s: float) -> None:
        times_s[policy, seed] = t_s
        update(sum(times_s.values()))

    return watch


def _of_campaign(report: Callable[[str, int, int], None]) -> Callable[[Any], None]:
    """A campaign's progress as a bar over its runs."""
    return lambda p: report("runs by torch" if p.by_torch else "runs", p.finished, p.of)


@contextmanager
def _stages_shown(progress: Any) -> Iterator[Any]:
    """As `_shown`, with a bar for each stage."""
    if progress is not True:
        _ensure_callable("progress", progress)
        yield progress
        return
    from sortie.sim.cli.console import stages

    with stages() as report:
        yield lambda stage, done, of: report(stage, done, round(of))


@contextmanager
def _shown(progress: Any, label: str, total: float) -> Iterator[Any]:
    """What a flight calls with its progress: the caller's own function, or with True the updater of a bar."""
    if progress is not True:
        _ensure_callable("progress", progress)
        yield progress
        return
    from sortie.sim.cli.console import bars

    with bars() as add:
        yield add(label, total)


def _ensure_callable(name: str, value: object) -> None:
    if value is not None and not callable(value):
        raise ScenarioError(f"{name}: {value!r}, must be a function, or None")
