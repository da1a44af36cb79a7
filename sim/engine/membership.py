"""Who is in the fleet: drones that join late, go home, come back, and reserves that take over."""

from __future__ import annotations

from functools import partial

from sortie.fleet.flight.descent import descending
from sortie.scenarios.schema import DroneJoins, DroneLeaves, DroneLost, Scenario
from sortie.sim.engine.world import World, at, with_frame


class Membership:
    """Grounds drones before the flight, lets them join, and sends them home.

    A drone that joins appears in its slot of the formation; the way there is not flown. A drone that goes home publishes
    LANDING without a region while it descends along the formation's way, and leaves the fleet on the ground.
    """

    def __init__(self, scenario: Scenario, world: World) -> None:
        self._world, self._mission, self._frame_s = world, scenario.mission, scenario.frame_s
        self._homebound: set[int] = set()
        self._replaced: set[int] = set()
        self._reserves = [list(group.reserve) for group in self._mission.groups]
        first: dict[int, object] = {}
        for event in sorted(scenario.events, key=lambda e: e.at_s):
            if isinstance(event, DroneJoins | DroneLeaves | DroneLost):
                first.setdefault(event.drone, event)
        waiting = {drone for drone, event in first.items() if isinstance(event, DroneJoins)}
        for drone in sorted(waiting.union(*self._reserves)):
            world.ground(drone)

    def renew(self, frame: int) -> None:
        """Send home those whose charge says so, and replace those who left. Call it first in a frame."""
        world, limit = self._world, self._mission.handover_soc
        for group, reserves in zip(self._mission.groups, self._reserves, strict=True):
            if not group.reserve:
                continue
            for drone in group.drones:
                if drone in self._replaced or drone in reserves:
                    continue
                flies = world.drones[drone].airborne
                if flies and drone not in self._homebound and limit is not None and world.batteries.soc[drone] <= limit:
                    self.go_home(drone, f"charge {world.batteries.soc[drone]:.0%}")
                if reserves and (drone in self._homebound or not flies):
                    self._replaced.add(drone)
                    self.join(reserves.pop(0), f"takes over from drone {drone}")

    def join(self, drone: int, text: str = "takes off") -> None:
        """A drone on the ground joins the fleet; nothing happens to one that flies."""
        if not self._world.drones[drone].airborne:
            self._homebound.discard(drone)
            self._world.join(drone, text)

    def go_home(self, drone: int, text: str = "told to") -> None:
        """A drone that flies goes home; nothing happens to one on the ground or on its way."""
        world = self._world
        if drone in self._homebound or not world.drones[drone].airborne:
            return
        self._homebound.add(drone)
        world.homebound.add(drone)
        world.note(drone, "drone_leaves", f"goes home: {text}")
        frame = world.next_frame
        if frame >= len(world.motion.time_s):
            return
        world.reroute(descending(world.motion, drone, frame, self._mission.descent_mps))
        height_m = float(world.motion.position_m[frame, drone, 2])
        down_s = frame * self._frame_s + height_m / self._mission.descent_mps
        at(world.env, with_frame(down_s, self._frame_s), partial(self._touch_down, drone))

    def _touch_down(self, drone: int) -> None:
        world = self._world
        if drone in self._homebound and world.drones[drone].airborne:
            world.drain()
            if world.drones[drone].airborne:
                world.remove(drone, "landed", "went home")
