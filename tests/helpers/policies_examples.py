"""Views that several tests of the policies look at, changes to them, and policies loaded as a user's files are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sortie.policies.contract import Descriptor, Directive, Disc, FleetView, Policy, TaskPhase
from sortie.policies.registry import resolve

SEES_ALL = bytes([0b10101010]) * 64
"""A coverage grid in which every cell is seen well."""


def fleet_of(n: int, *, soc: float = 0.9, goodput: float = 100.0, phase: TaskPhase = TaskPhase.SEARCH) -> FleetView:
    """n drones on a line, 10 m apart and a little more each; drone 0 is the ego."""
    region = Disc(0, 0, 32) if phase == TaskPhase.TRACK else None
    links = (goodput,) * (n - 1)
    descriptors = {
        i: Descriptor(0, i, at, (0, 0, 0, 1), (0, 0, 0), 42.0, soc, 1, 1, links, bytes(64), 0, phase, region)
        for i, at in {i: (10.0 * i + i * i, 0.0, 60.0) for i in range(n)}.items()
    }
    return FleetView(0, 0.1, descriptors, dict.fromkeys(descriptors, 0.1))


def changed(view: FleetView, *ids: int, **fields: Any) -> FleetView:
    """The view with fields of these drones' descriptors replaced; of all drones where none is named."""
    some = ids or tuple(view.descriptors)
    return view._replace(descriptors={i: d._replace(**fields) if i in some else d for i, d in view.descriptors.items()})


def aged(view: FleetView, ages_s: Mapping[int, float]) -> FleetView:
    """The view with other ages of some drones' descriptors."""
    return view._replace(age_s={**view.age_s, **ages_s})


def without(view: FleetView, *ids: int) -> FleetView:
    """The view as if these drones had never been heard."""
    return view._replace(
        descriptors={i: d for i, d in view.descriptors.items() if i not in ids},
        age_s={i: age_s for i, age_s in view.age_s.items() if i not in ids},
    )


def by_peer(directives: Sequence[Directive]) -> dict[int, Directive]:
    return {d.destination: d for d in directives}


def written(folder: Path, text: str, params: Mapping[str, object] | None = None) -> Policy:
    """The function `decide` of a text, loaded as a user's file is."""
    path = folder / "policy.py"
    path.write_text(text)
    return resolve(f"{path}:decide", params)
