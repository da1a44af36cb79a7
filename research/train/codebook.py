"""Fit a codebook to a network's features on the benchmark's train split, and write its card."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from research.benchmark.dataset import Benchmark, Frames, load_frames, make_split
from research.train.recipe import of_benchmark
from sortie.perception.budget import payload_bytes
from sortie.perception.errors import InputError
from sortie.perception.geometry import CHANNELS
from sortie.perception.network.codebook import ENTRIES, Codebook, encoder_digest, save_codebook
from sortie.perception.network.inference import folded
from sortie.perception.network.model import CarNet
from sortie.scenarios.replacing import replacing
from sortie.scenarios.streams import stream

CELLS_OF_A_MAP = 205
"""Taken of each drone's map: half of them its most confident cells (a twentieth of the map), half drawn evenly."""
Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class CodebookRecipe:
    """What a codebook is fitted by."""

    stages: int = 20
    """The most bytes of a cell."""
    scenes: int = 10
    """Of the train split, from the first."""
    iterations: int = 25
    """Of k-means in each stage."""
    seed: int = 0


def sample(net: CarNet, parts: Iterator[Frames], seed: int) -> Floats:
    """Cells [n, 80] of every drone's map: confident ones, which are sent first, and any."""
    net, out = folded(net), []
    with torch.inference_mode():
        for part, frames in enumerate(parts):
            rng = stream(seed, 0, part, "codebook.cells")
            for images in frames.images:
                features = net.encoder(torch.from_numpy(images))
                heat = F.max_pool2d(net.head(net.spread(features))[:, :1], 2).flatten(1)
                best = heat.topk(CELLS_OF_A_MAP, dim=1).indices[:, ::2]
                any_ = torch.from_numpy(rng.integers(heat.shape[1], size=(len(heat), CELLS_OF_A_MAP // 2)))
                at = torch.cat([best, any_], dim=1)[:, None].expand(-1, CHANNELS, -1)
                out.append(features.flatten(2).gather(2, at).permute(0, 2, 1).reshape(-1, CHANNELS).numpy())
    return np.concatenate(out)


def fit(cells: Floats, recipe: CodebookRecipe, progress: Callable[[str, int, int], None] | None = None) -> Floats:
    """The stages [stages, 256, 80] of a codebook: k-means of what the stages before leave of cells [n, 80].

    Raises:
        InputError: fewer cells than a stage has entries.
    """
    if len(cells) < ENTRIES:
        raise InputError(f"{len(cells)} cells, must be at least {ENTRIES}")
    left = np.array(cells, np.float32)
    stages = np.empty((recipe.stages, ENTRIES, left.shape[1]), np.float32)
    for k in range(recipe.stages):
        rng = stream(recipe.seed, 0, k, "codebook.stage")
        with warnings.catch_warnings():  # an entry that no cell is nearest to stays where it is
            warnings.simplefilter("ignore", UserWarning)
            entries, nearest = kmeans2(left, ENTRIES, iter=recipe.iterations, minit="points", rng=rng)
        stages[k] = entries.astype(np.float16)  # as they are stored
        left -= stages[k][nearest]
        if progress is not None:
            progress("stages", k + 1, recipe.stages)
    return stages


def make_codebook(
    net: CarNet,
    path: Path,
    bench: Benchmark,
    recipe: CodebookRecipe,
    *,
    weights: str,
    root: Path,
    progress: Callable[[str, int, int], None] | None = None,
) -> dict[str, Any]:
    """Fit a codebook to a network's features, and write it with its card; the facts about it.

    Args:
        weights: the name of the network's file.
        root: folder of benchmarks.
    """
    paths = make_split(bench, "train", root, scenes=recipe.scenes)
    cells = sample(net, (load_frames([p]) for p in paths), recipe.seed)
    stages = fit(cells, recipe, progress)
    codebook = Codebook(torch.from_numpy(stages), encoder_digest(net))
    spread = float(((cells - cells.mean(axis=0)) ** 2).sum())
    unexplained = {}
    for length in (1, 2, 5, 8, 10, 16, 20):
        if length <= recipe.stages:
            read = codebook.decode(codebook.encode(torch.from_numpy(cells), length)).numpy()
            unexplained[length] = float(((cells - read) ** 2).sum()) / spread
    facts = {
        "weights": weights, "benchmark": of_benchmark(bench), "stages": recipe.stages, "scenes": recipe.scenes,
        "iterations": recipe.iterations, "seed": recipe.seed, "cells": len(cells), "unexplained": unexplained,
    }  # fmt: skip
    save_codebook(codebook, path, facts)
    with replacing(path.with_suffix(".md")) as part:
        part.write_text(card(path.name, facts), "utf-8")
    return facts


def card(name: str, facts: dict[str, Any]) -> str:
    """The codebook's card, Markdown."""
    bench = facts["benchmark"]
    command = (
        f"python -m research fit codebook --weights {facts['weights']} --out {name} --stages {facts['stages']} "
        f"--scenes {facts['scenes']} --iterations {facts['iterations']} --seed {facts['seed']}"
        + (f" --bench-seed {bench['seed']}" if bench["seed"] else "")
    )
    whole = payload_bytes(1)
    rows = "\n".join(f"| {k} | {whole / k:.0f} | {100 * left:.1f} % |" for k, left in facts["unexplained"].items())
    return f"""# {name}

Codebook of the features of `{facts["weights"]}`: {facts["stages"]} stages of {ENTRIES} entries with {CHANNELS} numbers (float16).
A cell of {whole} B becomes one byte a stage; the first bytes alone are a coarser code of the same cell.

Made by `{command}`.

**Data**: {facts["cells"]} cells of {facts["scenes"]} scenes of the train split of benchmark `{bench["key"]}` (seed {bench["seed"]}, {bench["density"]} density).
Half of them are among the most confident twentieth of their map, half are any. Nothing outside of the benchmark was used.

| bytes of a cell | times fewer | variance that is lost, on these cells |
|---|---|---|
{rows}

**Made for** the network of that name alone. A receiver with another network or another codebook cannot read these codes.
"""
