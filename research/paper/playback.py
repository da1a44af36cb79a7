"""One frame of the benchmark in Rerun, as the paper's data figure: camera views, truth, detections, the cells shared at two budgets.

World frame ENU, metres. Entities: `world/truth` grey, `world/found` blue, `world/drones`, `world/mission`,
`shared/budget_0.25/cells` and so on over the truth, `views/drone_0/front` …
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from research.paper.picture import Picture
from sortie.perception.geometry import CELLS, to_world
from sortie.perception.scene.render import CAMERAS
from sortie.perception.types import Boxes
from sortie.sim.playback.recording import new_file
from sortie.sim.results.palette import MISSION, drone_colour

APPLICATION = "sortie-frame"
TRUTH, FOUND = (150, 152, 158, 255), (80, 150, 255, 255)
SHADES = ((0, 0, 0, 0), (44, 92, 120, 255), (46, 140, 152, 255), (110, 196, 160, 255), (226, 240, 170, 255))
"""By how many peers share a cell; more than four look like four."""
ALTITUDE_M, HEIGHT_M = 60.0, 1.8


def save_frame(picture: Picture, path: Path) -> None:
    """Save a frame as a recording with its layout inside; written to a temporary name, then renamed.

    Raises:
        RunError: the file cannot be written.
    """
    with new_file(path, layout(picture), APPLICATION) as recording:
        log_frame(recording, picture)


def log_frame(recording: rr.RecordingStream, picture: Picture) -> None:
    """Draw the frame into a recording."""

    def put(entity: str, *what: Any) -> None:
        recording.log(entity, *what, static=True, strict=True)

    recording.send_recording_name(picture.name)
    put("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    drones = np.column_stack([picture.true_pose[:, :2], np.full(len(picture.true_pose), ALTITUDE_M)])
    names = [f"{i}{' (ego)' if i == picture.ego else ''}" for i in range(len(drones))]
    colours = [drone_colour(i) for i in range(len(drones))]
    put("world/drones", rr.Points3D(drones, radii=1.5, colors=colours, labels=names, show_labels=True))
    put("world/truth", _solid(picture.truth, TRUTH, filled=True))
    put("world/found", _solid(picture.found, FOUND, filled=False))
    if picture.disc is not None:
        put("world/mission", _ring(*picture.disc))
    for budget, counts in picture.shared:
        entity = f"shared/budget_{budget:g}"
        put(f"{entity}/cells", _cells(picture, counts))
        put(f"{entity}/truth", _solid(picture.truth, TRUTH, filled=False))
        flat = drones * (1.0, 1.0, 0.0)
        put(f"{entity}/drones", rr.Points3D(flat, radii=1.5, colors=colours))
    for drone, views in enumerate([] if picture.views is None else picture.views):
        for name, view in zip(CAMERAS, views, strict=True):
            put(f"views/drone_{drone}/{name}", rr.Image(np.ascontiguousarray(view)))


def layout(picture: Picture) -> rrb.Blueprint:
    """Views of the five drones above, the ego's three maps below."""
    maps: list[rrb.View | rrb.Container] = [
        rrb.Spatial3DView(
            name="truth (grey) and detections (blue)", origin="world", contents="/world/**", **_eye(picture)
        )
    ]
    for budget, _ in picture.shared:
        name = f"cells shared with drone {picture.ego} at a budget of {budget:g}, lighter: more peers"
        maps.append(
            rrb.Spatial3DView(
                name=name, origin=f"shared/budget_{budget:g}", contents=f"/shared/budget_{budget:g}/**", **_eye(picture)
            )
        )
    body: rrb.Container = rrb.Horizontal(*maps)
    if picture.views is not None:
        cameras = [
            rrb.Tabs(
                *(rrb.Spatial2DView(name=f"drone {d} {c}", origin=f"views/drone_{d}/{c}") for c in CAMERAS),
                active_tab=len(CAMERAS) - 1,
            )
            for d in range(len(picture.views))
        ]
        body = rrb.Vertical(rrb.Horizontal(*cameras), body, row_shares=[1, 2.4])
    return rrb.Blueprint(
        body,
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def _eye(picture: Picture) -> dict[str, Any]:
    """From straight above the ego, north up."""
    x, y = picture.true_pose[picture.ego, :2].tolist()
    reach = picture.geometry.half_extent_m
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=(x, y - 0.05 * reach, 2.6 * reach), look_target=(x, y, 0.0), eye_up=(0.0, 0.0, 1.0)
    )  # fmt: skip
    return {"background": (20, 24, 30, 255), "line_grid": False, "eye_controls": eye}


def _solid(boxes: Boxes, colour: tuple[int, int, int, int], *, filled: bool) -> rr.Boxes3D:
    n = len(boxes)
    zero = np.zeros(n)
    return rr.Boxes3D(
        centers=np.column_stack([boxes.xy_m, np.full(n, HEIGHT_M / 2)]),
        half_sizes=np.column_stack([boxes.size_m / 2, np.full(n, HEIGHT_M / 2)]),
        quaternions=np.column_stack([zero, zero, np.sin(boxes.yaw_rad / 2), np.cos(boxes.yaw_rad / 2)]),
        colors=[colour] * n,
        radii=[-1.5] * n,
        fill_mode="solid" if filled else "majorwireframe",
    )


def _cells(picture: Picture, counts: NDArray[np.int64]) -> rr.Boxes3D:
    """The shared cells as flat squares on the ego's grid."""
    row, column = np.nonzero(counts)
    cell_m = picture.geometry.cell_m
    forward, left = ((i + 0.5 - CELLS / 2) * cell_m for i in (row, column))
    x, y = to_world(forward, left, picture.est_pose[picture.ego])
    n, yaw = len(row), picture.est_pose[picture.ego, 2]
    level = np.minimum(counts[row, column], len(SHADES) - 1)
    return rr.Boxes3D(
        centers=np.column_stack([x, y, np.zeros(n)]),
        half_sizes=np.tile([0.48 * cell_m, 0.48 * cell_m, 0.05], (n, 1)),
        quaternions=np.tile([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)], (n, 1)),
        colors=np.array(SHADES, np.uint8)[level],
        fill_mode="solid",
    )


def _ring(x_m: float, y_m: float, radius_m: float) -> rr.LineStrips3D:
    a = np.linspace(0, 2 * np.pi, 73)
    strip = np.column_stack([x_m + radius_m * np.cos(a), y_m + radius_m * np.sin(a), np.full(73, 0.6)])
    return rr.LineStrips3D([strip], colors=[MISSION], radii=[-2.0])
