"""What is drawn where: the picture of one frame, the arrows of links, the map's houses and trails, and what a layout shows.

Held: the pose that a grid lies by (the ego's own estimate), which cell and colour each square has, which direction's goodput
an arrow has, whose links are shown, how far drones fly apart, and which drones and plots a layout begins with.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from research.paper import playback as frame
from research.paper.picture import Picture
from sortie.perception.geometry import Geometry
from sortie.perception.types import Boxes
from sortie.policies.contract import Disc


class Kept:
    """A canvas, and a recording, that keep what is drawn."""

    def __init__(self) -> None:
        self.still: dict[str, Any] = {}
        self.rows: dict[str, list[tuple[float, list[Any]]]] = {}

    def static(self, path: str, *shown: Any) -> None:
        self.still[path] = shown[0]

    def log(self, path: str, *shown: Any, static: bool, strict: bool) -> None:
        self.still[path] = shown[0]

    def send_recording_name(self, name: str) -> None:
        self.name = name

    def columns(self, path: str, t_s: Any, columns: Any) -> None:
        for column in columns:
            name = column.component_descriptor().component.split(":")[1]
            values = column.as_arrow_array().to_pylist()
            known = self.rows.setdefault(f"{path} {name}", [])
            known += zip(np.asarray(t_s, float).tolist(), values, strict=True)


def told(part: Any) -> Any:
    return part.as_arrow_array().to_pylist()


# --- one frame of the benchmark -------------------------------------------------------------------------------------

TRUE = np.array([[1.0, 2.0, 0.0], [50.0, 60.0, 0.5], [90.0, 0.0, 1.0]])
BELIEVED = np.array([[3.0, 4.0, 0.1], [51.0, 62.0, 0.75], [91.0, 5.0, 1.5]])


def boxes(x_m: float, n: int) -> Boxes:
    return Boxes(
        np.array([[x_m + k, 7.0] for k in range(n)], np.float32), np.tile(np.float32([4.0, 2.0]), (n, 1)),
        np.full(n, 0.5, np.float32), np.ones(n, np.float32),
    )  # fmt: skip


def pictured() -> Picture:
    """The ego is drone 1; at the smaller budget one cell is shared by two peers and another by seven, at the larger one."""
    few, many = np.zeros((64, 64), np.int64), np.zeros((64, 64), np.int64)
    few[40, 10], few[3, 5], many[8, 9] = 2, 7, 1
    shared = ((0.25, few), (1.0, many))
    return Picture(
        "seed 0", 1, Geometry(51.2), TRUE, BELIEVED, boxes(10.0, 2), boxes(30.0, 1), Disc(5.0, 6.0, 7.0), shared
    )


def test_shared_cells_lie_where_the_ego_believes_them_to_be() -> None:
    kept = Kept()
    frame.log_frame(kept, pictured())  # type: ignore[arg-type]
    x, y, yaw = BELIEVED[1]
    for entity, cells in (
        ("shared/budget_0.25/cells", [(3, 5, 4), (40, 10, 2)]),
        ("shared/budget_1/cells", [(8, 9, 1)]),
    ):
        drawn = kept.still[entity]
        for place, turn, colour, half, (row, column, shade) in zip(
            told(drawn.centers), told(drawn.quaternions), told(drawn.colors), told(drawn.half_sizes), cells, strict=True
        ):
            forward, left = 1.6 * (row - 31.5), 1.6 * (column - 31.5)
            there = (
                x + math.cos(yaw) * forward - math.sin(yaw) * left,
                y + math.sin(yaw) * forward + math.cos(yaw) * left,
                0.0,
            )
            assert place == pytest.approx(there, abs=1e-4)
            assert turn == pytest.approx((0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)), abs=1e-6)
            assert colour == int.from_bytes(bytes(frame.SHADES[shade]), "big")
            assert half[:2] == pytest.approx((0.768, 0.768))


def test_what_is_there_and_what_was_found_are_apart() -> None:
    kept = Kept()
    frame.log_frame(kept, pictured())  # type: ignore[arg-type]
    for entity, x_m, n in (("world/truth", 10.0, 2), ("world/found", 30.0, 1), ("shared/budget_1/truth", 10.0, 2)):
        drawn = kept.still[entity]
        assert told(drawn.centers) == [pytest.approx([x_m + k, 7.0, 0.9]) for k in range(n)]
        assert told(drawn.half_sizes) == [pytest.approx([2.0, 1.0, 0.9])] * n
        assert told(drawn.quaternions)[0] == pytest.approx([0.0, 0.0, math.sin(0.25), math.cos(0.25)])
    ring = told(kept.still["world/mission"].strips)[0]
    assert [math.hypot(px - 5.0, py - 6.0) for px, py, _ in ring] == pytest.approx([7.0] * 73, abs=1e-5)
    assert told(kept.still["world/drones"].positions) == [[px, py, frame.ALTITUDE_M] for px, py, _ in TRUE.tolist()]
    assert told(kept.still["world/drones"].labels) == ["0", "1 (ego)", "2"]
    without = Kept()
    frame.log_frame(without, replace(pictured(), disc=None))  # type: ignore[arg-type]
    assert "world/mission" not in without.still
    eye = frame._eye(pictured())["eye_controls"]
    assert told(eye.look_target) == [[50.0, 60.0, 0.0]]


# --- links ----------------------------------------------------------------------------------------------------------


def drawn(kept: Kept) -> dict[tuple[int, int], tuple[int, float]]:
    """Colour and radius by sender and receiver, of the last frame."""
    names = ("origins", "vectors", "colors", "radii")
    origins, vectors, colours, radii = (kept.rows[f"world/links {name}"][-1][1] for name in names)
    found = {}
    for origin, vector, colour, radius in zip(origins, vectors, colours, radii, strict=True):
        step = 1 if vector[0] > 0 else -1
        sender = round((origin[0] - 3.5 * step) / 100)
        found[sender, round((origin[0] + vector[0] + 3.5 * step) / 100)] = (colour, radius)
    return found
