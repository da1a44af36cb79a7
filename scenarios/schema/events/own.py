"""Events of the user's own."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from sortie.scenarios.plugins.reference import Guard, checked_call, resolve
from sortie.scenarios.schema.base import ModelName, Params
from sortie.scenarios.schema.events.base import Fleet, Lasting


class Own(Lasting):
    """A user's class acts on the fleet, frame by frame (docs/guide/event.md)."""

    not_live: ClassVar[str] = "it acts on the simulated flight that is replayed, not on the bus"

    kind: Literal["own"]
    model: Annotated[str, ModelName("event")] = Field(description="The event's class (docs/guide/event.md).")
    params: Params = Field({}, description="Its keyword arguments.")

    def prepare(self, fleet: Fleet) -> Any:
        """The user's object.

        Raises:
            PluginError: an event that is not there, does not load, or has no such parameter.
        """
        made = checked_call("event", resolve("event", self.model, self.params), fleet.rng(fleet.index, "own event"))
        return Guard("event", made, ("step",))

    def begin(self, fleet: Fleet) -> None:
        fleet.note(f"{self.model} begins")
        if hasattr(fleet.prepared, "begin"):
            fleet.prepared.begin(fleet)

    def step(self, fleet: Fleet) -> None:
        fleet.prepared.step(fleet)

    def end(self, fleet: Fleet, lasts: bool) -> None:
        if hasattr(fleet.prepared, "end"):
            fleet.prepared.end(fleet)
        fleet.lift()
        fleet.note(f"{self.model} ends")
