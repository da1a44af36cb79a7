"""The 3-D scene of a playback: the town, its cars, the drones and their links, and what an ego saw.

World frame ENU, metres; radii are metres where positive and widths on the screen where negative (Rerun's own sign). Everything takes tables, so that the whole record and one second of it are drawn alike;
what a slice needs from before it (trails, goodput, recent bytes) is kept. A row at time t shows what was
known before t, which is why slices of whole seconds draw the same as the whole. Links are in `sortie.sim.playback.links`,
the cells that peers sent in `sortie.sim.playback.received`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import rerun as rr
from numpy.typing import NDArray

from sortie.fleet.coverage import cameras_of, footprint_radius_m
from sortie.perception.classes import PERSON
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import KERB_M, LANE_M, PAVEMENT_M
from sortie.perception.scene.traffic import Cars
from sortie.perception.types import Boxes
from sortie.scenarios.frames import frames_at
from sortie.scenarios.schema import Jammer, Scenario
from sortie.sim.playback import canvas as c
from sortie.sim.playback.canvas import SPAN_M, Canvas
from sortie.sim.playback.ground_map import GroundMap
from sortie.sim.playback.links import LinkArrows
from sortie.sim.playback.received import ReceivedCells
from sortie.sim.results import palette
from sortie.sim.results.flown_scene import BOX_HEIGHT_M, CIRCLE, cars_near, houses, inside, jamming, vehicles
from sortie.sim.results.palette import Floats
from sortie.sim.results.sightings import Sighting

TRAIL_S, TRAIL_STEP_S = 10.0, 0.5
GROUND_M = 1.0
PERSON_DRAWN_M = 1.5
"""People and their boxes are drawn this wide, so that they can be seen."""
_RING = np.pad(CIRCLE, ((0, 0), (0, 1)))


class Drawing:
    """Draws the scene of one sortie; `begin` once, then `add` with the tables in order of time."""

    def __init__(self, canvas: Canvas, scenario: Scenario, scene: SceneModel) -> None:
        self._canvas, self._scene, self._n = canvas, scene, scenario.fleet.drones
        self._rate_hz, self._targets = scenario.context.rate_hz, len(scenario.mission.targets)
        self._groups = range(len(scenario.mission.phases_of))
        self._takes_turns = scenario.takes_turns
        self._shown: set[int] = set()
        """The drones that were scored last, where drones take turns: the boxes of others are of an earlier time."""
        self._cameras = cameras_of(scenario.fleet)
        self._stations = {station.drone: station for station in scenario.fleet.ground}
        self._flying = vehicles(scenario.fleet)
        n = self._n
        self._links, self._received = LinkArrows(canvas, n, scenario.context.rate_hz), ReceivedCells(canvas, n)
        self._history: NDArray[np.float64] = np.zeros((0, n, 3))
        self._frames = 0
        self._resting: dict[int, Floats] = {}
        self._discs_shown = dict.fromkeys(self._groups, False)
        self._map = GroundMap(canvas, scenario, scene)
        self._jams = [event for event in scenario.events if isinstance(event, Jammer)]
        self._jamming: list[Jammer] = []
        self._roofs_m = 0.0

    # --- what holds at all times -----------------------------------------------------------------

    def begin(self) -> None:
        """Draw the town and the drones' bodies."""
        canvas = self._canvas
        canvas.static("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._town()
        for i in range(self._n):
            colour = palette.drone_colour(i)
            if i in self._stations:
                _mast(canvas, f"world/drones/{i}", colour, self._stations[i].position_m[2])
            else:
                _drone(canvas, f"world/drones/{i}", colour)
                canvas.static(f"world/trails/{i}", rr.Points3D.from_fields(radii=[-1.6], colors=[colour]))
            if i not in self._stations or self._stations[i].camera:
                ring = rr.LineStrips3D([_RING], colors=[(*colour[:3], 200)], radii=[-1.5])
                canvas.static(f"world/footprints/{i}", ring)
            for name, width in (("found", 2.0), ("missed", 1.5), ("false", 1.5)):
                canvas.static(f"world/seen/{i}/{name}", rr.Boxes3D.from_fields(radii=[-width]))
        canvas.static(
            "world/jammers",
            rr.Points3D.from_fields(radii=[2.0], colors=[palette.JAMMER], labels=["jammer"], show_labels=True),
        )
        self._links.begin()
        self._received.begin()
        canvas.static("world/people", rr.Points3D.from_fields(radii=[PERSON_DRAWN_M / 2], colors=[palette.PEOPLE]))
        canvas.static("world/cars/moving", rr.Boxes3D.from_fields(fill_mode="solid"))
        for group in self._groups:
            disc = rr.LineStrips3D.from_fields(colors=[palette.MISSION], radii=[-2.5])
            canvas.static(f"{_mission_path(group)}/disc", disc)
        for k in range(self._targets):
            label = "target" if self._targets == 1 else f"target {k}"
            pin = rr.Arrows3D(
                vectors=[(0, 0, -12)], origins=[(0, 0, 15)], radii=[0.6], colors=[palette.TARGET], labels=[label]
            )
            canvas.static(f"{_target_path(k)}/pin", pin)

    def _town(self) -> None:
        canvas, (x0, y0, x1, y1) = self._canvas, self._scene.rect
        ground = ground_image(self._scene.rect, self._scene.config.block_m)
        canvas.static(
            "world/town/ground",
            rr.GridMap(
                data=ground[::-1].tobytes(),  # its first row is the north edge
                format=rr.components.ImageFormat(
                    width=ground.shape[1], height=ground.shape[0], color_model="RGB", channel_datatype="U8"
                ),
                cell_size=GROUND_M,
                translation=[x0, y0, 0.0],
            ),
        )
        built = houses(self._scene)
        self._map.begin(ground, built)
        self._roofs_m = float(built[:, 4].max()) if len(built) else 0.0
        if len(built):
            low, high, top = built[:, :2], built[:, 2:4], built[:, 4]
            tone = _mix((150, 112, 98), (186, 184, 180), built[:, 5])
            canvas.static(
                "world/town/buildings",
                rr.Boxes3D(
                    centers=np.column_stack([(low + high) / 2, top / 2]),
                    half_sizes=np.column_stack([(high - low) / 2, top / 2]),
                    colors=tone,
                    fill_mode="solid",
                ),
            )
        trees = np.concatenate([b.trees for b in self._scene.town.blocks(x0, y0, x1, y1)])
        trees = trees[inside(trees[:, :2], self._scene.rect)]
        if len(trees):
            crowns = np.column_stack([trees[:, :2], np.maximum(trees[:, 3] - trees[:, 2], trees[:, 2])])
            tone = _mix((48, 92, 44), (86, 122, 56), trees[:, 4])
            canvas.static("world/town/trees", rr.Points3D(crowns, radii=trees[:, 2], colors=tone))  # spheres, cheaply
        parked = self._scene.parked_cars
        if len(parked):
            canvas.static("world/cars/parked", rr.Boxes3D(**_car_boxes(parked), fill_mode="solid"))

    # --- what changes ----------------------------------------------------------------------------

    def add(self, known_s: float, new: Mapping[str, pa.Table], seen: Iterable[Sighting]) -> None:
        """Draw new rows: `states`, `people`, `mission`, `descriptors`, `directives`, `transmissions`, and the fusions seen."""
        n = self._n
        column = {k: new["states"][k].to_numpy() for k in new["states"].column_names}
        t_s = column["t_s"][::n]
        position = np.column_stack([column[k] for k in ("x_m", "y_m", "z_m")]).reshape(-1, n, 3)
        attitude = np.column_stack([column[k] for k in ("qx", "qy", "qz", "qw")]).reshape(-1, n, 4)
        airborne = column["airborne"].reshape(-1, n)
        self._land(t_s, position, attitude, airborne)
        self._drones(t_s, position, attitude, column["soc"].reshape(-1, n), airborne)
        self._links.add(t_s, position, airborne, new)
        self._received.add(known_s, t_s, position, attitude, new)
        self._cars(t_s, position)
        self._people(new["people"])
        for group in self._groups:
            self._mission(group, new["mission"].filter(pc.equal(new["mission"]["group"], group)))
        self._follow(t_s)
        self._map.add(t_s, position, airborne, new["mission"])
        self._jammers(t_s)
        self._seen(list(seen))

    def _land(self, t_s: Floats, position: Floats, attitude: Floats, airborne: NDArray[np.bool_]) -> None:
        """Put drones that are down on the ground where they came down (the record keeps their height), in place."""
        if not len(t_s):
            return
        for i in self._flying:
            turns = np.flatnonzero(np.diff(airborne[:, i])) + 1
            for begin, end in pairwise([0, *turns.tolist(), len(t_s)]):
                up = bool(airborne[begin, i])
                if up == (i in self._resting):
                    self._turn(i, t_s[begin], position[begin - 1, i] if begin else self._last_position(i, position), up)
                if not up:
                    position[begin:end, i] = self._resting[i]
                    attitude[begin:end, i] = (0.0, 0.0, 0.0, 1.0)

    def _turn(self, drone: int, t_s: float, last: Floats, up: bool) -> None:
        """A drone comes down, or takes off again."""
        if up:
            del self._resting[drone]
        else:
            self._resting[drone] = np.array([last[0], last[1], 0.3])
            nothing = Boxes.empty()
            self._sighting_rows(drone, np.array([t_s]), [nothing], [nothing], [nothing])
        paint = _body_colours(palette.drone_colour(drone)) if up else [palette.FALLEN] * 4
        columns = rr.Boxes3D.columns(colors=paint).partition([4])
        self._canvas.columns(f"world/drones/{drone}/body", np.array([t_s]), columns)

    def _last_position(self, drone: int, position: Floats) -> Floats:
        return np.asarray(self._history[-1, drone] if len(self._history) else position[0, drone])

    def _drones(
        self, t_s: Floats, position: Floats, attitude: Floats, soc: Floats, airborne: NDArray[np.bool_]
    ) -> None:
        canvas, step = self._canvas, max(1, round(TRAIL_STEP_S * self._rate_hz))
        beads = round(TRAIL_S / TRAIL_STEP_S)
        track = np.concatenate([self._history, position])
        base = self._frames - len(self._history)  # the frame that track[0] is
        frames = self._frames + np.arange(len(t_s))
        # Beads stand at whole half seconds, so that they stay where they are while the drone flies on.
        bead_frames = (frames // step)[:, None] * step - step * np.arange(beads)[None, :]
        kept = bead_frames >= 0
        lengths = kept.sum(axis=1)
        second = np.flatnonzero(frames_at(t_s, 1.0) > frames_at(t_s - 1.0 / self._rate_hz, 1.0))
        for i in range(self._n):
            moves = rr.Transform3D.columns(translation=position[:, i], quaternion=attitude[:, i])
            canvas.columns(f"world/drones/{i}", t_s, moves)
            station = self._stations.get(i)
            names = [
                (f"{i} · {s:.0%}" if up else f"{i} · down")
                if station is None
                else f"{i} · {'ground' if station.mains else f'ground {s:.0%}'}{'' if up else ' · off'}"
                for s, up in zip(soc[second, i], airborne[second, i], strict=True)
            ]
            canvas.columns(f"world/drones/{i}/name", t_s[second], rr.Points3D.columns(labels=names))
            radius = np.maximum(1e-3, [footprint_radius_m(z, self._cameras[i]) for z in position[:, i, 2].tolist()])
            centre = np.column_stack([position[:, i, :2], np.full(len(t_s), 0.4)])
            scale = np.column_stack([radius, radius, np.ones(len(t_s))])
            canvas.columns(f"world/footprints/{i}", t_s, rr.Transform3D.columns(translation=centre, scale=scale))
            if station is not None:
                continue
            trail = track[:, i][(bead_frames - base)[kept]]
            canvas.columns(f"world/trails/{i}", t_s, rr.Points3D.columns(positions=trail).partition(lengths))
        middle = position[:, self._flying].mean(axis=1) * (1.0, 1.0, 0.0)
        canvas.columns("world/fleet", t_s, rr.Transform3D.columns(translation=middle))
        self._frames += len(t_s)
        self._history = track[-(step * beads + 1) :]

    def _cars(self, t_s: Floats, position: Floats) -> None:
        near, lengths = [], []
        for t, (x, y) in zip(t_s.tolist(), position[:, self._flying, :2].mean(axis=1).tolist(), strict=True):
            cars = cars_near(self._scene, t, x, y)
            near.append(cars)
            lengths.append(len(cars))
        if near:
            every = Cars(*(np.concatenate([getattr(k, f) for k in near]) for f in Cars.__slots__))
            boxes = rr.Boxes3D.columns(**_car_boxes(every)).partition(lengths)
            self._canvas.columns("world/cars/moving", t_s, boxes)

    def _people(self, people: pa.Table) -> None:
        at_s, lengths = np.unique(people["t_s"].to_numpy(), return_counts=True)
        places = np.column_stack(
            [people["x_m"].to_numpy(), people["y_m"].to_numpy(), np.full(len(people), PERSON_DRAWN_M / 2)]
        )
        self._canvas.columns("world/people", at_s, rr.Points3D.columns(positions=places).partition(lengths))

    def _mission(self, group: int, mission: pa.Table) -> None:
        t_s, path = mission["t_s"].to_numpy(), _mission_path(group)
        x, y, radius = (mission[k].to_numpy() for k in ("region_x_m", "region_y_m", "region_radius_m"))
        there = ~np.isnan(radius)
        before = np.concatenate([[self._discs_shown[group]], there])[: len(there)]
        for k in np.flatnonzero(there != before).tolist():
            ring = self._cage() if there[k] else []
            strips = rr.LineStrips3D.columns(strips=ring).partition([len(ring)])
            self._canvas.columns(f"{path}/disc", t_s[k : k + 1], strips)
        if len(there):
            self._discs_shown[group] = bool(there[-1])
        centre = np.column_stack([x, y, np.full(len(x), 0.6)])[there]
        scale = np.column_stack([radius, radius, np.ones(len(x))])[there]
        self._canvas.columns(path, t_s[there], rr.Transform3D.columns(translation=centre, scale=scale))

    def _cage(self) -> list[Floats]:
        """A region of radius 1: a ring on the ground and one over the roofs, which no house hides, on posts."""
        over = _RING + np.array((0.0, 0.0, self._roofs_m + 1.0))
        posts = [np.stack([_RING[k], over[k]]) for k in range(0, len(_RING) - 1, 6)]
        return [_RING, over, *posts]

    def _jammers(self, t_s: Floats) -> None:
        """Show the jammers that are on, from the frame in which one begins or ends."""
        for t in t_s.tolist():
            on = jamming(self._jams, t)
            if on != self._jamming:
                self._jamming = on
                places = np.array([jam.position_m for jam in on]).reshape(-1, 3)
                columns = rr.Points3D.columns(positions=places).partition([len(on)])
                self._canvas.columns("world/jammers", np.array([t]), columns)
                self._map.jammers(t, places[:, :2])

    def _follow(self, t_s: Floats) -> None:
        """The pins over the targets."""
        for k, path in enumerate(self._scene.targets):
            xyz = [(*path.pose(t)[:2], 0.0) for t in t_s.tolist()]
            self._canvas.columns(_target_path(k), t_s, rr.Transform3D.columns(translation=np.reshape(xyz, (-1, 3))))

    def _seen(self, seen: list[Sighting]) -> None:
        if self._takes_turns:
            for now_s in dict.fromkeys(s.t_s for s in seen):
                scored, nothing = {s.drone for s in seen if s.t_s == now_s}, [Boxes.empty()]
                for drone in self._shown - scored:
                    self._sighting_rows(drone, np.array([now_s]), nothing, nothing, nothing)
                self._shown = scored
        for i in sorted({s.drone for s in seen}):
            own = [s for s in seen if s.drone == i]
            t_s = np.array([s.t_s for s in own])
            self._sighting_rows(i, t_s, [s.hits for s in own], [s.missed for s in own], [s.false for s in own])

    def _sighting_rows(
        self, drone: int, t_s: Floats, found: list[Boxes], missed: list[Boxes], false: list[Boxes]
    ) -> None:
        """Send boxes of these times, a list of them each; the less sure the drone was, the darker."""
        for name, several, colour in (
            ("found", found, palette.FOUND),
            ("missed", missed, palette.MISSED),
            ("false", false, palette.FALSE),
        ):
            boxes = Boxes.join(several)
            light = 0.25 + 0.75 * np.clip(boxes.score, 0.0, 1.0)[:, None]
            shades = np.column_stack([light * colour[boxes.kind], np.full(len(boxes), 255)]).astype(np.uint8)
            columns = rr.Boxes3D.columns(**_flat_boxes(boxes), colors=c.packed(shades))
            self._canvas.columns(f"world/seen/{drone}/{name}", t_s, columns.partition([len(b) for b in several]))


# --- shapes ----------------------------------------------------------------------------------------


def ground_image(rect: tuple[float, float, float, float], block_m: float) -> NDArray[np.uint8]:
    """Roads, kerbs, pavements and lots [row = y, column = x, 3] at 1 m; its first row is the south edge."""
    x0, y0, x1, y1 = rect
    x = x0 + GROUND_M * (np.arange(int((x1 - x0) / GROUND_M)) + 0.5)
    y = y0 + GROUND_M * (np.arange(int((y1 - y0) / GROUND_M)) + 0.5)
    across_x, across_y = (np.abs((v / block_m + 0.5) % 1.0 - 0.5) * block_m for v in (x, y))
    near = np.minimum(across_x[None, :], across_y[:, None])
    image = np.empty((len(y), len(x), 3), np.uint8)
    image[...] = (70, 84, 58)
    image[near < PAVEMENT_M] = (104, 102, 98)
    image[near < KERB_M] = (64, 64, 67)
    image[near < LANE_M] = (54, 54, 58)
    return image


def _body_colours(colour: palette.Rgba) -> list[palette.Rgba]:
    return [(230, 230, 235, 255), (230, 230, 235, 255), colour, (255, 255, 255, 255)]


def _drone(canvas: Canvas, path: str, colour: palette.Rgba) -> None:
    """A quadrotor: nose, body and two crossed arms, four rotors."""
    arm = SPAN_M / 2 * np.sqrt(0.5)
    diagonal = [(0.0, 0.0, np.sin(a / 2), np.cos(a / 2)) for a in (np.pi / 4, -np.pi / 4)]
    level = (0.0, 0.0, 0.0, 1.0)
    canvas.static(
        f"{path}/body",
        rr.Boxes3D(
            centers=[(0, 0, 0), (0, 0, 0), (0, 0, 0.1), (1.1, 0, 0.1)],
            half_sizes=[(SPAN_M / 2, 0.18, 0.12), (SPAN_M / 2, 0.18, 0.12), (0.9, 0.6, 0.45), (0.5, 0.25, 0.2)],
            quaternions=[*diagonal, level, level],
            fill_mode="solid",
        ),
    )
    # Not static, because a drone that comes down goes grey; a static colour would win over that.
    canvas.columns(f"{path}/body", np.zeros(1), rr.Boxes3D.columns(colors=_body_colours(colour)).partition([4]))
    rotors = rr.Cylinders3D(
        lengths=[0.12] * 4,
        radii=[1.05] * 4,
        centers=[(x, y, 0.35) for x in (arm, -arm) for y in (arm, -arm)],
        colors=[(*colour[:3], 255)] * 4,
        fill_mode="solid",
    )
    canvas.static(f"{path}/rotors", rotors)
    canvas.static(f"{path}/name", rr.Points3D([(0, 0, 5.0)], radii=[0.01], colors=[colour], show_labels=True))


def _mast(canvas: Canvas, path: str, colour: palette.Rgba, height_m: float) -> None:
    """A ground station: a mast from the ground to its antenna, and a ball where the antenna is."""
    mast = rr.Cylinders3D(
        lengths=[max(height_m, 0.1)],
        radii=[0.25],
        centers=[(0, 0, -height_m / 2)],
        colors=[(150, 150, 155, 255)],
        fill_mode="solid",
    )
    canvas.static(f"{path}/mast", mast)
    canvas.static(f"{path}/antenna", rr.Points3D([(0, 0, 0)], radii=[1.2], colors=[colour]))
    canvas.static(f"{path}/name", rr.Points3D([(0, 0, 5.0)], radii=[0.01], colors=[colour], show_labels=True))


def _car_boxes(cars: Cars) -> dict[str, Any]:
    half = np.column_stack([cars.length_m, cars.width_m, cars.height_m]) / 2
    return {
        "centers": np.column_stack([cars.x_m, cars.y_m, half[:, 2]]),
        "half_sizes": half,
        "quaternions": c.about_z(cars.yaw_rad),
        "colors": c.packed(np.column_stack([cars.colour, np.full(len(cars), 255, np.uint8)])),
    }


def _mission_path(group: int) -> str:
    return f"world/mission/{group}" if group else "world/mission"


def _target_path(k: int) -> str:
    return f"world/target/{k}" if k else "world/target"


def _flat_boxes(boxes: Boxes) -> dict[str, Any]:
    size = np.where((boxes.kind == PERSON)[:, None], PERSON_DRAWN_M, boxes.size_m)
    half = np.column_stack([size / 2, np.full(len(boxes), BOX_HEIGHT_M / 2)])
    return {
        "centers": np.column_stack([boxes.xy_m, half[:, 2]]),
        "half_sizes": half,
        "quaternions": c.about_z(boxes.yaw_rad),
    }


def _mix(a: tuple[int, int, int], b: tuple[int, int, int], part: Floats) -> NDArray[np.uint8]:
    return (np.array(a) * (1 - part[:, None]) + np.array(b) * part[:, None]).astype(np.uint8)
