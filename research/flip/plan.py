"""The study's plan: reads and checks `variants.toml`. Free of torch."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

from research.benchmark.difficulty import Density
from research.paper.ways import CellsBy, Sharing
from research.train.recipe import Recipe
from sortie.perception.errors import InputError
from sortie.perception.evaluation.sharing import Unsent
from sortie.scenarios.regular import regular

PLAN = Path(__file__).parent / "variants.toml"
Tau = float | str
"""A score threshold, or "model" (the network's own) or "f1" (chosen on the tau split)."""


@dataclass(frozen=True, slots=True)
class Variant:
    """One way to train the network."""

    name: str
    reason: str
    seeds: tuple[int, ...]
    begins_from: str = ""
    """Name of the variant whose weights of the same seed it goes on from; empty for none."""
    recipe: dict[str, Any] = field(default_factory=dict)
    model: dict[str, Any] = field(default_factory=dict)

    def job(self, seed: int) -> str:
        """The name of one trained network."""
        return f"{self.name}-{seed}"

    def begins(self, seed: int) -> str:
        """The job whose weights this one begins from; empty for none."""
        return f"{self.begins_from}-{seed}" if self.begins_from else ""

    def recipe_for(self, seed: int) -> Recipe:
        """The run's parameters."""
        begins = self.begins(seed)
        return Recipe(seed=seed, warm_start=f"{begins}.safetensors" if begins else "", **self.recipe)


@dataclass(frozen=True, slots=True)
class MeasuredGrid:
    """What is measured of every trained network."""

    budgets: tuple[float, ...]
    starved: float
    policies: tuple[str, ...]
    unsent: tuple[Unsent, ...]
    cells_by: tuple[CellsBy, ...]
    taus: tuple[Tau, ...]
    densities: tuple[Density, ...]

    def conditions(self) -> Iterator[Sharing]:
        """Every policy at every budget, one fusion and one ranking; others follow by `measures.under`."""
        for budget in (self.starved, *self.budgets):
            for peers in self.policies:
                yield Sharing(budget, peers)


@dataclass(frozen=True, slots=True)
class StudyPlan:
    """The whole study."""

    paper: str
    hypothesis: str
    measured: MeasuredGrid
    variants: tuple[Variant, ...]

    def jobs(self) -> list[tuple[Variant, int]]:
        """Every network, in an order in which what others begin from comes first: first seeds, then further ones."""
        seeds = sorted({s for v in self.variants for s in v.seeds})
        return [(v, s) for s in seeds for v in self.variants if s in v.seeds]


def read_plan(path: Path = PLAN) -> StudyPlan:
    """The plan in a TOML file.

    Raises:
        InputError: naming the file, the place and what must be there.
    """
    try:
        raw = tomllib.loads(regular(path).read_text("utf-8"))
        given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in raw["evaluation"].items()}
        measured = MeasuredGrid(**given)
        variants = tuple(_variant(v) for v in raw["variant"])
        plan = StudyPlan(raw["question"]["paper"].strip(), raw["question"]["hypothesis"].strip(), measured, variants)
    except (tomllib.TOMLDecodeError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a plan of a study ({error})") from None
    for name, values, allowed in (
        ("unsent", measured.unsent, get_args(Unsent)),
        ("cells_by", measured.cells_by, get_args(CellsBy)),
        ("densities", measured.densities, get_args(Density)),
    ):
        for value in values:
            if value not in allowed:
                raise InputError(f"{path}: evaluation.{name} has {value!r}, must be {' or '.join(allowed)}")
    for tau in measured.taus:
        if tau not in ("model", "f1") and not (isinstance(tau, float) and 0 < tau < 1):
            raise InputError(f"{path}: evaluation.taus has {tau!r}, must be model, f1 or above 0 and below 1")
    list(measured.conditions())  # raises with its own message
    known: dict[str, Variant] = {}
    for v in variants:
        if v.name in known:
            raise InputError(f"{path}: variant {v.name} is named twice")
        if v.begins_from and v.begins_from not in known:
            raise InputError(f"{path}: variant {v.name} is from {v.begins_from!r}, must be a variant before it")
        if v.begins_from and not set(v.seeds) <= set(known[v.begins_from].seeds):
            raise InputError(f"{path}: variant {v.name} has seeds that {v.begins_from} has not")
        for seed in v.seeds:
            v.recipe_for(seed)
        known[v.name] = v
    return plan


def _variant(raw: dict[str, Any]) -> Variant:
    return Variant(
        raw["name"], raw["why"], tuple(raw["seeds"]), raw.get("from", ""), raw.get("recipe", {}), raw.get("model", {})
    )
