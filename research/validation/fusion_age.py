"""What age costs, and what moving late features by the known ego motion gives back (`make figures FIGURE=fusion_age`).

Five drones fly straight at a given speed. Each ego has its own features of now and its peers' of `age` ago, all cells;
they are placed by the pose that the peer had then (compensated), or by the one it has now, as if they were fresh
(ignored). What has driven on in the meantime lags either way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from research.benchmark.dataset import Benchmark
from research.benchmark.difficulty import Split
from research.benchmark.scenes import AREA_M, DRONES, draw_captures, draw_scene
from research.validation.stored import Column, Table, points
from sortie.perception.geometry import CELLS
from sortie.perception.ground_truth import ground_truth
from sortie.perception.metrics.ap import Matched, match, suppress
from sortie.perception.metrics.bootstrap import Difference, compare
from sortie.perception.network.bev import lift
from sortie.perception.network.decode import decode
from sortie.perception.network.fused import Peer, fused_map
from sortie.perception.network.inference import folded
from sortie.perception.network.model import CarNet
from sortie.perception.scene.render import Renderer
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture

AGES_S = (0.0, 0.1, 0.2, 0.5, 1.0)
SPEED_MPS = 10.0
SCORE_THRESHOLD, NMS_IOU = 0.1, 0.15


@dataclass(frozen=True, slots=True)
class AgeRow:
    """AP@0.5 of five egos with peers' features of one age; intervals are paired, by whole scenes."""

    age_s: float
    gain: Difference
    """Age ignored (a) and compensated (b)."""
    lost: Difference
    """Fresh (a) and compensated (b)."""
    over_single: Difference
    """A drone alone (a) and compensated (b)."""


def earlier(capture: Capture, age_s: float, speed_mps: float = SPEED_MPS) -> Capture:
    """Where the drone was `age_s` before, had it flown straight ahead; the error of its estimate is the same."""
    back = age_s * speed_mps
    dx, dy = back * np.cos(capture.true_yaw_rad), back * np.sin(capture.true_yaw_rad)

    def moved(xyz: tuple[float, float, float]) -> tuple[float, float, float]:
        return float(xyz[0] - dx), float(xyz[1] - dy), xyz[2]

    return capture._replace(
        t_s=capture.t_s - age_s, position_m=moved(capture.position_m), est_position_m=moved(capture.est_position_m)
    )


def measure(
    net: CarNet,
    *,
    bench: Benchmark = Benchmark(),  # noqa: B008 (frozen)
    split: Split = "test",
    scenes: int = 12,
    frames: int = 4,
    ages_s: Sequence[float] = AGES_S,
    speed_mps: float = SPEED_MPS,
    progress: Callable[[int, int], None] | None = None,
) -> list[AgeRow]:
    """One row an age, from `scenes` × `frames` fleet-frames rendered now and at every age.

    Raises:
        ValueError: an age below 0, or ages that do not begin with 0.
    """
    if not len(ages_s) or ages_s[0] != 0.0 or min(ages_s) < 0.0:
        raise ValueError(f"ages_s is {tuple(ages_s)}, must begin with 0 and hold no negative age")
    net = folded(net)
    units: dict[tuple[str, float], list[Matched]] = {}
    scene_of: list[int] = []
    for index in range(scenes):
        # a margin for where the fleet comes from
        reach = AREA_M + speed_mps * max(ages_s)
        scene = SceneModel(draw_scene(bench.seed, split, index, bench.difficulty), None, (-reach, -reach, reach, reach))
        renderer = Renderer(scene, bench.seed)
        for frame in range(frames):
            fleet = draw_captures(bench.seed, split, index, frame, bench.difficulty)
            for key, boxes in _frame(net, renderer, fleet, ages_s, speed_mps).items():
                truths = (ground_truth(scene.cars_at(e.t_s).table(), e.true_pose, net.config.half_extent_m).single() for e in fleet)  # fmt: skip
                units.setdefault(key, []).extend(match(b, t) for b, t in zip(boxes, truths, strict=True))
            scene_of += [index] * DRONES
            if progress is not None:
                progress(index * frames + frame + 1, scenes * frames)
    fresh, single = units["compensated", 0.0], units["single", 0.0]
    return [
        AgeRow(
            age,
            compare(units["ignored", age], units["compensated", age], scene_of),
            compare(fresh, units["compensated", age], scene_of),
            compare(single, units["compensated", age], scene_of),
        )
        for age in ages_s
    ]


@torch.inference_mode()
def _frame(
    net: CarNet, renderer: Renderer, fleet: Sequence[Capture], ages_s: Sequence[float], speed_mps: float
) -> dict[tuple[str, float], list[Boxes]]:
    """Boxes of every ego alone and, for each age, with its peers' features placed in the two ways."""
    geometry = net.config.geometry

    def boxes(fused: torch.Tensor | None, ego: int) -> Boxes:
        assert fused is not None
        local = decode(net.head(fused)[0], SCORE_THRESHOLD, geometry).numpy()
        return suppress(Boxes.placed(local, fleet[ego].est_pose), NMS_IOU)

    own = torch.empty(0)
    everywhere = torch.ones(CELLS, CELLS, dtype=torch.bool)
    out: dict[tuple[str, float], list[Boxes]] = {}
    for age in ages_s:
        then = [earlier(c, age, speed_mps) for c in fleet]
        maps = net.spread(net.encoder(lift(renderer.render(then), then, geometry)))
        if age == 0.0:
            own = maps
            out["single", age] = [boxes(own[ego : ego + 1], ego) for ego in range(DRONES)]
        for how, at in (("compensated", then), ("ignored", fleet)):
            if how == "ignored" and age == 0.0:
                out[how, age] = out["compensated", age]
                continue
            peers = [Peer(c.est_pose, 1.0, map_, everywhere) for c, map_ in zip(at, maps, strict=True)]
            out[how, age] = [
                boxes(fused_map(net, c.est_pose, own[i], peers[:i] + peers[i + 1 :], "masked"), i)
                for i, c in enumerate(fleet)
            ]
    return out


def table(rows: Sequence[AgeRow], about: str = "") -> Table:
    """A row an age; differences of AP."""
    return Table(
        [
            Column("age", "g", " s"),
            Column("age ignored", ".3f"),
            Column("compensated", ".3f"),
            Column("gain of compensation", "+.3f"),
            Column("compensated − fresh", "+.3f"),
            Column("compensated − single", "+.3f"),
        ],
        [[r.age_s, r.gain.ap_a, r.gain.ap_b, points(r.gain), points(r.lost), points(r.over_single)] for r in rows],
        about,
    )
