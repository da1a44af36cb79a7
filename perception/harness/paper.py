"""The paper's Evaluation on the benchmark: every condition that a claim needs, evaluated once, and every claim judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from perception.harness.claims import conditions
from perception.harness.condition import CellsBy, Unsent
from perception.harness.contract import FleetFrames, Instrument
from perception.harness.evaluate import FLOOR, Evaluation, evaluate
from perception.harness.measures import under
from perception.harness.scores import Bootstrap, By
from perception.harness.statistics import DRAWS

TAU = 0.1
"""UAV3D's head cuts its scores there; also the paper's, as far as it says."""


@dataclass(frozen=True, slots=True)
class Asked:
    """How the table is measured. The defaults are the paper's instrument, with masked fusion beside it."""

    unsent: tuple[Unsent, ...] = ("zero", "masked")
    cells_by: CellsBy = "confidence"
    tau: float = TAU
    """Boxes with a lower score do not count."""
    by: By = "frame"
    """What the bootstrap resamples."""
    draws: int = DRAWS

    def __post_init__(self) -> None:
        if not self.unsent:
            raise ValueError("unsent names no instrument, must name zero, masked or both")
        if not FLOOR <= self.tau < 1.0:
            raise ValueError(f"tau is {self.tau:g}, must be at least {FLOOR:g} and below 1")
        if self.draws < 1:
            raise ValueError(f"draws is {self.draws}, must be at least 1")


def measure(
    instrument: Instrument,
    frames: FleetFrames,
    asked: Asked = Asked(),
    *,
    store: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Mapping[Unsent, Bootstrap]:
    """Evaluate what the claims need, all instruments over the same features; the scores of each.

    Args:
        instrument, frames: a model and what it looks at.
        store: a folder for finished frames; a later call with the same arguments goes on from there.
        progress: called with frames done and frames in all.
    """
    every = dict.fromkeys(under(c, unsent, asked.cells_by) for unsent in asked.unsent for c in conditions())
    found: Evaluation = evaluate(instrument, frames, tuple(every), store=store, progress=progress)
    cut = found.at(asked.tau)
    return {u: Bootstrap(cut, u, asked.cells_by, by=asked.by, draws=asked.draws) for u in asked.unsent}
