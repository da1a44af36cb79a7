"""What lateness leaves of boxes and maps: the model's closed forms, and what an ego makes of its shares' ages."""

import numpy as np
import pytest
from perception_examples import cross
from scipy.stats import rayleigh

from sortie.perception.lateness import (
    MOVING,
    SIGMA0_M,
    SPEED_MPS,
    map_weight,
    moving_m2,
    own_age_s,
    reach_m,
    stands,
    still_right,
    still_right_of,
    variance_m2,
    weighed,
)
from sortie.perception.types import Share

AGES_S = np.array([0.0, 0.1, 0.3, 1.0, 60.0])
REACH_M = 0.95


def test_a_late_place_has_the_variance_of_the_declared_model() -> None:
    """Drawn cars, of which a share moves, are off by what the closed form says."""
    rng = np.random.default_rng(1)
    for age_s in (0.0, 0.2, 1.0):
        moves = rng.random(400_000) < MOVING
        sigma = np.where(moves, np.hypot(SIGMA0_M, SPEED_MPS * age_s), SIGMA0_M)
        off = sigma * rng.normal(size=400_000)
        assert off.var() == pytest.approx(float(variance_m2(age_s)), rel=0.02)


def test_the_chance_to_be_right_is_that_of_a_rayleigh_distance() -> None:
    fresh = rayleigh.cdf(REACH_M, scale=SIGMA0_M)
    late = rayleigh.cdf(REACH_M, scale=np.sqrt(moving_m2(AGES_S)))
    np.testing.assert_allclose(still_right(REACH_M, AGES_S), 1 - MOVING + MOVING * late / fresh, rtol=1e-12)
    assert still_right(REACH_M, 0.0) == 1.0
    assert (np.diff(still_right(REACH_M, AGES_S)) < 0).all()
    assert still_right(REACH_M, 60.0) == pytest.approx(1 - MOVING, abs=1e-3)  # cars that stand stay
    np.testing.assert_allclose(still_right_of(REACH_M, [SIGMA0_M**2, 1e-6, 1e9]), [1.0, 1.0, 0.0], atol=1e-6)
    assert reach_m(np.array([[4.5, 1.9]])) == pytest.approx(np.sqrt(1.5 * 1.9 / 3))


def test_a_map_counts_by_the_inverse_of_its_variance() -> None:
    assert map_weight(0.095, 0.095) == 1.0
    assert map_weight(0.095, 0.4) == 1.0  # an older look of one's own does not make a map count more than in full
    weights = [map_weight(age_s, 0.095) for age_s in (0.195, 0.295, 0.5, 2.0)]
    assert weights == sorted(weights, reverse=True)
    assert weights[0] == pytest.approx(float(variance_m2(0.095) / variance_m2(0.195)))
    assert weights[-1] < 0.01


def test_a_box_near_a_later_one_tells_that_its_car_stands() -> None:
    near, far = stands(np.array([0.2, 4.0]), np.array([0.5, 0.5]))
    assert near > 0.9
    assert far < 0.01
    assert stands(np.array([0.2]), np.array([0.0])) == pytest.approx(1 - MOVING)  # at one time nothing tells
    assert np.isfinite(stands(np.array([0.0, 1e3]), np.array([60.0, 60.0]))).all()


def test_the_chance_that_a_car_stands_is_that_of_bayes() -> None:
    """From the densities of the distance between two of its boxes, each off by σ0 along each axis."""
    off_m, apart_s = np.array([0.0, 0.3, 0.8, 1.5, 2.5]), np.array([0.1, 0.1, 0.3, 0.3, 1.0])
    still = (1 - MOVING) * rayleigh.pdf(off_m + 1e-9, scale=np.sqrt(2) * SIGMA0_M)
    moves = MOVING * rayleigh.pdf(off_m + 1e-9, scale=np.sqrt(2 * SIGMA0_M**2 + (SPEED_MPS * apart_s) ** 2))
    np.testing.assert_allclose(stands(off_m, apart_s), still / (still + moves), rtol=1e-6)


def test_only_late_maps_lose_weight_and_beside_the_freshest_look() -> None:
    now, old = cross(10.0, 20.0, 0.3, 10.0), cross(9.0, 20.0, 0.3, 9.7)
    late = Share(old[1], "features", 0.25, None, 0.8, (), 0.395)
    fresh, boxes = Share(now[2], "raw", 1.0, None, 0.5, (), 0.095), Share(old[3], "tracks", 0, None, 0.7, (), 0.395)
    got = weighed(now[0], [late, fresh, boxes])
    assert own_age_s(now[0], [late, fresh, boxes]) == pytest.approx(0.095)
    assert [s.weight for s in got] == [pytest.approx(0.8 * map_weight(0.395, 0.095)), 0.5, 0.7]
    resting = old[0]._replace(t_s=9.5)  # its own look is the oldest
    assert [s.weight for s in weighed(resting, [late, fresh])] == [0.8, 0.5]
    blind = now[0]._replace(looked=False)
    assert [s.weight for s in weighed(blind, [late])] == [0.8]
