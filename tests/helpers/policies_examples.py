"""Views that several tests of the policies look at."""

from __future__ import annotations

from pathlib import Path

from sortie.policies.contract import Descriptor, Disc, FleetView, Policy, TaskPhase
from sortie.policies.registry import resolve


def fleet_of(n: int, *, soc: float = 0.9, goodput: float = 100.0, phase: TaskPhase = TaskPhase.SEARCH) -> FleetView:
    """n drones on a line, 10 m apart and a little more each; drone 0 is the ego."""
    descriptors = {
        i: Descriptor(
            0, i, (10.0 * i + i * i, 0.0, 60.0), (0, 0, 0, 1), (0, 0, 0), 42.0, soc, 1, 1, (goodput,) * (n - 1),
            bytes(64), 0, phase, Disc(0, 0, 32) if phase == TaskPhase.TRACK else None,
        )
        for i in range(n)
    }  # fmt: skip
    return FleetView(0, 0.1, descriptors, dict.fromkeys(descriptors, 0.1))


def planted(name: str) -> Policy:
    """A policy of `policies_planted.py`, loaded as a user's file is."""
    return resolve(f"{Path(__file__).with_name('policies_planted.py')}:{name}")
