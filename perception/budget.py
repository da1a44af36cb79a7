"""The cell budget: which feature cells a drone sends, and the size of every payload in bytes. Free of torch.

A sender ranks the cells whose centres lie in its region of interest, by its own confidence, and sends
the best ⌊ρ · 4096⌋ of them. Pose and directive alone decide *how many* cells that is. So traffic is exact without
running the detector. The evaluation (`evaluation/sharing.py`) ranks cells by the same rule.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.perception.geometry import CELLS as GRID
from sortie.perception.geometry import CHANNELS, FULL
from sortie.scenarios.disc import Disc

Bools = NDArray[np.bool_]
CELLS = GRID * GRID
CELL_M = FULL.cell_m
"""Side of a cell in UAV3D's geometry, which sorties fly; only the benchmark has a smaller one."""
DETECTION_BYTES = 24
"""One detection: x, y, length, width, yaw, score as float32."""
COVARIANCE_BYTES = 12
"""What a box with uncertainty has beside a detection: east, east–north and north variance of its place, as float32."""
CLASS_BYTES = 1
"""The class of a detection, where the scenario has targets of several classes (`perception.classes`)."""
TRACK_BYTES = 20
"""One track: x, y, vx, vy as float32, id, class and score packed in 4 B."""
MOST_BOXES = 200
"""A drone detects at most so many boxes in one look, the best ones."""
MAX_TRACKS = 12
INDEX_BITS = 12
"""One cell index: 4096 cells."""
CODE_BYTES = 10
"""One cell of codes, where `perception.code_bytes` says nothing else."""
MAX_CODE_BYTES = 20
"""The longest code of a cell, an eighth of its features."""
CODEBOOK_BYTES = 8
"""What a payload of codes names its codebook by: seven bytes of its digest, and the bytes of a cell."""
RAW_BYTES = 5 * 800 * 450 * 3
"""Five cameras of 800 × 450 pixels, 3 B each: 5.4 MB (FACTS §1)."""


def payload_bytes(cells: int) -> int:
    """Feature bytes: cells × 80 channels × 2 B (FP16), as the paper counts them."""
    return cells * CHANNELS * 2


def index_list_bytes(cells: int) -> int:
    """Bytes of a list of cell indices, 12 bits each."""
    return -(-cells * INDEX_BITS // 8)


def index_bytes(cells: int) -> int:
    """Bytes that name the cells sent: a list or a 512 B bitmap, the smaller; nothing when all cells are sent."""
    return 0 if cells >= CELLS else min(CELLS // 8, index_list_bytes(cells))


def boxes_sent(representation: str, boxes: int) -> int:
    """How many of a drone's boxes it sends: all as detections, at most 12 as tracks."""
    return min(boxes, MAX_TRACKS) if representation == "tracks" else boxes


def content_bytes(
    representation: str, *, cells: int = 0, boxes: int = 0, classes: bool = False, code_bytes: int = CODE_BYTES
) -> int:
    """Bytes of a payload without its header: features or codes with their index, boxes, tracks, or raw images.

    Args:
        classes: whether each box names its class. A track always does.
        code_bytes: of a cell, where it is sent as a code.

    Raises:
        ValueError: another representation, naming it.
    """
    match representation:
        case "features":
            return payload_bytes(cells) + index_bytes(cells)
        case "codes":
            return CODEBOOK_BYTES + cells * code_bytes + index_bytes(cells)
        case "detections":
            return boxes * (DETECTION_BYTES + CLASS_BYTES * classes)
        case "uncertain_boxes":
            return boxes * (DETECTION_BYTES + COVARIANCE_BYTES + CLASS_BYTES * classes)
        case "tracks":
            return boxes * TRACK_BYTES
        case "raw":
            return RAW_BYTES
    raise ValueError(
        f"representation is {representation!r}, must be features, codes, detections, uncertain_boxes, tracks or raw"
    )


@lru_cache(maxsize=4)
def _centres_m(cell_m: float) -> tuple[float, ...]:
    """Cell centres along either axis of the sender's level frame: x forward (rows), y left (columns)."""
    return tuple((i + 0.5 - GRID / 2) * cell_m for i in range(GRID))


def roi_mask(roi: Disc | None, x_m: float, y_m: float, yaw_rad: float, cell_m: float = CELL_M) -> Bools:
    """[64, 64] bool: the cells of a sender at this estimated pose whose centres are in the disc; all without one."""
    if roi is None:
        return np.ones((GRID, GRID), bool)
    mask = np.zeros((GRID, GRID), bool)
    rows, columns, row_room, column_part = _window(roi, x_m, y_m, yaw_rad, cell_m)
    mask[rows, columns] = np.array(column_part) <= np.array(row_room)[:, None]
    return mask


def cells_in(rho: float, links: int = 1) -> int:
    """The number of cells in a budget: ⌊ρ · links · 4096⌋."""
    return math.floor(rho * links * CELLS + 1e-9)


def cells_sent(rho: float, roi: Disc | None, x_m: float, y_m: float, yaw_rad: float) -> int:
    """How many cells a sender sends: ⌊ρ·4096⌋, at most those in the ROI."""
    budget = cells_in(rho)
    if roi is None or budget == 0:
        return budget
    dx, dy, c, s = roi[0] - x_m, roi[1] - y_m, math.cos(yaw_rad), math.sin(yaw_rad)
    inside: int = loops().count(c * dx + s * dy, -s * dx + c * dy, float(roi[2]), CELL_M)
    return min(budget, inside)


@cache
def loops() -> Any:
    """The compiled loop, imported and made ready at its first use."""
    from sortie.perception import budget_loops

    budget_loops.count(0.0, 0.0, 1.0, CELL_M)
    return budget_loops


def must_choose(rho: float, roi: Disc | None, x_m: float, y_m: float, yaw_rad: float) -> bool:
    """Whether the budget is smaller than the number of cells allowed, so that cells have to be ranked."""
    return cells_in(rho) < (CELLS if roi is None else cells_sent(1.0, roi, x_m, y_m, yaw_rad))


def _window(
    roi: Disc, x_m: float, y_m: float, yaw_rad: float, cell_m: float = CELL_M
) -> tuple[slice, slice, list[float], list[float]]:
    """The rows and columns that a disc can touch, what each row leaves of the squared radius, and each column's squared distance.

    A cell is inside where its column's value is at most its row's. Lists, because there are about twenty of each.
    """
    dx, dy, radius_m = roi[0] - x_m, roi[1] - y_m, roi[2]
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    forward_m, left_m = c * dx + s * dy, -s * dx + c * dy
    rows, columns = _span(forward_m, radius_m, cell_m), _span(left_m, radius_m, cell_m)
    square, centres_m = radius_m * radius_m, _centres_m(cell_m)
    row_room = [square - (x - forward_m) * (x - forward_m) for x in centres_m[rows]]
    return rows, columns, row_room, [(y - left_m) * (y - left_m) for y in centres_m[columns]]


def _span(centre_m: float, radius_m: float, cell_m: float) -> slice:
    low = math.floor((centre_m - radius_m) / cell_m) + GRID // 2
    high = math.ceil((centre_m + radius_m) / cell_m) + GRID // 2
    if low >= 0 and high <= GRID:
        return slice(low, high)
    return slice(min(max(low, 0), GRID), min(max(high, 0), GRID))


def ranking(rank: NDArray[np.floating], first: Bools | None = None) -> NDArray[np.intp]:
    """[d, 4096]: each sender's cells as flat indices, in the order in which it sends them.

    Args:
        rank: [d, 64, 64], higher first; equal ones by the lower index.
        first: [d, 64, 64] bool, cells that come before all others, each part ranked in itself.
    """
    d = len(rank)
    order = np.argsort(-rank.reshape(d, CELLS).astype(np.float64), axis=1, kind="stable")
    if first is not None:
        late = np.take_along_axis(~first.reshape(d, CELLS), order, axis=1)
        order = np.take_along_axis(order, np.argsort(late, axis=1, kind="stable"), axis=1)
    return order


def select(
    rank: NDArray[np.floating],
    rho: float,
    roi: Disc | None,
    x_m: float,
    y_m: float,
    yaw_rad: float,
    missing: Sequence[int] = (),
) -> Bools:
    """[64, 64] bool: the cells that arrive: the `cells_sent` best ones, without those that went missing.

    Args:
        rank: [64, 64] confidence or norm, as for `ranking`.
        rho, roi, x_m, y_m, yaw_rad: as for `cells_sent`.
        missing: ranks among the cells sent (0 the best) that did not arrive.
    """
    count = cells_sent(rho, roi, x_m, y_m, yaw_rad)
    out = np.zeros(CELLS, bool)
    if count:
        order = ranking(rank[None], None if roi is None else roi_mask(roi, x_m, y_m, yaw_rad)[None])[0]
        out[order[:count]] = True
        out[order[list(missing)]] = False
    return out.reshape(GRID, GRID)
