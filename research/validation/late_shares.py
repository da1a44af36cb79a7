"""What late shares are worth: AP over leaving them out, by rung and age (`make figures FIGURE=late_shares`).

Five drones over towns of the calibration's held-out split, by the surrogate. Each ego has its own look and its peers'
shares of some age, boxes without a velocity. Scoring is 95 ms after the ego's look, as in a sortie.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from research.calibrate import plan
from research.validation.fusion_age import earlier
from research.validation.stored import Column, Table
from sortie.perception.joining import Rule
from sortie.perception.metrics.ap import Matched, average_precision, match
from sortie.perception.surrogate.detector import Job, SurrogateDetector
from sortie.perception.types import Capture, Share
from sortie.scenarios.intervals import SHARE, mean_interval
from sortie.scenarios.schema import Perception

DELAY_S = 0.095
"""From a look to its fusion."""
AGES_S = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0)
RATES_HZ = (2.0, 5.0, 10.0)
RUNGS = {
    "tracks": ("tracks", 0.0),
    "detections": ("detections", 0.0),
    "features, ρ = 0.02": ("features", 0.02),
    "features, ρ = 0.25": ("features", 0.25),
    "raw": ("raw", 1.0),
}
SPEED_MPS = 5.0
Case = tuple[str, str]
"""A rung, and an age or a rate."""
SILENCE: Case = ("silence", "")


def gains(rule: Rule, towns: int) -> dict[Case, NDArray[np.float64]]:
    """AP over silence in each town, [towns], by case."""
    ap: dict[Case, list[float]] = {}
    for town in range(towns):
        scene = plan.scene_model(1, "held-out", town)
        detector = SurrogateDetector(scene, Perception(detector="surrogate", join=rule), seed=town)
        found: dict[Case, list[Matched]] = {}
        for manner in range(len(plan.MANNERS)):
            fleet = _fleet(town, manner)
            truth = list(detector.truth_many([fleet[0].t_s + DELAY_S] * len(fleet), fleet))
            names, jobs = zip(*_cases(fleet), strict=True)
            boxes = iter(detector.detect_many(jobs))
            for name in names:
                found.setdefault(name, []).extend(match(next(boxes), cars) for cars in truth)
        for name, matched in found.items():
            ap.setdefault(name, []).append(average_precision(matched))
    alone = np.array(ap.pop(SILENCE))
    return {name: np.array(values) - alone for name, values in ap.items()}


def ages_of_peers() -> dict[str, list[float]]:
    """The ages of four peers' payloads beside the ego's look: all of one age, or each anywhere within a rate's interval."""
    fixed = {f"{age_s:g} s": [age_s] * 4 for age_s in AGES_S}
    return fixed | {f"{hz:g} Hz": [round(k / (4 * hz), 3) for k in (1, 3, 0, 2)] for hz in RATES_HZ}


def table(towns: int) -> Table:
    """A row for each age and rate: what is gained over silence, with intervals over towns."""
    nms, average = gains("nms", towns), gains("average", towns)
    columns = {
        "detections": (nms, "detections"),
        "detections, averaged": (average, "detections"),
        "features, ρ = 0.25": (nms, "features, ρ = 0.25"),
        "raw": (nms, "raw"),
    }

    def cell(its: dict[Case, NDArray[np.float64]], rung: str, age: str) -> tuple[float, float, float]:
        of = mean_interval(its[rung, age], SHARE.of_differences())
        return of.mean, of.low, of.high

    return Table(
        [Column("older than the ego's look by"), *(Column(name, "+.1f", factor=100) for name in columns)],
        [[age, *(cell(its, rung, age) for its, rung in columns.values())] for age in ages_of_peers()],
        f"Points of AP over leaving the shares out; {towns} towns of two moments, five egos each; intervals over towns. "
        "At a rate, each peer's payload is anywhere within the interval.",
    )


def _fleet(town: int, manner: int) -> list[Capture]:
    """Five drones over a town."""
    jobs = plan.moment(1, "held-out", town, manner, condition_egos=5)
    return sorted((j.ego for j in jobs if j.condition.endswith("alone")), key=lambda c: c.drone)


def _cases(fleet: list[Capture]) -> Iterator[tuple[Case, list[Job]]]:
    yield SILENCE, [(ego, []) for ego in fleet]
    for age, ages_s in ages_of_peers().items():
        sent = {a: [earlier(c, a, SPEED_MPS) for c in fleet] for a in set(ages_s)}
        for rung, (kind, rho) in RUNGS.items():
            jobs: list[Job] = []
            for ego in fleet:
                peers = [c.drone for c in fleet if c is not ego]
                late = zip(peers, ages_s, strict=True)
                jobs.append((ego, [Share(sent[a][p], kind, rho, None, 1.0, (), a + DELAY_S) for p, a in late]))
            yield (rung, age), jobs
