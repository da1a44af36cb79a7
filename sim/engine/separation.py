"""Members of a fleet that come too near each other, as events.

The slots of one formation keep apart by themselves, and planners keep to `fleet.steering.separation_m`. Groups, models of
movement and ground stations know nothing of each other: nothing moves them apart, and nothing breaks when they meet.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sortie.scenarios.schema import Fleet, Scenario
from sortie.sim.engine.world import World

APART_AGAIN = 1.2
"""A pair has parted when it is so many times the separation apart; jitter then makes no second event."""


class Separation:
    """Notes when two members that fly apart from each other come nearer than `fleet.steering.separation_m`."""

    def __init__(self, scenario: Scenario, world: World) -> None:
        self._world, self._least_m = world, scenario.fleet.steering.separation_m
        self._pairs = np.argwhere(np.triu(strangers(scenario.fleet), 1))
        self._near: NDArray[np.bool_] = np.zeros(len(self._pairs), dtype=bool)

    def check(self, frame: int) -> None:
        """Note the pairs that are too near since this frame."""
        if not len(self._pairs):
            return
        world, (one, other) = self._world, self._pairs.T
        (position_m,) = world.motion[frame : frame + 1].position_m
        airborne = np.array([status.airborne for status in world.drones])
        apart_m = np.linalg.norm(position_m[one] - position_m[other], axis=-1)
        apart_m[~(airborne[one] & airborne[other])] = np.inf
        for k in np.flatnonzero((apart_m < self._least_m) & ~self._near):
            text = f"{apart_m[k]:.1f} m from drone {other[k]}, fleet.steering.separation_m is {self._least_m:g}"
            world.note(int(one[k]), "too_near", text)
        self._near = apart_m < np.where(self._near, APART_AGAIN, 1.0) * self._least_m


def strangers(fleet: Fleet) -> NDArray[np.bool_]:
    """[N, N]: whether two members do not keep slots of one formation, and one of them flies."""
    stands = {station.drone for station in fleet.ground}
    unit = []
    for drone in range(fleet.drones):
        group = fleet.group_of(drone)
        of = fleet if group is None else group
        keeps_slot = drone not in stands and of.mobility == "formation"
        unit.append(-1 if group is None else fleet.groups.index(group))
        if not keeps_slot:
            unit[-1] = fleet.drones + drone  # a unit of its own
    flies = np.array([drone not in stands for drone in range(fleet.drones)])
    units = np.array(unit)
    apart: NDArray[np.bool_] = (units[:, None] != units[None]) & (flies[:, None] | flies[None])
    return apart
