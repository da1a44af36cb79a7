"""What the surrogate makes of an exchange: cells, shifts, covariates of fusion and of false alarms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from perception_examples import EMPTY, capture, cross
from wrong_rows import wrong_rows

from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.exchange import (
    ALARM_COVARIATES,
    FUSED_COVARIATES,
    FeatureShares,
    alarm_covariates,
    covariates,
    pair,
)
from sortie.perception.surrogate.features import CaptureColumns, Eyes
from sortie.perception.types import Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception, Scene, Target

BOUNDS = (-50.0, -50.0, 50.0, 50.0)


def exchanged(
    jobs: Sequence[tuple[Capture, Sequence[Share]]], captures: Sequence[Capture], *more: Any
) -> FeatureShares:
    return FeatureShares.of(jobs, {c: i for i, c in enumerate(captures)}, *more)


def paired(scene: SceneModel, ego: Capture, peer: Capture) -> np.ndarray:
    """How far off the first car is in the whole map of a peer."""
    fleet, jobs = CaptureColumns.of([ego, peer]), [(ego, [Share(peer, "features", 1.0, None, 1.0)])]
    return pair(exchanged(jobs, [ego, peer]), Eyes(scene).look(fleet), fleet).shift_m[0, 0]


def test_a_larger_budget_sends_more_cells_and_a_disc_those_of_its_area_in_the_map() -> None:
    ego, peer = cross(0.0, 0.0, 0.0)[:2]

    def shares(rho: float, roi: tuple[float, float, float] | None = None) -> FeatureShares:
        return exchanged([(ego, [Share(peer, "features", rho, roi, 1.0)])], [ego, peer])

    assert [shares(rho).cells[0, 0] for rho in (0.01, 0.1, 1.0)] == [40, 409, 4096]
    assert shares(1.0, (20.0, 0.0, 32.0)).allowed[0, 0] == pytest.approx(np.pi * 10**2)
    assert shares(1.0, (20.0 + 102.4, 0.0, 32.0)).allowed[0, 0] == pytest.approx(np.pi * 10**2 / 2, rel=0.05)


def test_an_old_share_of_a_moving_car_lies_behind_it_and_heading_errors_shift_it_by_its_range() -> None:
    drives = SceneModel(EMPTY, Target(waypoints_m=((-40.0, 0.0), (40.0, 0.0)), speed_mps=8.0), BOUNDS)
    behind = paired(drives, capture(0.0, 0.0, t_s=5.0), capture(5.0, 5.0, drone=1, t_s=4.6))
    np.testing.assert_allclose(behind, (-8.0 * 0.4, 0.0), atol=1e-4)
    stands = SceneModel(EMPTY, Target(waypoints_m=((60.0, 0.0),)), BOUNDS)
    turned = paired(stands, capture(0.0, 0.0), capture(0.0, 0.0, drone=1, est=(0.0, 0.0, 60.0, 0.01)))
    np.testing.assert_allclose(turned, (60 * (np.cos(0.01) - 1), 60 * np.sin(0.01)), atol=1e-4)


def test_a_region_is_a_place_in_the_world_whoever_is_turned_how() -> None:
    """Which of the cars that both have are aimed at: those in the disc."""

    def check(mine: float, theirs: float) -> None:
        disc = Disc(25.0, -10.0, 30.0)
        ego, peer = capture(10.0, 20.0, yaw=mine), capture(30.0, 5.0, yaw=theirs, drone=1)
        scene = SceneModel(Scene(moving_cars_per_km=30), Target(waypoints_m=((0, 0), (100, 0))), BOUNDS)
        fleet, eyes = CaptureColumns.of([ego, peer]), Eyes(scene)
        looks = eyes.look(fleet)
        jobs = [(ego, [Share(peer, "features", 1.0, disc, 1.0)])]
        exchange = FeatureShares.of(jobs, {ego: 0, peer: 1})
        pairs = pair(exchange, looks, fleet)
        both = pairs.peer[:, 0] >= 0
        inside = np.hypot(*(looks.world_m[pairs.look] - disc[:2]).T) <= disc.radius_m
        assert 3 < np.count_nonzero(inside & both) < np.count_nonzero(both)
        np.testing.assert_array_equal(pairs.aimed[both, 0], inside[both])
        assert np.abs(pairs.shift_m[both]).max() < 0.2  # both know where they are
        # laid elsewhere, as without motion compensation: the map is shifted, and holds the cells that its sender chose
        laid = FeatureShares.of(jobs, {ego: 0, peer: 1}, [[(30.0 + 6.0, 5.0 - 8.0, theirs + 0.2)]])
        elsewhere = pair(laid, looks, fleet)
        np.testing.assert_array_equal(elsewhere.aimed, pairs.aimed)
        assert np.hypot(*elsewhere.shift_m[both, 0].T).mean() > 3.0
        assert laid.allowed == pytest.approx(exchange.allowed)

    assert wrong_rows([(0.0, 0.0), (0.3, -1.1), (2.5, 0.8)], check) == {}


def test_cells_that_went_missing_are_counted_among_those_that_were_allowed() -> None:
    """A rank is a share of the allowed cells, however few of them were sent."""
    one = np.ones((1, 1))
    shares = FeatureShares(
        np.array([0]),
        np.array([[0]]),
        100 * one,
        4096 * one,
        np.full((1, 1, 3), np.inf),
        one,
        np.zeros((1, 1, 3)),
        {(0, 0): np.array([40])},
    )
    sent = np.array([[True], [True], [True]])
    shares.drop_missing(sent, np.array([[40.5], [41.5], [1.5]], np.float32) / 4096, np.zeros(3, np.intp))
    assert sent.ravel().tolist() == [False, True, True]


def test_what_false_alarms_hang_on_is_what_was_asked_for_and_how_far_cars_have_driven_since() -> None:
    """An ego with a whole map of now, a half one of 0.2 s and a disc of 0.4 s; and one with nothing. One car drives."""
    scene = SceneModel(EMPTY, Target(waypoints_m=((-40.0, 0.0), (40.0, 0.0)), speed_mps=8.0), BOUNDS)
    ego = capture(0.0, 0.0, t_s=5.0)
    peers = [capture(5.0, 5.0 * k, drone=k + 1, t_s=5.0 - 0.2 * k) for k in range(3)]
    given: list[tuple[float, tuple[float, float, float] | None]] = [(1.0, None), (0.5, None), (1.0, (0.0, 0.0, 32.0))]
    jobs = [(ego, [Share(p, "features", *g, 1.0) for p, g in zip(peers, given, strict=True)]), (peers[0], [])]
    captures = [ego, *peers]
    fleet = CaptureColumns.of(captures)
    exchange = exchanged(jobs, captures)
    x = alarm_covariates(exchange, Eyes(scene).look(fleet), fleet, np.zeros(2, bool), scene.config)
    by_name = dict(zip(ALARM_COVARIATES, x.T.tolist(), strict=True))
    disc = np.pi * 10**2 / 4096
    assert by_name["sharing"] == [0.75, 0.0]
    assert by_name["aimed"] == pytest.approx([(1 + 1 + disc) / 3, 1.0])
    assert by_name["received"] == pytest.approx([(1 + 0.5 + disc) / 4, 0.0], abs=1e-4)
    assert by_name["moving"] == pytest.approx([0.1, 0.1])
    assert by_name["late"] == pytest.approx([1.0, 0.0])
    assert by_name["gone"] == pytest.approx([0.1, 0.0])


@pytest.mark.parametrize(
    ("weights", "many"), [((0.5, 1.0, 0.5, 0.5), 3.0), ((1.0, 1.0, 0.0, 1.0), 2.0), ((1.0, 1.0, 0.5, 0.0), 1.8)]
)
def test_senders_are_counted_by_head_and_by_weight(weights: tuple[float, ...], many: float) -> None:
    """Four, of which one's cell did not come; unequal weights count as fewer, one of nothing not at all."""
    scene = SceneModel(EMPTY, Target(waypoints_m=((10.0, 0.0),)), BOUNDS)
    captures = [capture(0.0, 0.0), *(capture(5.0, 5.0 * k, drone=k + 1) for k in range(4))]
    fleet = CaptureColumns.of(captures)
    shares = [Share(p, "features", 1.0, None, w) for p, w in zip(captures[1:], weights, strict=True) if w > 0]
    exchange = exchanged([(captures[0], shares)], captures)
    looks = Eyes(scene).look(fleet)
    pairs = pair(exchange, looks, fleet)
    sent = np.array([[k != 1 for k, w in enumerate(weights) if w > 0]])
    sure = np.zeros(len(looks.car), np.float32)
    x = covariates(pairs, exchange, looks, sure, sent, np.full(sent.shape, 0.1, np.float32), np.zeros(1, bool))
    by_name = dict(zip(FUSED_COVARIATES, x[0].tolist(), strict=True))
    assert by_name["many"] == pytest.approx(many)
    assert by_name["senders"] == pytest.approx(sum(weights) - weights[1])


def test_maps_older_than_any_that_was_fitted_give_the_false_alarms_of_the_oldest_that_was() -> None:
    scene = SceneModel(Scene(), None, BOUNDS)
    detector = SurrogateDetector(scene, Perception(), seed=3)

    def expected(age_s: float) -> np.ndarray:
        ego = capture(10.0, 20.0, t_s=70.0)
        peers = [capture(10.0, 5.0 * k, drone=k + 1, t_s=70.0 - age_s) for k in range(4)]
        fleet = CaptureColumns.of([ego, *peers])
        exchange = exchanged([(ego, [Share(p, "features", 0.25, None, 1.0) for p in peers])], [ego, *peers])
        x = alarm_covariates(exchange, Eyes(scene).look(fleet), fleet, np.zeros(1, bool), scene.config)
        return detector.parameters.alarm_rates(x)

    for age_s in (0.5, 2.0, 60.0):
        np.testing.assert_allclose(expected(age_s), expected(0.4), rtol=1e-3)
    assert expected(0.4).sum() < 100
