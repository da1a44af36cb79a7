"""The results of an evaluation for the paper, under any instrument, threshold and disc. Free of torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from research.paper.scores import Bootstrap, By
from research.paper.ways import PAPER_WAYS, CellsBy, Ways
from sortie.perception.errors import InputError
from sortie.perception.evaluation.harness import FLOOR, Evaluation
from sortie.perception.evaluation.sharing import Unsent
from sortie.scenarios.intervals import DRAWS

TAU = 0.1
"""Score threshold: UAV3D's head drops boxes below it, and so does a scenario unless it says otherwise."""
DiscCentre = Literal["mission", "ego"]
"""Where the mission's disc is centred: on the target or on the ego."""


@dataclass(frozen=True, slots=True)
class TableSettings:
    """How the table is measured. The defaults are the paper's instrument, with masked fusion beside it.

    Raises:
        InputError: naming the field, its value and the bound.
    """

    unsent: tuple[Unsent, ...] = ("zero", "masked")
    cells_by: CellsBy = "confidence"
    tau: float = TAU
    """Boxes with a lower score do not count."""
    by: By = "frame"
    """What the bootstrap resamples."""
    draws: int = DRAWS
    ways: Ways = PAPER_WAYS

    def __post_init__(self) -> None:
        if not self.unsent:
            raise InputError("unsent names no instrument, must name zero, masked or both")
        if not FLOOR <= self.tau < 1.0:
            raise InputError(f"tau is {self.tau:g}, must be at least {FLOOR:g} and below 1")
        if self.draws < 1:
            raise InputError(f"draws is {self.draws}, must be at least 1")


@dataclass(frozen=True, slots=True)
class TableResults:
    """An evaluation of the paper's conditions under every instrument in the settings."""

    evaluation: Evaluation
    settings: TableSettings
    _made: dict[tuple[Unsent, float, DiscCentre], Bootstrap] = field(default_factory=dict)
    _cut: dict[float, Evaluation] = field(default_factory=dict)

    def scores(self, unsent: Unsent, *, tau: float | None = None, disc: DiscCentre = "mission") -> Bootstrap:
        """Bootstrapped APs of one instrument, at the threshold of the settings or another."""
        key = (unsent, self.settings.tau if tau is None else tau, disc)
        if key not in self._made:
            if key[1] not in self._cut:
                self._cut[key[1]] = self.evaluation.at(key[1])
            self._made[key] = Bootstrap(
                self._cut[key[1]],
                unsent,
                self.settings.cells_by,
                disc=disc,
                by=self.settings.by,
                draws=self.settings.draws,
                ways=self.settings.ways,
            )
        return self._made[key]

    def all_scores(self) -> dict[Unsent, Bootstrap]:
        """Bootstrapped APs of every instrument in the settings."""
        return {unsent: self.scores(unsent) for unsent in self.settings.unsent}
