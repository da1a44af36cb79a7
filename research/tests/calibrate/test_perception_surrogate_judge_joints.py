"""What a calibration is judged by: each condition under its own rules, in its own disc, over the replications.

The other detector is played by the surrogate itself under one replication, so that both sides are known beforehand.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, replace

import numpy as np
import pytest
from perception_examples import cross

from research.calibrate.collect import DetectorRuns
from research.calibrate.judge import IN_DISC, CalibrationVerdict, OrderKept, judge
from research.calibrate.plan import THRESHOLD, DetectorJob
from sortie.perception.metrics.ap import Matched, average_precision, match
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.features import Eyes
from sortie.perception.surrogate.model import SHIPPED, load
from sortie.perception.types import Boxes, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception, Scene

DISC = Disc(10.0, 30.0, 60.0)
A, B = "street: alone", "street: detections"
TOWN = SceneModel(Scene(parked_density=0.4), None, (-60.0, -60.0, 60.0, 60.0))
PARAMETERS = load(SHIPPED)
Both = dict[str, tuple[list[Matched], list[Matched]]]


def jobs_at(t_s: float) -> list[DetectorJob]:
    """Two drones under conditions that differ in one rule each."""
    out = []
    fleet = cross(10.0, 20.0, 0.3, t_s=t_s)
    for ego in fleet[:2]:
        peers = [c for c in fleet if c is not ego]
        maps = tuple(Share(c, "features", 0.02, None, 1.0) for c in peers)
        boxes = tuple(Share(c, "detections", 0.0, None, 1.0) for c in peers)
        out += [
            DetectorJob(ego, (), "masked", A, disc=DISC),
            DetectorJob(ego, maps, "masked", "maps"),
            DetectorJob(ego, maps, "zero", "zeros"),
            DetectorJob(ego, boxes, "masked", B, disc=DISC),
            DetectorJob(ego, boxes, "masked", "averaged", "average"),
        ]
    return out


def found(job: DetectorJob, draw: int, eyes: Eyes) -> tuple[Boxes, Boxes]:
    """Boxes and truth."""
    config = Perception(unsent_cells=job.unsent, join=job.join, score_threshold=THRESHOLD)
    detector = SurrogateDetector.of(TOWN, config, PARAMETERS, draw, eyes)
    return detector.detect([(job.ego, job.shares)])[0], detector.truth(job.ego.t_s, job.ego)


@pytest.fixture(scope="module")
def judged() -> Iterator[tuple[CalibrationVerdict, Both]]:
    """The verdict over two replications where the other detector is the second of them, and what both found, by hand. The
    other one has every car as well, by boxes that are too weak to count; where boxes are averaged none such are run."""
    eyes = Eyes(TOWN)
    runs, both = [], Both()
    for scene, t_s in enumerate((5.0, 9.0, 14.0)):
        jobs, answers = jobs_at(t_s), []
        for job in jobs:
            draws = [found(job, draw, eyes) for draw in (0, 1)]
            mine, truth = draws[1]
            weak = [replace(truth, score=np.full_like(truth.score, 0.09))] if job.join == "nms" else []
            answers.append(Boxes.join([mine, *weak]))
            for name, disc in ((job.condition, None), (job.condition + IN_DISC, job.disc)):
                if name.endswith(IN_DISC) and job.disc is None:
                    continue
                theirs, ours = both.setdefault(name, ([], []))
                theirs.append(match(mine, truth, disc))
                ours.extend(match(boxes, truth, disc) for boxes, _ in draws)
        runs.append(DetectorRuns("held-out", scene, jobs, answers, {}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("research.calibrate.judge.REPEATS", 2)
        patch.setattr("research.calibrate.judge.scene_model", lambda *at: TOWN)
        yield judge(PARAMETERS, runs), both


def test_every_condition_is_judged_under_its_own_rules_and_in_its_own_disc(
    judged: tuple[CalibrationVerdict, Both],
) -> None:
    verdict, both = judged
    assert {v.condition for v in verdict.levels} == set(both)
    assert {A + IN_DISC, B + IN_DISC, "maps", "zeros", "averaged"} < set(both)
    for v in verdict.levels:
        theirs, ours = both[v.condition]
        torch, surrogate = average_precision(theirs), average_precision(ours)
        assert (v.torch, v.surrogate) == pytest.approx((torch, surrogate), abs=1e-12)
        assert v.error == pytest.approx(surrogate - torch, abs=1e-12)
        assert v.low <= v.error <= v.high
        assert v.egos == 6
    assert len({round(v.surrogate, 6) for v in verdict.levels}) == len(verdict.levels), (
        "no two rules give the same boxes"
    )


def test_an_order_is_of_the_second_over_the_first_by_both(judged: tuple[CalibrationVerdict, Both]) -> None:
    verdict, both = judged
    ap = {name: [average_precision(m) for m in pair] for name, pair in both.items()}
    assert [(o.a, o.b) for o in verdict.orders] == [(A, B), (A + IN_DISC, B + IN_DISC)]
    for o in verdict.orders:
        assert o.torch == pytest.approx(ap[o.b][0] - ap[o.a][0], abs=1e-12)
        assert o.surrogate == pytest.approx(ap[o.b][1] - ap[o.a][1], abs=1e-12)
        assert o.low <= o.torch <= o.high
    facts = verdict.facts()
    assert facts["levels"] == [asdict(v) for v in verdict.levels]
    assert [(o["significant"], o["kept"]) for o in facts["orders"]] == [(o.significant, o.kept) for o in verdict.orders]


@pytest.mark.parametrize(
    ("torch", "low", "high", "surrogate", "significant", "kept"),
    [
        (0.05, 0.01, 0.09, 0.02, True, True),
        (0.05, 0.01, 0.09, -0.02, True, False),
        (0.05, 0.01, 0.09, 0.0, True, False),
        (-0.05, -0.09, -0.01, -0.001, True, True),
        (0.05, -0.01, 0.09, -0.02, False, True),
        (0.05, 0.0, 0.09, -0.02, False, True),
        (0.05, math.nan, math.nan, -0.02, False, True),
    ],
)
def test_an_order_is_lost_where_it_is_significant_and_the_surrogate_s_sign_is_another(
    torch: float, low: float, high: float, surrogate: float, significant: bool, kept: bool
) -> None:
    order = OrderKept("a", "b", torch, low, high, surrogate)
    assert (order.significant, order.kept) == (significant, kept)
