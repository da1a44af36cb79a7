"""What the shipped networks and their surrogates make of trucks, which none of them was trained on.

make figures FIGURE=trucks     # two minutes; `perception/README.md` has the table
"""

from __future__ import annotations

import numpy as np

from research.validation.stored import Column, Table
from sortie.perception.classes import TRUCK_FROM_M
from sortie.perception.detectors import make_detector
from sortie.perception.metrics.overlap import overlapping
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture
from sortie.scenarios.schema import Perception, Scene

TOWNS, DRONES, HEIGHT_M, NEAR_M = 12, 5, 60.0, 50.0
NETWORKS = {"coarse": "disconet.safetensors", "fine": "fine.safetensors"}
Answer = tuple[Boxes, Boxes, Capture]
"""A drone's boxes, the vehicles in its range, and its capture."""


def fleets() -> list[tuple[SceneModel, list[Capture]]]:
    """Towns in which three moving vehicles in ten are trucks, each under five drones in a line."""
    made = []
    for town in range(TOWNS):
        scene = SceneModel(Scene(seed=7_000 + town, trucks=0.3), None, (-150, -150, 150, 150))
        places = [(25.0 * (d - 2), 0.0, HEIGHT_M) for d in range(DRONES)]
        made.append((scene, [Capture(d, 5.0, at, (0.0, 0.0, 0.0, 1.0), at, 0.0) for d, at in enumerate(places)]))
    return made


def answers(detector: str, weights: str) -> list[Answer]:
    """What every drone finds by itself."""
    config = Perception(detector=detector, weights=weights)
    made: list[Answer] = []
    for scene, fleet in fleets():
        finds = make_detector(scene, config, 1)
        assert finds is not None
        found = finds.detect([(ego, []) for ego in fleet])
        made += [(b, finds.truth(ego.t_s, ego), ego) for b, ego in zip(found, fleet, strict=True)]
    return made


def row(found: list[Answer]) -> list[int | float]:
    """Trucks in range; shares found near and far; lengths of their boxes, 1st and 99th percentile; share that overlap by half.

    A truck is found where a box's middle lies less than half a truck's length from its own.
    """
    near, length_m, covered = [], [], []
    hit: list[bool] = []
    for boxes, truth, ego in found:
        for k in np.flatnonzero(truth.size_m[:, 0] >= TRUCK_FROM_M):
            truck = truth.take(np.array([k]))
            off_m = np.hypot(*(boxes.xy_m - truck.xy_m[0]).T)
            near.append(np.hypot(*(truck.xy_m[0] - ego.position_m[:2])) <= NEAR_M)
            hit.append(len(off_m) > 0 and off_m.min() < truck.size_m[0, 0] / 2)
            box = boxes.take(np.array([off_m.argmin()]) if hit[-1] else slice(0))
            length_m += box.size_m[:, 0].tolist()
            covered.append((overlapping(box.table(), truck.table())[2] >= 0.5).any())
    close, seen = np.array(near), np.array(hit)
    low_m, high_m = np.percentile(length_m, [1, 99])
    return [len(hit), seen[close].mean(), seen[~close].mean(), float(low_m), float(high_m), float(np.mean(covered))]


def table() -> Table:
    """A row for each network and detector."""
    columns = [
        Column("network"), Column("detector"), Column("trucks in range"),
        Column(f"found within {NEAR_M:g} m", ".0f", " %", 100), Column("found beyond", ".0f", " %", 100),
        Column("length of these boxes, from", ".1f", " m"), Column("to", ".1f", " m"),
        Column("overlap the truck by half", ".0f", " %", 100),
    ]  # fmt: skip
    rows = [
        [name, detector, *row(answers(detector, weights))]
        for name, weights in NETWORKS.items()
        for detector in ("torch", "surrogate")
    ]
    about = f"{TOWNS} towns, {DRONES} drones in a line at {HEIGHT_M:g} m, each by itself; lengths from the 1st to the 99th percentile."
    return Table(columns, rows, about)
