"""Many egos joined in one call: each as if it were alone, and by its own pose, age, errors and rule."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from perception_examples import capture

from sortie.perception.intersection import intersect, inverse
from sortie.perception.joining import EgoSources, Rule, SourceBoxes, joined_many
from sortie.perception.lateness import own_age_s
from sortie.perception.types import Boxes, Share
from sortie.perception.uncertainty import BoxErrors

ROUND = BoxErrors((-0.7, -0.2, 0.01, 0.6, -0.1), (-0.6, -0.2, 0.02, 0.2, 0.05), 0.15)
LONG = BoxErrors((0.2, -0.3, 0.0, 0.3, 0.0), (-1.4, 0.1, 0.0, 0.1, 0.0), 0.9)
POSES = ((0.0, 0.0, 0.0), (300.0, -40.0, 0.7), (-25.0, 60.0, -2.4), (8.0, 3.0, 1.5), (500.0, 500.0, 3.0))


def around(pose: tuple[float, float, float], rng: np.random.Generator, count: int) -> Boxes:
    """Boxes near places that all who look about this pose have boxes of; best first."""
    at = np.array([(k % 3 * 25.0 - 20.0, k // 3 * 25.0 - 15.0) for k in range(count)]) + rng.normal(0, 0.4, (count, 2))
    rows = np.column_stack(
        [at, np.full(count, 4.5), np.full(count, 1.9), rng.normal(0, 0.1, count), rng.uniform(0.2, 0.9, count)]
    )
    found = Boxes.placed(rows, (pose[0], pose[1], 0.0))
    return found.take(np.argsort(-found.score))


def egos(exact: bool) -> list[EgoSources]:
    """Of unequally many sources and boxes; ages, weights and errors differ, one has nobody to listen to, one hears only lies."""
    rng, found = np.random.default_rng(4), []
    for k, pose in enumerate(POSES):
        errors = (ROUND, LONG)[k % 2]
        others = []
        for s in range((2, 1, 0, 3, 1)[k]):
            boxes, there = around(pose, rng, 5 + s), (pose[0] + 15.0 * s, pose[1] - 9.0, 0.3 * s)
            known = (ROUND, LONG)[s % 2].covariances_m2(boxes.xy_m, boxes.score, there) if exact else None
            others.append(
                SourceBoxes(boxes, (0.9, 0.4, 0.7)[s], there, age_s=(0.3, 0.1, 0.6)[s] + 0.1 * k, covariance_m2=known)
            )
        if k == 4:
            others = [replace(others[0], weight=0.0)]
        own = around(pose, rng, 6 - k)
        found.append(
            EgoSources(pose, own, k == 3, others, (0.5, 0.05, 0.2, 0.8, 0.1)[k], k != 1, errors if exact else None)
        )
    return found


def table(boxes: Boxes) -> np.ndarray:
    return np.column_stack([boxes.table(), boxes.score])


@pytest.mark.parametrize("rule", ["nms", "average"])
def test_of_many_egos_each_is_joined_as_alone(rule: Rule) -> None:
    """Whoever else is joined in the same call, in whatever order; those with covariances beside those without."""
    every = [*egos(exact=False), *egos(exact=True)]
    alone = [table(joined_many([ego], rule)[0]) for ego in every]
    order = np.random.default_rng(1).permutation(len(every)).tolist()
    for places in (list(range(5)), list(range(5, 10)), list(range(10)), order):
        for k, boxes in zip(places, joined_many([every[k] for k in places], rule), strict=True):
            np.testing.assert_allclose(table(boxes), alone[k], rtol=1e-6, atol=1e-6)
    plain, other = (joined_many([egos(exact=False)[0]], r)[0] for r in ("nms", "average"))
    assert not np.allclose(
        table(plain)[0], table(other)[0], atol=1e-3
    )  # the rule matters where there are no covariances


@pytest.mark.parametrize("weight", [1.0, 0.6])
def test_an_ego_far_away_and_turned_joins_by_the_errors_of_its_own_sight(weight: float) -> None:
    """Its own places are uncertain along its own line of sight, which begins where it is. Weights go with their boxes, also
    where a peer's box is the best of all."""
    pose = (300.0, -40.0, 0.7)
    first, second = (np.array(p) for p in ((330.0, 0.0), (300.0, -90.0)))
    own = Boxes.placed(np.array([[*first, 4.5, 1.9, 0.0, 0.4], [*second, 4.5, 1.9, 0.0, 0.3]]), (0.0, 0.0, 0.0))
    theirs = Boxes.placed(
        np.array([[*np.add(second, [0.5, 0.3]), 4.5, 1.9, 0.0, 0.9], [*np.add(first, [-0.4, 0.6]), 4.5, 1.9, 0.0, 0.35]]), (0.0, 0.0, 0.0)
    )  # fmt: skip
    there = (360.0, -60.0, 0.0)
    sent = ROUND.covariances_m2(theirs.xy_m, theirs.score, there)
    mine = LONG.covariances_m2(own.xy_m, own.score, pose)
    assert np.abs(mine[0, 1]) > 0.1  # the sight runs north-east
    peer = SourceBoxes(theirs, weight, there, covariance_m2=sent)
    (found,) = joined_many([EgoSources(pose, own, False, [peer], errors=LONG)], "nms")
    assert len(found) == 2
    for which, (a, b) in enumerate(((0, 1), (1, 0))):
        at = np.stack([own.xy_m[a], theirs.xy_m[b]]).astype(float)
        information = inverse(np.stack([mine[a], sent[b]]).astype(float)) * np.array([[1.0], [weight]])
        wanted = intersect(at - at[0], information, np.zeros(2, np.intp), LONG.common).xy_m[0] + at[0]
        nearest = np.hypot(*(found.xy_m - wanted).T).min()
        assert nearest < 2e-4, which


def test_the_age_of_an_ego_s_look_is_by_the_shares_of_that_ego() -> None:
    """Two egos of one moment: each look is as old as its own shares say."""
    ego, other = capture(0.0, 0.0, t_s=5.0), capture(9.0, 0.0, drone=1, t_s=5.1)
    shares = [Share(other._replace(t_s=4.9), "detections", 0.0, None, 1.0, (), 0.5)]
    assert own_age_s(ego, shares) == pytest.approx(0.4)
    assert own_age_s(other, shares) == pytest.approx(0.3)
    assert EgoSources.of(ego, shares, Boxes.empty(), False, []).age_s == pytest.approx(0.4)
