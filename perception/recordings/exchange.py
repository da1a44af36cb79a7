"""What an ego of a recording receives: boxes by the cells that were sent, or features through the user's own fusion.

Without a fusion an object-level stand-in is modelled: a peer's recorded box reaches the ego if the cell that holds
its centre was sent. It cannot find a car that neither drone found alone, and silent peers cost it nothing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.perception.box_bounds import wrong_box
from sortie.perception.geometry import CELLS, Geometry
from sortie.perception.lateness import reach_m, still_right
from sortie.perception.recordings.recording import Floats, Recording, RecordingError, cells_of

Fuse = Callable[[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]], Any]
"""`fuse(agents, takes_part, weight)` → boxes [m, 6] in the ego's frame.

- agents [1 + k, C, 64, 64] float32 on the ego's grid, the ego's own first, zero where nothing arrived;
- takes_part [1 + k, 64, 64] bool: who counts in which cell (with unsent cells as zeros: all that a peer's grid covers);
- weight [1 + k]: each link's fusion weight, the ego's 1.
"""


@dataclass(frozen=True, slots=True)
class Sent:
    """What one peer sent: one drone of one recorded frame, and which of its cells [64, 64]."""

    frame: int
    drone: int
    cells: NDArray[np.bool_]
    pose: tuple[float, float, float]
    """What places it in the world."""
    weight: float = 1.0
    age_s: float = 0.0
    """From the capture to the fusion."""


def fusion_hash(reference: str | None) -> str:
    """A hash of the fusion's file and name."""
    if reference is None:
        return ""
    source = Path(reference.rpartition(":")[0]).read_bytes()
    return hashlib.blake2b(source + reference.rpartition(":")[2].encode(), digest_size=16).hexdigest()


def received_boxes(
    recording: Recording,
    ego: tuple[int, int] | None,
    pose: tuple[float, float, float],
    sent: Sequence[Sent],
    freshest_s: float = 0.0,
) -> Floats:
    """[m, 6]: the ego's own boxes and those of its peers whose cells were sent, in the ego's frame, before suppression.

    Args:
        ego: its recorded frame and its drone, None where it has no look of its own; pose: what places it in the world.
        freshest_s: the age of its own look; scores of what is older are multiplied by what that leaves.
    """
    geometry = recording.geometry
    parts = [np.zeros((0, 6))] if ego is None else [recording.boxes(*ego)]
    for s in sent:
        boxes = recording.boxes(s.frame, s.drone)
        row, column, inside = cells_of(boxes, geometry)
        arrived = inside & s.cells[row.clip(0, CELLS - 1), column.clip(0, CELLS - 1)]
        here = moved(boxes[arrived], s.pose, pose)
        reach = reach_m(here[:, 2:4])
        here[:, 5] *= s.weight * np.minimum(still_right(reach, s.age_s) / still_right(reach, freshest_s), 1.0)
        parts.append(here[(np.abs(here[:, :2]) < geometry.half_extent_m).all(axis=1)])
    return np.concatenate(parts)


def moved(boxes: Floats, there: Sequence[float], here: Sequence[float]) -> Floats:
    """Boxes [m, 6] of a frame at pose `there` in a frame at pose `here` (x, y, yaw in the world)."""
    turn = there[2] - here[2]
    c, s, ch, sh = np.cos(turn), np.sin(turn), np.cos(here[2]), np.sin(here[2])
    dx, dy = there[0] - here[0], there[1] - here[1]
    out = boxes.copy()
    out[:, 0] = c * boxes[:, 0] - s * boxes[:, 1] + ch * dx + sh * dy
    out[:, 1] = s * boxes[:, 0] + c * boxes[:, 1] - sh * dx + ch * dy
    out[:, 4] += turn
    return out


def fused(
    fuse: Fuse,
    recording: Recording,
    ego: tuple[int, int],
    pose: tuple[float, float, float],
    sent: Sequence[Sent],
    unsent: str,
) -> Floats:
    """[m, 6]: what the user's fusion finds in the ego's features and its peers', warped by their poses.

    Raises:
        RecordingError: no features, a grid that is not 64 × 64, or boxes that are none.
    """
    import torch

    from sortie.perception.network.fusion.base import takes_part
    from sortie.perception.network.warp import warp

    if recording.grid[1:] != (CELLS, CELLS):
        c, h, w = recording.grid
        raise RecordingError(
            f"{recording.path}: features are {c} × {h} × {w}, must be C × {CELLS} × {CELLS} to be fused"
        )
    agents = [recording.features(*ego)[None]]
    part = np.ones((1, CELLS, CELLS), bool)
    weight = np.array([1.0, *(s.weight for s in sent)], np.float32)
    if sent:
        maps = torch.from_numpy(np.stack([recording.features(s.frame, s.drone) for s in sent]))
        cells = torch.from_numpy(np.stack([s.cells for s in sent]))[:, None]
        # relative to the ego, so that float32 keeps millimetres kilometres from the origin
        there = torch.tensor([(s.pose[0] - pose[0], s.pose[1] - pose[1], s.pose[2]) for s in sent])
        here = torch.tensor((0.0, 0.0, pose[2]))
        with torch.inference_mode():
            on_grid, arrived, inside = warp(maps, cells, here, there, recording.cell_m)
            links = torch.from_numpy(weight[None, 1:])
            say = takes_part(arrived[None, :, 0], inside[None, :, 0], links, "masked" if unsent == "masked" else "zero")
        agents.append(on_grid.numpy())
        part = say[0].numpy()
    try:
        found = np.asarray(fuse(np.concatenate(agents), part, weight), np.float64)
    except Exception as error:  # the user's own code can raise anything; torch raises RuntimeError
        raise RecordingError(f"{recording.path}: the fusion failed, {type(error).__name__}: {error}") from error
    if found.ndim != 2 or found.shape[1] != 6:
        raise RecordingError(f"{recording.path}: the fusion gave shape {list(found.shape)}, must be boxes [m, 6]")
    if wrong := wrong_box(found):
        raise RecordingError(f"{recording.path}: the fusion gave boxes: {wrong}")
    return found


def within(boxes: Floats, geometry: Geometry) -> Floats:
    """The boxes centred in the grid's square."""
    return boxes[(np.abs(boxes[:, :2]) < geometry.half_extent_m).all(axis=1)]
