"""An evaluation's APs with one bootstrap for all of them (`measures.Scores`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from research.paper.measures import Floats, Region, under
from research.paper.ways import PAPER_WAYS, CellsBy, Sharing, Ways
from sortie.perception.evaluation.harness import Evaluation
from sortie.perception.evaluation.harness import Region as Evaluated
from sortie.perception.evaluation.sharing import Unsent
from sortie.perception.metrics.bootstrap import Ranked, rank
from sortie.scenarios.intervals import DRAWS, resamples
from sortie.scenarios.streams import stream

By = Literal["frame", "scene"]


class Bootstrap:
    """Bootstrapped APs of an evaluation at its threshold, for the paper's conditions under one way to fuse.

    Args:
        evaluation: it has to hold the conditions with `unsent`, `cells_by` and `ways` put in.
        unsent, cells_by: what a cell that was not sent counts as, and what ranks cells.
        ways: what peers that were not chosen count as, and which cells are sent first.
        disc: which of the evaluation's regions answers for the mission.
        by: what is resampled: frames, or whole scenes.
        draws: resamples, and as many random splits into halves.

    Raises:
        ValueError: an evaluation in another convention than `rotated`, which resamples know nothing of.
    """

    def __init__(
        self,
        evaluation: Evaluation,
        unsent: Unsent,
        cells_by: CellsBy = "confidence",
        *,
        disc: Literal["mission", "ego"] = "mission",
        by: By = "frame",
        draws: int = DRAWS,
        seed: int = 0,
        ways: Ways = PAPER_WAYS,
    ) -> None:
        if (convention := evaluation.settings.convention) != "rotated":
            raise ValueError(f"the evaluation's convention is {convention!r}, must be 'rotated' to be resampled")
        self._evaluation, self._unsent, self._cells_by, self._ways = evaluation, unsent, cells_by, ways
        self._disc, self._by = disc, by
        self._draws, self._seed = draws, seed
        self._ranked: dict[tuple[Sharing, Evaluated], Ranked] = {}
        self._scores: dict[tuple[Sharing, Evaluated], tuple[float, Floats]] = {}
        self._weights: dict[tuple[str, int], Floats] = {}

    def ap(self, condition: Sharing, region: Region) -> float:
        """On all frames."""
        return self._get(condition, region)[0]

    def draws(self, condition: Sharing, region: Region) -> Floats:
        """[draws], on resampled frames, the same ones for all conditions."""
        return self._get(condition, region)[1]

    def halves(self, condition: Sharing, region: Region, *, resampled: bool) -> Floats:
        """[draws, 2], on the halves of random splits."""
        ranked = self._rank(condition, region)
        n = len(ranked.truths)
        both = [self._once(f"half {side} {resampled}", n) for side in (0, 1)]
        return np.stack([ranked.ap(w) for w in both], axis=1)

    def fleet_frame_bytes(self, condition: Sharing) -> Sequence[float]:
        """Payload bytes of each frame, all egos together, the index apart."""
        sent = self._evaluation.payload_bytes[self._under(condition)]
        per_frame: list[float] = sent.reshape(-1, self._evaluation.settings.egos).sum(axis=1).astype(float).tolist()
        return per_frame

    def _under(self, condition: Sharing) -> Sharing:
        return under(condition, self._unsent, self._cells_by, self._ways)

    def _get(self, condition: Sharing, region: Region) -> tuple[float, Floats]:
        key = self._key(condition, region)
        if key not in self._scores:
            ranked = self._rank(condition, region)
            weights = self._once("resamples", len(ranked.truths))
            self._scores[key] = (self._evaluation.ap(*key), ranked.ap(weights))
        return self._scores[key]

    def _key(self, condition: Sharing, region: Region) -> tuple[Sharing, Evaluated]:
        return self._under(condition), self._disc if region == "mission" else region

    def _rank(self, condition: Sharing, region: Region) -> Ranked:
        key = self._key(condition, region)
        if key not in self._ranked:
            self._ranked[key] = rank(self._evaluation.matched(*key), self._evaluation.groups(key[1], self._by))
        return self._ranked[key]

    def _once(self, what: str, groups: int) -> Floats:
        """Weights [draws, groups], made once and then reused."""
        if (what, groups) not in self._weights:
            if what == "resamples":
                self._weights[what, groups] = resamples(groups, self._draws, self._seed)
            else:
                for resampled in (False, True):
                    for side, weights in enumerate(split(groups, self._draws, self._seed, resampled=resampled)):
                        self._weights[f"half {side} {resampled}", groups] = weights
        return self._weights[what, groups]


def split(groups: int, splits: int, seed: int = 0, *, resampled: bool) -> tuple[Floats, Floats]:
    """Weights [splits, groups] of the two halves of random splits, no group in both.

    `resampled`: within each half as many groups are drawn with replacement as it has.
    """
    rng = stream(seed, 0, (), "harness.halves")
    first = np.argsort(rng.random((splits, groups)), axis=1) < groups // 2
    if not resampled:
        return first.astype(np.float64), (~first).astype(np.float64)
    rng = stream(seed, 0, (), "harness.halves.resampled")
    halves = []
    for member in (first, ~first):
        chances = member / np.maximum(member.sum(axis=1, keepdims=True), 1)
        drawn = [rng.multinomial(int(m.sum()), c) for m, c in zip(member, chances, strict=True)]
        halves.append(np.array(drawn, np.float64).reshape(splits, groups))
    return halves[0], halves[1]
