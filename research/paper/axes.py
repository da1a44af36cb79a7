"""Which context axes a policy reads and what it decides, observed while it runs: generates the paper's table of methods.

A policy is run on views whose descriptors record every field that is read. A method decides something if it ever differs
from full sharing (full maps to every peer, every frame, fused at weight 1).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from typing import Any, NamedTuple, cast

from sortie.policies.catalogue.prior import METHODS
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import Descriptor, Directive, FleetView, Representation
from sortie.scenarios.report_text import NONE, table


class Axis(Enum):
    """Groups of a descriptor's fields, named as the columns of the paper's table."""

    MISSION = "Mis."
    SCENE = "Scene"
    PLATFORM = "Plat."
    GEOMETRY = "Geom."


FIELDS: dict[str, Axis | None] = {
    "stamp_ns": None,
    "agent_id": None,
    "position_m": Axis.GEOMETRY,
    "orientation_xyzw": Axis.GEOMETRY,
    "velocity_mps": Axis.GEOMETRY,
    "footprint_radius_m": Axis.GEOMETRY,
    "battery_soc": Axis.PLATFORM,
    "cpu_headroom": Axis.PLATFORM,
    "gpu_headroom": Axis.PLATFORM,
    "peer_goodput_mbps": Axis.PLATFORM,
    "goodput_to": Axis.PLATFORM,
    "link_state": Axis.PLATFORM,
    "coverage_grid": Axis.SCENE,
    "coverage_corner": Axis.SCENE,  # the place of the grid, to one cell: without it the grid means nothing
    "novelty_flags": Axis.SCENE,
    "task_phase": Axis.MISSION,
    "region": Axis.MISSION,
    "priority_target_ids": Axis.MISSION,
    "feature_space": None,
    "roster": None,
    "codebook": None,
    "counts": None,
}
"""Which axis each field of a descriptor belongs to."""

DECISIONS = ("duty", "topology", "fidelity", "ROI", "rate", "fusion wts")
"""The six decisions; fidelity is representation and budget, rate is rate and deadline."""


class Observed(NamedTuple):
    """The axes that a policy read and the decisions that it made."""

    axes: frozenset[Axis]
    decisions: frozenset[str]


class _WatchedDescriptor:
    """A descriptor that records which fields are read. It is no tuple, so nothing can be read by index."""

    def __init__(self, descriptor: Descriptor, read: set[str]) -> None:
        self._descriptor, self._read = descriptor, read

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._descriptor, name)
        if name not in FIELDS:
            raise AttributeError(f"a watched descriptor has fields alone, {name!r} is not one")
        self._read.add(name)
        return value


def observe(policy: Callable[..., Sequence[Directive]], views: Iterable[FleetView]) -> Observed:
    """Run a policy on views that record what is read.

    That it leaves out detached peers, and sends no maps to other networks, is the plane's rule, no decision.
    """
    read: set[str] = set()
    decided: set[str] = set()
    for view in (v.attached for v in views):
        watched = {i: cast(Descriptor, _WatchedDescriptor(d, read)) for i, d in view.descriptors.items()}
        for directive in policy(view._replace(descriptors=watched)):
            if view.shares_features_with(directive.destination):
                decided |= decisions_of(directive)
    return Observed(frozenset(a for f in read if (a := FIELDS[f]) is not None), frozenset(decided))


def decisions_of(d: Directive) -> set[str]:
    """The decisions in which a directive differs from full sharing."""
    full = full_sharing(d.source, d.destination, 1.0, "")
    differs = {
        "duty": d.duty_percent != full.duty_percent,
        "topology": d.representation == Representation.NONE,
    }
    if d.representation != Representation.NONE:  # for a link that carries nothing the rest has no meaning
        differs |= {
            "fidelity": (d.representation, d.rho) != (full.representation, full.rho),
            "ROI": d.roi is not None,
            "rate": (d.rate_hz, d.deadline_s) != (full.rate_hz, full.deadline_s),
            "fusion wts": d.fusion_weight != full.fusion_weight,
        }
    return {name for name, is_so in differs.items() if is_so}


def method_table(views: Sequence[FleetView], everything: Iterable[Callable[..., Sequence[Directive]]]) -> str:
    """The paper's table: a row for each prior method, and one for the plane, from what `everything` reads and decides.

    A method with a fusion network of its own decides fusion weights there.
    """
    rows = []
    for method in METHODS.values():
        axes, decided = observe(method.policy, views)
        if not decided and method.fusion is not None:
            decided = frozenset({"fusion wts"})
        rows.append(_row(method.name, Observed(axes, decided)))
    seen = [observe(policy, views) for policy in everything]
    plane = Observed(frozenset().union(*(o.axes for o in seen)), frozenset().union(*(o.decisions for o in seen)))
    head = ("method", "Mis.", "Scene", "Plat.", "Geom.", "decides")
    return "\n".join(table(head, [*rows, _row("Context plane", plane)])) + "\n"


def _row(title: str, observed: Observed) -> list[str]:
    read = ["●" if axis in observed.axes else NONE for axis in Axis]
    decides = (
        "all six"
        if len(observed.decisions) == len(DECISIONS)
        else " + ".join(d for d in DECISIONS if d in observed.decisions)
    )
    return [title, *read, decides]
