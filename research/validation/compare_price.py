"""What ±1 AP point between three policies costs by the torch detector, with and without the surrogate as control variate.

    python -m research.validation.compare_price torch [K N]   # flies what compare_price.csv lacks, seeds K, K + N, … of the plan
    python -m research.validation.compare_price surrogate     # the same for the surrogate's sorties
    make figures FIGURE=price                              # works the figures out, for research/pages/price.md

The plan, written before anything of it was flown:

- **Scenario**: `track_target` scored at 1 Hz as in the campaign `link_battery`, with its links and batteries as `track_target` has
  them, but 10 s long (tracking from 3 s on) in place of 20 s (from 5 s on), as processor time is scarce. Policies: `worked`,
  `adaptive` and `all-4`. Two gains over `worked`, each in the full scene and in the mission disc.
- **Expensive measurement**: a seed flown with `perception.detector: torch` under the three policies, from take-off on, traffic
  included (`half_width.fly_torch`). The policies of a seed share what the network has encoded.
- **Cheap measurement**: the same seed flown with the surrogate, its gain averaged over eight draws of the surrogate's boxes on
  one flight (`half_width.fly_surrogate`).
- **Seeds**: 5,000,001 to 5,000,032 by both, 6,000,001 to 6,000,096 by the surrogate alone. Each has a town and draws of its
  own. Torch seeds are flown in order; all seeds from the first one on without a gap count, however many these are.
- **Costs** are processor seconds a seed (three policies), medians.
- **Price**: the cost at which both gains have a 95 % interval of ±1 AP point, with the cheapest ratio of cheap to expensive
  sorties, relative to the cost of torch alone (`control_variates.plan_units`, `Plan.cost_ratio`; 1 where torch alone is as
  cheap). Its interval is a jackknife over seeds (Student's over the pseudo-values): a bootstrap draws seeds twice, and so cannot
  leave them out.
- **Hypothesis 1**: the surrogate's gain is correlated with the torch detector's in the full scene, with both 95 % intervals
  above 0. In the mission disc, with a few cars, both correlations are lower than in the full scene.
- **Hypothesis 2**: the price is above 0.3 in both areas, far above the tenth that is wished for. The ratio of the costs alone,
  about 15, forbids a tenth unless the squared correlation is above 0.99.

The plan is carried out three times. The first time receivers kept the best of overlapping boxes (`perception.join: nms`, then the
default), and only eight torch seeds and 15 further ones of the surrogate were finished. Hypothesis 1 was missed, hypothesis 2
met; the cost ratio of each gain alone was added when the results were known. The second time receivers average (the default
now): the first half of hypothesis 1 was met, the second missed, and hypothesis 2 met. The third time both detectors have the
fine network and a score threshold of 0.25, the defaults now. Seeds, costs and both hypotheses are the same each time, and each
table replaces the one before, whatever it gives. This was written before anything of that time was flown.

A first form of this plan had 20 s, and sorties that share nothing. It was changed when no seed of it had been finished: other
processes left too little of the machine. Before any plan, sorties of 20 s were flown by the surrogate with the seeds 900 to 911,
and by torch with 900 and 901, to learn what a sortie costs and how far gains vary between draws on one flight.
"""

from __future__ import annotations

import csv
import itertools
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy import stats

import sortie
from research.validation.stored import Cell, Column, Table
from sortie.scenarios.control_variates import Controlled, Plan, controlled_mean, plan_units
from sortie.scenarios.intervals import mean_interval
from sortie.sim.experiment.compare import AREAS, Contender
from sortie.sim.experiment.half_width import METRICS, Row, fly_surrogate, fly_torch

TABLE = Path(__file__).parent / "compare_price.csv"
SHORT = {
    "duration_s": 10,
    "mission.phases": [{"at_s": 0, "phase": "search"}, {"at_s": 3, "phase": "track", "region": {"radius_m": 32}}],
    "perception.sample_rate_hz": 1,
}
POINT = 0.01
"""One AP point."""
POLICIES = ("worked", "adaptive", "all-4")
CONTRASTS = tuple(f"{policy} {area}" for policy in POLICIES[1:] for area in AREAS)
TORCH_SEEDS = range(5_000_001, 5_000_033)
MORE_SEEDS = range(6_000_001, 6_000_097)
EARLY = 8
"""The correlation of so many first seeds is shown too: how far a small pilot can be off. Added when all were flown."""


def contenders(detector: str) -> list[Contender]:
    """The policies; `worked` has the parameters of the scenario."""
    flown = {**SHORT, "perception.detector": detector}
    others = {p: {**flown, "policy.name": p, "policy.params": {}} for p in POLICIES[1:]}
    return [Contender(p, sortie.load("track_target", others.get(p, flown))) for p in POLICIES]


def fly(by: str, seeds: range) -> None:
    """Fly what the table lacks of some seeds, and add a row each."""
    done = {(row["by"], int(row["seed"])) for row in rows()}
    how: Callable[..., Row] = fly_torch if by == "torch" else fly_surrogate
    for seed in seeds:
        if (by, seed) in done:
            continue
        row = how(contenders(by), seed)
        gains = [row.gains[policy][metric] for policy in POLICIES[1:] for metric in METRICS]
        cells = ["" if g is None else f"{g:.6f}" for g in gains]
        with TABLE.open("a", newline="") as file:
            csv.writer(file, lineterminator="\n").writerow([by, seed, *cells, f"{row.processor_s:.2f}"])


def rows() -> list[dict[str, str]]:
    """The table."""
    with TABLE.open(newline="") as file:
        return list(csv.DictReader(file))


Seeds = dict[int, tuple[list[float], float]]
"""By seed: the gains, contrast by contrast, and the processor seconds."""


def measured(by: str, seeds: range) -> Seeds:
    """Rows of a detector."""
    return {
        int(row["seed"]): ([float(row[c] or "nan") for c in CONTRASTS], float(row["processor_s"]))
        for row in rows()
        if row["by"] == by and int(row["seed"]) in seeds
    }


def without_gap(flown: Seeds) -> Seeds:
    """The torch seeds from the first one on, up to the first that is missing."""
    kept = itertools.takewhile(flown.__contains__, TORCH_SEEDS)
    return {seed: flown[seed] for seed in kept}


def estimates(torch: Seeds, cheap: Seeds, further: Seeds, area: str, *, control: bool = True) -> list[Controlled]:
    """Both gains in an area."""
    return [
        controlled_mean(
            [gains[k] for gains, _ in torch.values()],
            [cheap[seed][0][k] for seed in torch],
            [gains[k] for gains, _ in further.values()],
            control=control,
        )
        for k, contrast in enumerate(CONTRASTS)
        if contrast.endswith(area)
    ]


def seconds(flown: Seeds) -> float:
    """The median of a seed."""
    return float(np.median([s for _, s in flown.values()]))


def price(torch: Seeds, cheap: Seeds, further: Seeds, area: str) -> Plan:
    """What is planned for ±1 AP point."""
    return plan_units(estimates(torch, cheap, further, area), POINT, seconds(torch), seconds(further))


def jackknifed(whole: float, left_out: Sequence[float]) -> tuple[float, float, float]:
    """A figure with Student's interval over the pseudo-values of leaving each seed out."""
    n = len(left_out)
    found = mean_interval([n * whole - (n - 1) * value for value in left_out])
    return whole, whole - found.half_width, min(whole + found.half_width, 1.0)


def _ratio_of(found: Controlled, costs_s: tuple[float, float]) -> float:
    """The predicted cost ratio for one gain alone."""
    return plan_units([found], POINT, *costs_s).cost_ratio


def tables() -> dict[str, Table]:
    """`price`: what ±1 AP point costs, by area; `price_gains`: the gains that were measured on the way, both ways."""
    torch, paired = without_gap(measured("torch", TORCH_SEEDS)), measured("surrogate", TORCH_SEEDS)
    further = measured("surrogate", MORE_SEEDS)
    costs, gains = list[list[Cell]](), list[list[Cell]]()
    for area, told in (("full_scene", "full scene"), ("mission", "mission disc")):
        plan = price(torch, paired, further, area)
        ratios = [
            price({s: row for s, row in torch.items() if s != left}, paired, further, area).cost_ratio for left in torch
        ]
        alone = plan_units(estimates(torch, paired, further, area), POINT, 1.0, 1.0, control=False)
        ratio = jackknifed(plan.cost_ratio, ratios)
        costs.append([told, alone.expensive, plan.expensive, plan.cheap, ratio, seconds(torch), seconds(further)])
        both = (estimates(torch, paired, further, area, control=control) for control in (False, True))
        for policy, plain, used in zip(POLICIES[1:], *both, strict=True):
            k = CONTRASTS.index(f"{policy} {area}")
            x, y = ([of[seed][0][k] for seed in torch] for of in (paired, torch))
            found, early = stats.pearsonr(x, y), stats.pearsonr(x[:EARLY], y[:EARLY])
            low, high = found.confidence_interval()
            alone_s = seconds(torch), seconds(further)
            one = [_ratio_of(used, alone_s)]
            for left in torch:
                rest = {seed: row for seed, row in torch.items() if seed != left}
                its = estimates(rest, paired, further, area)[POLICIES.index(policy) - 1]
                one.append(_ratio_of(its, (seconds(rest), alone_s[1])))
            intervals = [(e.mean, e.low, e.high) for e in (plain.estimate, used.estimate)]
            gains.append(
                [f"{policy}, {told}", (float(found.statistic), float(low), float(high)), float(early.statistic), used.explained,
                 jackknifed(one[0], one[1:]), math.sqrt(plain.variance), *intervals]
            )  # fmt: skip
    points = {"form": "+.1f", "factor": 100}
    about = f"{len(torch)} seeds by both detectors, {len(further)} further seeds by the surrogate; 95 % intervals."
    return {
        "price": Table(
            [Column("accuracy"), Column("torch alone: seeds"), Column("with the surrogate: paired seeds"),
             Column("further seeds"), Column("cost ratio", ".2f"), Column("a seed by torch", ".1f", " s"),
             Column("by the surrogate", ".2f", " s")],
            costs, "Planned for ±1 AP point in both gains. Processor time; a seed is three sorties.",
        ),
        "price_gains": Table(
            [Column("gain over `worked`"), Column("correlation", ".2f"), Column("correlation in the first eight seeds", ".2f"), Column("predicted variance", ".0f", " %", 100),
             Column("cost ratio for this gain alone", ".2f"), Column("deviation between seeds", ".1f", factor=100), Column("by torch alone", **points),  # type: ignore[arg-type]
             Column("with the surrogate", **points)],  # type: ignore[arg-type]
            gains, about,
        ),
    }  # fmt: skip


if __name__ == "__main__":
    if not TABLE.exists():
        TABLE.write_text(",".join(["by", "seed", *CONTRASTS, "processor_s"]) + "\n")
    if sys.argv[1] == "torch":
        start, step = (int(v) for v in sys.argv[2:4]) if len(sys.argv) > 3 else (0, 1)
        fly("torch", TORCH_SEEDS[start::step])
    else:
        fly("surrogate", TORCH_SEEDS)
        fly("surrogate", MORE_SEEDS)
