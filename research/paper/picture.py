"""The content of the paper's data figure for one frame: ground truth, detections, and the cells shared at two budgets.

Free of torch; drawn by `figure_frame.draw` and, in Rerun, by the simulator's playback.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from research.paper.measures import under
from research.paper.ways import FULL_SHARING, PAPER_WAYS, CellsBy, Sharing, Ways
from sortie.perception.errors import InputError
from sortie.perception.evaluation.harness import (
    REGION_M,
    FleetFrames,
    Instrument,
    Settings,
    exchanges,
    frame_keys,
    mission_target,
    truth,
)
from sortie.perception.evaluation.sharing import Exchange, Floats
from sortie.perception.geometry import CELLS, Geometry, to_local, to_world
from sortie.perception.metrics.ap import suppress
from sortie.perception.types import Boxes
from sortie.scenarios.disc import Disc

PAPER_BUDGETS = (0.25, 0.02)


@dataclass(frozen=True, slots=True)
class Picture:
    """The data to draw for one frame and ego; world frame ENU, metres."""

    name: str
    ego: int
    geometry: Geometry
    true_pose: Floats
    """[d, 3] x, y, yaw of every drone."""
    est_pose: Floats
    """[d, 3] as believed; the ego's places its grid."""
    truth: Boxes
    found: Boxes
    """Under full sharing, at τ."""
    disc: Disc | None
    """The mission's."""
    shared: tuple[tuple[float, NDArray[np.int64]], ...]
    """For each budget how many peers share each cell of the ego's grid [64, 64]."""
    views: NDArray[np.uint8] | None = None
    """[d, cameras, height, width, 3] what the drones' cameras saw."""


def picture(
    instrument: Instrument,
    frames: FleetFrames,
    f: int,
    *,
    ego: int = 0,
    budgets: Sequence[float] = PAPER_BUDGETS,
    tau: float = 0.1,
    cells_by: CellsBy = "confidence",
    ways: Ways = PAPER_WAYS,
    views: NDArray[np.uint8] | None = None,
) -> Picture:
    """Frame `f` from one ego, under zero fill; `cells_by` and `ways` as for `measures.under`.

    Raises:
        InputError: no such frame or drone.
    """
    n, drones = frames.est_pose.shape[:2]
    if not 0 <= f < n:
        raise InputError(f"frame is {f}, must be 0 to {n - 1}")
    if not 0 <= ego < drones:
        raise InputError(f"ego is {ego}, must be 0 to {drones - 1}")
    settings = Settings(egos=drones)
    key = frame_keys(frames)[f]
    target = mission_target(frames, f, key)
    view, geometry = instrument.look(frames, f), instrument.geometry
    conditions = [FULL_SHARING, *(under(Sharing(budget), "zero", cells_by, ways) for budget in budgets)]
    given = [e for e, _ in exchanges(view, frames, f, key, conditions, settings, geometry, target) if e.ego == ego]
    found = Boxes.placed(view.detect(given[:1], tau)[0], tuple(frames.est_pose[f, ego].tolist()))
    return Picture(
        name=f"scene {key[0]}, frame {f}",
        ego=ego,
        geometry=geometry,
        true_pose=frames.true_pose[f],
        est_pose=frames.est_pose[f],
        truth=truth(frames, f, ego, geometry),
        found=suppress(found, settings.nms_iou),
        disc=None if target is None else Disc(*target, REGION_M),
        shared=tuple(
            (budget, sharers(e, frames.est_pose[f], geometry)) for budget, e in zip(budgets, given[1:], strict=True)
        ),
        views=views,
    )


def sharers(exchange: Exchange, est_pose: Floats, geometry: Geometry) -> NDArray[np.int64]:
    """[64, 64] on the ego's grid: how many peers sent the cell of theirs in which the ego's cell has its centre."""
    along = (np.arange(CELLS) + 0.5 - CELLS / 2) * geometry.cell_m
    forward, left = np.meshgrid(along, along, indexing="ij")
    x, y = to_world(forward, left, est_pose[exchange.ego])
    count = np.zeros((CELLS, CELLS), np.int64)
    for peer, sent in zip(exchange.peers, exchange.sent, strict=True):
        row, column = (np.floor(v / geometry.cell_m + CELLS / 2).astype(int) for v in to_local(x, y, est_pose[peer]))
        inside = (row >= 0) & (row < CELLS) & (column >= 0) & (column < CELLS)
        count[inside] += sent[row[inside], column[inside]]
    return count
