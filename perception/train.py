"""Train the detector: `sortie train`, or `python -m perception.train`.

Scenes are drawn and rendered once (`frames.py`), then encoder, edge network and head learn together under
full sharing; a third of the supervised outputs are single-drone, so that the head works without peers.
Every batch follows from (seed, step), checkpoints are safetensors written under a temporary name, and a
run that was cut off goes on from its last checkpoint to the same end.
"""

from __future__ import annotations

import copy
import csv
import json
import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from perception.ap import Difference, Matched, compare, match, suppress
from perception.frames import DRONES, TRAIN_SEED, VALIDATION_SEED, Frames, load_frames, make_frames
from perception.learn import EGOS, SHARD_FRAMES, SHARDS, apply, draw_batch, gradients, local_cars
from perception.model import CarNet, decode, load_weights, save_weights, warp
from perception.types import Boxes
from scenarios.streams import stream

PER_SCENE = 12
SCORE_THRESHOLD, NMS_IOU = 0.1, 0.15
PEAK_LR = 2.5e-3

log_to_nowhere = logging.getLogger("sortie.train")


@dataclass(frozen=True, slots=True)
class TrainResult:
    """Where the weights are and what they reach on held-out scenes: AP@0.5 of a single drone (a) and of full sharing (b)."""

    weights: Path
    steps: int
    loss: float
    validation: Difference
    frames: int
    minutes: float


# --- validation -----------------------------------------------------------------------------------


@torch.inference_mode()
def validate(
    net: CarNet, frames: Frames, device: torch.device, egos: int = DRONES
) -> tuple[list[Matched], list[Matched], list[int]]:
    """Matches of each ego of each frame alone and with full sharing, in the world frame by estimated poses, and the frames' scenes."""
    net = net.eval()
    single: list[Matched] = []
    full: list[Matched] = []
    scenes: list[int] = []
    everywhere = torch.ones(DRONES - 1, 1, 64, 64, dtype=torch.bool, device=device)
    ones = torch.ones(DRONES - 1, device=device)
    for f in range(len(frames.images)):
        features = net.encoder(torch.from_numpy(frames.images[f]).to(device))
        est = torch.from_numpy(frames.est_pose[f]).float().to(device)
        for ego in range(egos):
            peers = [i for i in range(DRONES) if i != ego]
            warped, sent, inside = warp(features[peers], everywhere, est[ego], est[peers])
            fused = net.fuse(features[ego : ego + 1], warped, sent, inside, ones, "masked")
            out = net.head(torch.cat([features[ego : ego + 1], fused])).cpu()
            truth = local_cars(frames.cars[f], frames.true_pose[f, ego])
            local = np.concatenate([truth, np.ones((len(truth), 1))], axis=1)
            world = Boxes.placed(local, tuple(frames.true_pose[f, ego]))
            for one, into in zip(out, (single, full), strict=True):
                found = Boxes.placed(decode(one, SCORE_THRESHOLD).numpy(), tuple(frames.est_pose[f, ego]))
                into.append(match(suppress(found, NMS_IOU), world))
            scenes.append(int(frames.scene[f]))
    return single, full, scenes


# --- the run --------------------------------------------------------------------------------------


def learning_rate(step: int, steps: int) -> float:
    """One cycle: up over the first tenth, then down a cosine to 1 % of the peak."""
    warm = max(1, steps // 10)
    if step < warm:
        return PEAK_LR * (0.1 + 0.9 * step / warm)
    return float(PEAK_LR * (0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * (step - warm) / max(1, steps - warm)))))


def train(
    out: Path,
    *,
    frames: int = 1800,
    steps: int = 1200,
    seed: int = 0,
    minutes: float | None = None,
    resume: bool = True,
    warm_start: Path | None = None,
    work: Path = Path("runs/train"),
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    log: logging.Logger = log_to_nowhere,
) -> TrainResult:
    """Train and validate; write the weights to `out` and their card beside them.

    Args:
        out: the safetensors file to write.
        frames: training fleet-frames (rounded up to whole scenes of 12).
        steps: optimiser steps of 4 frames.
        minutes: stop training after this long, validate and write what there is; the checkpoint stays.
        resume: go on from the checkpoint in `work`, if it belongs to the same seed, frames and steps.
        warm_start: begin from these weights instead of from nothing.
        work: where rendered frames, checkpoint and loss curve are kept.
        device: "cpu" or "cuda"; left out, cuda where there is one.
        progress: called with (stage, done, of).

    Raises:
        ValueError: for a step or frame count below 1, or weights that do not fit.
    """
    for name, value in (("frames", frames), ("steps", steps)):
        if value < 1:
            raise ValueError(f"{name} is {value}, must be at least 1")
    begun = time.monotonic()
    tell = progress or (lambda stage, done, of: None)
    where = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    scenes = -(-frames // PER_SCENE)
    files = make_frames(work / "frames", TRAIN_SEED, scenes, PER_SCENE, lambda i, n: tell("rendering scenes", i, n))
    held_out = make_frames(
        work / "frames", VALIDATION_SEED, 12, 6, lambda i, n: tell("rendering validation scenes", i, n)
    )
    data = load_frames(files)
    log.info("%d training frames in %d scenes", len(data.images), scenes)

    torch.manual_seed(seed)
    net = (CarNet() if warm_start is None else load_weights(warm_start)).to(where).train()
    optimiser = torch.optim.AdamW(net.parameters(), lr=PEAK_LR, weight_decay=1e-3)
    run = {"seed": seed, "frames": scenes * PER_SCENE, "steps": steps, "warm_start": str(warm_start or "")}
    checkpoint = work / "checkpoint.safetensors"
    first, spent = _restore(checkpoint, run, net, optimiser, log) if resume else (0, 0.0)
    curve = work / "loss.csv"
    if first == 0:
        curve.write_text("step,loss,lr\n")
    replicas = [copy.deepcopy(net) for _ in range(SHARDS)]
    pool = ThreadPoolExecutor(SHARDS)
    recent: list[float] = []
    loss, done = float("nan"), first
    for step in range(first, steps):
        rate = learning_rate(step, steps)
        for group in optimiser.param_groups:
            group["lr"] = rate
        jobs = [
            pool.submit(gradients, r, draw_batch(data, seed, step, i), stream(seed, 0, (step, i), "train.egos"), where)
            for i, r in enumerate(replicas)
        ]
        values, grads = zip(*(job.result() for job in jobs), strict=True)
        apply(net, replicas, list(grads), optimiser)
        done = step + 1
        recent = [*recent[-49:], float(np.mean(values))]
        loss = float(np.mean(recent))
        if done % 10 == 0:
            with curve.open("a", newline="") as file:
                csv.writer(file).writerow([done, f"{loss:.4f}", f"{rate:.3g}"])
            tell("training", done, steps)
            log.info("step %d of %d, loss %.4f", done, steps, loss)
        late = minutes is not None and time.monotonic() - begun > 60 * minutes
        if done % 100 == 0 or done == steps or late:
            _save(checkpoint, {**run, "step": done, "spent_s": spent + time.monotonic() - begun}, net, optimiser)
        if late:
            log.info("stopped after %.1f minutes at step %d of %d", minutes, done, steps)
            break
    pool.shutdown()
    spent += time.monotonic() - begun

    tell("validating", 0, 1)
    held = load_frames(held_out)
    single, full, groups = validate(net, held, where)
    difference = compare(single, full, groups)
    tell("validating", 1, 1)
    facts = {**run, "step": done, "loss": round(loss, 4), "validation_frames": len(held.images), **asdict(difference)}
    save_weights(net.cpu(), out, {"sortie": json.dumps(facts)})
    result = TrainResult(out, done, loss, difference, len(data.images), spent / 60)
    _write_card(out.with_name("README.md"), result, run)
    log.info("AP@0.5 single %.3f, full %.3f", difference.ap_a, difference.ap_b)
    return result


def _save(path: Path, facts: dict[str, Any], net: CarNet, optimiser: torch.optim.Optimizer) -> None:
    from safetensors.torch import save_file

    tensors = {f"net.{k}": v.detach().cpu().contiguous() for k, v in net.state_dict().items()}
    for i, parameter in enumerate(net.parameters()):
        for key, value in optimiser.state[parameter].items():
            tensors[f"adam.{i}.{key}"] = torch.as_tensor(value).detach().cpu().contiguous()
    part = path.with_name(path.name + ".part")
    save_file(tensors, part, metadata={"sortie": json.dumps(facts)})
    part.replace(path)


def _restore(
    path: Path, run: dict[str, Any], net: CarNet, optimiser: torch.optim.Optimizer, log: logging.Logger
) -> tuple[int, float]:
    """Load a checkpoint of the same run; (0, 0.0) when there is none or it belongs to another."""
    from safetensors import safe_open

    if not path.is_file():
        return 0, 0.0
    with safe_open(path, framework="pt") as file:
        facts = json.loads(file.metadata()["sortie"])
        if any(facts.get(k) != v for k, v in run.items()):
            log.info("%s belongs to another run (%s); starting anew", path, facts)
            return 0, 0.0
        tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118 (not a mapping)
    net.load_state_dict({k[4:]: v for k, v in tensors.items() if k.startswith("net.")})
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("adam."):
            _, index, key = name.split(".", 2)
            state.setdefault(int(index), {})[key] = value
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
    log.info("resuming at step %d", facts["step"])
    return int(facts["step"]), float(facts["spent_s"])


def _write_card(path: Path, result: TrainResult, run: dict[str, Any]) -> None:
    v = result.validation
    command = f"sortie train --frames {run['frames']} --steps {run['steps']} --seed {run['seed']}"
    card = f"""# disconet.safetensors

The shipped detector: encoder, DiscoNet-style edge network and centre head of `perception/model.py`, float32.

| | |
|---|---|
| made by | `{command}` |
| warm start | {run["warm_start"] or "none"} |
| data | {result.frames} fleet-frames of five drones in {result.frames // PER_SCENE} procedural towns (scene seeds from {TRAIN_SEED}), drawn and rendered by `perception/frames.py`; no outside data |
| steps | {result.steps} of {run["steps"]}, {SHARDS * SHARD_FRAMES} frames each, AdamW, one cycle, peak {PEAK_LR} |
| supervised outputs | per frame {EGOS} drones that fuse all others present (two to five) and one that is alone, so a third are single-drone |
| final loss | {result.loss:.3f} (mean of the last 50 steps) |
| time | {result.minutes:.0f} min on two CPU cores or as told by the log |
| AP@0.5, single drone | {v.ap_a:.3f} |
| AP@0.5, full sharing | {v.ap_b:.3f} |
| cooperation, paired 95 % interval over scenes | {v.delta:+.3f} [{v.low:+.3f}, {v.high:+.3f}] |

Validation: 72 fleet-frames × 5 egos in 12 towns with other seeds (from {VALIDATION_SEED}), score threshold {SCORE_THRESHOLD}, rotated
NMS at IoU {NMS_IOU}, boxes put into the world by the *estimated* pose (σ 0.2 m and 0.5°), every car inside the ego's ±102.4 m
square counted, seen by anyone or not. The interval resamples whole scenes.

Made for: five drones 14–28 m apart, 54–66 m up, headings within a few degrees of each other, banks of a few degrees, the towns
of this generator. Not made for: other altitudes, peers that look another way, real images. Trained with full sharing only: no
cells were dropped and no link had a weight.
"""
    part = path.with_name(path.name + ".part")
    part.write_text(card)
    part.replace(path)


if __name__ == "__main__":
    import argparse

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "weights" / "disconet.safetensors")
    parser.add_argument("--work", type=Path, default=Path("runs/train"))
    parser.add_argument("--frames", type=int, default=1800)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--warm-start", type=Path)
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    train(
        args.out, frames=args.frames, steps=args.steps, seed=args.seed, minutes=args.minutes, work=args.work,
        warm_start=args.warm_start, log=logging.getLogger("sortie.train"),
    )  # fmt: skip
