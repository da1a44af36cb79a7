"""The parameters of a training run, and the command that repeats it. Free of torch."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from research.benchmark.dataset import MOST, SIZES, Benchmark
from sortie.perception.errors import InputError

PEAK_LR = 2.5e-3
Precision = Literal["float32", "bfloat16"]
FULL_SIZE = SIZES["train"][0]


@dataclass(frozen=True, slots=True)
class Recipe:
    """One run. Everything that its weights follow from, beside the machine.

    Raises:
        InputError: naming the field, its value and its bounds.
    """

    steps: int = 500
    """Optimiser steps."""
    batch: int = 4
    """Fleet-frames a step; an even number, as two shards share them."""
    seed: int = 0
    """Of weights, batches and their order."""
    scenes: int = FULL_SIZE
    """The first so many scenes of the benchmark's train split; it goes on beyond its usual 100."""
    peak_lr: float = PEAK_LR
    """The cycle's highest learning rate."""
    cell_dropout: float = 0.0
    """Probability that a link is thinned: only a fraction of its cells arrives, log-uniform from 1 % to all, cells at random."""
    unsent: Literal["masked", "zero"] = "masked"
    """What a dropped cell is in training: it is left out, or takes part as zeros. Under full sharing there is no difference."""
    varied: float = 0.0
    """Share of the steps whose frames come from the varied benchmark (`VARIED`)."""
    precision: Precision = "float32"
    """Of the forward and backward passes; the weights and the optimiser are float32."""
    warm_start: str = ""
    """Name of the weights that it begins from; empty for none. Tensors that do not fit begin anew."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("steps", 1, 10**6),
            ("batch", 2, 1024),
            ("seed", 0, 2**31),
            ("scenes", 1, MOST["train"]),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"{name} is {value}, must be {low} to {high}")
        if self.batch % 2:
            raise InputError(f"batch is {self.batch}, must be even")
        if not 0 < self.peak_lr <= 1:
            raise InputError(f"peak_lr is {self.peak_lr}, must be above 0 and at most 1")
        if not 0 <= self.cell_dropout <= 1:
            raise InputError(f"cell_dropout is {self.cell_dropout}, must be 0 to 1")
        if not 0 <= self.varied <= 1:
            raise InputError(f"varied is {self.varied}, must be 0 to 1")
        if self.precision not in get_args(Precision):
            raise InputError(f"precision is {self.precision!r}, must be float32 or bfloat16")
        if self.unsent not in ("masked", "zero"):
            raise InputError(f"unsent is {self.unsent!r}, must be masked or zero")


def command(recipe: dict[str, Any], model: dict[str, Any], bench_seed: int, out: str) -> str:
    """The command line that repeats a run; fields that stand at their defaults are left out."""
    plain = asdict(Recipe())
    flags = [
        f"--{name.replace('_', '-')} {value:g}" if isinstance(value, float) else f"--{name.replace('_', '-')} {value}"
        for name, value in recipe.items()
        if name in plain and value != plain[name]
    ]
    usual = {
        "half_extent_m": 102.4,
        "fusion": "disconet",
        "exchange": "rectified",
        "decoder": "shallow",
        "grid": "coarse",
        "image_px": 256,
    }
    names = {"half_extent_m": "range", "image_px": "image-px"}
    flags += [f"--{names.get(n, n)} {v}" for n, v in model.items() if v != usual.get(n, v)]
    flags += [f"--bench-seed {bench_seed}"] if bench_seed else []
    return " ".join(["python -m research train", *flags, "--out", out])


def benchmark_root() -> Path:
    """Where benchmarks are kept unless said otherwise."""
    return Path("runs/bench")


def of_benchmark(bench: Benchmark) -> dict[str, Any]:
    """The facts about the data that a weights file stores."""
    return {
        "key": bench.key(),
        "seed": bench.seed,
        "density": bench.difficulty.density,
        "half_extent_m": bench.geometry.half_extent_m,
    }
