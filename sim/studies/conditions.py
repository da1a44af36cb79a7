"""Policies over a set of contexts: each flown in each, at the same budget, seeds and draws; summed up in pairs."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sortie.perception.detectors import make_detector
from sortie.perception.metrics.ap import average_precision
from sortie.policies.registry import POLICIES, parameters, resolve
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.conditions import Condition, Contexts
from sortie.sim.engine.sortie import DetectorMaker, run_sortie
from sortie.sim.folders import RunError
from sortie.sim.results.outcome import matched, outcome

FIXED = ("all-4", "best-2", "worst-2", "random-2", "fixed-compression", "silence")
"""Policies that do the same whatever the context; the best of them, and the best of them in each context, are the
paper's two yardsticks."""
DRAWS = 4000


@dataclass(frozen=True, slots=True)
class Cell:
    """One policy in one context, over all seeds."""

    policy: str
    context: str
    ap: float
    """AP@0.5 by the context's metric."""
    data_bytes: float
    """Sent a sortie, handshakes included."""
    energy_j: float
    miss_rate: float


@dataclass(frozen=True, slots=True)
class Summary:
    """One policy over all contexts."""

    policy: str
    ap: float
    gain: tuple[float, float, float]
    """Mean AP over that of the best fixed policy, with its 95 % interval: contexts resampled in pairs; NaN for a single one."""
    of_oracle: float | None
    """Mean AP over that of the best fixed policy of each context; None where those found nothing."""
    data_bytes: float
    energy_j: float
    miss_rate: float


def fly_all(
    contexts: Contexts,
    policies: Sequence[str],
    *,
    progress: Callable[[str, int], None] | None = None,
    detector_of: DetectorMaker = make_detector,
) -> list[Cell]:
    """Every policy in every context; the budget goes to every policy that takes one.

    Args:
        progress: called with the policy and how many of its contexts are flown.
        detector_of: as `run_sortie` takes it.

    Raises:
        ScenarioError, PolicyError, RunError: a context or policy that cannot be flown or scored, before anything is.
    """
    planned = [(p, c, [scenario_of(contexts, c, p)] * len(contexts.seeds)) for p in policies for c in contexts.contexts]
    for _, context, (scenario, *_) in planned:
        if scenario.perception.detector == "none":
            raise RunError(f"context {context.name}: perception.detector is none, contexts are compared by accuracy")
    cells: list[Cell] = []
    for k, (policy, context, scenarios) in enumerate(planned):
        cells.append(_fly(policy, context, scenarios, contexts.seeds, detector_of))
        if progress is not None:
            progress(policy, k % len(contexts.contexts) + 1)
    return cells


def scenario_of(contexts: Contexts, context: Condition, policy: str) -> Scenario:
    """A context's scenario under a policy, within the context's budget."""
    scenario = load(contexts.base, [*contexts.set, *context.set, f"policy.name={policy}", "policy.params={}"])
    function = resolve(policy)
    inner = function.func if isinstance(function, functools.partial) else function
    budget = {"rho": context.rho} if "rho" in parameters(inner) else {}
    return scenario.model_copy(update={"policy": scenario.policy.model_copy(update={"params": budget})})


def _fly(
    policy: str, context: Condition, scenarios: Sequence[Scenario], seeds: Sequence[int], detector_of: DetectorMaker
) -> Cell:
    frames, results = [], []
    for scenario, seed in zip(scenarios, seeds, strict=True):
        record = run_sortie(scenario, None, seed, detector_of=detector_of)
        frames += list(matched(record, mission=context.metric == "mission").values())
        results.append(outcome(record))
    ap = average_precision(frames) if frames else float("nan")
    return Cell(
        policy,
        context.name,
        float(ap),
        float(np.mean([r["bytes"]["data_sent"] for r in results])),
        float(np.mean([r["energy_j"]["total"] for r in results])),
        float(np.mean([r["deadline_miss_rate"] or 0.0 for r in results])),
    )


def summarise(cells: Sequence[Cell]) -> list[Summary]:
    """Every policy's means over the contexts, against the best fixed policy flown and each context's best fixed one.

    Accuracy is of the contexts in which every policy has one: where no car was to be seen, there is none.

    Raises:
        RunError: there is no such context.
    """
    policies = list(dict.fromkeys(c.policy for c in cells))
    contexts = list(dict.fromkeys(c.context for c in cells))
    at = {(c.policy, c.context): c for c in cells}
    ap = {p: np.array([at[p, c].ap for c in contexts]) for p in policies}
    known = np.isfinite(list(ap.values())).all(axis=0)
    if not known.any():
        raise RunError("no context has an accuracy under every policy: there was no car to be seen, or nothing scored")
    ap = {p: a[known] for p, a in ap.items()}
    best = _best_fixed({p: float(a.mean()) for p, a in ap.items()})
    oracle = float(np.max([ap[p] for p in _fixed(policies)], axis=0).mean())
    rows = []
    for p in policies:
        mine = [at[p, c] for c in contexts]
        low, high = paired_interval(ap[p] - ap[best])
        mean = float(ap[p].mean())
        rows.append(
            Summary(
                p, mean, (mean - float(ap[best].mean()), low, high), mean / oracle if oracle else None,
                float(np.mean([c.data_bytes for c in mine])), float(np.mean([c.energy_j for c in mine])),
                float(np.mean([c.miss_rate for c in mine])),
            )
        )  # fmt: skip
    return rows


def best_fixed(rows: Sequence[Summary]) -> str:
    """The fixed policy that the gains are over."""
    return _best_fixed({r.policy: r.ap for r in rows})


def _best_fixed(ap: Mapping[str, float]) -> str:
    return max(_fixed(list(ap)), key=lambda p: ap[p])


def _fixed(policies: Sequence[str]) -> list[str]:
    """Those that do the same whatever the context; the first of all where none does."""
    return [p for p in policies if p in FIXED] or list(policies[:1])


def paired_interval(differences: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the mean difference over contexts [n]; NaN of a single one, which has none."""
    if len(differences) < 2:
        return float("nan"), float("nan")
    from scipy import stats  # half a second to import, and only here

    low, high = stats.bootstrap(
        (differences,), np.mean, n_resamples=DRAWS, method="percentile", rng=np.random.default_rng(seed)
    ).confidence_interval
    return float(low), float(high)


def all_policies() -> list[str]:
    """Every registered policy."""
    return list(POLICIES)
