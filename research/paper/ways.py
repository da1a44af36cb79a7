"""What the paper's studies add to the product's evaluation: more ways to share, equal conditions computed once, threads.

All of research uses these names in place of those of `sortie.perception.evaluation`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Self, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from sortie.perception.evaluation import harness, sharing
from sortie.perception.evaluation.harness import Evaluation, FleetFrames, Instrument, Settings
from sortie.perception.evaluation.sharing import Floats, FrameView, Rank

T = TypeVar("T")
CellsBy = Literal["confidence", "norm"]
Absent = Literal["excluded", "zeros"]
Serve = Literal["grid", "region_first"]


class Ways(NamedTuple):
    """What an instrument does with peers that were not chosen, and which cells it sends first."""

    absent: Absent = "excluded"
    serve: Serve = "grid"
    """All cells by rank, or those of the mission's disc before all others."""


PAPER_WAYS = Ways()


def by_norm(view: FrameView) -> NDArray[np.floating]:
    """Cells in the order of the norm of their features."""
    plane: NDArray[np.floating] = view.rank("norm")  # type: ignore[call-arg]
    return plane


@dataclass(frozen=True)
class Sharing(sharing.Sharing):
    """The product's condition, with what only studies vary."""

    cells_by: CellsBy = "confidence"
    """What ranks a sender's cells."""
    absent: Absent = "excluded"
    """A peer that was not chosen has no part in the fusion, or takes part as zeros wherever its grid reaches."""

    ALLOWED: ClassVar[Mapping[str, tuple[str, ...]]] = {
        **sharing.Sharing.ALLOWED,
        "cells_by": get_args(CellsBy),
        "absent": get_args(Absent),
    }

    @property
    def rank(self) -> Rank:
        """As the product's, or by norm."""
        return by_norm if self.cells_by == "norm" else super().rank

    def cells_from(self, ego: int, overlap: Floats, key: tuple[int, ...] = (), seed: int = 0) -> dict[int, int]:
        """As the product's; absent peers that count as zeros come last, with no cells."""
        chosen = super().cells_from(ego, overlap, key, seed)
        if self.absent == "excluded":
            return chosen
        return chosen | {i: 0 for i in range(len(overlap)) if i != ego and i not in chosen}

    def plain(self, drones: int = 5) -> Self:
        """The simplest condition that gives the same boxes in a fleet of this size; what is equal is computed once.

        Knobs that choose among cells say nothing when every cell goes, nor those that choose among peers when all
        peers share.
        """
        others = drones - 1
        out = self
        if out.k and out.k == others:
            out = replace(out, peers=f"all-{others}")
        if out.k and out.received_budget * others >= out.k:
            out = replace(out, allocation="uniform", cells_by="confidence", roi=False)
        if out.unsent == "masked" or out.k in (0, others):
            out = replace(out, absent="excluded")
        if out.received_budget == 0.0 and out.unsent == "masked":
            return type(self)(0.0, "none")
        return out


SINGLE = Sharing(0.0, "none")
"""A drone alone."""
FULL_SHARING = Sharing(1.0)
"""Every peer sends every cell."""


def evaluate(
    instrument: Instrument,
    frames: FleetFrames,
    conditions: Sequence[Sharing],
    *,
    store: Path | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
    **settings: Any,
) -> Evaluation:
    """As the product's, but equal conditions are computed once, and frames are worked on side by side.

    Args:
        workers: so many threads; the numbers do not depend on it.
        settings: fields of `Settings`.
    """
    drones = frames.est_pose.shape[1]
    plain = {c: c.plain(drones) for c in conditions}
    each = partial(in_order, workers=workers, start=getattr(instrument, "start_worker", None))
    found = harness.evaluate(
        instrument,
        frames,
        tuple(plain.values()),
        Settings(**settings),
        store=store,
        each=each,
        progress=progress,
    )
    return under_all_names(found, plain)


def under_all_names(found: Evaluation, computed_as: Mapping[Sharing, Sharing]) -> Evaluation:
    """The same with every condition, each with the results of the equal one that it was computed as."""

    def named(values: Mapping[sharing.Sharing, T]) -> dict[sharing.Sharing, T]:
        return {c: values[plain] for c, plain in computed_as.items()}

    return replace(
        found,
        conditions=tuple(computed_as),
        units={(c, r): found.units[plain, r] for c, plain in computed_as.items() for r in found.settings.regions},
        cells=named(found.cells),
        payload_bytes=named(found.payload_bytes),
        index_bytes=named(found.index_bytes),
    )


def in_order(
    task: Callable[[int], T], numbers: Iterable[int], workers: int, start: Callable[[], None] | None
) -> Iterator[T]:
    """The task of each number, in order, by so many threads; never more than twice as many ahead as there are threads."""
    if workers <= 1:
        yield from map(task, numbers)
        return
    with ThreadPoolExecutor(workers, "evaluate", initializer=start) as pool:
        ahead: list[Future[T]] = []
        try:
            for f in numbers:
                ahead.append(pool.submit(task, f))
                if len(ahead) == 2 * workers:
                    yield ahead.pop(0).result()
            while ahead:
                yield ahead.pop(0).result()
        finally:
            for future in ahead:
                future.cancel()
