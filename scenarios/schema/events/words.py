"""False descriptors: an attacker's, and a drone's own."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import About, Claim, Fleet, Lasting

OVERSIZED_BYTES = 2000
KEY_BYTES = 32


class Spoof(Lasting):
    """An attacker imitates a drone's descriptors: it lacks the fleet's key, but hears every broadcast."""

    not_live: ClassVar[str] = "no attacker joins the bus"

    kind: Literal["spoof"]
    drone: DroneId = Field(description="Whose descriptors are imitated.")
    attack: Literal["forged", "replayed", "malformed", "oversized"] = Field(
        "forged", description="What is put on the air."
    )
    rate_hz: float = Field(10.0, ge=1e-3, le=1000, description="Datagrams a second.")

    def begin(self, fleet: Fleet) -> None:
        fleet.note(f"{self.attack} descriptors at {self.rate_hz:g} Hz", self.drone)
        fleet.run(self._attack(fleet))

    def end(self, fleet: Fleet, lasts: bool) -> None:
        """The attack stops by itself."""

    def _attack(self, fleet: Fleet) -> Iterator[float]:
        rng = fleet.rng((self.drone, fleet.index), "spoof")
        forge = fleet.forger(rng.bytes(KEY_BYTES))
        captured = b""
        while self.until_s is None or fleet.t_s < self.until_s:
            genuine = fleet.last_datagram(self.drone)
            captured = captured or genuine
            if genuine:
                match self.attack:
                    case "forged":
                        datagram = forge(genuine, _empty_handed)
                    case "replayed":
                        datagram = captured
                    case "malformed":
                        datagram = rng.bytes(len(genuine))
                    case "oversized":
                        datagram = genuine + bytes(OVERSIZED_BYTES)
                fleet.inject(datagram, self.drone)
            yield 1.0 / self.rate_hz


def _empty_handed(descriptor: Any) -> Any:
    """A false descriptor: the drone claims an empty battery and no links."""
    return descriptor._replace(battery_soc=0.0, peer_goodput_mbps=(0.0,) * len(descriptor.peer_goodput_mbps))


class Lie(Lasting):
    """A drone says what is false, in its own descriptors."""

    acts_live: ClassVar[bool] = True
    in_trace: ClassVar[bool] = False

    kind: Literal["lie"]
    drone: DroneId = Field(description="Who lies, in its own descriptors.")
    about: About = Field("coverage", description="What is false.")
    claim: Claim = Field(
        "much",
        description="All cells new, 500 Mb/s to everyone, a full battery; or nothing seen, 0.1 Mb/s, an empty one.",
    )

    def begin(self, fleet: Fleet) -> None:
        fleet.lie(self.drone, self.about, self.claim)
        fleet.note(f"claims {self.claim} {self.about}", self.drone)

    def end(self, fleet: Fleet, lasts: bool) -> None:
        fleet.lift()
        self.note_end(fleet, lasts, "lie_over", "tells the truth again", "still lies: another lie lasts")
