"""Cells that fail."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Fleet, PackEvent


class CellFailure(PackEvent):
    """A pack loses a cell."""

    told_live: ClassVar[frozenset[str]] = frozenset({"cell_failure"})

    kind: Literal["cell_failure"]
    drone: DroneId = Field(description="Whose pack loses a cell: its voltage and its energy are gone.")

    def happen(self, fleet: Fleet) -> None:
        left = fleet.cells(self.drone) - 1
        fleet.note({0: "no cell is left", 1: "1 cell is left"}.get(left, f"{left} cells are left"), self.drone)
        fleet.drop_cell(self.drone)
