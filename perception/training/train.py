"""Train the detector: `sortie train`, or `python -m perception.training.train`.

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from perception.checkpoint import load_weights
from perception.frames import PER_SCENE, TRAIN_SEED, VALIDATION_SEED, load_frames, make_frames
from perception.harness.statistics import Difference
from perception.model import CarNet
from perception.training.learn import SHARDS, apply, draw_batch, gradients
from perception.training.validation import history, publish, validate_all
from scenarios.streams import stream

PEAK_LR = 2.5e-3

log_to_nowhere = logging.getLogger("sortie.train")


@dataclass(frozen=True, slots=True)
class TrainResult:
    """Where the weights are, and what they reach on held-out towns under the schema's default pose errors (a alone, b all five)."""

    weights: Path
    steps: int
    loss: float
    validation: Difference
    frames: int
    minutes: float


def learning_rate(step: int, steps: int, peak: float = PEAK_LR) -> float:
    """One cycle: up over the first tenth, then down a cosine to 1 % of the peak."""
    warm = max(1, steps // 10)
    if step < warm:
        return peak * (0.1 + 0.9 * step / warm)
    return float(peak * (0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * (step - warm) / max(1, steps - warm)))))


def train(
    out: Path,
    *,
    frames: int = 1200,
    steps: int = 700,
    seed: int = 0,
    peak_lr: float = PEAK_LR,
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
        peak_lr: the cycle's highest learning rate.
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
    run = {
        "seed": seed,
        "frames": scenes * PER_SCENE,
        "steps": steps,
        "peak_lr": peak_lr,
        "warm_start": warm_start.name if warm_start else "",
    }
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
        rate = learning_rate(step, steps, peak_lr)
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

    runs = [*history(warm_start), {**run, "done": done, "loss": round(loss, 4), "minutes": round(spent / 60, 1)}]
    levels = validate_all(net, load_frames(held_out), where, lambda i, n: tell("validating", i, n))
    publish(net.cpu(), out, runs, levels)
    usual = levels[0].gain
    log.info("AP@0.5 single %.3f, full %.3f", usual.ap_a, usual.ap_b)
    return TrainResult(out, done, loss, usual, len(data.images), spent / 60)


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


if __name__ == "__main__":
    import argparse

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent.parent / "weights" / "disconet.safetensors")
    parser.add_argument("--work", type=Path, default=Path("runs/train"))
    parser.add_argument("--frames", type=int, default=1200)
    parser.add_argument("--steps", type=int, default=700)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--peak-lr", type=float, default=PEAK_LR)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--warm-start", type=Path)
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    train(
        args.out, frames=args.frames, steps=args.steps, seed=args.seed, peak_lr=args.peak_lr, minutes=args.minutes,
        work=args.work, warm_start=args.warm_start, log=logging.getLogger("sortie.train"),
    )  # fmt: skip
