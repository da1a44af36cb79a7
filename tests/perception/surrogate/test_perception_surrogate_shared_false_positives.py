"""False alarms that stand in the world: how many, for whom, and found again in what a fleet saw."""

import numpy as np
import pytest
from perception_examples import capture

from sortie.perception.surrogate.features import CaptureColumns
from sortie.perception.surrogate.shared_false_positives import TILE_M, SharedFalsePositives

pytestmark = pytest.mark.slow


def fleet(*at: tuple[float, float]) -> CaptureColumns:
    return CaptureColumns.of([capture(x, y, yaw=0.3, drone=k) for k, (x, y) in enumerate(at)])


def test_as_many_things_lie_in_a_square_as_are_expected_there() -> None:
    counts = []
    for town in range(60):
        things = SharedFalsePositives(town).about(fleet((0, 0)), 30.0)
        assert (things.rarity < 30.0).all()
        counts.append([int((things.there[0] & (things.rarity < most)).sum()) for most in (10.0, 30.0)])
    mean, variance = np.mean(counts, axis=0), np.var(counts, axis=0)
    np.testing.assert_allclose(mean, [10, 30], rtol=0.15)
    np.testing.assert_allclose(variance, [10, 30], rtol=0.5)  # Poisson: as thrown


def test_things_are_spread_over_their_tiles_by_two_draws_and_turned_by_a_third() -> None:
    """Each even in 0 … 1, and none tells of another."""
    several = [SharedFalsePositives(town).about(fleet((0, 0)), 40.0) for town in range(20)]
    xy = np.concatenate([things.xy_m for things in several]) / TILE_M % 1.0
    draws = np.column_stack([xy, np.concatenate([things.yaw_rad for things in several]) / (2 * np.pi)]).T
    np.testing.assert_allclose(draws.mean(axis=1), 0.5, atol=0.03)
    np.testing.assert_allclose(np.corrcoef(draws), np.eye(3), atol=0.1)


def test_things_stand_where_they_stand_whichever_drones_look() -> None:
    town = SharedFalsePositives(7)
    alone, both = town.about(fleet((300, -200)), 20.0), town.about(fleet((-500, 0), (300, -200)), 20.0)
    seen = both.there[1]
    here = np.lexsort(alone.xy_m[alone.there[0]].T)
    there = np.lexsort(both.xy_m[seen].T)
    np.testing.assert_array_equal(alone.xy_m[alone.there[0]][here], both.xy_m[seen][there])
    np.testing.assert_array_equal(alone.key[alone.there[0]][here], both.key[seen][there])
    assert not np.array_equal(SharedFalsePositives(8).about(fleet((300, -200)), 20.0).xy_m, alone.xy_m)
