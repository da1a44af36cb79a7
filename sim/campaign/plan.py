"""What a campaign flies: a pure function from its specification and a run's number to that run's task.

Runs are numbered so that what is averaged over comes first: draws if fields are drawn, replications if not. Within,
grid points, replications and policies; the policies of one scene stand together, on equal seeds, so that they are
compared pair by pair.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from perception.surrogate.model import SHIPPED
from policies.registry import resolve
from scenarios.campaign import Campaign
from scenarios.load import loads
from scenarios.load_campaign import Study, as_node
from scenarios.nodes import assign, plain
from scenarios.schema import Scenario
from sim.campaign.code import code_version, file_digest
from sim.campaign.spread import TAIL, Floats, design, drawn_fields, grid, quantile
from sim.campaign.work import number, task_key
from sim.folders import RunError
from sim.named import policy_overrides
from sim.outcome import outcome
from sim.sortie import run_sortie

FORMAT = 1


class Run(NamedTuple):
    """Where a run stands in the campaign."""

    run: int
    unit: int
    """What is averaged over: the draw, or the replication where nothing is drawn."""
    cell: int
    """A draw at a grid point: draw × grid points + grid point."""
    replication: int
    policy: int


@dataclass(frozen=True)
class Plan:
    """A campaign, worked out.

    Args:
        spec: plain JSON, everything that decides what is flown; equal specs give equal rows.
    """

    spec: Mapping[str, Any]

    @cached_property
    def campaign(self) -> Campaign:
        return Campaign.model_validate_json(json.dumps(self.spec["campaign"]), strict=True)

    @cached_property
    def digest(self) -> str:
        """Of the specification, the code version in it: results of another one are never taken for this one's."""
        return hashlib.sha256(json.dumps(self.spec, sort_keys=True).encode()).hexdigest()

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
    def shard(self) -> int:
        """Runs in one file of the table; policies of one scene never stand in two."""
        p = len(self.policies)
        return max(1, min(5000, max(30, self.runs // 20)) // p) * p

    def at(self, run: int) -> Run:
        """A run's place."""
        rest, policy = divmod(run, len(self.policies))
        grid_points, replications = len(self.grid), self.campaign.replications
        if drawn_fields(self.campaign):
            unit, inner = divmod(rest, grid_points * replications)
            point, replication = divmod(inner, replications)
            return Run(run, unit, unit * grid_points + point, replication, policy)
        unit, point = divmod(rest, grid_points)
        return Run(run, unit, point, unit, policy)

    def varied(self, cell: int) -> dict[str, Any]:
        """A cell's values of the varied fields, in the campaign's order."""
        draw, point = divmod(cell, len(self.grid))
        vary, at = self.campaign.vary, self.grid[point]
        drawn = dict(zip(drawn_fields(self.campaign), self.points[draw].tolist(), strict=True))
        tail = TAIL if self.campaign.sample.method == "morris" else 0.0
        return {name: at[name] if name in at else quantile(vary[name], drawn[name], tail=tail) for name in vary}

    def seed(self, cell: int) -> int:
        """The seed of a cell's runs, whichever the policy: a function of the campaign's seed and the cell."""
        words = np.random.SeedSequence([self.campaign.seed, cell]).generate_state(1, np.uint64)
        return int(words[0] >> 1)

    @cached_property
    def _base(self) -> Any:
        return as_node(self.spec["base"])

    def task(self, run: int) -> str:
        """What the worker receives."""
        at = self.at(run)
        node = self._base
        for name, value in self.varied(at.cell).items():
            node = assign(node, name.split("."), as_node(value))
        scenario = plain(node)
        assert isinstance(scenario, dict)  # noqa: S101
        seed = self.seed(at.cell)
        scenario |= {"policy": {**scenario["policy"], **self.spec["policies"][at.policy][1]}, "seed": seed}
        task = {
            "scenario": scenario,
            "seed": seed,
            "replication": at.replication,
            "metrics": self.spec["campaign"]["metrics"],
            "files": self.spec["files"],
        }
        return json.dumps(task, sort_keys=True)

    def key(self, run: int) -> str:
        """The run's key: a hash of its task and the code version."""
        return task_key(self.task(run), self.code)


def make_plan(study: Study) -> Plan:
    """A campaign's plan; what is wrong is found before anything is flown.

    Raises:
        PolicyError: an unknown policy or parameter.
        RunError: a metric that no outcome has, or a file that cannot be read.
    """
    campaign, base = study.campaign, study.base
    sections = base.model_dump(mode="json", exclude_none=True)
    for name in sections["perception"].keys() & {"weights", "recording"}:  # a worker may stand elsewhere
        sections["perception"][name] = str(Path(sections["perception"][name]).resolve())
    policies = [(label or base.policy.name, _policy(label, base)) for label in campaign.policies]
    _check_metrics(campaign, base)
    return Plan(
        {
            "format": FORMAT,
            "campaign": campaign.model_dump(mode="json"),
            "base": sections,
            "columns": {name: list(values) for name, values in study.columns.items()},
            "policies": [[label, section] for label, section in policies],
            "files": _files(base, [section["name"] for _, section in policies]),
            "code": code_version(),
        }
    )


def _policy(label: str, base: Scenario) -> dict[str, Any]:
    """A policy's name and parameters, checked; a file's path made absolute, for workers elsewhere."""
    if label:
        text = json.dumps(base.model_dump(mode="json", exclude_none=True))
        base = loads(text, label, policy_overrides(label, base.policy.name))
    resolve(base.policy.name, base.policy.params)
    path, colon, function = base.policy.name.rpartition(":")
    name = f"{Path(path).resolve()}:{function}" if colon else base.policy.name
    return {"name": name, "params": dict(base.policy.params)}


def _files(base: Scenario, policies: list[str]) -> dict[str, str]:
    """Digests of the files that runs read beside the code, by path."""
    paths = [Path(name.rpartition(":")[0]) for name in policies if ":" in name]
    config = base.perception
    paths += [Path(p).resolve() for p in (config.weights, config.recording) if p is not None]
    if config.recorded_fusion is not None:
        paths.append(Path(config.recorded_fusion.rpartition(":")[0]))
    if config.detector == "surrogate" and config.weights is None:
        paths.append(SHIPPED)
    if config.detector == "torch" and config.weights is None:
        paths += sorted((SHIPPED.parents[2] / "weights").glob("*.safetensors"))
    found = {}
    for path in paths:
        inside = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        for file in inside:
            try:
                found[str(file)] = file_digest(file)
            except OSError as error:
                raise RunError(f"{file}: cannot be read: {error.strerror}") from None
    return found


def _check_metrics(campaign: Campaign, base: Scenario) -> None:
    """Against the outcome of a moment's flight, which has every field that does not depend on what happens."""
    sections = base.model_dump(mode="json", exclude_none=True) | {"duration_s": 2 * base.frame_s, "events": []}
    sections["perception"] = {"detector": "none"}
    result = outcome(run_sortie(Scenario.model_validate_json(json.dumps(sections), strict=True)))
    for i, name in enumerate(campaign.metrics):
        try:
            number(result, name)
        except ValueError as error:
            raise RunError(f"metrics.{i}: {error}") from None
