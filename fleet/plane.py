"""The rules of the context plane, and the state of a drone that several parts of a simulation share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

from sortie.fleet.computer import Work
from sortie.fleet.coverage import cameras_of
from sortie.fleet.lies import falsified
from sortie.fleet.messages.compact import FULL, Form
from sortie.perception.budget import CODE_BYTES
from sortie.perception.files import codebook_digest
from sortie.perception.geometry import USUAL, Cameras
from sortie.policies.contract import Descriptor
from sortie.policies.plane_rules import PlaneRules
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.events.base import About, Claim
from sortie.scenarios.shipped import located


class Equipment(NamedTuple):
    """What every drone knows of another's make."""

    compute_delay_s: float
    """From sensing to features ready to send."""
    cameras: Cameras = USUAL
    flies: bool = True
    """False for a ground station."""


def equipment_of(scenario: Scenario) -> dict[int, Equipment]:
    """Each drone's equipment."""
    each = zip(scenario.compute_delays_s, cameras_of(scenario.fleet), strict=True)
    stations = {station.drone for station in scenario.fleet.ground}
    return {i: Equipment(delay_s, cameras, i not in stations) for i, (delay_s, cameras) in enumerate(each)}


def codebooks(scenario: Scenario) -> tuple[str, ...]:
    """Each drone's codebook as its descriptors name it: by its digest, empty for the fleet's common one.

    Raises:
        InputError: a make's codebook that is missing, naming the file.
    """
    common = scenario.perception.codebook
    return tuple(
        "" if n.codebook is None or n.codebook == common else codebook_digest(located(Path(n.codebook)))
        for n in scenario.networks
    )


@dataclass(frozen=True)
class FleetRules(PlaneRules):
    """The plane's rules, and what drones send and are known to carry."""

    compute_delay_s: float
    tile_limit_bytes: int | None = None
    """Features are sent as tiles of at most this size. None sends them as one sample."""
    people: bool = False
    """Whether drones have thermal cameras, so that what they know of people is logged."""
    classes: bool = False
    """Whether there are targets of several classes, so that each detection names its class."""
    form: Form = FULL
    """The resolution of descriptors on the wire."""
    maps_bring_looks: bool = False
    """Whether the boxes of a drone's own look go with its maps, by which receivers correct poses."""
    code_bytes: int = CODE_BYTES
    """Of a cell that is sent as a code."""
    makes: Mapping[int, Equipment] = field(default_factory=dict)
    """The equipment of drones; others have `compute_delay_s` and the usual cameras."""

    @classmethod
    def of(cls, scenario: Scenario, **fields: Any) -> Self:
        """The rules of a scenario; `fields` replaces some of them."""
        perception, radio = scenario.perception, scenario.radio
        of_scenario = {
            "compute_delay_s": perception.compute_delay_s,
            "tile_limit_bytes": radio.fragment_bytes if radio.framing == "tiles" else None,
            "people": perception.thermal is not None,
            "classes": len(perception.classes) > 1,
            "form": Form(**scenario.context.form.model_dump()),
            "maps_bring_looks": perception.match_poses,
            "code_bytes": perception.code_bytes,
            "makes": equipment_of(scenario),
        }
        return super().of(scenario, **of_scenario | fields)

    def equipment(self, drone: int) -> Equipment:
        """What a drone carries."""
        return self.makes.get(drone) or Equipment(self.compute_delay_s)


@dataclass(slots=True)
class DroneStatus:
    """The state of one drone that its agent, the world and the scenario's events share.

    It is made before them and handed to each, so that none of them has to hold another.
    """

    feature_space: str = ""
    """The network of the drone: only maps of one feature space can be fused. Empty: the fleet's common one."""
    codebook: str = ""
    """Digest of its codebook; empty for the fleet's common one."""
    looks: bool = True
    """Whether it has a detector. Without one it sends context alone, and uses the boxes that it is sent."""
    airborne: bool = True
    """False while the drone is on the ground or lost."""
    perceiving: bool = False
    """Whether perception runs in the current frame."""
    clock_skew_s: float = 0.0
    """Error of the drone's clock."""
    blocked: set[int] = field(default_factory=set)
    """Scenario events by which its cameras see nothing."""
    slower_s: dict[int, float] = field(default_factory=dict)
    """What scenario events add to the time from sensing to features ready to send."""
    work: Work = field(default_factory=Work)
    """What the drone's computer did so far."""
    lies: dict[int, Callable[[Descriptor], Descriptor]] = field(default_factory=dict)
    """Falsifications of the drone's descriptors, by the index of the scenario event that causes them."""

    @property
    def slowed_s(self) -> float:
        """What `slower_s` adds up to."""
        return plain_sum(self.slower_s.values())

    def lie(self, cause: int, about: About, claim: Claim) -> None:
        """From now on the drone's descriptors say something false, until `lift`."""
        self.lies[cause] = partial(falsified, about=about, claim=claim)

    def lift(self, cause: int) -> None:
        """Take back what a scenario event did."""
        self.blocked.discard(cause)
        self.slower_s.pop(cause, None)
        self.lies.pop(cause, None)

    def leave(self) -> None:
        """The drone leaves the plane."""
        self.airborne = self.perceiving = False
