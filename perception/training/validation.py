"""What weights are worth on held-out towns, and the card that says so: `python -m perception.training.validation WEIGHTS FRAMES`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from perception.ap import Matched, match, suppress
from perception.checkpoint import load_weights, read_facts, save_weights
from perception.decode import decode
from perception.frames import (
    DRONES,
    HEADING_ERROR_DEG,
    PER_SCENE,
    POSE_ERROR_M,
    TRAIN_SEED,
    VALIDATION_SEED,
    Frames,
    load_frames,
)
from perception.fusion.base import takes_part
from perception.harness.statistics import Difference, compare
from perception.model import CarNet
from perception.training.learn import EGOS, SHARD_FRAMES, SHARDS, local_cars
from perception.types import Boxes
from perception.warp import warp

SCORE_THRESHOLD, NMS_IOU = 0.1, 0.15
LEVELS = ((1.0, 1.0), (1.0, 0.4), (0.0, 0.0))
"""Pose errors, as factors of the usual σ of position and heading."""


@dataclass(frozen=True, slots=True)
class Level:
    """AP@0.5 of a drone alone (a) and with all five (b) under pose errors of these standard deviations."""

    position_sigma_m: float
    heading_sigma_deg: float
    gain: Difference


def with_errors(frames: Frames, position: float, heading: float) -> Frames:
    """The same frames with their position and heading errors multiplied."""
    factor = np.array([position, position, heading])
    return replace(frames, est_pose=frames.true_pose + factor * (frames.est_pose - frames.true_pose))


@torch.inference_mode()
def validate(
    net: CarNet, frames: Frames, device: torch.device, egos: int = DRONES
) -> tuple[list[Matched], list[Matched], list[int]]:
    """Matches of each ego of each frame alone and with full sharing, and the frames' scenes.

    Boxes are put into the world by the estimated pose; every car inside the ego's true ±102.4 m square counts.
    """
    net = net.eval()
    single: list[Matched] = []
    full: list[Matched] = []
    scenes: list[int] = []
    everywhere = torch.ones(DRONES - 1, 1, 64, 64, dtype=torch.bool, device=device)
    ones = torch.ones(DRONES, device=device)
    geometry = net.config.geometry
    for f in range(len(frames.images)):
        features = net.encoder(torch.from_numpy(frames.images[f]).to(device))
        est = torch.from_numpy(frames.est_pose[f]).float().to(device)
        for ego in range(egos):
            peers = [i for i in range(DRONES) if i != ego]
            warped, sent, inside = warp(features[peers], everywhere, est[ego], est[peers], geometry.cell_m)
            part = takes_part(sent[None, :, 0], inside[None, :, 0], ones[None, 1:], "masked")
            fused = net.fusion(torch.cat([features[ego : ego + 1], warped])[None], part, ones[None])
            out = net.head(torch.cat([features[ego : ego + 1], fused])).cpu()
            truth = local_cars(frames.cars[f], frames.true_pose[f, ego], geometry)
            local = np.concatenate([truth, np.ones((len(truth), 1))], axis=1)
            world = Boxes.placed(local, tuple(frames.true_pose[f, ego]))
            for one, into in zip(out, (single, full), strict=True):
                found = Boxes.placed(decode(one, SCORE_THRESHOLD, geometry).numpy(), tuple(frames.est_pose[f, ego]))
                into.append(match(suppress(found, NMS_IOU), world))
            scenes.append(int(frames.scene[f]))
    return single, full, scenes


def validate_all(
    net: CarNet, frames: Frames, device: torch.device, progress: Callable[[int, int], None] | None = None
) -> list[Level]:
    """`validate` at every level of pose error, the usual one first; intervals by whole scenes."""
    out = []
    for k, (position, heading) in enumerate(LEVELS):
        single, full, scenes = validate(net, with_errors(frames, position, heading), device)
        out.append(Level(position * POSE_ERROR_M, heading * HEADING_ERROR_DEG, compare(single, full, scenes)))
        if progress is not None:
            progress(k + 1, len(LEVELS))
    return out


def history(weights: Path | None) -> list[dict[str, Any]]:
    """The training runs that the weights say they come from; none for None."""
    if weights is None:
        return []
    runs: list[dict[str, Any]] = read_facts(weights).get("runs", [])
    return runs


def publish(net: CarNet, path: Path, runs: list[dict[str, Any]], levels: list[Level]) -> None:
    """Write the weights with their history, and the card beside them."""
    facts = {"runs": runs, "validation": [asdict(level) for level in levels]}
    save_weights(net, path, facts)
    part = path.with_name("README.md.part")
    part.write_text(card(path.name, runs, levels))
    part.replace(path.with_name("README.md"))


def card(name: str, runs: list[dict[str, Any]], levels: list[Level]) -> str:
    """The model card, Markdown."""

    def command(r: dict[str, Any]) -> str:
        warm = f" --warm-start {r['warm_start']}" if r["warm_start"] else ""
        return f"python -m perception.training.train --frames {r['frames']} --steps {r['steps']} --seed {r['seed']} --peak-lr {r['peak_lr']:g}{warm}"

    made = "\n".join(
        f"| {k} | `{command(r)}` | {r['done']} | {r['loss']:.3f} | {r['minutes']:.0f} |" for k, r in enumerate(runs, 1)
    )
    accuracy = "\n".join(
        f"| {v.position_sigma_m:g} m, {v.heading_sigma_deg:g}° | {v.gain.ap_a:.3f} | {v.gain.ap_b:.3f} "
        f"| {v.gain.delta:+.3f} [{v.gain.low:+.3f}, {v.gain.high:+.3f}] |"
        for v in levels
    )
    frames = runs[-1]["frames"] if runs else 0
    return f"""# {name}

The detector's weights: encoder, DiscoNet-style edge network and centre head of `perception/model.py`, float32.

| run | made by | steps done | loss, mean of the last 50 | minutes on two shared cores |
|---|---|---|---|---|
{made}

`sortie train` runs the same. **Data**: {frames} fleet-frames of five drones in {frames // PER_SCENE} procedural towns (scene seeds from
{TRAIN_SEED}), drawn and rendered by `perception/frames.py`; no outside data. **Learning**: {SHARDS * SHARD_FRAMES} frames a step, AdamW, one cycle; mirrored and
turned by quarters. In each frame {EGOS} drones fuse everyone present (two to five) and one is alone, so a third of the supervised
outputs are single-drone: the head works without peers.

| pose error σ (position, heading) | AP@0.5 alone | AP@0.5, all five | cooperation, paired 95 % interval by towns |
|---|---|---|---|
{accuracy}

Held out: fleet-frames in 12 towns of other seeds (from {VALIDATION_SEED}), every drone an ego; score threshold {SCORE_THRESHOLD}, rotated NMS at IoU
{NMS_IOU}. Boxes stand in the world by the drone's *estimated* pose, so its heading error moves every far box: 0.5° is 0.7 m at 80 m,
and a car is 1.85 m wide. Every car inside the ego's ±102.4 m square counts, whether anyone can see it or not.

**Made for** five drones 14–28 m apart, 54–66 m up, headings within a few degrees of each other, banks of a few degrees, towns of
this generator. **Not made for** other altitudes, peers that look another way, real images. Trained with full sharing only: no
cells were dropped and no link had a weight, so what a starved budget does is a property of the fusion, not of the training.
"""


if __name__ == "__main__":
    import argparse

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("weights", type=Path)
    parser.add_argument("frames", type=Path, help="the folder of rendered frames of `sortie train`")
    args = parser.parse_args()
    held_out = load_frames(sorted(args.frames.glob(f"scene_{str(VALIDATION_SEED)[:-3]}*.npz")))
    net = load_weights(args.weights)
    publish(net, args.weights, history(args.weights), validate_all(net, held_out, torch.device("cpu")))
