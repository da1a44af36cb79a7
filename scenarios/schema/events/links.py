"""Links that fade, and jammers."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Event, Fleet, Jammer, Lasting, Misfit
from sortie.scenarios.schema.movement import GroundStation


class LinkDrop(Lasting):
    """One link, or all links of a drone, lose power in both directions."""

    told_live: ClassVar[frozenset[str]] = frozenset({"link_drop", "link_back"})
    not_live: ClassVar[str] = "it changes the replayed goodput alone, the bus loses nothing"

    kind: Literal["link_drop"]
    drone: DroneId = Field(description="Whose links fade.")
    peer: DroneId | None = Field(None, description="The other end; left out, every link of the drone.")
    loss_db: float = Field(30.0, gt=0, le=200, description="Extra loss, both directions.")

    def misfit(self, station: GroundStation | None) -> Misfit | None:
        if self.peer == self.drone:
            return "peer", f"{self.peer}", "another drone than drone"
        return super().misfit(station)

    def begin(self, fleet: Fleet) -> None:
        fleet.note(f"{self._links} lose {self.loss_db:g} dB", self.drone)
        fleet.weaken(self.drone, self.peer, self.loss_db)

    def end(self, fleet: Fleet, lasts: bool) -> None:
        fleet.lift()
        back = f"{self._links} are back"
        self.note_end(fleet, lasts, "link_back", back, f"{back} only where no other drop lasts")

    def overlaps(self, other: Event) -> bool:
        if not isinstance(other, LinkDrop):
            return False
        a, b = ({drop.drone, drop.peer} - {None} for drop in (self, other))
        return a <= b or b <= a or len(a) == len(b) == 1  # two drones with weak links share one

    @property
    def _links(self) -> str:
        return f"links of {self.drone}" if self.peer is None else f"links of {self.drone}–{self.peer}"


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
