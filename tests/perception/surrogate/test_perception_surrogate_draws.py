"""The surrogate's draws: of which car, drone, moment, seed and replication each is, and of whom not."""

from __future__ import annotations

import dataclasses
from functools import cache
from itertools import product

import numpy as np
import pytest
from perception_examples import capture, cross
from scipy.special import ndtr

from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.draws import Drawn, DrawSource
from sortie.perception.surrogate.features import CaptureColumns, Eyes
from sortie.perception.surrogate.hashing import uniform
from sortie.perception.surrogate.shared_false_positives import TILE_M, SharedFalsePositives
from sortie.scenarios.schema import Perception, Scene, Target

BOUNDS = (-50.0, -50.0, 50.0, 50.0)
TIMES = np.arange(2.0, 26.0, 2.0)


@cache
def town() -> SceneModel:
    return SceneModel(Scene(moving_cars_per_km=30), Target(waypoints_m=((0, 0), (100, 0))), BOUNDS)


def drawn(drone: int = 0, t_s: float = 5.0, seed: int = 3, replication: int = 0) -> Drawn:
    """The draws of one look at each of many cars, none of which are the same for all drones."""
    eyes = Eyes(town())
    source = DrawSource(seed, replication, 7, eyes.traffic.identity, np.zeros(4, np.float32))
    at = [capture(0.0, 0.0, drone=drone, t_s=t_s)]
    return source.of(at, eyes.look(CaptureColumns.of(at)))


def columns(d: Drawn, label: str) -> dict[str, np.ndarray]:
    """All numbers of looks as uniform ones."""
    return {
        f"look {label}": d.look,
        f"rank {label}": ndtr(d.rank),
        f"find 0 {label}": d.find[:, 0],
        f"find 1 {label}": d.find[:, 1],
        f"residual {label}": d.residual,
    }


def test_no_two_of_the_surrogate_s_draws_share_a_number() -> None:
    """Of every purpose, drone, moment, seed and replication, car by car."""
    each: dict[str, np.ndarray] = {}
    for how in ({}, {"drone": 1}, {"t_s": 5.1}, {"seed": 4}, {"replication": 1}):
        each |= columns(drawn(**how), str(how))
    fixed = drawn().offset_draw
    each["offset"] = fixed[:, 0]
    n = min(map(len, each.values()))
    assert n > 60
    values = {name: v[:n] for name, v in each.items()}
    for name, v in values.items():
        assert 0.3 < v.mean() < 0.7, name
    correlation = np.corrcoef(list(values.values()))
    np.fill_diagonal(correlation, 0.0)
    worst = np.unravel_index(np.abs(correlation).argmax(), correlation.shape)
    assert np.abs(correlation).max() < 0.6, [list(values)[k] for k in worst]
    alike = [len(np.intersect1d(a, b)) for a, b in product(values.values(), repeat=2) if a is not b]
    assert max(alike) == 0


def test_false_positives_are_drawn_for_each_drone_and_moment() -> None:
    a, b = drawn(), drawn(drone=1)
    for first, second in ((a, b), (a, drawn(t_s=5.1)), (a, drawn(seed=4)), (a, drawn(replication=1))):
        for name in ("alarm_at", "alarm_which"):
            one, other = getattr(first, name).ravel(), getattr(second, name).ravel()
            assert len(np.intersect1d(one, other)) == 0
        assert first.moment[0] != second.moment[0]
    bands = a.alarm_which[0]
    assert len(np.unique(bands)) == bands.size
    assert abs(np.corrcoef(a.alarm_at[0, :, 0], a.alarm_which[0, :, 0])[0, 1]) < 0.9


def test_each_drone_has_a_shared_false_positive_by_a_draw_of_its_own() -> None:
    """Drones in one place at one moment see the same things, and not all the same of them, nor at the next look."""
    detector = SurrogateDetector(
        SceneModel(Scene(parked_density=0, moving_cars_per_km=0), None, BOUNDS), Perception(), 3
    )
    detector.parameters = dataclasses.replace(
        detector.parameters, shared_false_positives=np.array([1.0, 0.5, 0.0, 0.0], np.float32)
    )

    def things(drone: int, t_s: float) -> set[tuple[int, int]]:
        (boxes,) = detector.detect([(capture(0.0, 0.0, drone=drone, t_s=t_s), [])])
        return {tuple(np.round(xy).astype(int).tolist()) for xy in boxes.xy_m}

    looks = {(drone, k): things(drone, 5.0 + 0.5 * k) for drone in range(3) for k in range(12)}
    every = set().union(*looks.values())
    assert len(every) >= 4
    known = sorted(every)
    table = np.array([[thing in looks[drone, k] for thing in known] for drone in range(3) for k in range(12)], float)
    assert 0.1 < table.mean() < 0.9
    by_drone = table.reshape(3, -1)
    assert not any(np.array_equal(by_drone[i], by_drone[j]) for i, j in ((0, 1), (0, 2), (1, 2)))
    per_look = table.reshape(3, 12, -1)
    assert (per_look[:, 1:] != per_look[:, :-1]).any(axis=(1, 2)).all()


def test_draws_do_not_depend_on_what_was_sent_nor_on_who_else_flies() -> None:
    eyes, fleet = Eyes(town()), cross(10.0, 20.0, 0.3)
    draws = DrawSource(3, 0, 7, eyes.traffic.identity, np.full(4, 0.3, np.float32))
    every, two = eyes.look(CaptureColumns.of(fleet)), eyes.look(CaptureColumns.of(fleet[1:3]))
    a, b = draws.of(fleet, every), draws.of(fleet[1:3], two)
    mine = np.isin(every.capture, (1, 2))
    for name in ("look", "rank", "find", "residual"):
        np.testing.assert_array_equal(getattr(a, name)[mine], getattr(b, name))
    np.testing.assert_array_equal(a.alarm_at[1:3], b.alarm_at)


@pytest.mark.parametrize("part", [0.0, 0.3, 1.0])
def test_that_share_of_the_cars_has_one_draw_for_all_drones(part: float) -> None:
    eyes = Eyes(SceneModel(Scene(), None, BOUNDS))
    draws = DrawSource(3, 0, 7, eyes.traffic.identity, np.full(4, part, np.float32))
    fleet = [c for t in TIMES for c in cross(10.0, 20.0, 0.3, t_s=float(t))]
    looks = eyes.look(CaptureColumns.of(fleet))
    drawn = draws.of(fleet, looks)
    cars = [looks.car == c for c in np.unique(looks.car) if (looks.car == c).sum() > 5]
    for values in (drawn.look, drawn.find[:, 0], drawn.residual):
        alike = np.mean([np.ptp(values[of]) == 0.0 for of in cars])
        assert alike == pytest.approx(part, abs=0.1)
        assert values.mean() == pytest.approx(0.5, abs=0.1)


def test_which_cars_are_hard_is_the_towns_and_the_rest_the_sorties() -> None:
    eyes, fleet = Eyes(town()), cross(10.0, 20.0, 0.3)
    looks, half = eyes.look(CaptureColumns.of(fleet)), np.full(4, 0.5, np.float32)
    a, b, other = (
        DrawSource(*key, eyes.traffic.identity, half).of(fleet, looks) for key in ((3, 0, 7), (4, 1, 7), (3, 0, 8))
    )
    own = a.look == b.look
    assert own.mean() == pytest.approx(0.5, abs=0.15)
    np.testing.assert_array_equal(a.offset_draw, b.offset_draw)
    assert (a.look == other.look).mean() < 0.05


@pytest.mark.parametrize(
    "larger", [(-53.0, -51.0, 50.0, 50.0), (-50.0, -50.0, 90.0, 130.0), (-900.0, -50.0, 900.0, 50.0)]
)
def test_a_car_keeps_its_draws_wherever_the_scene_ends(larger: tuple[float, float, float, float]) -> None:
    """Parked cars, moving ones and the target, at two moments. The longest scene has two patterns of moving cars."""
    config = Scene(moving_cars_per_km=20)
    fleet = [*cross(10.0, 20.0, 0.3), *cross(10.0, 20.0, 0.3, t_s=40.0)]
    kinds, sorties = [], []
    for bounds, key in ((BOUNDS, (3, 0)), (larger, (3, 0)), (larger, (4, 1))):
        eyes = Eyes(SceneModel(config, Target(waypoints_m=((15.0, 20.0),)), bounds))
        looks = eyes.look(CaptureColumns.of(fleet))
        drawn = DrawSource(*key, 7, eyes.traffic.identity, np.full(4, 0.5, np.float32)).of(fleet, looks)
        order = np.lexsort([*looks.world_m.T.round(6), looks.capture])
        kinds.append(eyes.traffic.identity[looks.car[order], 0].tolist())
        sorties.append([v[order] for v in (drawn.look, drawn.rank, drawn.find, drawn.residual, drawn.offset_draw)])
    assert kinds[0] == kinds[1] == kinds[2]
    assert set(kinds[0]) == {0, 1, 2, 3}
    small, same_sortie, other_sortie = sorties
    for mine, theirs in zip(small, same_sortie, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    np.testing.assert_array_equal(small[-1], other_sortie[-1])
    assert (small[0] == other_sortie[0]).mean() == pytest.approx(0.5, abs=0.15)


def test_no_two_cars_of_a_pattern_are_one() -> None:
    traffic = Eyes(SceneModel(Scene(moving_cars_per_km=30, parked_density=0.9), None, (-400, -400, 400, 400))).traffic
    assert len(np.unique(traffic.identity, axis=0)) == traffic.count > 1000


def test_uniform_draws_are_uniform_and_unlike_across_purposes() -> None:
    words = np.arange(100_000, dtype=np.uint64)
    u, v = uniform(words, 0), uniform(words, 1)
    for one in (u, v):
        assert abs(one.mean() - 0.5) < 4 / np.sqrt(12 * len(u))
        assert abs(one.var() - 1 / 12) < 1e-3
    assert abs(np.corrcoef(u, v)[0, 1]) < 0.015
    assert abs(np.corrcoef(u[1:], u[:-1])[0, 1]) < 0.015


def over(*at: tuple[float, float]) -> CaptureColumns:
    return CaptureColumns.of([capture(x, y, yaw=0.3, drone=k) for k, (x, y) in enumerate(at)])


@pytest.mark.slow
def test_as_many_things_lie_in_a_square_as_are_expected_there() -> None:
    counts = []
    for town in range(60):
        things = SharedFalsePositives(town).about(over((0, 0)), 30.0)
        assert (things.rarity < 30.0).all()
        counts.append([int((things.there[0] & (things.rarity < most)).sum()) for most in (10.0, 30.0)])
    mean, variance = np.mean(counts, axis=0), np.var(counts, axis=0)
    np.testing.assert_allclose(mean, [10, 30], rtol=0.15)
    np.testing.assert_allclose(variance, [10, 30], rtol=0.5)  # Poisson: as thrown


@pytest.mark.slow
def test_things_are_spread_over_their_tiles_by_two_draws_and_turned_by_a_third() -> None:
    """Each even in 0 … 1, and none tells of another."""
    several = [SharedFalsePositives(town).about(over((0, 0)), 40.0) for town in range(20)]
    xy = np.concatenate([things.xy_m for things in several]) / TILE_M % 1.0
    draws = np.column_stack([xy, np.concatenate([things.yaw_rad for things in several]) / (2 * np.pi)]).T
    np.testing.assert_allclose(draws.mean(axis=1), 0.5, atol=0.03)
    np.testing.assert_allclose(np.corrcoef(draws), np.eye(3), atol=0.1)


def test_things_stand_where_they_stand_whichever_drones_look() -> None:
    town = SharedFalsePositives(7)
    alone, both = town.about(over((300, -200)), 20.0), town.about(over((-500, 0), (300, -200)), 20.0)
    seen = both.there[1]
    here = np.lexsort(alone.xy_m[alone.there[0]].T)
    there = np.lexsort(both.xy_m[seen].T)
    np.testing.assert_array_equal(alone.xy_m[alone.there[0]][here], both.xy_m[seen][there])
    np.testing.assert_array_equal(alone.key[alone.there[0]][here], both.key[seen][there])
    assert not np.array_equal(SharedFalsePositives(8).about(over((300, -200)), 20.0).xy_m, alone.xy_m)
