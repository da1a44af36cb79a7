"""A campaign's plan: a pure function from its specification and a run's number to that run's task.

Runs are numbered so that what is averaged over comes first: draws if fields are drawn, replications if not. Within,
grid points, replications and policies; the policies of one scene stand together, on equal seeds, so that they are
compared pair by pair.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sortie.policies.contract import PolicyError
from sortie.policies.registry import resolve
from sortie.scenarios.reading.campaign import Study, extremes
from sortie.scenarios.reading.files import (
    found_beside,
    named_files,
    named_models,
    value_at,
    with_files,
    without_brackets,
)
from sortie.scenarios.reading.load import loads
from sortie.scenarios.reading.nodes import ScenarioError, as_node, assign, plain
from sortie.scenarios.schema import Perception
from sortie.scenarios.schema.campaign import PARAMS, Campaign
from sortie.sim.engine.pilot import named_policy
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.experiment.flight import Task, file_digests, found_file
from sortie.sim.experiment.spread import TAIL, Floats, design, drawn_fields, grid, quantiles
from sortie.sim.folders import RunError
from sortie.sim.identity import flight_code, packages
from sortie.sim.policy_text import policy_overrides
from sortie.sim.results.outcome import check_number, open_keys

FORMAT = 2


class PlannedRun(NamedTuple):
    """Where a run stands in the campaign."""

    run: int
    unit: int
    """What is averaged over: the draw, or the replication where nothing is drawn."""
    cell: int
    """A draw at a grid point: draw × grid points + grid point."""
    replication: int
    policy: int


@dataclass(frozen=True)
class CampaignPlan:
    """A campaign, worked out.

    Args:
        spec: plain JSON, everything that decides what is flown; equal specs give equal rows.
    """

    spec: Mapping[str, Any]

    @cached_property
    def campaign(self) -> Campaign:
        return Campaign.model_validate_json(json.dumps(self.spec["campaign"]), strict=True)

    @property
    def code(self) -> str:
        return str(self.spec["code"])

    @property
    def policies(self) -> list[str]:
        """Labels, in the campaign's order."""
        return [label for label, _ in self.spec["policies"]]

    @cached_property
    def points(self) -> Floats:
        """The design [draws, drawn fields] in the unit cube."""
        campaign = self.campaign
        return design(campaign.sample, len(drawn_fields(campaign)), campaign.seed)

    @cached_property
    def grid(self) -> list[dict[str, Any]]:
        return grid(self.campaign, self.spec["columns"])

    @property
    def cells(self) -> int:
        return len(self.points) * len(self.grid)

    @property
    def runs(self) -> int:
        return self.cells * self.campaign.replications * len(self.policies)

    @property
    def units(self) -> int:
        return len(self.points) if drawn_fields(self.campaign) else self.campaign.replications

    @property
    def unit_runs(self) -> int:
        """Runs of one unit; they stand together."""
        return self.runs // self.units

    @property
    def by_torch(self) -> bool:
        """Whether it is the torch detector's part of a campaign (`sortie.sim.experiment.by_torch`)."""
        return bool(self.spec.get("by_torch"))

    @property
    def unit(self) -> str:
        """What a unit is."""
        return "draw" if drawn_fields(self.campaign) else "replication"

    @property
    def shard(self) -> int:
        """Runs of one part; policies of one scene never stand in two. By torch a unit, so that more of them can follow."""
        if self.by_torch:
            return self.unit_runs
        p = len(self.policies)
        return max(1, min(5000, max(30, self.runs // 20)) // p) * p

    def at(self, run: int) -> PlannedRun:
        """A run's place."""
        rest, policy = divmod(run, len(self.policies))
        grid_points, replications = len(self.grid), self.campaign.replications
        if drawn_fields(self.campaign):
            unit, inner = divmod(rest, grid_points * replications)
            point, replication = divmod(inner, replications)
            return PlannedRun(run, unit, unit * grid_points + point, replication, policy)
        unit, point = divmod(rest, grid_points)
        return PlannedRun(run, unit, point, unit, policy)

    def varied(self, cell: int) -> dict[str, Any]:
        """A cell's values of the varied fields, in the campaign's order."""
        draw, point = divmod(cell, len(self.grid))
        at, drawn = self.grid[point], self._drawn
        return {name: at[name] if name in at else drawn[name][draw] for name in self.campaign.vary}

    @cached_property
    def _drawn(self) -> dict[str, Sequence[Any]]:
        """The values of the drawn fields, draw by draw."""
        tail = TAIL if self.campaign.sample.method == "morris" else 0.0
        columns = zip(drawn_fields(self.campaign), self.points.T, strict=True)
        return {name: quantiles(self.campaign.vary[name], u, tail=tail) for name, u in columns}

    def seed(self, cell: int) -> int:
        """The seed of a cell's runs, whichever the policy: a function of the campaign's seed and the cell."""
        words = np.random.SeedSequence([self.campaign.seed, cell]).generate_state(1, np.uint64)
        return int(words[0] >> 1)

    @cached_property
    def _base(self) -> Any:
        return as_node(self.spec["base"])

    def task(self, run: int) -> Task:
        """What is flown, and what of it is asked."""
        at = self.at(run)
        node, varied = self._base, self.varied(at.cell)
        for name, value in varied.items():
            node = assign(node, name.split("."), as_node(value))
        scenario = without_brackets(plain(node))
        assert isinstance(scenario, dict)  # noqa: S101
        seed, policy = self.seed(at.cell), self.spec["policies"][at.policy][1]
        params = {name.removeprefix(PARAMS): value for name, value in varied.items() if name.startswith(PARAMS)}
        policy = {**scenario["policy"], **policy, "params": {**policy["params"], **params}}
        text = json.dumps(scenario | {"policy": policy, "seed": seed}, sort_keys=True)
        files, packages = self.spec["files"], self.spec.get("packages", {})
        asked = self.campaign.metrics
        return Task(text, seed, at.replication, asked, self.code, files=files, packages=packages, number=run)


def make_plan(study: Study, **more: Any) -> CampaignPlan:
    """A campaign's plan, checked before anything is flown.

    Args:
        more: further entries of its specification.

    Raises:
        PolicyError: an unknown policy or parameter.
        RunError: a metric that no outcome has, or a file that cannot be read.
    """
    campaign, base = study.campaign, study.base

    def place(name: str) -> str:
        """From anywhere: a worker may stand elsewhere."""
        return found_file(name, study.folder)

    sections = with_files(base.model_dump(mode="json", exclude_none=True), place)
    policies = [
        (label or base.policy.name, with_files({"policy": _policy(study, i)}, place)["policy"])
        for i, label in enumerate(campaign.policies)
    ]
    spec, columns = campaign.model_dump(mode="json"), {k: list(values) for k, values in study.columns.items()}
    wholes = [sections | {"policy": section} for _, section in policies]
    files = {file for whole in wholes for file in named_files(whole)}
    models = {model for whole in wholes for model in named_models(whole)}
    for field in sorted(campaign.vary):  # a model before its parameters, which may name files
        holder, within = (columns, field) if field in columns else (spec["vary"][field], "values")
        values = holder.get(within) or []
        found = {json.dumps(value): value for value in values if not isinstance(value, int | float)}
        others: dict[str, list[Any]] = {}  # wholes with other models, by what the field then has
        for text, value in found.items():
            varied = [with_files(_with(whole, field, value), place, study.folder) for whole in wholes]
            found[text] = next((v for each in varied if (v := value_at(field, each)) != value), value)
            flown = [without_brackets(each) for each in varied]
            files.update(file for each in flown for file in named_files(each))
            models.update(model for each in flown for model in named_models(each))
            if named_models(flown[0]) != named_models(wholes[0]):
                others.setdefault(json.dumps(value_at(field, flown[0])), flown[: len(policies)])
        values[:] = [found.get(json.dumps(value), value) for value in values]
        wholes += [each for flown in others.values() for each in flown]
    _check_metrics(study, [section for _, section in policies])
    return CampaignPlan(
        {
            "format": FORMAT,
            "campaign": spec,
            "base": sections,
            "columns": columns,
            "policies": [[label, section] for label, section in policies],
            "files": file_digests(sorted(files)),
            "packages": packages(models, files),
            "code": flight_code([sections, columns, spec]),
            **more,
        }
    )


def _with(sections: dict[str, Any], field: str, value: Any) -> Any:
    """The plain sections in which a dotted field has this value."""
    return plain(assign(as_node(sections), field.split("."), as_node(value)))


def _policy(study: Study, number: int) -> dict[str, Any]:
    """What a policy's runs have in the scenario's section: another than the base's own flies to the end."""
    label, base = study.campaign.policies[number], study.base
    at = study.where("policies", number) if label else study.where("base")
    try:
        if label:
            overrides = policy_overrides(label, base.policy.name)
            for name in (override.partition("=")[0].strip() for override in overrides):
                if name in study.campaign.vary:
                    raise PolicyError(f"{label} has its own {name}, which is varied; leave it out here")
            text = json.dumps(base.model_dump(mode="json", exclude_none=True))
            base = found_beside(loads(text, label, overrides), study.folder)
        resolve(base.policy.name, base.policy.params)
    except (PolicyError, ScenarioError) as error:
        raise PolicyError(f"{at}: {error}") from None
    for name, spread in study.campaign.vary.items():
        if name.startswith(PARAMS):
            try:
                for value in extremes(spread, study.columns.get(name, ())):
                    resolve(base.policy.name, {name.removeprefix(PARAMS): value})
                    if ":" in base.policy.name:
                        break  # a file's function has no bounds, and is loaded each time
            except PolicyError as error:
                raise PolicyError(f"{study.where('vary', name)}: {error}") from None
    section = base.policy.model_dump(mode="json", exclude_none=True)
    return {name: section[name] for name in ("name", "params", "changes", "commands")}


def _check_metrics(study: Study, policies: Sequence[Mapping[str, Any]]) -> None:
    """Hold the metrics' names against the outcome's reference."""
    # what the base reads is looked at here, once, not in thousands of runs; a copy is not validated, so that changes of
    # policy may lie beyond its end
    short = {"duration_s": 2 * study.base.frame_s, "events": (), "perception": Perception(detector="none")}
    run_sortie(study.base.model_copy(update=short))
    keys = _metric_keys(study, policies)
    for i, name in enumerate(study.campaign.metrics):
        try:
            check_number(name, keys)
        except RunError as error:
            raise RunError(f"{study.where('metrics', i)}: {error}") from None


def _metric_keys(study: Study, policies: Sequence[Mapping[str, Any]]) -> dict[str, Collection[str]]:
    """What the open parts of the runs' outcomes may be keyed by."""
    base, vary = study.base, study.campaign.vary
    timed = any(name == "duration_s" or name.partition(".")[0] == "mission" for name in vary)
    phases = study.phases if timed else sum(phase.at_s < base.duration_s for phase in base.mission.phases)
    traced = base.fleet.trace is not None or not vary.keys().isdisjoint({"fleet", "fleet.trace"})
    flown = [change for section in policies for change in section["changes"]]
    if not any(name.startswith(PARAMS) for name in vary):  # else every run has another name for its policy
        flown += policies
    names = [named_policy(one["name"], dict(sorted(one["params"].items()))).name for one in flown]  # as tasks have them
    return open_keys(study.drones, phases, names, traced=traced, metrics=base.metrics)
