"""A survey's counts by hand, of a frame that is told number by number, and the means over styles."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from research.benchmark import survey as surveying
from research.benchmark.dataset import Benchmark
from research.benchmark.survey import Counts, by_style, survey
from sortie.perception.geometry import Geometry

INSIDE = np.array([[1, 1, 0, 1, 0], [0, 1, 0, 0, 1]], bool)
PART = np.array([[0.4, 0.2, 1.0, 0.0, 1.0], [1.0, 0.6, 1.0, 0.2, 0.0]])
"""Of each car's roof, by drone. The third car is in nobody's square."""
T_S = 41.5


class Cars:
    def __init__(self, index: np.ndarray) -> None:
        self.index = index

    def where(self, which: np.ndarray) -> Cars:
        return Cars(self.index[which])


def block(lots: list[tuple[float, ...]], buildings: list[tuple[float, ...]]) -> Any:
    return SimpleNamespace(lots=np.array(lots).reshape(-1, 4), buildings=np.array(buildings).reshape(-1, 6))


BLOCKS = [
    block([(0, 0, 10, 10), (0, 0, 20, 20)], [(0, 0, 10, 10, 6.0, 1.0)]),
    block([(50, 50, 80, 80)], [(50, 50, 80, 60, 12.0, 3.0)]),
]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What the survey asked for, in order."""
    out: list[Any] = []

    def cars_at(t_s: float) -> Cars:
        out.append(t_s)
        return Cars(np.arange(5))

    def captures(*at: Any) -> list[Any]:
        out.append(at[:4])
        return [SimpleNamespace(t_s=T_S, drone=k) for k in range(2)]

    def inside(capture: Any, cars: Cars, half: float) -> np.ndarray:
        out.append(half)
        return INSIDE[capture.drone][cars.index]

    town = SimpleNamespace(blocks=lambda *rectangle: BLOCKS)
    stand_ins: dict[str, Any] = {
        "draw_scene": lambda *at: SimpleNamespace(style="suburb", block_m=50.0),
        "model_of": lambda config: SimpleNamespace(cars_at=cars_at, town=town),
        "draw_captures": captures,
        "inside": inside,
        "visible": lambda scene, capture, cars: PART[capture.drone][cars.index],
    }
    for name, made in stand_ins.items():
        monkeypatch.setattr(surveying, name, made)
    return out


def test_every_count_is_of_the_cars_that_each_ego_is_scored_by(asked: list[Any]) -> None:
    """Five pairs of an ego and a car. Alone: the first car by the first drone, the second by the second. Of the fleet: the
    first car, the second for both, and the fifth, which only the other one sees."""
    found = survey(Benchmark(3, geometry=Geometry(51.2)), "test", 7, 2)
    assert asked == [(3, "test", 7, 2), T_S, 51.2, 51.2]
    assert found == Counts(
        "suburb", 2.5, pytest.approx(2 / 5), pytest.approx(4 / 5), pytest.approx(400 / 5000), 9.0, 20.0
    )  # type: ignore[arg-type]


def test_an_empty_frame_and_an_empty_town_count_nothing(asked: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surveying, "inside", lambda capture, cars, half: np.zeros(len(cars.index), bool))
    for b in BLOCKS:
        monkeypatch.setattr(b, "buildings", np.zeros((0, 6)))
    found = survey(Benchmark(), "test", 7)
    assert (found.cars, found.alone, found.fleet, found.built, found.height_m) == (0.0, 0.0, 0.0, 0.0, 0.0)
    assert asked[0] == (0, "test", 7, 0)


def test_means_are_over_the_scenes_of_a_style_and_over_all() -> None:
    one = Counts("town", 10.0, 0.5, 0.75, 0.25, 8.0, 20.0)
    rows = [one, replace(one, style="yard", cars=40.0), replace(one, cars=20.0, alone=1.0)]
    assert by_style(rows) == [
        ("town", 2, replace(one, cars=15.0, alone=0.75)),
        ("yard", 1, rows[1]),
        ("all", 3, replace(one, style="all", cars=pytest.approx(70 / 3), alone=pytest.approx(2 / 3))),  # type: ignore[arg-type]
    ]
