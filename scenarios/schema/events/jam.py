"""Jammers."""

from __future__ import annotations

from typing import ClassVar, Literal

from sortie.scenarios.schema.events.base import Fleet, Jammer


class Jam(Jammer):
    """A jammer stands somewhere."""

    not_live: ClassVar[str] = "it changes the replayed goodput alone, the bus loses nothing"

    kind: Literal["jam"]

    def begin(self, fleet: Fleet) -> None:
        fleet.note(f"a jammer of {self.power_dbm:g} dBm at {self.position_m}")
        fleet.jam(self.position_m, self.power_dbm)

    def end(self, fleet: Fleet, lasts: bool) -> None:
        fleet.lift()
        self.note_end(fleet, lasts, "jam_over", "the jammer is off", "this jammer is off, another one is still on")
