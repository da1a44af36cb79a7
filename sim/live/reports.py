"""Messages from a drone's process to the bench, by pipe, once a second: plain values that outlive the process."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from sortie.policies.staleness import LinkHealth
from sortie.scenarios.errors import SortieError
from sortie.sim.export.topics import TopicKind


class HealthChange(NamedTuple):
    """A drone's context about a peer became fresh, degraded or detached."""

    t_s: float
    drone: int
    peer: int
    health: LinkHealth
    age_s: float
    """Age of the peer's latest descriptor."""


class NewDirective(NamedTuple):
    """A directive that a policy node published for the first time: what a link carries changed."""

    t_s: float
    drone: int
    peer: int
    representation: str
    rate_hz: float
    reason: str


class Count(NamedTuple):
    """Samples and their bytes."""

    samples: int = 0
    bytes: int = 0

    def plus(self, size: int) -> Count:
        """The count with one more sample."""
        return Count(self.samples + 1, self.bytes + size)


class Notice(NamedTuple):
    """An event: a policy took over, or the shield replaced a directive."""

    t_s: float
    drone: int
    text: str


@dataclass(slots=True)
class SinceLastReport:
    """What happened since the last report."""

    decide_ns: list[int] = field(default_factory=list)
    """Processor time of each decision."""
    data_age_s: list[float] = field(default_factory=list)
    """Age of each payload's capture when it came in."""
    health: list[HealthChange] = field(default_factory=list)
    orders: list[NewDirective] = field(default_factory=list)
    notices: list[Notice] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Report:
    """One drone's counts since the begin, and what happened since its last report."""

    drone: int
    begin_s: float
    """When the process began to fly."""
    t_s: float
    cpu_s: float
    """Since then: processor time of all threads of the process, and of its policy's process."""
    published: int
    heard: int
    """Valid descriptors of other drones."""
    lost: int
    """Descriptors of other drones that `--loss` dropped."""
    refused: dict[str, int]
    """Invalid descriptors, directives and payloads, by reason."""
    late_s: float
    """The longest time from the begin of a frame until its descriptor was published; planned are 10 ms at most."""
    sent: dict[TopicKind, Count]
    received: dict[TopicKind, Count]
    new: SinceLastReport
    fallbacks: int = 0
    """Decisions by the fallback, because the policy gave none in time."""
    policy_restarts: int = 0
    """New processes for the policy."""


class Ready(NamedTuple):
    """The process has found all others."""

    drone: int


class Go(NamedTuple):
    """When the flight begins: on the host's monotonic clock, and as ns since 1970."""

    monotonic_s: float
    unix_ns: int


class Home(NamedTuple):
    """The process has flown to the end. This is its last message."""

    drone: int


class Failed(NamedTuple):
    """The process failed; its error has one line."""

    drone: int
    error: SortieError
