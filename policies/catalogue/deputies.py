"""A policy that reads all four context axes and makes all six decisions: each receiver is served by a few drones.

For each receiver, the k drones are appointed that add most to what it sees, weighted by link and battery. Every drone
computes the same appointment from the same descriptors, so nothing is negotiated. A drone with false claims can take
the place of a better one; trust (`sortie.fleet.trust`) is for that.
"""

from __future__ import annotations

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.coverage_cells import seen_well
from sortie.policies.catalogue.freshness import freshness
from sortie.policies.catalogue.worked import (
    FULL_RATE_HZ,
    HALF_RATE_HZ,
    HIGH_BATTERY,
    LOW_BATTERY,
    MIN_GOODPUT_MBPS,
    NO_GOODPUT,
    SLOW_RATE_HZ,
)
from sortie.policies.contract import (
    AGENT_IDS,
    Descriptor,
    Directive,
    FleetView,
    Representation,
    TaskPhase,
    boxes_across_networks,
    nothing,
)
from sortie.policies.geometry import footprint_overlap

GOOD_GOODPUT_MBPS = 20.0
RESTING_DUTY_PERCENT = 50
SLOW_DEADLINE_S = 0.5


@among_attached
@boxes_across_networks
def deputies(view: FleetView, *, k: int = 2, rho: float = 0.25) -> list[Directive]:
    """Each receiver is served by the k drones that add most: unseen cells × link × battery, nearer ones first on ties."""
    me = view.me
    if me is None:
        return []
    resting = RESTING_DUTY_PERCENT if me.battery_soc < LOW_BATTERY else 100
    directives = []
    for peer in view.peers:
        place = _appointed(view, peer).index(view.ego)
        if place >= k:
            directives.append(
                nothing(view.ego, peer, f"not among the {k} that add most")._replace(duty_percent=resting)
            )
        else:
            serve = _serve(view, me, peer, rho, f"deputy {place + 1} of {k}")
            directives.append(serve._replace(duty_percent=resting))
    return directives


def _serve(view: FleetView, me: Descriptor, peer: int, rho: float, why: str) -> Directive:
    """The directive by which the ego serves a peer."""
    roi = me.region if me.task_phase == TaskPhase.TRACK else None
    weight = freshness(view.age_s[peer], view.period_s)
    goodput_mbps = me.goodput_to(peer)
    if me.battery_soc < LOW_BATTERY or goodput_mbps < MIN_GOODPUT_MBPS:
        weak = NO_GOODPUT.get(me.link_state(peer)) or f"goodput {goodput_mbps:.2g} < {MIN_GOODPUT_MBPS:g} Mb/s"
        cause = "battery < 30 %" if me.battery_soc < LOW_BATTERY else weak
        return Directive(
            view.ego,
            peer,
            Representation.DETECTIONS,
            0.0,
            roi,
            SLOW_RATE_HZ,
            SLOW_DEADLINE_S,
            weight,
            reason=f"{why}, {cause}",
        )
    rate_hz = FULL_RATE_HZ if me.battery_soc >= HIGH_BATTERY else HALF_RATE_HZ
    return Directive(view.ego, peer, Representation.FEATURES, rho, roi, rate_hz, fusion_weight=weight, reason=why)


def _appointed(view: FleetView, receiver: int) -> list[int]:
    """All drones but the receiver, those that add most to it first."""
    served = view.descriptors[receiver]
    known = seen_well(served)

    def merit(i: int) -> tuple[float, float, int]:
        d = view.descriptors[i]
        adds = len(seen_well(d) - known) * _link(d.goodput_to(receiver)) * _battery(d.battery_soc)
        return -round(adds), -round(footprint_overlap(d, served), 1), (i - receiver) % AGENT_IDS

    return sorted((i for i in view.descriptors if i != receiver), key=merit)


def _link(goodput_mbps: float) -> float:
    """1 for a good link, ¼ for a bad one or one without a goodput."""
    return min(1.0, max(0.25, goodput_mbps / GOOD_GOODPUT_MBPS))


def _battery(soc: float) -> float:
    return 1.0 if soc >= HIGH_BATTERY else 0.5 if soc >= LOW_BATTERY else 0.1
