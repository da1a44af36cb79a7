"""Fusing what arrived is never worse than leaving it out: every rung, age and rate, on towns that fitted nothing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import get_args

import numpy as np
import pytest
from fusion_age import earlier
from scipy.stats import ttest_1samp

from sortie.perception.joining import Rule
from sortie.perception.metrics.ap import Matched, average_precision, match
from sortie.perception.surrogate import plan
from sortie.perception.surrogate.detector import Job, SurrogateDetector
from sortie.perception.types import Capture, Share
from sortie.scenarios.schema import Perception

TOWNS = 20
DELAY_S = 0.095
"""From a look to its fusion, as in a sortie."""
AGES_S = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0)
RATES_HZ = (2.0, 5.0, 10.0)
RUNGS = {
    "tracks": ("tracks", 0.0),
    "detections": ("detections", 0.0),
    "features, ρ = 0.02": ("features", 0.02),
    "features, ρ = 0.25": ("features", 0.25),
    "raw": ("raw", 1.0),
}
LEVEL = 0.01
"""Of each one-sided test."""
SPEED_MPS = 5.0
Case = tuple[str, str]
"""A rung, and an age or a rate."""


def ages_of_peers() -> dict[str, list[float]]:
    """The ages of four peers' payloads beside the ego's look: all of one age, or each anywhere within a rate's interval."""
    fixed = {f"{age_s:g} s": [age_s] * 4 for age_s in AGES_S}
    return fixed | {f"{hz:g} Hz": [round(k / (4 * hz), 3) for k in (1, 3, 0, 2)] for hz in RATES_HZ}


def moment(town: int, manner: int) -> list[Capture]:
    """Five drones over a town of the held-out split."""
    jobs = plan.moment(1, "held-out", town, manner, condition_egos=5)
    return sorted((j.ego for j in jobs if j.condition.endswith("alone")), key=lambda c: c.drone)


def cases(fleet: list[Capture]) -> Iterator[tuple[Case, list[Job]]]:
    yield ("silence", ""), [(ego, []) for ego in fleet]
    for age, ages_s in ages_of_peers().items():
        sent = {a: [earlier(c, a, SPEED_MPS) for c in fleet] for a in set(ages_s)}
        for rung, (kind, rho) in RUNGS.items():
            jobs = []
            for ego in fleet:
                peers = [c.drone for c in fleet if c is not ego]
                late = zip(peers, ages_s, strict=True)
                jobs.append((ego, [Share(sent[a][p], kind, rho, None, 1.0, (), a + DELAY_S) for p, a in late]))
            yield (rung, age), jobs


@pytest.fixture(scope="module", params=get_args(Rule))
def gains(request: pytest.FixtureRequest) -> dict[Case, np.ndarray]:
    """AP over silence, [towns], by case."""
    ap: dict[Case, list[float]] = {}
    for town in range(TOWNS):
        detector = SurrogateDetector(
            plan.scene_model(1, "held-out", town), Perception(detector="surrogate", join=request.param), seed=town
        )
        found: dict[Case, list[Matched]] = {}
        for manner in range(len(plan.MANNERS)):
            fleet = moment(town, manner)
            truth = list(detector.truth_many([fleet[0].t_s + DELAY_S] * len(fleet), fleet))
            names, jobs = zip(*cases(fleet), strict=True)
            boxes = iter(detector.detect_many(jobs))
            for name in names:
                found.setdefault(name, []).extend(match(next(boxes), cars) for cars in truth)
        for name, matched in found.items():
            ap.setdefault(name, []).append(average_precision(matched))
    alone = np.array(ap.pop(("silence", "")))
    return {name: np.array(values) - alone for name, values in ap.items()}


@pytest.mark.parametrize("rung", RUNGS)
def test_fusing_what_arrived_is_never_worse_than_leaving_it_out(gains: dict[Case, np.ndarray], rung: str) -> None:
    worse = {
        age: (float(gain.mean()), p)
        for (name, age), gain in gains.items()
        if name == rung and (p := float(ttest_1samp(gain, 0.0, alternative="less").pvalue)) < LEVEL
    }
    assert not worse


def test_what_is_fresh_is_worth_most(gains: dict[Case, np.ndarray]) -> None:
    for rung in RUNGS:
        assert gains[rung, "0 s"].mean() > gains[rung, "0.3 s"].mean() + 0.02
        assert gains[rung, "10 Hz"].mean() > gains[rung, "2 Hz"].mean()
