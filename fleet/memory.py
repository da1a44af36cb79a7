"""What one drone knows of the others: their descriptors, their payloads, and how far it trusts each of them."""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Iterable, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.fleet.clock import PeerClocks
from sortie.fleet.coverage import LOOK_STANDS_S
from sortie.fleet.gate import Payload
from sortie.fleet.messages.auth import Dropped, DropReason, Opened
from sortie.fleet.messages.extensions import WIDE_FROM
from sortie.fleet.peers import PeerTable, loops
from sortie.fleet.plane import DroneStatus, FleetRules
from sortie.fleet.probes import Probes, window_of
from sortie.fleet.standings import STRIKES_TO_DOUBT, UNJUDGED, Standing, Standings
from sortie.fleet.trust import (
    JUDGED_EVERY_S,
    LONG_SILENCE,
    Arrival,
    charge_loop,
    discounted,
    judge,
    split_arrivals,
)
from sortie.perception.geometry import USUAL
from sortie.perception.types import Capture
from sortie.policies.contract import ROUNDING_PERIODS, Descriptor, FleetView
from sortie.policies.geometry import note_circles
from sortie.scenarios.disc import LISTED_MEMBERS
from sortie.scenarios.representation import MAPS, Representation

_FEATURES, _CODES = Representation.FEATURES, Representation.CODES  # slow to look up, each time


class Received(NamedTuple):
    """One payload as it arrived, and the capture that it was made of."""

    capture: Capture
    payload: Payload
    t_done_s: float
    stamp_s: float
    """When it was captured, by its sender's clock."""
    missing: tuple[int, ...] = ()
    """Ranks of its feature cells that did not arrive, ascending; rank 0 is the best cell."""
    phy_mbps: float = math.inf
    """The data rate at which its frames arrived."""


class PeerMemory:
    """The descriptors and payloads that one drone received, and its trust in each peer."""

    def __init__(self, drone: int, rules: FleetRules, status: DroneStatus, table: PeerTable | None = None) -> None:
        """Args: `table` holds the times of all receivers that hear the same datagrams; None makes one for this drone alone."""
        self.drone, self.status = drone, status
        self.held: dict[int, Received] = {}
        """The newest payload of each peer."""
        self.table = table = table or PeerTable(1, window_of(rules.detached_after_periods), drone)
        self.row = row = drone - table.first
        self.probes = Probes(table, row, rules.descriptor_period_s)
        self._rules = rules
        self._period_s, self._fresh_s = rules.descriptor_period_s, rules.fresh_s
        self.clocks = PeerClocks(rules.period_s, table.ahead_s[row], table.watched[row])
        self._heard_s, self._stamps_s, self._ahead_s = table.heard_s[row], table.stamps_s[row], table.ahead_s[row]
        self._circles = table.circles[row]
        self._known: dict[int, Descriptor] = {}  # by ascending id
        self.ids: NDArray[np.int64] = np.empty(0, np.int64)
        """Of whom it has a descriptor, itself included, ascending; another array once there is one more."""
        self.others: NDArray[np.intp] = np.empty(0, np.intp)
        """Places in `ids` of all but itself."""
        self._standings = Standings({}, table.heard_s.shape[1] if rules.trust else 0)
        self._doubted: frozenset[int] = frozenset()
        self._arrivals: dict[int, list[Arrival]] = {}
        self._judged_at_s = -math.inf
        self._cameras = {i: its.cameras for i, its in rules.makes.items() if its.cameras != USUAL}
        self._stations = frozenset(i for i, its in rules.makes.items() if not its.flies)
        self._loops = loops()
        charge_loop()

    def hear(self, opened: Opened | Dropped, now_s: float) -> DropReason | None:
        """Take a datagram in, as `hear`; returns why it was refused, None if it was accepted."""
        refused = hear([self], opened, now_s)
        return refused[0][1] if refused else None

    def meet(self, descriptor: Descriptor, now_s: float) -> None:
        """Take in a descriptor, entered in the table already, of a new peer or of one with another clock."""
        sender = descriptor.agent_id
        self.clocks.heard(sender, now_s + self.status.clock_skew_s - descriptor.stamp_ns * 1e-9)
        if sender in self._known:
            self._known[sender] = descriptor  # the table has the rest already
        else:
            self.hold(descriptor, now_s)

    def hold(self, descriptor: Descriptor, now_s: float) -> None:
        """Replace the last descriptor of this sender, which may be the drone itself."""
        known, sender = self._known, descriptor.agent_id
        if sender in known:
            known[sender] = descriptor
        else:  # by ascending id, so that the order of arrival decides nothing
            self._known = dict(sorted([*known.items(), (sender, descriptor)]))
            self.ids = np.array(list(self._known), np.int64)
            self.others = np.flatnonzero(self.ids != self.drone)
        self._heard_s[sender], self._stamps_s[sender] = now_s, descriptor.stamp_ns * 1e-9
        self._circles[sender] = _circle(descriptor)

    def can_fuse(self, payload: Payload) -> bool:
        """Whether the drone can use it. Feature cells of another network mean nothing to it, and codes of another codebook.

        Without a network no map means anything to it.
        """
        rung, status = payload.representation, self.status
        if not status.looks and rung in MAPS:
            return False
        if rung == _CODES and payload.codebook != status.codebook:
            return False
        return rung not in (_FEATURES, _CODES) or payload.feature_space == status.feature_space

    def receive(self, received: Received) -> None:
        """Keep a peer's payload, unless a newer capture of that peer arrived before it, or this drone cannot fuse it."""
        peer = received.capture.drone
        held = self.held.get(peer)
        self.status.work.payload_bytes += received.payload.size_bytes
        self.status.work.maps += received.payload.representation in MAPS
        if self._rules.trust:
            delay_s = self._rules.equipment(peer).compute_delay_s
            took_s = self.payload_age_s(received, received.t_done_s) - delay_s
            self._arrivals.setdefault(peer, []).append(
                Arrival(
                    0 if received.missing else received.payload.size_bytes, took_s, received.phy_mbps, received.t_done_s
                )
            )
        if not self.can_fuse(received.payload):
            return
        if self.status.airborne and (held is None or received.capture.t_s >= held.capture.t_s):
            self.held[peer] = received

    def in_own_time(self, peer: int, stamp_s: float) -> float:
        """A moment of a peer's clock in this drone's time, which the air's times are in."""
        return stamp_s - self.status.clock_skew_s + self.clocks.offset_s.get(peer, 0.0)

    def payload_age_s(self, received: Received, now_s: float) -> float:
        """A payload's age as this drone knows it: by its stamp and the two clocks, and at least the time since it arrived."""
        return max(now_s - self.in_own_time(received.capture.drone, received.stamp_s), now_s - received.t_done_s)

    @property
    def peers(self) -> list[int]:
        """Every drone heard so far."""
        return [i for i in self._known if i != self.drone]

    def heard_ago_s(self, peer: int, now_s: float) -> float:
        """Time since the last descriptor of a peer arrived, whatever its stamp; infinite if none did."""
        return now_s - float(self._heard_s[peer]) if peer in self._known else math.inf

    def ages(self, now_s: float) -> NDArray[np.float64]:
        """Age of the descriptor of each of `ids`, by this drone's clock and the peers' offsets from it, and at least the
        time since it arrived."""
        clock_s = now_s + self.status.clock_skew_s
        found: NDArray[np.float64] = self._loops.ages(
            clock_s, now_s, self.ids, self._heard_s, self._stamps_s, self._ahead_s
        )
        return found

    def ages_s(self, now_s: float) -> dict[int, float]:
        """The same by peer."""
        return dict(zip(self._known, self.ages(now_s).tolist(), strict=True))

    def view(self, now_s: float, ages: NDArray[np.float64] | None = None) -> FleetView:
        """What a policy reads: the fleet as this drone knows it, without the claims that it doubts.

        Args: `ages`: those of this moment; None works them out.
        """
        known = dict(self._known)
        for doubted in self._doubted:
            known[doubted] = discounted(known[doubted])
        shown = note_circles(known, self.ids, self._circles.copy())
        ages_s = self.ages(now_s) if ages is None else ages
        by_peer = MappingProxyType(dict(zip(known, ages_s.tolist(), strict=True)))
        return FleetView(self.drone, self._period_s, shown, by_peer, self._rules.detached_after_periods)

    def members(self, now_s: float, here_m: tuple[float, float, float]) -> tuple[int, ...]:
        """Ids of the drone and its attached peers, ascending; of the peers that claim to be nearest, where a descriptor cannot
        list them all."""
        limit_s = (self._rules.detached_after_periods + ROUNDING_PERIODS) * self._period_s
        found: list[int] = self.ids[self.ages(now_s) <= limit_s].tolist()
        if self.drone not in found:
            insort(found, self.drone)
        if len(found) > LISTED_MEMBERS:
            others = [i for i in found if i != self.drone]
            if others[-1] >= WIDE_FROM:
                away_m = np.linalg.norm(np.array([self._known[i].position_m for i in others]) - here_m, axis=1)
                nearest = np.array(others)[np.argsort(away_m, kind="stable")[: LISTED_MEMBERS - 1]]
                found = sorted([self.drone, *nearest.tolist()])
        return tuple(found)

    def believed(self) -> list[Descriptor]:
        """The latest descriptors of the peers that it does not doubt."""
        return self._believed(self._known)

    def believed_near(self, x_m: float, y_m: float, reach_m: float) -> list[Descriptor]:
        """Those of `believed` that claim to be in a square about a place, as far as `reach_m` to each side."""
        return self._believed(self.ids[self._loops.near(self.ids, self._circles, x_m, y_m, reach_m)].tolist())

    def _believed(self, of: Iterable[int]) -> list[Descriptor]:
        return [self._known[i] for i in of if i != self.drone and i not in self._doubted]

    def trust_in(self, peer: int) -> float:
        """Trust in a peer, 0 … 1. The fusion weight of its payloads is multiplied by it."""
        return self._standings.get(peer, UNJUDGED).trust

    def judge(self, now_s: float) -> list[tuple[int, Standing]]:
        """Check each claim once that peers made since the last call.

        Returns:
            Peers for which trust changed, with their new standing.
        """
        before = self._standings
        if now_s - self._judged_at_s >= LONG_SILENCE * JUDGED_EVERY_S:  # the drone itself was away
            before = Standings(before)
            before.rows["unheard"] = LONG_SILENCE
        since_s, self._judged_at_s = max(now_s - self._fresh_s, self._judged_at_s), now_s
        looking: set[int] = set()
        # its own claims stand, however long ago another of its nodes published them
        since = (self._heard_s[self.ids] > since_s).tolist()
        heard = {i: d for (i, d), is_new in zip(self._known.items(), since, strict=True) if is_new or i == self.drone}
        arrivals, too_old_s = {}, now_s - max(2.0 * JUDGED_EVERY_S, 2.0 * self._period_s)
        for i, came in self._arrivals.items():
            claimed_s = (
                min(float(self._heard_s[i]), self.in_own_time(i, heard[i].stamp_ns * 1e-9)) if i in heard else too_old_s
            )
            arrivals[i], later = split_arrivals(came, claimed_s)
            if any(claimed_s - a.sent_s < LOOK_STANDS_S / 2 for a in arrivals[i]):
                looking.add(i)
            self._arrivals[i] = [a for a in later if a.t_done_s > too_old_s]
        self._standings = after = judge(
            before,
            self.drone,
            heard,
            arrivals,
            self._rules.form,
            looking,
            self._cameras,
            self._stations,
        )
        strikes, were = after.rows["strikes"], before.rows["strikes"]
        self._doubted = frozenset(np.flatnonzero(strikes >= STRIKES_TO_DOUBT).tolist())
        moved = np.flatnonzero(strikes != were).tolist()
        return [(peer, after[peer]) for peer in moved if after[peer].trust != before.get(peer, UNJUDGED).trust]


def _circle(d: Descriptor) -> tuple[float, float, float]:
    """The footprint that a drone claims."""
    x_m, y_m, _ = d.position_m
    return float(x_m), float(y_m), float(d.footprint_radius_m)


def hear(receivers: Sequence[PeerMemory], opened: Opened | Dropped, now_s: float) -> list[tuple[int, DropReason]]:
    """Take a datagram in at all drones that it reached: a credible one replaces the last descriptor of its sender.

    It was opened and decoded once for all of them. Whether it is a replay is each receiver's own question: a drone takes only
    counters above the highest that it has taken from this sender with this key. What is refused changes nothing.

    Args:
        receivers: rows of one table.
        opened: the datagram.
        now_s: when it arrived.

    Returns:
        The drones that refused it, and why.
    """
    if isinstance(opened, Dropped):
        return [(memory.drone, opened.reason) for memory in receivers]
    if not receivers:
        return []
    descriptor, key_id, counter = opened
    sender, first = descriptor.agent_id, receivers[0]
    table, rules = first.table, first._rules
    if sender >= table.heard_s.shape[1]:  # no drone of this fleet has such an id
        return [(memory.drone, DropReason.MALFORMED) for memory in receivers]
    module, count = loops(), len(receivers)
    found = module.hear(
        np.fromiter([memory.row for memory in receivers], np.int64, count),
        table.first,
        np.fromiter([memory.status.clock_skew_s for memory in receivers], np.float64, count),
        sender,
        descriptor.stamp_ns * 1e-9,
        _circle(descriptor),
        now_s,
        key_id is not None,
        np.uint64(counter),
        rules.period_s,
        rules.descriptor_period_s,
        table.window,
        table.counters(key_id or 0),
        table.heard_s,
        table.stamps_s,
        table.circles,
        table.watched,
        table.bits,
    ).tobytes()
    taken, unusual, refused = module.TAKEN, module.UNUSUAL, module.REFUSED
    if found.count(taken) == count:  # as nearly always
        for memory in receivers:
            memory._known[sender] = descriptor
        return []
    drops = []
    for memory, what in zip(receivers, found, strict=True):
        if what == taken:
            memory._known[sender] = descriptor
        elif what == unusual:
            memory.meet(descriptor, now_s)
        elif what == refused:
            drops.append((memory.drone, DropReason.REPLAYED))
    return drops
