"""What ±1 AP point between three policies costs by the torch detector, with and without the surrogate as control variate.

    python tests/validation/compare_price.py torch [K N]   # flies what compare_price.csv lacks, seeds K, K + N, … of the plan
    python tests/validation/compare_price.py surrogate     # the same for the surrogate's sorties
    make figures FIGURE=price                              # works the figures out, for docs/results/price.md

The plan, written before anything of it was flown:

- **Scenario**: `track_target` with what the campaign `link_battery` sets (20 s, tracking from 5 s on, scored at 1 Hz), and its
  links and batteries as `track_target` has them. Policies: `worked`, `adaptive` and `all-4`. Two gains over `worked`, each in
  the full scene and in the mission disc.
- **Expensive measurement**: a sortie with `perception.detector: torch`, from take-off on, traffic included.
- **Cheap measurement**: the same seed flown with the surrogate, its gain averaged over eight draws of the surrogate's boxes on
  that one flight.
- **Seeds**: 5,000,001 to 5,000,024 by both, 6,000,001 to 6,000,192 by the surrogate alone. Each has a town and draws of its
  own. A torch sortie takes 15 s of processor time, so the torch seeds are flown in order until 07:10 UTC on 2026-11-24; the
  last of them from 1 on without a gap count, however many these are.
- **Costs** are in processor seconds a seed (three sorties), medians.
- **Price**: the cost at which both gains have a 95 % interval of ±1 AP point, with the cheapest ratio of cheap to expensive
  sorties (`scenarios/control_variates.py`), relative to the cost of torch alone. Its interval is a percentile bootstrap over
  seeds with 2,000 draws.
- **Hypothesis 1**: the surrogate's gain is correlated with the torch detector's in the full scene, with both 95 % intervals
  above 0. In the mission disc, with a few cars, correlations are lower than in the full scene.
- **Hypothesis 2**: the price is below 1 in the full scene, and far above the tenth that is wished for: above 0.3 in both areas.
  The ratio of costs alone, about 15, forbids a tenth unless the correlation is above 0.99.

Before the plan, sorties of the surrogate with seeds 900 to 911 were flown, and of torch with 900 and 901, to learn what a
sortie costs and how far the gains of the surrogate's draws vary on one flight (as much as between flights, or half).
"""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import sortie
from sortie.sim.studies.compare import AREAS, Contender, compare, in_town_of

TABLE = Path(__file__).parent / "compare_price.csv"
LINK_BATTERY = {
    "duration_s": 20,
    "mission.phases": [{"at_s": 0, "phase": "search"}, {"at_s": 5, "phase": "track", "region": {"radius_m": 32}}],
    "perception.sample_rate_hz": 1,
}
POLICIES = ("worked", "adaptive", "all-4")
CONTRASTS = tuple(f"{policy} {area}" for policy in POLICIES[1:] for area in AREAS)
TORCH_SEEDS = range(5_000_001, 5_000_025)
MORE_SEEDS = range(6_000_001, 6_000_193)


def contenders(seed: int, detector: str) -> list[Contender]:
    """The policies in the town of a seed."""
    own = {"policy.params": {}}  # of worked: those of the scenario
    scenarios = (
        sortie.load("track_target", {**LINK_BATTERY, "perception.detector": detector, "policy.name": p, **own})
        if p != "worked"
        else sortie.load("track_target", {**LINK_BATTERY, "perception.detector": detector})
        for p in POLICIES
    )
    return [Contender(p, in_town_of(s, seed)) for p, s in zip(POLICIES, scenarios, strict=True)]


def fly_torch(seeds: Sequence[int]) -> None:
    """Fly seeds one by one, and add a row each."""
    for seed in seeds:
        begin_s = time.process_time()
        flown = compare(contenders(seed, "torch"), [seed]).sorties
        gains = {f"{s.policy} {area}": s.gain[area] for s in flown[1:] for area in AREAS}
        _add("torch", seed, [gains[c] for c in CONTRASTS], time.process_time() - begin_s)


def _add(by: str, seed: int, gains: Sequence[float | None], seconds: float) -> None:
    with TABLE.open("a", newline="") as file:
        cells = ["" if g is None else f"{g:.6f}" for g in gains]
        csv.writer(file, lineterminator="\n").writerow([by, seed, *cells, f"{seconds:.2f}"])


def rows() -> list[dict[str, str]]:
    """The table."""
    with TABLE.open(newline="") as file:
        return list(csv.DictReader(file))


if __name__ == "__main__":
    if not TABLE.exists():
        TABLE.write_text(",".join(["by", "seed", *CONTRASTS, "processor_s"]) + "\n")
    done = {(row["by"], int(row["seed"])) for row in rows()}
    start, step = (int(v) for v in sys.argv[2:4]) if len(sys.argv) > 3 else (0, 1)
    fly_torch([s for s in TORCH_SEEDS[start::step] if ("torch", s) not in done])
