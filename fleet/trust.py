"""Trust in what peers claim: each claim is held against what the listener can check for itself.

Coverage is held against the pose beside it (what its cameras can show from there) and against the payloads of its
looks (who looks from above the roofs sees something), goodput against the payloads that arrived, and battery against the fleet's: no charge
comes back, and no drone flies for nothing. A ground station may be on mains, so its charge need not fall.

Doubts have to last: a judgement is made once a second, and only the second in a row that finds something lowers trust.
Without a doubt trust is exactly 1.

All of it is pure: `judge` takes what is known and gives what is thought of a peer next.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from functools import cache
from itertools import pairwise
from statistics import median
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from sortie.fleet.coverage import LOOK_STANDS_S, attitude, camera_states, loops, unpack_grid
from sortie.fleet.messages.compact import FULL, Form
from sortie.fleet.standings import MOST_STRIKES, Standing, Standings
from sortie.perception.geometry import USUAL, Cameras
from sortie.policies.contract import COVERAGE_BYTES, COVERAGE_CELL_M, COVERAGE_CELLS, Coverage, Descriptor

JUDGED_EVERY_S = 1.0

# --- coverage
FALSE_CELLS = 4
"""So many cells that cannot be so are a doubt, and so few cells of a drone that looks."""
ROOFS_M = 20.0
"""Lower than this a drone may see next to nothing: houses hide the ground from it."""

# --- goodput
LARGE_BYTES = 10_000
"""Smaller payloads say too little about a link."""
COUNTS_FOR_S = 2.0 * JUDGED_EVERY_S
ROUNDING_S = 1e-6
UNDERSTATED, OVERSTATED = 0.1, 1.5
"""A claim is a doubt below the first times what was seen to arrive (an estimate rises by 0.3 of the gap at each
sample), or above the second times the data rate at which it came: no link carries more than that."""

# --- battery; a jump, and what else the charge is watched for, is in `sortie.fleet.trust_loops`
RISE = 0.03
"""Charge that may come back: estimators of real drones correct themselves by a few percent."""
PERCENT = 0.01
"""Estimators that tell charge in whole percents let it fall in steps: so much of a fall may go unseen."""
FALL, FALL_SHARE = 0.005, 0.1
"""When the fleet's charge fell by so much in the median, who fell by less than this share of it is doubted: even a
battery of ten times the others' capacity falls that far."""
LONG_SILENCE = 30
"""After so many judgements without a claim of a drone its charge is watched anew: it may have rested on the ground. In a
shorter silence it is taken to have flown on behind a weak link. Had it rested, four seconds of flight before that would
still be more than FALL_SHARE of the others'."""

UNKNOWN_GRID = bytes(64)


class Arrival(NamedTuple):
    """A payload as its receiver saw it come in."""

    size_bytes: int
    took_s: float
    """From its capture, compute delay taken off, to its last byte."""
    phy_mbps: float
    """The data rate of its frames, as its receiver's radio knows it; infinite where it does not."""
    t_done_s: float = -math.inf
    """When its last byte came."""

    @property
    def sent_s(self) -> float:
        """When it was handed to its sender's radio."""
        return self.t_done_s - self.took_s

    @property
    def mbps(self) -> float:
        """What the link carried at the least: waiting counts as transfer."""
        return self.size_bytes * 8e-6 / max(self.took_s, 1e-4)


@cache
def charge_loop() -> Any:
    """The compiled loop, imported and made ready at its first use."""
    from sortie.fleet.trust_loops import watch_charge

    watch_charge(Standings({}).rows, np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.bool_), 0.0)
    return watch_charge


def judge(
    standings: Mapping[int, Standing],
    ego: int,
    known: Mapping[int, Descriptor],
    arrivals: Mapping[int, Sequence[Arrival]],
    form: Form = FULL,
    looking: Container[int] = (),
    cameras: Mapping[int, Cameras] = MappingProxyType({}),
    stations: Container[int] = (),
) -> Standings:
    """What `ego` thinks of everyone after one more second.

    Args:
        standings: what it thought, itself included; empty at first.
        known: the latest descriptor of every drone that it heard since it last judged, and its own.
        arrivals: payloads that reached it in this second, by sender.
        form: how finely descriptors are written; what rounding can do is no doubt.
        looking: who looked shortly before its claim, as payloads of that look show.
        cameras: those of drones that have others than the usual ones.
        stations: who stands on the ground. Their charge says nothing about the fleet's fall, and may stay as it is.

    Returns:
        Standings of all in `known`, and of others a second older: one strike more where a claim cannot be so, one less
        where all can. The ego has nothing to doubt in itself, but its battery is one of the fleet's.
    """
    claims, ids, peers = list(known.values()), np.array(list(known), np.int64), [i for i in known if i != ego]
    after = Standings(standings, int(ids.max(initial=-1)) + 1)
    claimed_soc = np.array([d.battery_soc for d in claims])
    flies = np.array([i not in stations for i in known], np.bool_) if stations else np.ones(len(ids), np.bool_)
    false_charge, others_fell = charge_loop()(after.rows, ids, claimed_soc, flies, form.soc_step)
    wrong = {}  # what coverage says of peers
    if math.isfinite(form.blur_m):
        kinds = [cameras.get(i, USUAL) for i in peers] if cameras else [USUAL] * len(peers)
        for peer, cells in zip(peers, _count_cells([known[i] for i in peers], form.blur_m, kinds), strict=True):
            if cells.seen < FALSE_CELLS or cells.impossible >= FALSE_CELLS:
                wrong[peer] = _coverage_doubt(cells, peer in looking)
    doubts, open_to_doubt = {}, {*wrong, *arrivals, *ids[false_charge].tolist()} - {ego}
    for k, (peer, claim) in enumerate(known.items()):
        if peer not in open_to_doubt:
            continue
        doubt, came = wrong.get(peer, ""), arrivals.get(peer)
        if not doubt and came and claim.counts(ego):  # who leaves the ego out claims no goodput to it
            doubt = goodput_doubt(claim.goodput_to(ego), came, form.goodput_step_mbps)
        if not doubt and false_charge[k]:
            standing = after[peer]
            unseen = max(3 * form.soc_step, 0.0 if standing.fine else PERCENT)
            doubt = battery_doubt(
                claim.battery_soc, standing.least_soc, standing.first_soc, float(others_fell[k]), unseen
            )
        if doubt:
            doubts[peer] = doubt
    after.reasons |= doubts
    strikes, struck = after.rows["strikes"], np.array(list(doubts), np.int64)
    raised = np.minimum(strikes[struck] + 1, MOST_STRIKES)
    strikes[ids] = np.maximum(strikes[ids], 1) - 1
    strikes[struck] = raised
    return after


def discounted(d: Descriptor) -> Descriptor:
    """A doubted drone's descriptor as policies get to read it: where it is, and nothing of what it says of itself."""
    return d._replace(
        coverage_grid=UNKNOWN_GRID,
        novelty_flags=0,
        battery_soc=0.0,
        peer_goodput_mbps=(0.0,) * len(d.peer_goodput_mbps),
    )


# --- the three checks ----------------------------------------------------------------------------


def coverage_doubt(d: Descriptor, blur_m: float = 0.0, looks: bool = False, cameras: Cameras = USUAL) -> str:
    """What a coverage grid says that its pose or its payloads forbid; empty where it may be so.

    How much is hidden from a drone, others cannot know. A drone that looks from above the roofs sees some of the ground.

    Args:
        d: the claim.
        blur_m: how far a cell may be off by the descriptor's form.
        looks: whether the drone is known to look.
        cameras: the drone's.
    """
    return _coverage_doubt(_count_cells([d], blur_m, [cameras])[0], looks)


def _coverage_doubt(cells: _Cells, looks: bool) -> str:
    if cells.impossible >= FALSE_CELLS:
        return f"coverage: {cells.impossible} cells seen well that its cameras cannot show so"
    if looks and cells.is_high and cells.seen < FALSE_CELLS:
        return f"coverage: {cells.seen} cells seen by a drone that looks"
    return ""


class _Cells(NamedTuple):
    """What a coverage grid claims, in cells."""

    impossible: int
    """Seen well, where the drone's cameras cannot show it so from its pose."""
    seen: int
    is_high: bool
    """Whether the drone is above the roofs."""


_COUNTED: dict[int, tuple[Descriptor, float, Cameras, _Cells]] = {}
"""By the identity of the claim, which all who heard it share."""
_MOST_COUNTED = 4096


def _count_cells(claims: Sequence[Descriptor], blur_m: float, cameras: Sequence[Cameras]) -> list[_Cells]:
    """The cells that claims see, and those that they cannot; claims that are judged by several drones are counted once.

    Args:
        claims: the claims.
        blur_m: how far a cell may be off by the descriptors' form.
        cameras: of the drone of each claim.
    """
    found = list(map(_COUNTED.get, map(id, claims)))
    new = [
        k
        for k, (d, its, one) in enumerate(zip(claims, cameras, found, strict=True))
        if one is None or one[0] is not d or one[1] != blur_m or (one[2] is not its and one[2] != its)
    ]
    if len(_COUNTED) + len(new) > max(_MOST_COUNTED, 2 * len(claims)):
        _COUNTED.clear()
    for kind in dict.fromkeys([cameras[k] for k in new]):
        several = [k for k in new if cameras[k] == kind]
        for k, cells in zip(several, _count([claims[k] for k in several], blur_m, kind), strict=True):
            _COUNTED[id(claims[k])] = found[k] = claims[k], blur_m, kind, cells
    return [one[3] for one in found if one is not None]


def _count(claims: Sequence[Descriptor], blur_m: float, cameras: Cameras) -> list[_Cells]:
    grids = np.frombuffer(b"".join([d.coverage_grid for d in claims]), np.uint8).reshape(-1, COVERAGE_BYTES)
    half, position_m = COVERAGE_CELLS // 2, np.array([d.position_m for d in claims])
    corner = np.array([d.coverage_corner for d in claims], np.float64)
    away_x = position_m[:, 0] - (corner[:, 1] + half) * COVERAGE_CELL_M
    away_y = position_m[:, 1] - (corner[:, 0] + half) * COVERAGE_CELL_M
    body = attitude(np.array([d.orientation_xyzw for d in claims]))
    could, found = camera_states(away_x, away_y, position_m[:, 2], body, cameras), []
    counts = loops().count(grids, could).tolist()
    for d, possible, (impossible, seen) in zip(claims, could, counts, strict=True):
        if impossible >= FALSE_CELLS:  # else no leave that is given can matter
            flown_m = math.hypot(*d.velocity_mps) * LOOK_STANDS_S + blur_m
            reach = 1 + math.ceil(flown_m / COVERAGE_CELL_M)  # a cell more: it may have turned since it looked
            near = binary_dilation(possible >= Coverage.WELL, np.ones((3, 3)), iterations=reach)
            impossible = int(np.count_nonzero((unpack_grid(d.coverage_grid) >= Coverage.WELL) & ~near))
        found.append(_Cells(impossible, seen, d.position_m[2] >= ROOFS_M))
    return found


def goodput_doubt(claimed_mbps: float, arrivals: Sequence[Arrival], step_mbps: float = 0.0) -> str:
    """What a goodput claim says against the payloads that came over the link; empty where it may be so.

    Args: `step_mbps` is the step in which the descriptor's form writes goodputs. Rounding adds or takes half of it, and a weak
    link that would round to nothing reads a whole step.
    """
    if not arrivals:
        return ""
    fastest_mbps = max(a.phy_mbps for a in arrivals)
    if claimed_mbps - step_mbps > OVERSTATED * fastest_mbps:
        return f"goodput: {claimed_mbps:.0f} Mb/s claimed, frames came at {fastest_mbps:.0f}"
    rates = [a.mbps for a in arrivals if a.size_bytes >= LARGE_BYTES]
    if rates and claimed_mbps + step_mbps / 2 < UNDERSTATED * median(rates):
        return f"goodput: {claimed_mbps:.1f} Mb/s claimed, {median(rates):.0f} arrived"
    return ""


def battery_doubt(
    claimed_soc: float, least_soc: float, first_soc: float, others_fell: float, unseen: float = 0.0
) -> str:
    """What a charge says against the past and the fleet's; empty where it may be so.

    Args:
        claimed_soc: the claim.
        least_soc, first_soc: the least that it claimed before, and the first.
        others_fell: by how much the charge of the others that fly fell since the first, in the median.
        unseen: how far it may fall before that shows in a claim.
    """
    if claimed_soc > least_soc + RISE:
        return f"battery: {claimed_soc:.0%} after {least_soc:.0%}"
    fell = first_soc - claimed_soc
    if others_fell >= FALL + unseen and fell < FALL_SHARE * others_fell:
        return f"battery: fell by {fell:.1%} while the fleet's fell by {others_fell:.1%}"
    return ""


def split_arrivals(arrivals: Sequence[Arrival], claimed_s: float) -> tuple[list[Arrival], list[Arrival]]:
    """Arrivals to check a claim of `claimed_s` against, and arrivals after it, which are kept for the next claim.

    Arrivals more than COUNTS_FOR_S before the claim are in neither list: their link may have broken since. Where the
    series of arrivals has a gap before the claim, a payload may have been lost. Such arrivals bound the data rate from
    above, and their sizes are set to zero, so that they say nothing about how much must have arrived.
    """
    before = [a for a in arrivals if claimed_s - COUNTS_FOR_S < a.t_done_s <= claimed_s]
    sent_s = sorted(a.sent_s for a in before)
    apart_s = min((b - a for a, b in pairwise(sent_s)), default=0.0)
    if claimed_s - max(sent_s, default=claimed_s) > apart_s + ROUNDING_S:
        before = [a._replace(size_bytes=0) for a in before]
    return before, [a for a in arrivals if a.t_done_s > claimed_s]
