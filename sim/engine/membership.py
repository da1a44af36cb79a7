"""Who is in the fleet: drones that join late, go home, come back, and reserves that take over."""

from __future__ import annotations

import math
from functools import partial

from sortie.fleet.flight.steps import landing_s
from sortie.scenarios.frames import with_frame
from sortie.scenarios.schema import MemberEvent, Scenario
from sortie.sim.engine.manoeuvres import Manoeuvres
from sortie.sim.engine.world import World, at


class Membership:
    """Grounds drones before the flight, lets them join, and sends them home.

    A drone that joins appears in its slot of the formation; the way there is not flown. A drone that goes home publishes
    LANDING without a region while it descends along the formation's way, and leaves the fleet on the ground.
    """

    def __init__(self, scenario: Scenario, world: World, manoeuvres: Manoeuvres) -> None:
        self._world, self._mission, self._manoeuvres = world, scenario.mission, manoeuvres
        self._frame_s, self._stations = scenario.frame_s, {station.drone for station in scenario.fleet.ground}
        self._homebound: dict[int, float] = {}
        """By drone that went home and did not come back: when it touches down."""
        self._replaced: set[int] = set()
        self._reserves = [list(group.reserve) for group in self._mission.groups]
        first: dict[int, str] = {}
        for event in sorted(scenario.events, key=lambda e: e.at_s):
            if isinstance(event, MemberEvent) and event.presence:
                first.setdefault(event.drone, event.presence)
        self._awaited = {drone for drone, presence in first.items() if presence == "in"}
        """Drones that are yet to join for the first time; nobody takes over from them."""
        for drone in sorted(self._awaited.union(*self._reserves)):
            world.ground(drone)
        for group in scenario.fleet.groups:
            end_s = landing_s(group)
            if end_s is not None:
                for drone in group.drones:
                    at(world.env, with_frame(end_s, self._frame_s), partial(self.go_home, drone, "its legs end"))

    def renew(self, frame: int) -> None:
        """Send home those whose charge says so, and replace those who left."""
        world, limit = self._world, self._mission.handover_soc
        for group, reserves in zip(self._mission.groups, self._reserves, strict=True):
            if not group.reserve:
                continue
            for drone in group.drones:
                if drone in self._replaced or drone in reserves or drone in self._awaited:
                    continue
                flies = world.drones[drone].airborne
                if flies and drone not in self._homebound and limit is not None and world.batteries.soc[drone] <= limit:
                    self.go_home(drone, f"charge {world.batteries.soc[drone]:.0%}")
                if reserves and (drone in self._homebound or not flies):
                    self._replaced.add(drone)
                    self.join(reserves.pop(0), f"takes over from drone {drone}")

    def join(self, drone: int, text: str = "") -> None:
        """A drone on the ground joins the fleet; nothing happens to one that flies.

        Args:
            text: what the record says; empty says that it takes off, or that a ground station is switched on.
        """
        world = self._world
        self._awaited.discard(drone)
        if world.drones[drone].airborne:
            return
        world.join(drone, text or ("is switched on" if drone in self._stations else "takes off"))
        if world.drones[drone].airborne:
            self._replaced.discard(drone)
            for reserves in self._reserves:
                if drone in reserves:
                    reserves.remove(drone)
            self._homebound.pop(drone, None)
            self._manoeuvres.appear(drone)

    def go_home(self, drone: int, text: str = "told to") -> None:
        """A drone that flies goes home; nothing happens to one on the ground or on its way."""
        world = self._world
        if drone in self._homebound or not world.drones[drone].airborne:
            return
        self._homebound[drone] = math.inf
        world.descend(drone, f"goes home: {text}")
        down_s = self._manoeuvres.descend(drone, self._mission.descent_mps)
        if down_s is not None:
            self._homebound[drone] = down_s
            at(world.env, with_frame(down_s, self._frame_s), partial(self._touch_down, drone, down_s))

    def _touch_down(self, drone: int, down_s: float) -> None:
        world = self._world
        if self._homebound.get(drone) == down_s and world.drones[drone].airborne:
            world.drain()
            if world.drones[drone].airborne:
                world.remove(drone, "landed", "went home")
