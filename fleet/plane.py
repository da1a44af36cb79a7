"""The rules of the context plane, and the state of a drone that several parts of a simulation share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from sortie.fleet.computer import Work
from sortie.fleet.coverage import cameras_of
from sortie.fleet.messages.compact import FULL, Form
from sortie.perception.budget import CODE_BYTES
from sortie.perception.files import codebook_digest
from sortie.perception.geometry import USUAL, Cameras
from sortie.policies.contract import Descriptor
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.schema import Scenario
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


@dataclass(frozen=True, slots=True)
class PlaneRules:
    """The plane's periods, the same for every drone, and what drones are known to carry."""

    period_s: float
    frames: int
    degraded_after_periods: float
    detached_after_periods: float
    dwell_s: float
    hysteresis: float
    compute_delay_s: float
    tile_limit_bytes: int | None = None
    """Features are sent as tiles of at most this size. None sends them as one sample."""
    trust: bool = False
    """Whether drones check the claims of their peers (`sortie.fleet.trust`)."""
    people: bool = False
    """Whether drones have thermal cameras, so that what they know of people is logged."""
    classes: bool = False
    """Whether there are targets of several classes, so that each detection names its class."""
    publish_every: int = 1
    """Frames from one descriptor to the next. Staleness counts in periods of that length."""
    form: Form = FULL
    """The resolution of descriptors on the wire."""
    maps_bring_looks: bool = False
    """Whether the boxes of a drone's own look go with its maps, by which receivers correct poses."""
    code_bytes: int = CODE_BYTES
    """Of a cell that is sent as a code."""
    roster: bool = False
    """Whether drones publish which members of the fleet they know (`sortie.policies.contract.Roster`)."""
    makes: Mapping[int, Equipment] = field(default_factory=dict)
    """The equipment of drones; others have `compute_delay_s` and the usual cameras."""

    def equipment(self, drone: int) -> Equipment:
        """What a drone carries."""
        return self.makes.get(drone) or Equipment(self.compute_delay_s)

    @property
    def descriptor_period_s(self) -> float:
        """Time from one descriptor of a drone to its next."""
        return self.period_s * self.publish_every

    @property
    def fresh_s(self) -> float:
        """A descriptor up to this age is fresh."""
        return self.descriptor_period_s * self.degraded_after_periods


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

    def leave(self) -> None:
        """The drone leaves the plane."""
        self.airborne = self.perceiving = False
