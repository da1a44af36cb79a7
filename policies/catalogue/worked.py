"""The paper's worked policy: its decision table (Table III) as one pure function."""

from __future__ import annotations

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.contract import (
    Directive,
    FleetView,
    LinkState,
    Representation,
    TaskPhase,
    boxes_across_networks,
    nothing_to_all,
)
from sortie.policies.geometry import peers_by_overlap

HIGH_BATTERY = 0.60
LOW_BATTERY = 0.30
FULL_RATE_HZ, HALF_RATE_HZ, SLOW_RATE_HZ = 10.0, 5.0, 2.0
MIN_GOODPUT_MBPS = 5.0
TOP_PEERS = 2
TRACK = TaskPhase.TRACK
FEATURES, DETECTIONS = Representation.FEATURES, Representation.DETECTIONS  # slow to look up, each time
NO_GOODPUT = {
    LinkState.UNKNOWN: "goodput not measured yet",
    LinkState.PROBED: "goodput not measured lately",
    LinkState.SILENT: "goodput: link silent, nothing got through",
}
"""Reasons for links without a goodput to name."""
NOT_CHOSEN = f"not among the {TOP_PEERS} most overlapping peers"


@among_attached
@boxes_across_networks
def worked(view: FleetView, *, rho: float = 1.0) -> list[Directive]:
    """Battery picks representation and rate, the link may lower both, the phase the ROI, overlap the peers.

    A peer with another network gets detections where the table says features.

    Args:
        view: the fleet's latest descriptors.
        rho: the share of the drone's feature cells sent on each link that carries features (the paper's table: all).

    Returns:
        One directive per peer in the view.
    """
    me = view.me
    if me is None:
        return []
    if me.battery_soc >= HIGH_BATTERY:
        rung, rate_hz, why = FEATURES, FULL_RATE_HZ, "battery ≥ 60 %"
    elif me.battery_soc >= LOW_BATTERY:
        rung, rate_hz, why = FEATURES, HALF_RATE_HZ, "battery < 60 %"
    else:
        rung, rate_hz, why = DETECTIONS, SLOW_RATE_HZ, "battery < 30 %"
    roi = me.region if me.task_phase == TRACK else None
    if roi is not None:
        why += f", track: ROI {roi.radius_m:.0f} m"
    ego, chosen = view.ego, peers_by_overlap(view)[:TOP_PEERS]
    link_rho = rho if rung == FEATURES else 0.0
    peers = view.peers
    directives = list(nothing_to_all(ego, peers, NOT_CHOSEN))
    for peer in chosen:
        if (goodput_mbps := me.goodput_to(peer)) < MIN_GOODPUT_MBPS:
            weak = NO_GOODPUT.get(me.link_state(peer)) or f"goodput {goodput_mbps:.2g} < {MIN_GOODPUT_MBPS:g} Mb/s"
            directive = Directive(ego, peer, DETECTIONS, 0.0, roi, min(rate_hz, SLOW_RATE_HZ), reason=weak)
        else:
            directive = Directive(ego, peer, rung, link_rho, roi, rate_hz, reason=why)
        directives[peers.index(peer)] = directive
    return directives
