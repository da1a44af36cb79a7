"""The map of a playback: the fleet from above over roads and houses, north up, with mission regions, targets and jammers.

A 2-D view counts pixels from its upper left corner; one pixel is one metre, and (0, 0) is the scene's north-west corner.
As in `sortie.sim.playback.scene`, tables come whole or by whole seconds.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from sortie.perception.scene.scene_model import MARGIN_M, SceneModel
from sortie.scenarios.frames import frame_at, frames_at
from sortie.scenarios.schema import Scenario
from sortie.sim.playback.canvas import Canvas, packed
from sortie.sim.results import palette
from sortie.sim.results.flown_scene import CIRCLE
from sortie.sim.results.palette import Floats

TRAIL_S = 60
"""So long a way behind each drone is drawn, a point a second."""
STEP_S = 0.5
"""Regions and targets are drawn anew so often."""
SCALE_M = 100.0
HOUSE = (128, 124, 120)


class GroundMap:
    """Draws the map of one sortie; `begin` once, then `add` with the tables in order of time."""

    def __init__(self, canvas: Canvas, scenario: Scenario, scene: SceneModel) -> None:
        self._canvas, self._scene, self._n = canvas, scene, scenario.fleet.drones
        self._rate_hz = scenario.context.rate_hz
        self._groups = range(len(scenario.mission.phases_of))
        self._trail: Floats = np.zeros((0, self._n, 2))
        self._flew: NDArray[np.bool_] = np.zeros(self._n, bool)
        self._colours = np.array([palette.drone_colour(i) for i in range(self._n)], np.uint8)
        self._frames = 0

    def begin(self, ground: NDArray[np.uint8], houses: Floats) -> None:
        """Draw what never changes.

        Args:
            ground: roads and lots, [row, column, 3] at 1 m; its first row is the south edge.
            houses: x and y of the low and of the high corner, [K, 4 or more], ENU metres.
        """
        canvas = self._canvas
        image = ground[::-1].copy()
        corners = np.concatenate([self._flat(houses[:, :2]), self._flat(houses[:, 2:4])], axis=1).astype(int)
        for x0, y1, x1, y0 in corners.tolist():
            image[max(0, y0) : max(0, y1), max(0, x0) : max(0, x1)] = HOUSE
        canvas.static("map/ground", rr.Image(image))
        x_m, y_m = MARGIN_M - 40.0, image.shape[0] - MARGIN_M + 40.0  # by the fleet's way, which the map shows
        scale = rr.LineStrips2D(
            [[(x_m, y_m), (x_m + SCALE_M, y_m)]], colors=[(240, 240, 240, 255)], radii=[-2.5], labels=[f"{SCALE_M:g} m"]
        )
        canvas.static("map/scale", scale)
        names = [str(i) for i in range(self._n)]
        canvas.static("map/drones", rr.Points2D.from_fields(radii=[-6.0], labels=names, draw_order=40.0))
        canvas.static("map/trails", rr.LineStrips2D.from_fields(radii=[-1.5], colors=self._colours, draw_order=20.0))
        canvas.static(
            "map/mission", rr.LineStrips2D.from_fields(radii=[-2.5], colors=[palette.MISSION], draw_order=30.0)
        )
        canvas.static("map/targets", rr.Points2D.from_fields(radii=[-5.0], colors=[palette.TARGET], draw_order=35.0))
        canvas.static(
            "map/jammers",
            rr.Points2D.from_fields(radii=[-8.0], colors=[palette.JAMMER], labels=["jammer"], draw_order=38.0),
        )

    def add(self, t_s: Floats, position: Floats, airborne: NDArray[np.bool_], mission: pa.Table) -> None:
        """Draw the frames at `t_s` [T] from positions [T, N, 3] and the rows of `mission`; drones that are down are grey."""
        canvas, n = self._canvas, self._n
        flat = self._flat(position[..., :2])
        colours = np.where(airborne[..., None], self._colours, np.array(palette.FALLEN, np.uint8)).reshape(-1, 4)
        points = rr.Points2D.columns(positions=flat.reshape(-1, 2), colors=packed(colours))
        canvas.columns("map/drones", t_s, points.partition([n] * len(t_s)))
        self._trails(t_s, flat, airborne)
        step = max(1, round(STEP_S * self._rate_hz))
        drawn = t_s[(self._frames + np.arange(len(t_s))) % step == 0]
        self._frames += len(t_s)
        self._regions(drawn, mission)
        if self._scene.targets:
            at = [[path.pose(t)[:2] for path in self._scene.targets] for t in drawn.tolist()]
            places = self._flat(np.array(at).reshape(-1, 2))
            targets = rr.Points2D.columns(positions=places).partition([len(self._scene.targets)] * len(drawn))
            canvas.columns("map/targets", drawn, targets)

    def jammers(self, t_s: float, places: Floats) -> None:
        """From now on these jammers [K, 2] are on."""
        columns = rr.Points2D.columns(positions=self._flat(places)).partition([len(places)])
        self._canvas.columns("map/jammers", np.array([t_s]), columns)

    def _trails(self, t_s: Floats, flat: Floats, airborne: NDArray[np.bool_]) -> None:
        """A trail begins anew where a drone takes off."""
        for k in np.flatnonzero(frames_at(t_s, 1.0) > frames_at(t_s - 1.0 / self._rate_hz, 1.0)).tolist():
            self._trail = np.concatenate([self._trail, flat[k][None]])[-TRAIL_S:]
            took_off = airborne[k] & ~self._flew
            self._trail[:, took_off] = flat[k, took_off]
            self._flew = airborne[k]
            strips = rr.LineStrips2D.columns(strips=list(self._trail.swapaxes(0, 1))).partition([self._n])
            self._canvas.columns("map/trails", t_s[k : k + 1], strips)

    def _regions(self, drawn: Floats, mission: pa.Table) -> None:
        """The rings of all groups; none where there is no region."""
        rows = {name: mission[name].to_numpy() for name in ("t_s", "region_x_m", "region_y_m", "region_radius_m")}
        frame_s = 1.0 / self._rate_hz
        frames = frames_at(rows["t_s"], frame_s)
        for t_s in drawn.tolist():
            now = np.flatnonzero((frames == frame_at(t_s, frame_s)) & ~np.isnan(rows["region_radius_m"]))
            rings = [
                self._flat((rows["region_x_m"][k], rows["region_y_m"][k]) + rows["region_radius_m"][k] * CIRCLE)
                for k in now.tolist()
            ]
            columns = rr.LineStrips2D.columns(strips=rings).partition([len(rings)])
            self._canvas.columns("map/mission", np.array([t_s]), columns)

    def _flat(self, xy_m: Floats) -> Floats:
        """ENU metres [..., 2] as places on the map."""
        x0, _, _, y1 = self._scene.rect
        return np.stack([xy_m[..., 0] - x0, y1 - xy_m[..., 1]], axis=-1)
