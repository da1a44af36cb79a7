"""What the plane counts in: periods of a descriptor, seconds of judging, periods of a rate; and what a claim answers for.

A drone may publish in every frame or in every third. Ages, staleness and probes count in periods of its descriptors.
Judging counts in seconds, whatever is published. Each claim is judged once, and for what its payloads can tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from agent_rig import Rig, capture, descriptor, memory, payload

from sortie.fleet.flight.descent import descending, level_again
from sortie.fleet.flight.displaced import displaced
from sortie.fleet.flight.motion import Trajectories, fly
from sortie.fleet.flight.viewpoints import Move, Plan, bounds_of, course_of, grant
from sortie.fleet.gate import Gate
from sortie.fleet.memory import Received
from sortie.fleet.messages.wire import decode_descriptor
from sortie.fleet.traces import DroneTrace, PoseTrace, follow
from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.staleness import LinkHealth
from sortie.scenarios.schema import Fleet

FULL = Directive(0, 1, Representation.FEATURES, 0.5, None, 10.0)
GRID = b"\xff" * 64
"""More than any camera sees: a doubt in itself."""


def to_all(view: FleetView) -> list[Directive]:
    return [FULL._replace(destination=p) for p in view.peers]


class Told(Rig):
    """An agent with what its log heard of its link to drone 1."""

    def __init__(self, **rules: Any) -> None:
        self.told: list[tuple[float, LinkHealth]] = []
        super().__init__(to_all, dwell_s=0.0, hysteresis=0.0, trust=False, **rules)

    def directive(self, t_s: float, asked: Directive, enforced: Directive, link: LinkHealth, reason: str) -> None:
        if not self.told or self.told[-1][1] != link:
            self.told.append((t_s, link))


# --- periods of a descriptor ------------------------------------------------------------------------------------


@pytest.mark.parametrize("degraded", [3.0, 5.0])
@pytest.mark.parametrize("every", [1, 2, 3])
def test_thresholds_of_age_are_periods_of_a_descriptor(every: int, degraded: float) -> None:
    """A peer that is heard once: its link is degraded and detached after so many of its periods, and then gets no handshake."""
    rig = Told(publish_every=every, degraded_after_periods=degraded, detached_after_periods=10.0)
    rig.agent._handshake_bytes = lambda: 64
    rig.hear(1)
    rig.env.run(until=4.0)
    period_s = 0.1 * every
    assert [link for _, link in rig.told] == [LinkHealth.FRESH, LinkHealth.DEGRADED, LinkHealth.DETACHED]
    for (t_s, _), periods in zip(rig.told[1:], (degraded, 10.0), strict=True):
        assert periods * period_s < t_s <= periods * period_s + 0.1 + 1e-9
    assert max(t_s for t_s, _ in rig.shaken) == pytest.approx(10.0 * period_s, abs=0.1)
    assert max(t_s for t_s, _, p, _ in rig.sent if p.representation == Representation.FEATURES) <= (
        degraded * period_s + 0.1 + 1e-9
    )


@pytest.mark.parametrize("every", [1, 3])
def test_peers_are_judged_once_a_second_however_often_they_publish(every: int, monkeypatch: Any) -> None:
    rig = Rig(lambda view: [], dwell_s=0.0, publish_every=every)
    judged: list[float] = []
    monkeypatch.setattr(rig.memory, "judge", lambda now_s: judged.append(now_s) or [])
    rig.env.run(until=4.5)
    assert judged == pytest.approx([0.01, 1.01, 2.01, 3.01, 4.01])


@pytest.mark.parametrize("skew_s", [0.0, 2.5])
def test_a_stamp_is_of_the_moment_of_sensing_by_the_own_clock(skew_s: float) -> None:
    """Not of the moment of publishing, which is a little later."""
    rig = Rig(lambda view: [], dwell_s=0.0)
    rig.memory.status.clock_skew_s = skew_s
    rig.env.run(until=0.55)
    stamps = [decode_descriptor(datagram).stamp_ns * 1e-9 for _, datagram in rig.published]
    assert stamps == pytest.approx([0.1 * k + skew_s for k in range(6)], abs=1e-6)
    assert [t_s for t_s, _ in rig.published] == pytest.approx([0.1 * k + 0.01 for k in range(6)])


@pytest.mark.parametrize("rate_hz", [2.0, 3.0, 5.0])
@pytest.mark.parametrize("rested_s", [0.7, 5.0])
def test_a_link_that_could_not_send_does_not_make_up_for_it(rate_hz: float, rested_s: float) -> None:
    """Whatever kept it from sending: from then on it sends at its rate, one payload a frame at most."""
    gate = Gate()
    gate.enforce(FULL._replace(rate_hz=rate_hz))
    assert len(gate.due(0.0)) == 1
    sent = [k for k in range(20) if gate.due(rested_s + 0.1 * k)]
    assert len(sent) == pytest.approx(2 * rate_hz, abs=1)
    assert np.diff(sent[1:]).min() >= int(10 / rate_hz)  # the first may keep to the slots of before


# --- what a claim answers for -----------------------------------------------------------------------------------


def strikes(mine: Any, peer: int = 1) -> int:
    standing = mine._standings.get(peer)
    return 0 if standing is None else standing.strikes


@pytest.mark.parametrize("every", [1, 10])
def test_a_claim_is_judged_once(every: int) -> None:
    """Also one that is still fresh at the next judgement, because its sender publishes seldom."""
    mine = memory(publish_every=every)
    mine.hold(descriptor(0, 10.0), 10.0)
    mine.hold(descriptor(1, 10.0, coverage_grid=GRID), 10.0)
    mine.judge(10.05)
    assert strikes(mine) == 1
    mine.judge(11.05)
    assert strikes(mine) == 1
    mine.hold(descriptor(1, 11.9, coverage_grid=GRID), 11.9)
    mine.judge(12.05)
    assert strikes(mine) == 2


@pytest.mark.parametrize(("every", "judged"), [(1, 0), (3, 1)])
def test_a_claim_that_is_no_longer_fresh_is_not_judged(every: int, judged: int) -> None:
    """Its drone may be gone since: who left does not fall into doubt for its last word. Fresh is three of its periods."""
    mine = memory(publish_every=every)
    mine.hold(descriptor(0, 10.0), 10.0)
    mine.hold(descriptor(1, 9.9), 9.9)
    mine.judge(10.05)
    before = strikes(mine)
    mine.hold(descriptor(1, 10.5, coverage_grid=GRID), 10.5)
    mine.judge(11.05)
    assert strikes(mine) == before + judged


@pytest.mark.parametrize(("missing", "doubted"), [((), True), ((90, 91), False)])
def test_a_payload_that_came_in_part_says_nothing_of_what_its_link_carries(
    missing: tuple[int, ...], doubted: bool
) -> None:
    """How much of it came is not known to the byte. A whole one that came fast makes a weak link a lie."""
    mine = memory()
    mine.hold(descriptor(0, 10.0), 10.0)
    for t_s in (9.4, 9.6, 9.8):
        mine.receive(Received(capture(1, t_s), payload(200_000), t_s + 0.05, t_s, missing, 600.0))
    poor = b"\x55" * 64
    mine.hold(descriptor(1, 10.0, peer_goodput_mbps=(0.5,) * 4, coverage_grid=poor), 10.0)
    mine.judge(10.05)
    assert ("goodput" in mine._standings[1].reason) == doubted


# --- ways that follow each other ---------------------------------------------------------------------------------


def test_groups_that_move_at_random_have_ways_of_their_own() -> None:
    """Each group, the fleet, another seed and another replication: the same start, other places."""
    alone = [{"drones": [i], "mobility": "random_waypoint"} for i in (1, 2)]
    fleet = Fleet(drones=3, mobility="random_waypoint", groups=alone)
    ways = np.stack(
        [
            fly(fleet, 60.0, 0.1, seed, replication).position_m[:, drone, :2]
            for seed, replication in ((5, 0), (6, 0), (5, 1))
            for drone in range(3)
        ]
    )
    assert np.ptp(ways[:, 0], axis=0).max() < 4.0  # but for their jitter they begin in one place
    apart = np.linalg.norm(ways[:, None] - ways[None], axis=-1).max(axis=-1)
    assert apart[~np.eye(len(ways), dtype=bool)].min() > 20.0


STILL = Fleet.model_validate({"motion": {"pose_jitter_m": 0.0, "gust_sigma_mps": 0.0}})


def _moved(flown: Trajectories, base: Trajectories, frame: int) -> Trajectories:
    course = course_of(STILL, np.asarray(base.time_s))
    plans: list[Plan] = [()] * 5
    move = grant(2, (5.0, 15.0), plans, course, bounds_of(STILL), frame)
    assert isinstance(move, Move)
    plans[2] = (move,)
    return displaced(flown, base, course, plans, frame)


@pytest.mark.parametrize("order", [("descends", "moves"), ("moves", "descends"), ("descends", "moves", "climbs")])
def test_whatever_follows_whatever_a_velocity_is_the_slope_of_its_place(order: Sequence[str]) -> None:
    """A drone that goes home, moves within the formation and comes back, in any order: each keeps what it does not change."""
    base = fly(STILL, 30.0, 0.1, 3)
    flown = base
    for frame, what in zip((50, 100, 200), order, strict=False):
        match what:
            case "moves":
                flown = _moved(flown, base, frame)
            case "descends":
                flown = descending(flown, 2, frame, 1.5)
            case _:
                flown = level_again(flown, base, 2, frame)
    slope = (flown.position_m[2:, 2] - flown.position_m[:-2, 2]) / 0.2
    off = np.abs(slope - flown.velocity_mps[1:-1, 2])
    jumps = np.zeros(len(off), bool)  # a descent begins at once, and who joins appears in its slot
    for frame in (50, 100, 200):
        jumps[frame - 2 : frame + 1] = True
    assert off[~jumps].max() < 0.02
    assert np.abs(flown.velocity_mps[60:, 2, 2]).max() == pytest.approx(1.5)
    np.testing.assert_allclose(
        flown.est_position_m[:, 2] - flown.position_m[:, 2],
        base.est_position_m[:, 2] - base.position_m[:, 2],
        atol=1e-9,
    )


# --- work ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("handshake", [0, 132])
def test_every_byte_that_a_drone_sends_is_work(handshake: int) -> None:
    """Payloads and handshakes, to each peer; what it looked at and decided as well."""
    rig = Rig(to_all, dwell_s=0.0, handshake=handshake)
    rig.hear(1, 2)
    rig.env.run(until=0.25)
    work = rig.memory.status.work
    assert len(rig.sent) == 2 * 2
    assert len(rig.shaken) == (2 * 2 if handshake else 0)
    assert work.payload_bytes == sum(p.size_bytes for _, _, p, _ in rig.sent) + handshake * len(rig.shaken)
    assert (work.looks, work.decisions, work.maps) == (3, 3, 0)


# --- traces -------------------------------------------------------------------------------------------------------


def test_before_and_after_its_trace_a_drone_has_neither_speed_nor_acceleration() -> None:
    """One that speeds up from its first row to its last; within, both are the slopes of what is flown."""
    base = fly(STILL, 6.0, 0.1, 3)
    t_s = np.arange(2.0, 4.01, 0.1)
    along = 1.5 * (t_s - 1.0) ** 2
    place = np.stack([along, 0 * along, 60 + 0 * along], axis=1)
    flown = follow(base, {1: DroneTrace(PoseTrace(t_s, place, None, None), None)}, 0.1)
    speed, push = flown.velocity_mps[:, 1], flown.acceleration_mps2[:, 1]
    beyond = (base.time_s < 2.0 - 1e-6) | (base.time_s > 4.0 + 1e-6)
    assert beyond.sum() == 39
    assert not speed[beyond].any()
    assert not push[beyond].any()
    assert push[22:38, 0] == pytest.approx(np.full(16, 3.0), abs=1e-6)
    assert speed[25, 0] == pytest.approx(3.0 * 1.5)
