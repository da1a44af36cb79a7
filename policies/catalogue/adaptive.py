"""Adaptive policies: they choose how to spend one byte budget, by mission, link, battery and geometry.

Each decision chooses an arm, which is a way to spend the budget: how many peers get features, who gets boxes, and
whether maps hold everything or the mission region alone. `adaptive` chooses by rules that read mission, coverage,
budget and links. `learned` chooses by a linear model that was fitted on simulated sorties (`python -m research learn`).

`sent_budget` is the number of cells that a drone sends over all its links, as a share of full sharing. At the same
number, no arm sends more bytes than a fixed policy.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from math import floor, fsum, isfinite, log2, log10
from pathlib import Path
from typing import NamedTuple

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.coverage_cells import sees
from sortie.policies.catalogue.prior.full import RATE_HZ
from sortie.policies.contract import (
    FEATURE_CELLS,
    FEATURE_MAP_MEGABITS,
    Descriptor,
    Directive,
    FleetView,
    LinkState,
    Representation,
    TaskPhase,
    boxes_across_networks,
    nothing,
)
from sortie.policies.geometry import footprint_overlap, peers_by_overlap
from sortie.scenarios.plain_sum import plain_sum

CARRIED = 0.5
"""A drone sends at most this share of its mean goodput, because the others send as well."""
STEPS_A_HALVING = 2
"""What the air carries is rounded down in steps of √2, so that a varying goodput does not change the directive."""
TRIED = (LinkState.SILENT, LinkState.MEASURED)
"""Links with a goodput that counts; the others have not carried a payload lately."""
EVERYONE = 255
LEARNED = Path(__file__).with_name("learned.json")


class Arm(NamedTuple):
    """A way to spend the budget."""

    peers: int
    """How many of the most overlapping peers get features and share the budget (all, if there are fewer)."""
    boxes: bool
    """Whether the others get boxes; if not, they get nothing."""
    region: bool
    """Whether features are of the mission region alone, if there is one."""

    @property
    def text(self) -> str:
        """The arm as text for a reason."""
        who = "all" if self.peers >= EVERYONE else f"{self.peers}"
        rest = ", boxes to the rest" if self.boxes and self.peers < EVERYONE else ""
        return f"features to {who}{rest}" if self.peers else "boxes to all"


ARMS: tuple[Arm, ...] = (Arm(EVERYONE, True, True), Arm(2, True, True), Arm(0, True, False))
"""The arms that the adaptive policies choose from. While searching there is no region, and maps hold everything."""
MAPS, BOXES = ARMS[0], ARMS[-1]
FEW = 8 / FEATURE_CELLS
"""Share of a map. A link that would carry less gets boxes."""


def spend(view: FleetView, arm: Arm, sent_budget: float, why: str) -> list[Directive]:
    """The directives of an arm. The chosen peers share the budget evenly, as far as the air carries it.

    Args:
        view: the fleet's latest descriptors.
        arm: how to spend.
        sent_budget: cells that the drone sends over all its links, as a share of full sharing, 0 … 1.
        why: the reason; the arm's text is added.
    """
    me = view.me
    if me is None:
        return []
    ego, peers = view.ego, view.peers
    chosen = peers if arm.peers >= len(peers) else peers_by_overlap(view)[: arm.peers]
    rho = per_link(view, me, chosen, sent_budget)
    roi = me.region if arm.region and me.task_phase == TaskPhase.TRACK else None
    reason = f"{why}: {arm.text}"
    directives = []
    for peer in peers:
        if peer in chosen:
            directives.append(Directive(ego, peer, Representation.FEATURES, rho, roi, RATE_HZ, reason=reason))
        elif arm.boxes:
            directives.append(Directive(ego, peer, Representation.DETECTIONS, 0.0, None, RATE_HZ, reason=reason))
        else:
            directives.append(nothing(ego, peer, reason))
    return directives


def per_link(view: FleetView, me: Descriptor, chosen: Sequence[int], sent_budget: float) -> float:
    """The share of a map that each of these peers is sent: they share the budget evenly, as far as the air carries it."""
    if not chosen:
        return 0.0
    return min(1.0, sent_budget * view.full_sharing_maps / len(chosen), carried(me, chosen))


def carried(me: Descriptor, peers: Sequence[int]) -> float:
    """The share of a map that each of these links carries in time, by the drone's measured goodput; 1 if none is.

    Samples beyond that would wait for one another and miss their deadlines.
    """
    measured = [me.goodput_to(peer) for peer in peers if me.link_state(peer) in TRIED]
    if not measured:
        return 1.0
    share = CARRIED * fsum(measured) / len(measured) / (len(peers) * FEATURE_MAP_MEGABITS * RATE_HZ)
    return float(min(1.0, 2.0 ** (floor(STEPS_A_HALVING * log2(max(share, 1e-6))) / STEPS_A_HALVING)))


@among_attached
@boxes_across_networks
def arm(view: FleetView, *, index: int = 0, sent_budget: float = 0.25) -> list[Directive]:
    """Always the same arm, for `python -m research learn` and comparisons."""
    return spend(view, ARMS[index % len(ARMS)], sent_budget, "fixed arm")


FEATURES = ("log10 of the budget", "tracking a region", "mean overlap of peers", "log10 of 1 + mean goodput", "charge")


def features(view: FleetView, sent_budget: float) -> tuple[float, ...]:
    """The inputs of the learned policy, in the order of `FEATURES`: budget, mission, coverage, links, battery."""
    me = view.me
    if me is None:
        return (0.0,) * len(FEATURES)
    peers = view.peers
    overlap = plain_sum(footprint_overlap(me, view.descriptors[p]) for p in peers) / len(peers) if peers else 0.0
    goodput_mbps = plain_sum(me.goodput_to(p) for p in peers) / len(peers) if peers else 0.0
    tracking = me.task_phase == TaskPhase.TRACK and me.region is not None
    return log10(max(sent_budget, 1e-4)), float(tracking), overlap, log10(1.0 + max(0.0, goodput_mbps)), me.battery_soc


@among_attached
def boxes(view: FleetView) -> list[Directive]:
    """Boxes to every peer, whatever the context: the cheapest way of sharing."""
    return spend(view, BOXES, 0.0, "fixed")


@among_attached
@boxes_across_networks
def adaptive(view: FleetView, *, sent_budget: float = 0.25) -> list[Directive]:
    """Rules over mission, coverage, budget and links: feature cells of a tracked region that it sees, otherwise boxes.

    A region is small, so even a small budget carries its important cells. Of the whole scene, boxes find more under every
    budget (by the torch detector, `python -m research learn --by-torch`). A drone that sees nothing of the region has no cells of it
    to send. The rules are older than the moving and averaging of boxes; since then boxes are ahead in a region as
    well (docs/results/policies.md).
    """
    me = view.me
    if me is None:
        return []
    if me.task_phase != TaskPhase.TRACK or me.region is None:
        return spend(view, BOXES, sent_budget, "no region")
    if not sees(me, me.region):
        return spend(view, BOXES, sent_budget, "a region out of sight")
    rho = per_link(view, me, view.peers, sent_budget)
    if rho < FEW:
        return spend(view, BOXES, sent_budget, f"a region, budget and links {rho:.2g} < {FEW:.2g}")
    return spend(view, MAPS, sent_budget, "a region")


@among_attached
@boxes_across_networks
def learned(view: FleetView, *, sent_budget: float = 0.25) -> list[Directive]:
    """The arm with the largest predicted gain, by a model of simulated sorties (`python -m research learn`); ties go to the earlier arm."""
    seen = features(view, sent_budget)
    z = [(x - m) / s for x, m, s in zip(seen, _MODEL.mean, _MODEL.scale, strict=True)]
    gains = [w[0] + plain_sum(a * b for a, b in zip(w[1:], z, strict=True)) for w in _MODEL.weights]
    best = max(range(len(ARMS)), key=lambda k: gains[k])
    return spend(view, ARMS[best], sent_budget, "learned")


class Model(NamedTuple):
    """The model that `python -m research learn` stores: for each arm, the AP gained over the first arm, linear in `FEATURES`."""

    mean: tuple[float, ...]
    scale: tuple[float, ...]
    weights: tuple[tuple[float, ...], ...]
    """[arms][1 + features], intercept first."""


def read_model(path: Path) -> Model:
    """A stored model.

    Raises:
        ValueError: its shapes do not fit `FEATURES` and `ARMS`, or a number is not finite.
    """
    data = json.loads(path.read_text("utf-8"))
    model = Model(tuple(data["mean"]), tuple(data["scale"]), tuple(tuple(w) for w in data["weights"]))
    numbers = [*model.mean, *model.scale, *(x for w in model.weights for x in w)]
    shapes = {len(model.mean), len(model.scale), *(len(w) - 1 for w in model.weights)}
    if shapes != {len(FEATURES)} or len(model.weights) != len(ARMS) or not all(map(isfinite, numbers)):
        raise ValueError(f"{path}: must have {len(ARMS)} arms of 1 + {len(FEATURES)} finite weights")
    return model


_MODEL = read_model(LEARNED)  # once, when the policy is loaded: a decision reads no file
