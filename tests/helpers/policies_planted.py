"""Policies for the tests of proofs, most with a planted fault. `planted` loads one as a user's file is loaded."""

from __future__ import annotations

from sortie.policies.catalogue.baselines import everyone
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Directive, FleetView, Representation, TaskPhase
from sortie.policies.geometry import footprint_overlap


def drops_below_detections(view: FleetView) -> list[Directive]:
    """Falls silent in a sliver of charge in which no drawn view lies."""
    me = view.me
    tired = me is not None and 0.4 < me.battery_soc < 0.4000001 and me.task_phase == TaskPhase.RETURN
    return [d._replace(representation=Representation.NONE) if tired else d for d in worked(view)]


def rises_with_age(view: FleetView) -> list[Directive]:
    """Sends faster to a peer whose descriptor is between 0.2 and 0.2001 s old."""
    return [d._replace(rate_hz=9.0 if 0.2 < view.age_s[d.destination] < 0.2001 else 1.0) for d in everyone(view)]


def out_of_bounds(view: FleetView) -> list[Directive]:
    return [d._replace(rate_hz=40 * view.descriptors[d.destination].battery_soc) for d in everyone(view)]


def crashes(view: FleetView) -> list[Directive]:
    me = view.me
    if me is not None and me.peer_goodput_mbps[:1] and me.peer_goodput_mbps[0] == 77.25:
        raise RuntimeError("the one goodput")
    return everyone(view)


def reads_overlap(view: FleetView) -> list[Directive]:
    me = view.me
    assert me is not None
    return [d for d in everyone(view) if footprint_overlap(me, view.descriptors[d.destination]) >= 0]


def reads_grid(view: FleetView) -> list[Directive]:
    me = view.me
    return everyone(view) if me is None or me.coverage_grid[0] >= 0 else []


def best_goodput(view: FleetView) -> list[Directive]:
    me = view.me
    assert me is not None
    best = max(view.peers, key=me.goodput_to, default=None)
    return [d if d.destination == best else d._replace(rate_hz=1.0) for d in everyone(view)]


def rises(view: FleetView, tired: object) -> list[Directive]:
    return [d._replace(rho=2.0) if tired else d for d in everyone(view)]


def charge(view: FleetView) -> float:
    return 1.0 if view.me is None else view.me.battery_soc


def falls(view: FleetView) -> list[Directive]:
    return [d._replace(rate_hz=10.0 if view.age_s[d.destination] / view.period_s <= 3 else 2.0) for d in everyone(view)]


def explains(view: FleetView) -> list[Directive]:
    return [
        full_sharing(view.ego, p, 1.0, f"{charge(view):.0%}" if p == 1 else f"{charge(view):.0%} left")
        for p in view.peers
    ]


def drops(view: FleetView) -> list[Directive]:
    """The worked policy with a fault: silent in a sliver of charge."""
    me = view.me
    tired = me is not None and 0.4 < me.battery_soc < 0.5
    return [d._replace(representation=Representation.NONE) if tired else d for d in worked(view)]
