"""Train the detector: what `python -m research train` runs.

Encoder, fusion and head learn together on the benchmark's train split; a third of the supervised outputs are
single-drone, so that the head works without peers. Every batch follows from (seed, step), checkpoints are
safetensors written under a temporary name, and a run that was cut off goes on from its last checkpoint to the
same end.
"""

from __future__ import annotations

import copy
import csv
import json
import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from research.benchmark.dataset import Benchmark, Frames, load_frames, make_split
from research.benchmark.difficulty import VARIED
from research.flip.networks import load, network, read_config
from research.train.devices import device_named, gpu_name
from research.train.learn import SHARDS, Batch, Thinning, apply, draw_batch, gradients
from research.train.recipe import PEAK_LR, Recipe, benchmark_root
from research.train.validation import history, publish, validate, validate_all
from sortie.perception.errors import InputError
from sortie.perception.metrics.bootstrap import Difference
from sortie.perception.network.fusion.own import OwnFusion
from sortie.perception.network.fusion.registry import FUSIONS
from sortie.perception.network.model import CarNet, ModelConfig
from sortie.scenarios.replacing import replacing
from sortie.scenarios.streams import stream

AHEAD = 2
"""So many steps ahead their batches are drawn."""
SAVE_STEPS, SAVE_S = 100, 120.0
"""A checkpoint is written every so many steps, and after so many seconds."""
CHECK_STEPS, CHECKS, CHECK_FRAMES, CHECK_EGOS = 100, 20, 12, 2
"""Validation AP is looked at every so many steps, in a long run so many times, on so many frames with so many egos each."""

log_to_nowhere = logging.getLogger("sortie.train")
Scalars = Callable[[int, dict[str, float]], None]
CURVE = {"loss": "train/loss", "lr": "train/lr", "ap_single": "validation/ap_single", "ap_full": "validation/ap_full"}
"""The columns of `loss.csv` after the step, and the name of the value in each."""


@dataclass(frozen=True, slots=True)
class TrainResult:
    """Where the weights are, and what they reach on the validation split (a alone, b all five)."""

    weights: Path
    steps: int
    loss: float
    validation: Difference
    frames: int
    minutes: float


@dataclass(frozen=True, slots=True)
class _Progress:
    """How far a run has come: its steps, the time they took, and the losses of the last 50."""

    step: int = 0
    spent_s: float = 0.0
    recent: tuple[float, ...] = ()


def learning_rate(step: int, steps: int, peak: float = PEAK_LR) -> float:
    """One cycle: up over the first tenth, then down a cosine to 1 % of the peak."""
    warm = max(1, steps // 10)
    if step < warm:
        return peak * (0.1 + 0.9 * step / warm)
    return float(peak * (0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * (step - warm) / max(1, steps - warm)))))


def train(
    out: Path,
    recipe: Recipe = Recipe(),  # noqa: B008 (frozen)
    config: ModelConfig = ModelConfig(),  # noqa: B008 (frozen)
    bench: Benchmark | None = None,
    *,
    root: Path | None = None,
    work: Path | None = None,
    warm_start: Path | None = None,
    minutes: float | None = None,
    resume: bool = True,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    scalars: Scalars | None = None,
    log: logging.Logger = log_to_nowhere,
) -> TrainResult:
    """Train and validate; write the weights to `out` and their card beside them.

    Args:
        out: the safetensors file to write.
        recipe, config, bench: the run, the network and the data; the benchmark of the config's range by default.
        root: folder of benchmarks; splits that are missing are made.
        work: where checkpoint and loss curve are kept; the folder of `out` by default.
        warm_start: begin from these weights instead of from nothing, as far as tensors fit (the log names the others).
        minutes: stop training after this long, validate and write what there is; the checkpoint stays.
        resume: go on from the checkpoint in `work`, if it belongs to the same run.
        device: as `device_named` takes it.
        progress: called with (stage, done, of).
        scalars: called with (step, values by name) for loss curves: train/loss, train/lr, validation/ap_single, validation/ap_full.
            A resumed run first calls it with the rows that `loss.csv` already has.

    Raises:
        InputError: weights that cannot be read, a benchmark, weights or a checkpoint of another range or image than the
            network's, or no such device.
    """
    begun = time.monotonic()
    tell = progress or (lambda stage, done, of: None)
    show = scalars or (lambda step, values: None)
    bench = Benchmark(geometry=config.geometry) if bench is None else bench
    if bench.geometry.half_extent_m != config.half_extent_m:
        raise InputError(
            f"the benchmark reaches ±{bench.geometry.half_extent_m:g} m, must be the network's ±{config.half_extent_m:g} m"
        )
    if bench.geometry != config.geometry:
        raise InputError(
            f"the benchmark's image_px is {bench.geometry.image_px}, must be the network's {config.image_px}"
        )
    where = device_named(device)
    root, work = root or benchmark_root(), work or out.parent
    torch.manual_seed(recipe.seed)
    net = network(config, None if config.fusion in FUSIONS else OwnFusion(config.fusion))
    if warm_start is not None:
        _begin_from(net, warm_start, log)
    net = net.to(where).train()
    optimiser = torch.optim.AdamW(net.parameters(), lr=recipe.peak_lr, weight_decay=1e-3)
    run = {**asdict(recipe), "model": asdict(config), "benchmark": bench.key()}
    work.mkdir(parents=True, exist_ok=True)
    checkpoint = work / "checkpoint.safetensors"
    before = _restore(checkpoint, run, net, optimiser, log) if resume else _Progress()

    files = make_split(bench, "train", root, scenes=recipe.scenes, progress=lambda i, n: tell("rendering scenes", i, n))
    held_out = make_split(bench, "validation", root, progress=lambda i, n: tell("rendering validation", i, n))
    data, validation = load_frames(files), load_frames(held_out)
    varied = data
    if recipe.varied:
        other = replace(bench, difficulty=VARIED)
        varied = load_frames(
            make_split(other, "train", root, scenes=recipe.scenes, progress=lambda i, n: tell("rendering varied", i, n))
        )
    check, check_steps = _first(validation, CHECK_FRAMES), max(CHECK_STEPS, recipe.steps // CHECKS // 10 * 10)
    log.info("%d training frames in %d scenes", len(data), len(files))
    done, curve = before.step, work / "loss.csv"
    rows = _resume_curve(curve, done)
    recent = before.recent or tuple(row["train/loss"] for _, row in rows[-1:])  # a checkpoint of 0.2.0 has none
    for step, row in rows:
        show(step, row)
    replicas = [copy.deepcopy(net) for _ in range(SHARDS)]

    def draw(step: int, shard: int) -> Batch:
        from_varied = recipe.varied and stream(recipe.seed, 0, step, "train.varied").random() < recipe.varied
        return draw_batch(varied if from_varied else data, recipe, step, shard, config.geometry)

    with ThreadPoolExecutor(SHARDS) as pool, ThreadPoolExecutor(SHARDS) as drawing:
        saved_s = time.monotonic()
        for step, batches in _drawn_ahead(drawing, draw, range(done, recipe.steps)):
            rate = learning_rate(step, recipe.steps, recipe.peak_lr)
            for group in optimiser.param_groups:
                group["lr"] = rate
            jobs = [
                pool.submit(
                    gradients,
                    r,
                    batch,
                    where,
                    Thinning.of(recipe, step, i),
                    recipe.precision,
                )
                for i, (r, batch) in enumerate(zip(replicas, batches, strict=True))
            ]
            values, grads = zip(*(job.result() for job in jobs), strict=True)
            apply(net, replicas, list(grads), optimiser)
            done = step + 1
            recent = (*recent[-49:], float(np.mean(values)))
            late = minutes is not None and time.monotonic() - begun > 60 * minutes
            if done % 10 == 0 or done == recipe.steps or late:
                row = {"train/loss": float(np.mean(recent)), "train/lr": rate}
                if done % check_steps == 0 and done < recipe.steps:
                    gain = validate(copy.deepcopy(net), check, where, CHECK_EGOS)
                    row |= {"validation/ap_single": gain.ap_a, "validation/ap_full": gain.ap_b}
                _note(curve, done, row)
                show(done, row)
                tell("training", done, recipe.steps)
                log.info("step %d of %d, %s", done, recipe.steps, ", ".join(f"{k} {v:.4g}" for k, v in row.items()))
            if done % SAVE_STEPS == 0 or done == recipe.steps or late or time.monotonic() - saved_s > SAVE_S:
                saved_s = time.monotonic()
                now = _Progress(done, before.spent_s + time.monotonic() - begun, recent)
                _save(checkpoint, {**run, **asdict(now)}, net, optimiser)
            if late:
                log.info("stopped after %.1f minutes at step %d of %d", minutes, done, recipe.steps)
                break
    spent = before.spent_s + time.monotonic() - begun
    loss = float(np.mean(recent))

    facts = {
        **asdict(recipe),
        "device": _called(where),
        "done": done,
        "loss": round(loss, 4),
        "minutes": round(spent / 60, 1),
    }
    levels = validate_all(net, validation, bench, where, lambda i, n: tell("validating", i, n))
    publish(net.cpu(), out, bench, [*history(warm_start), facts], levels)
    usual = levels[0].gain
    show(done, {"validation/ap_single": usual.ap_a, "validation/ap_full": usual.ap_b})
    log.info("AP@0.5 single %.3f, full %.3f", usual.ap_a, usual.ap_b)
    return TrainResult(out, done, loss, usual, len(data), spent / 60)


def _drawn_ahead(
    pool: ThreadPoolExecutor, draw: Callable[[int, int], Batch], steps: range
) -> Iterator[tuple[int, list[Batch]]]:
    """Each step and the batches of its shards, which are drawn while earlier steps are computed."""
    coming: deque[list[Future[Batch]]] = deque()
    for step in steps:
        for later in range(step + len(coming), min(step + AHEAD + 1, steps.stop)):
            coming.append([pool.submit(draw, later, shard) for shard in range(SHARDS)])
        yield step, [job.result() for job in coming.popleft()]


def _called(device: torch.device) -> str:
    """What a card calls the machine of a run."""
    return gpu_name(device) or f"{SHARDS} cores"


def _first(frames: Frames, count: int) -> Frames:
    """Some frames of different scenes."""
    which = np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).astype(int))
    return Frames(*(getattr(frames, name)[which] for name in Frames.__slots__))


def _begin_from(net: CarNet, path: Path, log: logging.Logger) -> None:
    """Take over the tensors of `path` that the network has in the same shape."""
    own = read_config(path).fusion not in FUSIONS and isinstance(net.fusion, OwnFusion)
    given = load(path, copy.deepcopy(net.fusion) if own else None)
    found = read_config(path)
    if found.half_extent_m != net.config.half_extent_m:
        raise InputError(f"{path}: made for another range than ±{net.config.half_extent_m:g} m")
    _refuse_other_image(path, found.image_px, net.config)
    mine, theirs = net.state_dict(), given.state_dict()
    fit = {k: v for k, v in theirs.items() if k in mine and mine[k].shape == v.shape}
    net.load_state_dict(fit, strict=False)
    anew = sorted(set(mine) - set(fit))
    if anew:
        log.info("begin anew: %s", ", ".join(anew))


def _refuse_other_image(path: Path, image_px: int, config: ModelConfig, advice: str = "") -> None:
    if image_px != config.image_px:
        raise InputError(f"{path}: image_px is {image_px}, must be {config.image_px} as in the run{advice}")


def _resume_curve(path: Path, done: int) -> list[tuple[int, dict[str, float]]]:
    """The rows of the loss curve up to the checkpoint; the file loses later ones, because their steps are done again."""
    rows: list[dict[str, str]] = []
    if done and path.is_file():
        with path.open(newline="") as file:
            whole = (
                line for line in file if line.endswith("\n") and line.count(",") == len(CURVE)
            )  # a kill may cut the last
            rows = [row for row in csv.DictReader(whole) if int(row["step"]) <= done]
    with replacing(path) as part, part.open("w", newline="") as file:
        kept = csv.DictWriter(file, ("step", *CURVE))
        kept.writeheader()
        kept.writerows(rows)
    return [(int(row["step"]), {CURVE[c]: float(row[c]) for c in CURVE if row[c]}) for row in rows]


def _note(path: Path, step: int, row: dict[str, float]) -> None:
    """One more line of the loss curve."""
    with path.open("a", newline="") as file:
        csv.writer(file).writerow([step, *(f"{row[c]:.4g}" if c in row else "" for c in CURVE.values())])


def _save(path: Path, facts: dict[str, Any], net: CarNet, optimiser: torch.optim.Optimizer) -> None:
    from safetensors.torch import save_file

    tensors = {f"net.{k}": v.detach().cpu().contiguous() for k, v in net.state_dict().items()}
    for i, parameter in enumerate(net.parameters()):
        for key, value in optimiser.state[parameter].items():
            tensors[f"adam.{i}.{key}"] = torch.as_tensor(value).detach().cpu().contiguous()
    with replacing(path) as part:
        save_file(tensors, part, metadata={"sortie": json.dumps(facts)})


def _restore(
    path: Path, run: dict[str, Any], net: CarNet, optimiser: torch.optim.Optimizer, log: logging.Logger
) -> _Progress:
    """Load a checkpoint of the same run; no progress when there is none or it belongs to another.

    Raises:
        InputError: it belongs to a network of another image.
    """
    from safetensors import safe_open

    if not path.is_file():
        return _Progress()
    with safe_open(path, framework="pt") as file:
        facts = json.loads(file.metadata()["sortie"])
        facts["model"] = asdict(ModelConfig()) | facts.get("model", {})  # an older one does not name newer choices
        _refuse_other_image(path, facts["model"]["image_px"], net.config, "; --no-resume starts anew")
        if any(facts.get(k) != v for k, v in run.items()):
            log.info("%s belongs to another run (%s); starting anew", path, facts)
            return _Progress()
        tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118 (not a mapping)
    net.load_state_dict({k[4:]: v for k, v in tensors.items() if k.startswith("net.")})
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("adam."):
            _, index, key = name.split(".", 2)
            state.setdefault(int(index), {})[key] = value
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
    log.info("resuming at step %d", facts["step"])
    return _Progress(facts["step"], facts["spent_s"], tuple(facts.get("recent", ())))
