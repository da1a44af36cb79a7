"""The policy contract: the types that go into a policy and come out of it, and the bounds of its output.

A policy is any callable `policy(view: FleetView) -> Sequence[Directive]`. It has no clock (the view has the ages), no
input or output, and no payloads. Positions are ENU. An orientation is a quaternion x, y, z, w of FLU in ENU. A policy
that also chooses where its drone looks from has a second function, marked by `looks_from`.

The types are named tuples. They are frozen, and creating one takes a third of the time of a frozen dataclass; a fleet
creates tens of thousands a minute. `d._replace(rate_hz=5.0)` is a changed copy.
"""

from __future__ import annotations

import functools
import inspect
import math
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from functools import lru_cache
from operator import is_, itemgetter
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, TypeVar

from sortie.scenarios.disc import AGENT_IDS as AGENT_IDS  # policies import this and the next two from here
from sortie.scenarios.disc import Disc as Disc
from sortie.scenarios.errors import SortieError
from sortie.scenarios.link_state import LinkState as LinkState
from sortie.scenarios.link_state import state_of
from sortie.scenarios.representation import Representation as Representation

AnyValue = TypeVar("AnyValue")
PERSON_FLAG = 4
"""Of a descriptor's `novelty_flags`: the publisher's thermal camera found a person in its region of responsibility."""
COVERAGE_CELLS = 16
"""The coverage grid is 16 × 16 cells of two bits, north-aligned, centred on the drone."""
COVERAGE_CELL_M = 12.8
"""Side of a coverage cell; cells lie on the world's lattice of this pitch."""
COVERAGE_BYTES = COVERAGE_CELLS**2 // 4
FEATURE_CELLS = 64 * 64
"""The cells of a drone's feature map, of which ρ is a share."""
FEATURE_CELL_BYTES = 80 * 2
"""A feature cell: 80 channels of 2 bytes."""
FEATURE_MAP_MEGABITS = 8 * FEATURE_CELLS * FEATURE_CELL_BYTES / 1e6
"""A whole feature map."""


DETACHED_AFTER_PERIODS = 10.0
"""The plane's second threshold of age, in periods of a descriptor."""
ROUNDING_PERIODS = 1e-6
"""An age of exactly three periods, computed in floats, is not older than three periods."""


class TaskPhase(IntEnum):
    """What a drone is doing, as its descriptor states it."""

    TRANSIT = 0
    SEARCH = 1
    TRACK = 2
    RETURN = 3
    LANDING = 4


PHASE_NAMES: dict[TaskPhase, str] = {phase: phase.name.lower() for phase in TaskPhase}
"""The names in scenarios, tables and views on disk."""
PHASE_OF: dict[str, TaskPhase] = {name: phase for phase, name in PHASE_NAMES.items()}


class Coverage(IntEnum):
    """How well a cell of the coverage grid is seen (two bits)."""

    UNSEEN = 0
    POOR = 1
    WELL = 2
    NOVEL = 3


class Roster(NamedTuple):
    """The drones that one drone counts as members of the fleet."""

    epoch: int
    """How often the set has changed since this drone began. Epochs of two drones cannot be compared."""
    members: tuple[int, ...]
    """Their ids, ascending, the drone's own among them. Drones that know the same members have equal tuples."""

    def slot(self, drone: int) -> int | None:
        """A drone's place among the members; None if it is none."""
        at = bisect_left(self.members, drone)
        return at if at < len(self.members) and self.members[at] == drone else None


class Descriptor(NamedTuple):
    """One drone's context, with the fields of the paper's schema (180 B as CDR with five drones)."""

    stamp_ns: int
    """The publisher's clock, ns since the begin of the sortie."""
    agent_id: int
    position_m: tuple[float, float, float]
    orientation_xyzw: tuple[float, float, float, float]
    velocity_mps: tuple[float, float, float]
    footprint_radius_m: float
    battery_soc: float
    cpu_headroom: float
    """Share of the companion computer's processor that was left over in the last second, 0 … 1."""
    gpu_headroom: float
    """The same of its accelerator."""
    peer_goodput_mbps: tuple[float, ...]
    """As measured by this drone, to every other drone by ascending id; with a `roster`, to its other members alone. Read
    it by `goodput_to`; `link_state` says what 0 means."""
    coverage_grid: bytes
    """64 B, four cells a byte, lowest bits first, row by row from south-west."""
    novelty_flags: int
    task_phase: TaskPhase
    region: Disc | None
    """Region of responsibility; on the wire f32[4] x, y, radius, 1 (all zero: none)."""
    priority_target_ids: tuple[int, ...] = ()
    feature_space: str = ""
    """The network that makes this drone's feature maps; only maps of one space can be fused. Empty: the fleet's common one.

    An optional field: it is on the wire where it is not empty (`sortie.fleet.messages.extensions`)."""
    roster: Roster | None = None
    """The members that this drone knows, and whom its goodputs belong to. None: it publishes no roster.

    An optional field, as `feature_space`."""
    codebook: str = ""
    """Digest of the codebook that this drone's codes are of; only codes of one codebook can be read. Empty: the fleet's
    common one.

    An optional field, as `feature_space`."""

    @property
    def coverage_corner(self) -> tuple[int, int]:
        """Row and column, in the world's lattice, of the coverage grid's south-west cell."""
        x_m, y_m, _ = self.position_m
        half = COVERAGE_CELLS // 2
        return math.floor(y_m / COVERAGE_CELL_M) - half, math.floor(x_m / COVERAGE_CELL_M) - half

    def link_state(self, peer: int) -> LinkState:
        """Whether this drone knows its link to `peer`: measured, probed by descriptors, silent or unknown."""
        return state_of(self.goodput_to(peer))

    def goodput_to(self, peer: int) -> float:
        """Goodput to `peer`, Mb/s, as this drone measured it (0 where unknown and off the roster; `link_state` explains tiny values)."""
        return goodput_in(self.peer_goodput_mbps, self.agent_id, self.roster, peer)

    def counts(self, drone: int) -> bool:
        """Whether this drone counts another as a member of the fleet; true of all where it publishes no roster."""
        return self.roster is None or drone in self.roster.members

    def goodput_by_id(self, drones: int) -> tuple[float, ...]:
        """Goodput to every other of the drones 0 … `drones` − 1, by ascending id; 0 for those off the roster."""
        if self.roster is None:
            return self.peer_goodput_mbps
        return tuple([self.goodput_to(i) for i in range(drones) if i != self.agent_id])

    def with_roster(self, roster: Roster) -> Descriptor:
        """The same descriptor with this roster, and with goodputs to its members alone."""
        return self._replace(peer_goodput_mbps=goodput_to_members(self, roster), roster=roster)


def goodput_to_members(d: Descriptor, roster: Roster) -> tuple[float, ...]:
    """A descriptor's goodput to the other members of any roster, by ascending id; 0 for those off its own."""
    ids = range(len(d.peer_goodput_mbps) + 1) if d.roster is None else d.roster.members
    known = dict(zip([i for i in ids if i != d.agent_id], d.peer_goodput_mbps, strict=False))
    return tuple([known.get(i, 0.0) for i in roster.members if i != d.agent_id])


def goodput_in(known: tuple[float, ...], me: int, roster: Roster | None, peer: int) -> float:
    """Goodput to `peer` in the list of drone `me`; `goodput_to_members` reads the whole list at once."""
    if peer == me:
        return 0.0
    place = peer if roster is None else roster.slot(peer)
    if place is None:
        return 0.0
    slot = place - (peer > me)  # the drone's own place is left out
    return known[slot] if slot < len(known) else 0.0


def plain_copy(mapping: Mapping[int, AnyValue]) -> dict[int, AnyValue]:
    """A copy of a view's mapping that can be changed. That of a view in flight is one of a plain dictionary, in a tenth of the time."""
    copied: dict[int, AnyValue] = mapping.copy() if isinstance(mapping, MappingProxyType) else dict(mapping)
    return copied


class FleetView(NamedTuple):
    """A policy's input: the latest descriptor of every drone heard so far, of whatever age.

    `descriptors` and `age_s` have the same keys in the same order. The ego is one of them. In flight both can be read only: whatever a
    policy did to them would reach the staleness rules and the record.
    """

    ego: int
    period_s: float
    descriptors: Mapping[int, Descriptor]
    age_s: Mapping[int, float]
    detached_after_periods: float = DETACHED_AFTER_PERIODS
    """A peer whose descriptor is older than this is detached: nothing reaches it, and nothing comes from it."""

    @property
    def frozen(self) -> FleetView:
        """The same view with mappings that can be read only.

        Example:
            >>> FleetView(0, 0.1, {}, {0: 0.0}).frozen.age_s[0] = 1.0
            Traceback (most recent call last):
            TypeError: 'mappingproxy' object does not support item assignment
        """
        return self._replace(descriptors=MappingProxyType(self.descriptors), age_s=MappingProxyType(self.age_s))

    def __reduce__(self) -> tuple[Any, ...]:
        """A view that can be read only is copied, and goes to another process, as one with plain mappings."""
        return FleetView, (self.ego, self.period_s, dict(self.descriptors), dict(self.age_s), self[-1])

    @property
    def me(self) -> Descriptor | None:
        """The ego's own descriptor; None in an empty view."""
        return self.descriptors.get(self.ego)

    @property
    def peers(self) -> tuple[int, ...]:
        """Ids of the other drones heard, ascending."""
        ids = sorted(self.descriptors)
        if self.ego in self.descriptors:
            ids.remove(self.ego)
        return tuple(ids)

    @property
    def human_in_region(self) -> bool:
        """Whether the ego has a region and knows of a person there: by its own thermal camera, or by an attached peer's flag.

        A peer's flag is about the peer's region. It counts for the ego too where the two have different regions.
        """
        me = self.me
        if me is None or me.region is None:
            return False
        return any(d.novelty_flags & PERSON_FLAG for d in self.attached.descriptors.values())

    @property
    def attached(self) -> FleetView:
        """The view without detached peers; the view itself where there are none.

        Example:
            >>> heard = {i: None for i in range(3)}
            >>> list(FleetView(0, 0.1, heard, {0: 0.0, 1: 0.2, 2: 1.5}).attached.descriptors)
            [0, 1]
        """
        limit_s = (self.detached_after_periods + ROUNDING_PERIODS) * self.period_s
        ego = self.ego
        far = [i for i, age_s in self.age_s.items() if not age_s <= limit_s and i != ego]
        if not far:
            return self
        descriptors, ages_s = plain_copy(self.descriptors), plain_copy(self.age_s)
        for i in far:
            del descriptors[i], ages_s[i]
        return FleetView(ego, self.period_s, descriptors, ages_s, self.detached_after_periods)

    @property
    def members(self) -> tuple[int, ...]:
        """Ids of the ego and its attached peers, ascending."""
        return tuple(sorted({self.ego, *self.attached.peers}))

    @property
    def roster(self) -> Roster:
        """The roster that the ego publishes; where it publishes none, its `members` at epoch 0."""
        me = self.me
        return Roster(0, self.members) if me is None or me.roster is None else me.roster

    @property
    def full_sharing_maps(self) -> int:
        """The maps that a drone sends, and receives, under full sharing: N − 1 in a fleet of N, heard or not.

        N counts the drones that the ego lists goodput to, and drones that were heard beyond them: with a roster, its members
        in place of the scenario's fleet. Drones with different rosters count differently until those agree.
        """
        me = self.me
        return max(len(self.peers), 0 if me is None else len(me.peer_goodput_mbps))

    def shares_features_with(self, peer: int) -> bool:
        """Whether the ego and a peer can fuse each other's feature maps.

        Drones with different networks can exchange detections, tracks, raw images and context, but no maps.
        """
        me, other = self.me, self.descriptors.get(peer)
        return me is None or other is None or me.feature_space == other.feature_space

    def shares_codes_with(self, peer: int) -> bool:
        """Whether the ego and a peer can read each other's codes: maps of one network through one codebook."""
        me, other = self.me, self.descriptors.get(peer)
        return self.shares_features_with(peer) and (me is None or other is None or me.codebook == other.codebook)


class Directive(NamedTuple):
    """One policy decision for one outgoing link (36 B on the wire).

    Two directives are equal if all fields but `reason` are equal.
    """

    source: int
    destination: int
    representation: Representation = Representation.NONE
    rho: float = 0.0
    """At most this share of the source's feature cells is sent on the link, as features or as codes, 0 … 1."""
    roi: Disc | None = None
    """Only cells, boxes or tracks inside; None is everywhere."""
    rate_hz: float = 0.0
    deadline_s: float = 0.1
    fusion_weight: float = 1.0
    """The weight of this link's payloads at the receiver, 0 … 1. The receiver multiplies it by its trust and by what each
    payload's own age leaves, so a policy need not."""
    duty_percent: int = 100
    """Share of frames in which the source runs perception at all, 0 … 100."""
    reason: str = ""
    """Why, as text for the record, at most `MAX_REASON` characters. It is not on the wire and no part of equality."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Directive) and self[:-1] == other[:-1]

    def __ne__(self, other: object) -> bool:
        return not (isinstance(other, Directive) and self[:-1] == other[:-1])

    def __hash__(self) -> int:
        return hash(self[:-1])


def nothing(source: int, destination: int, reason: str) -> Directive:
    """The directive to send nothing. Equal arguments give one object, because it is the most frequent directive.

    An id of another type than int, though equal to one, gives a directive of its own.
    """
    if type(source) is type(destination) is int and type(reason) is str:
        return _nothing(source, reason)[destination]
    return Directive(source, destination, reason=reason)


def nothing_to_all(source: int, destinations: tuple[int, ...], reason: str) -> tuple[Directive, ...]:
    """`nothing` for each of several destinations."""
    if type(destinations) is tuple and type(source) is int and type(reason) is str:
        return _nothing(source, reason).to_all(destinations)
    return tuple([nothing(source, destination, reason) for destination in destinations])


class _Nothing(dict[int, Directive]):
    """By destination, the directive to send nothing; made when it is first asked for."""

    def __init__(self, source: int, reason: str) -> None:
        self._source, self._reason = source, reason
        self._last: tuple[tuple[int, ...], tuple[Directive, ...]] = (), ()

    def to_all(self, destinations: tuple[int, ...]) -> tuple[Directive, ...]:
        """Those for several destinations; most often they are the same as the last time."""
        before, answer = self._last
        if len(destinations) == len(before) and all(map(is_, destinations, before)):
            return answer
        if len(destinations) < 2 or set(map(type, destinations)) != {int}:
            return tuple([nothing(self._source, destination, self._reason) for destination in destinations])
        made: tuple[Directive, ...] = itemgetter(*destinations)(self)  # in half the time of one after the other
        self._last = destinations, made
        return made

    def __missing__(self, destination: int) -> Directive:
        made = self[destination] = Directive(self._source, destination, reason=self._reason)
        return made


@lru_cache(maxsize=1 << 13)  # a few for each of a thousand drones
def _nothing(source: int, reason: str) -> _Nothing:
    return _Nothing(source, reason)


class Policy(Protocol):
    """Any callable of this shape is a policy."""

    def __call__(self, view: FleetView, /) -> Sequence[Directive]: ...


class Reposition(NamedTuple):
    """A request of a drone to look from another place than its slot in the formation.

    `fleet.viewpoints` grants as much of it as separation, fence, speed and acceleration allow. The request is valid
    until the drone's next decision. A request for the place where the drone already is moves nothing.
    """

    x_m: float
    """The place over ground where the drone would be now, ENU; it moves on with the formation."""
    y_m: float
    reason: str = ""
    """Why, as text for the record, at most `MAX_REASON` characters."""


class Viewpoint(Protocol):
    """The optional second part of a policy. It is called with the view of every decision; None means the drone's slot."""

    def __call__(self, view: FleetView, /) -> Reposition | None: ...


AnyPolicy = TypeVar("AnyPolicy", bound=Callable[..., Sequence[Directive]])


def looks_from(viewpoint: Callable[..., Reposition | None]) -> Callable[[AnyPolicy], AnyPolicy]:
    """Mark a policy as one that also chooses viewpoints. Keyword parameters that both functions have are given to both."""

    def mark(policy: AnyPolicy) -> AnyPolicy:
        marked: Any = policy
        marked.viewpoint = viewpoint
        return policy

    return mark


OTHER_NETWORK = "another network: it cannot fuse this drone's maps"
# slow to look up, each time
_NONE, _FEATURES = Representation.NONE, Representation.FEATURES
_CODES, _DETECTIONS = Representation.CODES, Representation.DETECTIONS


def boxes_across_networks(policy: AnyPolicy) -> AnyPolicy:
    """Let a policy send detections where it would send features or codes to a drone with another network or codebook.

    Region, rate, deadline, weight and duty stay as the policy decided. A peer of the same feature space gets what the
    policy decided.
    """

    @functools.wraps(policy)
    def decide(view: FleetView, **params: object) -> Sequence[Directive]:
        directives = policy(view, **params)
        foreign = [
            k
            for k, d in enumerate(directives)
            if d[2] is not _NONE  # as most links carry nothing
            and (
                (d[2] == _FEATURES and not view.shares_features_with(d.destination))
                or (d[2] == _CODES and not view.shares_codes_with(d.destination))
            )
        ]
        if not foreign:
            return directives
        changed = list(directives)
        for k in foreign:
            changed[k] = changed[k]._replace(representation=_DETECTIONS, rho=0.0, reason=OTHER_NETWORK)
        return changed

    decide.__signature__ = inspect.signature(policy)  # type: ignore[attr-defined]
    return decide  # type: ignore[return-value]


class PolicyError(SortieError):
    """A policy broke its contract; the message names the directive, the field and the bound."""


class DirectiveBound(NamedTuple):
    """The highest value of a directive's field, and what kind of value it is. The lowest value is 0 for every field."""

    high: float
    kind: str

    def breaks(self, name: str, value: Any) -> str | None:
        """What is wrong with a number (NaN is out of bounds), or None."""
        return None if 0 <= value <= self.high else f"{name} is {value!r}, must be in [0, {self.high:g}]"


DIRECTIVE_BOUNDS: dict[str, DirectiveBound] = {
    "representation": DirectiveBound(
        int(max(Representation)), "a Representation, such as sortie.Representation.DETECTIONS"
    ),
    "rho": DirectiveBound(1.0, "a number"),
    "rate_hz": DirectiveBound(30.0, "a number"),
    "deadline_s": DirectiveBound(10.0, "a number"),
    "fusion_weight": DirectiveBound(1.0, "a number"),
    "duty_percent": DirectiveBound(100, "a whole number"),
}
"""The bounds of a directive's numbers: for policies, for the shield and for what comes in over the wire."""
MAX_REASON = 1000
"""A reason has at most so many characters: a fleet writes tens of thousands of them into a record."""
MAX_REPOSITION_M = 200.0
"""A drone may not ask for a place farther away than this."""
