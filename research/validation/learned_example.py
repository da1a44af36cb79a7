"""The policy that docs/guide/learn.md trains: trained, frozen, and flown against fixed policies in conditions that it never saw.

`make figures FIGURE=learned_example` measures. `learned_example.toml` is the plan: conditions, seeds and hypotheses were
written before any policy flew in them.
"""

from __future__ import annotations

import importlib
import re
import runpy
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from research.validation.stored import ROOT, Cell, Column, Table
from sortie.scenarios.intervals import Estimate, mean_interval
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.env import COST_PER_KJ, COST_PER_MB
from sortie.sim.experiment.conditions import scenario_of
from sortie.sim.experiment.places import Flights
from sortie.sim.experiment.rank import SUITE, Entry, Ranked, load_suite, rank

PAGE = ROOT / "docs/guide/learn.md"
PLAN = Path(__file__).with_name("learned_example.toml")
KEPT = ROOT / "docs/guide/learned_example.py"
"""The policy file that the page's program wrote."""
LEARNED, OVER = f"{KEPT}:learned", "worked"


def plan() -> dict[str, Any]:
    """What was written beforehand."""
    return tomllib.loads(PLAN.read_text("utf-8"))


def program(folder: Path) -> ModuleType:
    """The page's `train.py`, imported from this folder, where it and `sharing.py` are written."""
    for name, text in re.findall(r"^```python\n# file: (\w+\.py)\n(.*?)^```$", PAGE.read_text("utf-8"), re.M | re.S):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, "utf-8")
    forget()
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module("train")
    finally:
        sys.path.remove(str(folder))


def forget() -> None:
    """Let the page's modules be imported anew."""
    for name in ("sharing", "train"):
        sys.modules.pop(name, None)
    importlib.invalidate_caches()


def kept_weights() -> list[list[float]]:
    """Those of the policy file that is kept."""
    weights: list[list[float]] = runpy.run_path(str(KEPT))["WEIGHTS"]
    return weights


def measure(work: Path, workers: int = 2) -> Mapping[str, Table]:
    """Train, write the policy file, fly it, and compare.

    Args:
        work: folder of the program, the conditions and the flights.
        workers: number of processes.
    """
    planned, train = plan(), program(work)
    weights, _ = train.train(planned["generations"], planned["candidates"], planned["train_seeds"])
    train.freeze(weights, KEPT)
    return tables(work, workers)


def tables(work: Path, workers: int = 2) -> Mapping[str, Table]:
    """Fly the kept policy file and compare."""
    planned, file = plan(), work / "held_out.yaml"
    program(work).write_conditions(file, planned["held_out_seeds"], planned["duration_s"])
    against = planned["policies"]

    def ranked(suite: str, others: list[str], *, again: bool) -> Ranked:
        return rank(
            [Entry(LEARNED)], work / "flights.sqlite", suite=suite, against=others, again=again, workers=workers
        )

    held_out = ranked(str(file), against, again=True)
    others = [p for p in against if "(" not in p]
    troubled = ranked(SUITE, others, again=False)  # of the others the stored results
    if troubled.stale:
        troubled = ranked(SUITE, others, again=True)
    conditions = load_suite(str(file))
    about = (
        f"{held_out.conditions} held-out conditions of {planned['duration_s']} s; intervals of 95 % over conditions, and of "
        "differences corrected for the number of pairs. Means of a sortie."
    )
    return {
        "learned_example": compared(held_out, conditions, about),
        "learned_example_ranking": compared(
            troubled, load_suite(SUITE), f"The {troubled.conditions} conditions of `{SUITE}`, in the same form."
        ),
        "learned_example_hypotheses": hypotheses(planned["hypotheses"], held_out, troubled),
    }


def compared(ranked: Ranked, conditions: ConditionSet, about: str) -> Table:
    """A row for each policy, the highest AP first."""
    columns = [
        Column("policy"), Column("AP", ".3f"), Column(f"over {OVER}", "+.1f", factor=100), Column("mission AP", ".3f"),
        Column("full-scene AP", ".3f"), Column("AP less costs", ".3f"), Column("data", ".2f", " MB", 1e-6),
        Column("energy", ".2f", " kJ", 1e-3), Column("missed", ".1f", " %", 100),
    ]  # fmt: skip
    gains = ranked.against(OVER)
    less = less_costs(ranked.flights, conditions)
    rows: list[list[Cell]] = []
    for r in ranked.rows:
        gain = None if r.policy == OVER else gains[r.policy].difference
        f = r.figures
        rows.append(
            [
                "the learned policy" if r.policy == LEARNED else f"`{r.policy}`", _cell(r.score),
                None if gain is None else (-gain.mean, -gain.high, -gain.low),
                f["ap50.mission"].mean, f["ap50.full_scene"].mean, _cell(less[r.policy]), _cell(f["bytes.data_sent"]),
                r.energy_j, None if f["deadline_miss_rate"].count == 0 else f["deadline_miss_rate"].mean,
            ]
        )  # fmt: skip
    return Table(columns, rows, about)


def less_costs(flights: Flights, conditions: ConditionSet) -> dict[str, Estimate]:
    """By policy, over conditions: the AP of a whole sortie, less the reward's costs of a drone and second."""
    found = {}
    for policy, of_policy in flights.items():
        values = []
        for c in conditions.conditions:
            scenario, v = scenario_of(conditions, c, "silence"), of_policy[c.name].values
            cost = COST_PER_MB * _number(v["bytes.data_sent"]) / 1e6 + COST_PER_KJ * _number(v["energy_j.total"]) / 1e3
            values.append(_number(v[f"ap50.{c.metric}"]) - cost / (scenario.fleet.drones * scenario.duration_s))
        found[policy] = mean_interval(np.array(values))
    return found


def hypotheses(texts: list[str], held_out: Ranked, troubled: Ranked) -> Table:
    """Each hypothesis of the plan with its difference, and whether the whole interval is on its side."""

    def points(ranked: Ranked, other: str) -> tuple[float, float, float]:
        d = ranked.against(LEARNED)[other].difference
        return 100 * d.mean, 100 * d.low, 100 * d.high

    sent = {p: _values(held_out.flights, p, "bytes.data_sent") for p in (LEARNED, OVER)}
    saved = mean_interval((sent[OVER] / 10 - sent[LEARNED]) / 1e6)
    differences = [
        (points(held_out, OVER), "points of AP"),
        ((saved.mean, saved.low, saved.high), "MB below a tenth"),
        (points(held_out, "boxes"), "points of AP"),
        (points(held_out, "uncertain-boxes"), "points of AP"),
        (points(troubled, OVER), "points of AP"),
    ]
    rows: list[list[Cell]] = [
        [text, found, unit, verdict(found)] for text, (found, unit) in zip(texts, differences, strict=True)
    ]
    return Table([Column("hypothesis"), Column("difference", "+.1f"), Column("in"), Column("verdict")], rows)


def verdict(found: tuple[float, float, float]) -> str:
    """What the ends of an interval decide; a difference above zero is what the hypothesis says.

    Example:
        >>> verdict((1.0, 0.5, 1.5)), verdict((1.0, -0.5, 2.5)), verdict((-1.0, -1.5, -0.5))
        ('holds', 'not decided', 'is refuted')
    """
    _, low, high = found
    return "holds" if low > 0 else "is refuted" if high <= 0 else "not decided"


def _values(flights: Flights, policy: str, name: str) -> NDArray[np.float64]:
    return np.array([_number(f.values[name]) for f in flights[policy].values()])


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def _cell(estimate: Estimate) -> Cell:
    return None if estimate.count == 0 else (estimate.mean, estimate.low, estimate.high)
