"""The cell budget: which cells a peer may send, and what they weigh in bytes. Free of torch.

A sender fills its region of interest first: it ranks the cells whose centres lie in the disc, by its own
confidence or by feature norm, and sends the best ⌊ρ · 4096⌋ of them. How *many* cells that is follows from
pose and directive alone, so traffic is exact without running the detector.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence

import numpy as np

from sortie.perception.geometry import CELLS as GRID
from sortie.perception.geometry import CHANNELS, FULL

CELLS = GRID * GRID
CELL_M = FULL.cell_m
"""Sorties fly UAV3D's geometry; the smaller one is for the benchmark alone."""
DETECTION_BYTES = 24
"""One detection: x, y, length, width, yaw, score as float32."""
TRACK_BYTES = 20
"""One track: x, y, vx, vy as float32, id, class and score packed in 4 B."""
MAX_TRACKS = 12
INDEX_BITS = 12
"""One cell index: 4096 cells."""
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


def content_bytes(representation: str, *, cells: int = 0, boxes: int = 0) -> int:
    """Bytes of a payload without its header: features with their index, detections, tracks, or raw images.

    Raises:
        ValueError: another representation, naming it.
    """
    match representation:
        case "features":
            return payload_bytes(cells) + index_bytes(cells)
        case "detections":
            return boxes * DETECTION_BYTES
        case "tracks":
            return boxes * TRACK_BYTES
        case "raw":
            return RAW_BYTES
    raise ValueError(f"representation is {representation!r}, must be features, detections, tracks or raw")


_CENTRES_M = tuple((i + 0.5 - GRID / 2) * CELL_M for i in range(GRID))
"""Along either axis of the sender's levelled frame: x forward (rows), y left (columns)."""


def roi_mask(roi: tuple[float, float, float] | None, x_m: float, y_m: float, yaw_rad: float) -> np.ndarray:
    """[64, 64] bool: cells of a sender at this estimated pose whose centres are in the disc (x, y, radius), ENU."""
    if roi is None:
        return np.ones((GRID, GRID), bool)
    mask = np.zeros((GRID, GRID), bool)
    rows, columns, room, aside = _window(roi, x_m, y_m, yaw_rad)
    mask[rows, columns] = np.array(aside) <= np.array(room)[:, None]
    return mask


def cells_sent(rho: float, roi: tuple[float, float, float] | None, x_m: float, y_m: float, yaw_rad: float) -> int:
    """How many cells go: ⌊ρ·4096⌋, at most those in the ROI."""
    budget = math.floor(rho * CELLS + 1e-9)
    if roi is None or budget == 0:
        return budget
    _, _, room, aside = _window(roi, x_m, y_m, yaw_rad)
    aside.sort()
    return min(budget, sum([bisect_right(aside, left) for left in room]))


def must_choose(rho: float, roi: tuple[float, float, float] | None, x_m: float, y_m: float, yaw_rad: float) -> bool:
    """Whether the budget is below the cells there are, so that they have to be ranked."""
    candidates = CELLS if roi is None else cells_sent(1.0, roi, x_m, y_m, yaw_rad)
    return math.floor(rho * CELLS + 1e-9) < candidates


def _window(
    roi: tuple[float, float, float], x_m: float, y_m: float, yaw_rad: float
) -> tuple[slice, slice, list[float], list[float]]:
    """The rows and columns that a disc can touch; what each row leaves of the squared radius, and each column's squared
    distance from the centre: a cell is inside where the second is at most the first. Lists: there are some twenty."""
    dx, dy, radius_m = roi[0] - x_m, roi[1] - y_m, roi[2]
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    forward_m, left_m = c * dx + s * dy, -s * dx + c * dy
    rows, columns = _span(forward_m, radius_m), _span(left_m, radius_m)
    square = radius_m * radius_m
    room = [square - (x - forward_m) * (x - forward_m) for x in _CENTRES_M[rows]]
    return rows, columns, room, [(y - left_m) * (y - left_m) for y in _CENTRES_M[columns]]


def _span(centre_m: float, radius_m: float) -> slice:
    low = math.floor((centre_m - radius_m) / CELL_M) + GRID // 2
    high = math.ceil((centre_m + radius_m) / CELL_M) + GRID // 2
    if low >= 0 and high <= GRID:
        return slice(low, high)
    return slice(min(max(low, 0), GRID), min(max(high, 0), GRID))


def select(
    rank: np.ndarray,
    rho: float,
    roi: tuple[float, float, float] | None,
    x_m: float,
    y_m: float,
    yaw_rad: float,
    missing: Sequence[int] = (),
) -> np.ndarray:
    """[64, 64] bool: the cells that are sent, exactly `cells_sent` of them, less those that are missing.

    Args:
        rank: [64, 64] what ranks the cells (confidence or norm), higher first; ties go to the lower index.
        rho, roi, x_m, y_m, yaw_rad: as for `cells_sent`.
        missing: which of those sent, counted from the best, did not arrive.
    """
    allowed = roi_mask(roi, x_m, y_m, yaw_rad).ravel()
    count = cells_sent(rho, roi, x_m, y_m, yaw_rad)
    out = np.zeros(CELLS, bool)
    if count:
        order = np.argsort(np.where(allowed, -rank.ravel().astype(np.float64), np.inf), kind="stable")
        out[order[:count]] = True
        out[order[list(missing)]] = False
    return out.reshape(GRID, GRID)
