"""The AP of weights on the validation split, and their card."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from research.benchmark.dataset import SIZES, Benchmark, Frames
from research.benchmark.difficulty import VARIED
from research.flip.networks import read_config
from research.paper.instrument import CarNetInstrument
from research.paper.results import TAU
from research.paper.ways import FULL_SHARING, SINGLE, evaluate
from research.train.learn import EGOS
from research.train.recipe import command, of_benchmark
from sortie.perception.geometry import IMAGE_PX, Geometry
from sortie.perception.metrics.bootstrap import Difference, compare
from sortie.perception.network.checkpoint import read_facts, save_weights
from sortie.perception.network.model import CarNet
from sortie.scenarios.replacing import replacing
from sortie.scenarios.report_text import interval, table

LEVELS = ((1.0, 1.0), (1.0, 2.5), (0.0, 0.0))
"""Factors on the benchmark's own pose errors, position and heading; its own first."""


@dataclass(frozen=True, slots=True)
class PoseErrorAp:
    """AP@0.5 of a drone alone (a) and with all five (b) under pose errors of these standard deviations."""

    position_sigma_m: float
    heading_sigma_deg: float
    gain: Difference


def with_errors(frames: Frames, position: float, heading: float) -> Frames:
    """The same frames with their position and heading errors multiplied."""
    error = frames.est_pose - frames.true_pose
    error[..., 2] = (error[..., 2] + np.pi) % (2 * np.pi) - np.pi
    return replace(frames, est_pose=frames.true_pose + np.array([position, position, heading]) * error)


def validate(net: CarNet, frames: Frames, device: torch.device, egos: int = 5) -> Difference:
    """A drone alone against full sharing on these frames; the interval is by whole scenes."""
    found = evaluate(
        CarNetInstrument(net, device), frames, (SINGLE, FULL_SHARING), regions=("full",), egos=egos, floor=TAU
    )
    return compare(found.matched(SINGLE), found.matched(FULL_SHARING), found.groups(by="scene").tolist())


def validate_all(
    net: CarNet,
    frames: Frames,
    bench: Benchmark,
    device: torch.device,
    progress: Callable[[int, int], None] | None = None,
) -> list[PoseErrorAp]:
    """`validate` at every level of pose error, the benchmark's own first."""
    out = []
    d = bench.difficulty
    for k, (position, heading) in enumerate(LEVELS):
        gain = validate(net, with_errors(frames, position, heading), device)
        out.append(PoseErrorAp(position * d.position_error_sigma_m, heading * d.heading_error_sigma_deg, gain))
        if progress is not None:
            progress(k + 1, len(LEVELS))
    return out


def history(weights: Path | None) -> list[dict[str, Any]]:
    """The training runs that the weights say they come from, the last one with the network that it made; none for None."""
    runs: list[dict[str, Any]] = [] if weights is None else read_facts(weights).get("runs", [])
    if weights is not None and runs:
        runs[-1]["model"] = asdict(read_config(weights))
    return runs


def publish(
    net: CarNet, path: Path, bench: Benchmark, runs: list[dict[str, Any]], levels: Sequence[PoseErrorAp]
) -> None:
    """Write the weights with their history, and the card beside them (`<name>.md`)."""
    facts = {"runs": runs, "benchmark": of_benchmark(bench), "validation": [asdict(level) for level in levels]}
    save_weights(net, path, facts)
    with replacing(path.with_suffix(".md")) as part:
        part.write_text(card(path.name, asdict(net.config), facts), "utf-8")


def card(name: str, model: dict[str, Any], facts: dict[str, Any]) -> str:
    """The model card, Markdown, from the facts in the weights file."""
    bench, runs = facts["benchmark"], facts["runs"]
    outs = [*(r["warm_start"] for r in runs[1:]), name]
    made = "\n".join(
        table(
            ("run", "made by", "steps done", "loss, mean of the last 50", "minutes", "on"),
            (
                (
                    f"{k}",
                    f"`{command(r, r.get('model', model), bench['seed'], out)}`",
                    f"{r['done']}",
                    f"{r['loss']:.3f}",
                    f"{r['minutes']:.0f}",
                    r.get("device", "two shared cores"),
                )
                for k, (r, out) in enumerate(zip(runs, outs, strict=False), 1)
            ),
        )
    )
    gains = [(v, v["gain"]) for v in facts["validation"]]
    accuracy = "\n".join(
        table(
            (
                "pose error σ (position, heading)",
                "AP@0.5 alone",
                "AP@0.5, all five",
                "cooperation, paired 95 % interval by scenes",
            ),
            (
                (
                    f"{v['position_sigma_m']:g} m, {v['heading_sigma_deg']:g}°",
                    f"{g['ap_a']:.3f}",
                    f"{g['ap_b']:.3f}",
                    interval(g["delta"], g["low"], g["high"], lambda d: f"{d:+.3f}"),
                )
                for v, g in gains
            ),
        )
    )
    last: dict[str, Any] = {"batch": 4, "varied": 0.0} | (
        runs[-1] if runs else {"scenes": 0, "cell_dropout": 0.0, "unsent": "masked"}
    )
    dropped = (
        f"In {100 * last['cell_dropout']:.0f} % of links only a random part of the cells arrived ({last['unsent']})."
        if last["cell_dropout"]
        else "Full sharing only: no cells were dropped, so what a starved budget does is a property of the fusion."
    )
    varied, heights, headings = "", "55–65 m", "within a few degrees of each other"
    beyond = "other altitudes, peers that look another way"
    if last["varied"]:
        low, high = VARIED.altitude_m
        beyond = "other altitudes"
        heights, headings = f"{low:g}–{high:g} m", f"that differ by {VARIED.yaw_sigma_deg:g}° (standard deviation)"
        varied = (
            f" In {100 * last['varied']:.0f} % of the steps the frames are of {last['scenes']} varied scenes: dense traffic, fleets "
            f"{heights} up, headings {headings}."
        )
    scenes, per_scene = SIZES["validation"]
    asked, pictures = "", ""
    if (image_px := model.get("image_px", IMAGE_PX)) != IMAGE_PX:
        cameras = Geometry(image_px=image_px).cameras
        asked = f" --image-px {image_px}"
        pictures = f"pictures of {cameras.width_px} × {cameras.height_px} pixels (`fleet.camera.width_px` {cameras.width_px}), "
    return f"""# {name}

Weights of `perception/network/model.py`, float32: {", ".join(f"{k} {v}" for k, v in model.items())}.

{made}

**Data**: {last["scenes"] * SIZES["train"][1]} fleet-frames of five drones in {last["scenes"]} scenes, the train split of benchmark
`{bench["key"]}` (seed {bench["seed"]}, {bench["density"]} density, ±{bench["half_extent_m"]:g} m; `python -m research bench make{asked}`); no outside data.{varied}
**Learning**: {last["batch"]} frames a step, AdamW, one cycle; mirrored and turned by quarters. In each frame {EGOS} drones fuse everyone
present (two to five) and one is alone, so a third of the supervised outputs are single-drone: the head works without peers.
{dropped}

{accuracy}

Validation split: {scenes * per_scene} fleet-frames in {scenes} scenes, every drone an ego; score threshold {TAU}. Boxes stand in the world by the
drone's *estimated* pose, so its heading error moves every far box: 0.5° is 0.7 m at 80 m, and a car is 1.85 m wide. Every car
inside the ego's square counts, whether anyone can see it or not.

**Made for** five drones 17–23 m apart, {heights} up, headings {headings}, banks of a few degrees, {pictures}towns of
this generator. **Not made for** {beyond}, real images.
"""
