"""The scene of a sortie as visualization_msgs/MarkerArray, which the 3-D panels of Foxglove and RViz draw.

| topic | shows |
|---|---|
| `/scene/town` | buildings and parked cars, once |
| `/scene/cars` | moving cars near the fleet |
| `/scene/mission` | each group's mission region, the targets, and jammers that are on |
| `/scene/links` | links as lines, from red (1 Mb/s and below) to green (100 Mb/s and above) by goodput; grey if not measured |
| `/drone_0/boxes` | what drone 0 detected: cars that it found and missed, and false positives |

Each message replaces the one before on its topic, so that a viewer may begin anywhere. The frame is `world`, ENU in metres.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.traffic import Cars
from sortie.perception.types import Boxes
from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.schema import Jammer
from sortie.sim.results import palette as c
from sortie.sim.results.flown_scene import BOX_HEIGHT_M, CIRCLE, cars_near, houses, jamming, scene_of, vehicles
from sortie.sim.results.link_traffic import LinkTraffic
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.regions import Regions
from sortie.sim.results.sightings import sightings

MARKERS = "visualization_msgs/msg/MarkerArray"
TOWN, CARS, MISSION, LINKS = "/scene/town", "/scene/cars", "/scene/mission", "/scene/links"
SCENE_HZ = 5.0
"""Cars, regions and links are drawn so often, in whole frames."""
LINK_WIDTH_M, RING_WIDTH_M = 0.4, 1.0
BUILDING = (170, 160, 150, 255)
_CUBE, _SPHERE, _LINE_STRIP, _LINE_LIST, _TEXT, _CYLINDER, _ARROW = 1, 2, 4, 5, 9, 3, 0
_DELETE_ALL = 3

Timed = tuple[float, str, Any]
"""Time in s, topic and message."""


class SceneMarkers:
    """Makes the messages of one sortie.

    Args:
        record: the sortie.
        make: the message classes by their short names.
        begin_ns: when it began, ns since 1970.
    """

    def __init__(self, record: SortieRecord, make: SimpleNamespace, begin_ns: int) -> None:
        self._record, self._make, self._begin_ns = record, make, begin_ns
        self._scene: SceneModel = scene_of(record)
        scenario, states = record.scenario, record.tables["states"]
        self._n = scenario.fleet.drones
        self._t_s = states["t_s"].to_numpy()[:: self._n]
        axes = [states[name].to_numpy().reshape(-1, self._n) for name in ("x_m", "y_m", "z_m")]
        self._position = np.stack(axes, axis=-1)
        self._airborne = states["airborne"].to_numpy(zero_copy_only=False).reshape(-1, self._n)
        step = max(1, round(scenario.context.rate_hz / SCENE_HZ))
        self._drawn = range(0, len(self._t_s), step)

    def messages(self) -> list[Iterator[Timed]]:
        """Streams of messages, each in order of time."""
        return [
            self._town(),
            self._cars(),
            self._mission(),
            self._links(),
            self._boxes(),
            self._waiting(),
            self._landed(),
        ]

    # --- streams ---------------------------------------------------------------------------------

    def _town(self) -> Iterator[Timed]:
        markers = [
            self._marker("buildings", _CUBE, 0.0, ((x + u) / 2, (y + v) / 2, top / 2), (u - x, v - y, top), BUILDING)
            for x, y, u, v, top in houses(self._scene)[:, :5].tolist()
        ]
        yield 0.0, TOWN, self._array(0.0, [*markers, *self._car_markers("parked", 0.0, self._scene.parked_cars)])

    def _cars(self) -> Iterator[Timed]:
        flying = vehicles(self._record.scenario.fleet)
        for k in self._drawn:
            t_s, (x, y) = float(self._t_s[k]), self._position[k, flying, :2].mean(axis=0).tolist()
            near = cars_near(self._scene, t_s, x, y)
            yield t_s, CARS, self._array(t_s, self._car_markers("moving", t_s, near))

    def _mission(self) -> Iterator[Timed]:
        mission, targets = self._record.scenario.mission, self._scene.targets
        regions = Regions(self._record.tables["mission"], mission)
        groups = {mission.group_of(drone): drone for drone in range(self._n)}  # one drone of each
        jams = [event for event in self._record.scenario.events if isinstance(event, Jammer)]
        for k in self._drawn:
            t_s, markers = float(self._t_s[k]), []
            for x, y, radius in regions.at(np.full(len(groups), t_s), list(groups.values())).tolist():
                if radius == radius:  # NaN where there is none
                    size = (2 * radius, 2 * radius, 0.2)
                    markers.append(self._marker("region", _CYLINDER, t_s, (x, y, 0.3), size, (*c.MISSION[:3], 60)))
                    ring = [(x + radius * a, y + radius * b, 0.6) for a, b in CIRCLE.tolist()]
                    markers.append(self._lines("region", _LINE_STRIP, t_s, ring, RING_WIDTH_M, c.MISSION))
            for path in targets:
                x, y = path.pose(t_s)[:2]
                arrow = self._lines("target", _ARROW, t_s, [(x, y, 15.0), (x, y, 3.0)], 0.6, c.TARGET)
                arrow.scale = self._make.Vector3(0.6, 1.8, 3.0)
                markers.append(arrow)
            for jam in jamming(jams, t_s):
                markers.append(self._marker("jammer", _SPHERE, t_s, jam.position_m, (4.0, 4.0, 4.0), c.JAMMER))
                above = (*jam.position_m[:2], jam.position_m[2] + 6.0)
                words = self._marker("jammer", _TEXT, t_s, above, (0.0, 0.0, 5.0), c.JAMMER)
                words.text = f"jammer {jam.power_dbm:g} dBm"
                markers.append(words)
            yield t_s, MISSION, self._array(t_s, markers)

    def _links(self) -> Iterator[Timed]:
        if not 2 <= self._n <= LISTED_IDS:
            return
        traffic = LinkTraffic(self._n, self._record.scenario.context.rate_hz)
        tables = self._record.tables
        goodput, _ = traffic.add(self._t_s, tables["descriptors"], tables["transmissions"])
        senders, receivers = np.nonzero(~np.eye(self._n, dtype=bool))
        for k in self._drawn:
            up = self._airborne[k, senders] & self._airborne[k, receivers]
            i, j = senders[up], receivers[up]
            way = self._position[k, j] - self._position[k, i]
            aside = 0.9 * np.cross(way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-6), (0.0, 0.0, 1.0))
            # both directions side by side, each in its sender's half and beyond
            ends = np.stack([self._position[k, i] + aside, self._position[k, j] + aside], axis=1).reshape(-1, 3)
            colours = np.repeat(c.goodput_colours(goodput[k, i, j]), 2, axis=0)
            t_s = float(self._t_s[k])
            lines = self._lines("links", _LINE_LIST, t_s, ends.tolist(), LINK_WIDTH_M, c.UNMEASURED)
            lines.colors = [self._colour(rgba) for rgba in colours.tolist()]
            yield t_s, LINKS, self._array(t_s, [lines])

    def _boxes(self) -> Iterator[Timed]:
        tables = {name: self._record.tables[name] for name in ("fusions", "detections", "truths")}
        regions = Regions(self._record.tables["mission"], self._record.scenario.mission)
        for seen in sightings(tables, regions):
            markers = []
            for name, boxes, colours in (
                ("found", seen.hits, c.FOUND),
                ("missed", seen.missed, c.MISSED),
                ("false", seen.false, c.FALSE),
            ):
                markers += self._box_markers(name, seen.t_s, boxes, colours)
            yield seen.t_s, f"/drone_{seen.drone}/boxes", self._array(seen.t_s, markers)

    def _waiting(self) -> Iterator[Timed]:
        """Where drones take turns at being scored, one that waits shows no boxes: they would be of an earlier time."""
        scored: dict[float, set[int]] = {}
        if self._record.scenario.takes_turns:
            fusions = self._record.tables["fusions"]
            for t_s, drone in zip(fusions["t_s"].to_pylist(), fusions["drone"].to_pylist(), strict=True):
                scored.setdefault(t_s, set()).add(drone)
        for before_s, t_s in pairwise(scored):
            for drone in sorted(scored[before_s] - scored[t_s]):
                yield t_s, f"/drone_{drone}/boxes", self._array(t_s, [])

    def _landed(self) -> Iterator[Timed]:
        """Who comes down sees nothing from then on."""
        for k, drone in np.argwhere(self._airborne[:-1] & ~self._airborne[1:]).tolist():
            t_s = float(self._t_s[k + 1])
            yield t_s, f"/drone_{drone}/boxes", self._array(t_s, [])

    # --- markers ---------------------------------------------------------------------------------

    def _car_markers(self, name: str, t_s: float, cars: Cars) -> list[Any]:
        rows = np.column_stack([cars.x_m, cars.y_m, cars.yaw_rad, cars.length_m, cars.width_m, cars.height_m])
        return [
            self._marker(name, _CUBE, t_s, (x, y, height / 2), (length, width, height), (*colour, 255), yaw)
            for (x, y, yaw, length, width, height), colour in zip(rows.tolist(), cars.colour.tolist(), strict=True)
        ]

    def _box_markers(self, name: str, t_s: float, boxes: Boxes, colours: NDArray[np.float64]) -> list[Any]:
        """The less sure the drone was, the more transparent."""
        rows = np.column_stack([boxes.xy_m, boxes.yaw_rad, boxes.size_m, np.clip(boxes.score, 0.0, 1.0)])
        return [
            self._marker(
                name,
                _CUBE,
                t_s,
                (x, y, BOX_HEIGHT_M / 2),
                (length, width, BOX_HEIGHT_M),
                (*colours[kind].tolist(), 60 + 120 * score),
                yaw,
            )
            for (x, y, yaw, length, width, score), kind in zip(rows.tolist(), boxes.kind.tolist(), strict=True)
        ]

    def _lines(self, name: str, kind: int, t_s: float, points: Any, width_m: float, colour: Any) -> Any:
        marker = self._marker(name, kind, t_s, (0.0, 0.0, 0.0), (width_m, 0.0, 0.0), colour)
        marker.points = [self._make.Point(*point) for point in points]
        return marker

    def _marker(
        self, name: str, kind: int, t_s: float, at: Any, size: Any, colour: Any, yaw_rad: float = 0.0, action: int = 0
    ) -> Any:
        make = self._make
        turn = make.Quaternion(0.0, 0.0, float(np.sin(yaw_rad / 2)), float(np.cos(yaw_rad / 2)))
        return make.Marker(
            header=make.Header(self._time(t_s), "world"),
            ns=name,
            id=0,
            type=kind,
            action=action,
            pose=make.Pose(make.Point(*at), turn),
            scale=make.Vector3(*size),
            color=self._colour(colour),
            lifetime=make.Duration(0, 0),
            frame_locked=False,
            points=[],
            colors=[],
            texture_resource="",
            texture=make.CompressedImage(make.Header(self._time(t_s), ""), "", np.zeros(0, np.uint8)),
            uv_coordinates=[],
            text="",
            mesh_resource="",
            mesh_file=make.MeshFile("", np.zeros(0, np.uint8)),
            mesh_use_embedded_materials=False,
        )

    def _array(self, t_s: float, markers: list[Any]) -> Any:
        """The markers numbered, after one that deletes those before."""
        clear = self._marker("", _CUBE, t_s, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0, 0, 0, 0), action=_DELETE_ALL)
        for number, marker in enumerate(markers):
            marker.id = number
        return self._make.MarkerArray([clear, *markers])

    def _colour(self, rgba: Any) -> Any:
        return self._make.ColorRGBA(*(part / 255 for part in rgba))

    def _time(self, t_s: float) -> Any:
        return self._make.Time(*divmod(self._begin_ns + round(t_s * 1e9), 1_000_000_000))
