"""Where drones fly: formations, routes, groups with ways of their own, ground stations, and what movement is held to."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from sortie.scenarios.schema.base import MOST_DRONES, DroneId, ModelName, Params, PointM, Section, inconsistent

RANDOM_MOBILITY = ("random_waypoint", "gauss_markov")
Mobility = Annotated[str, ModelName("mobility", ("formation", *RANDOM_MOBILITY), take_params=RANDOM_MOBILITY)]
"""Who decides where drones fly: the formation on its route, a random model, or one of one's own."""
Height = Annotated[float, Field(ge=2, le=400)]


class Formation(Section):
    shape: Literal["cross", "line", "wedge", "grid", "circle"] = Field(
        "cross", description="Slots around the moving reference point."
    )
    spacing_m: float = Field(
        20.0, gt=0, le=500, description="Distance between neighbouring slots (arc length for circle)."
    )
    altitude_m: float = Field(60.0, ge=10, le=400, description="Height of the formation above the ground.")


class Route(Section):
    waypoints_m: tuple[PointM, ...] = Field(
        ((0.0, 0.0),),
        min_length=1,
        max_length=1000,
        description="Ground track of the reference point, ENU (x, y); one point hovers.",
    )
    speed_mps: float = Field(5.0, gt=0, le=30, description="Ground speed along the route.")
    turn_time_s: float = Field(4.0, gt=0, le=60, description="Time over which a corner is rounded.")


class Motion(Section):
    wind_mps: tuple[Annotated[float, Field(ge=-40, le=40)], Annotated[float, Field(ge=-40, le=40)]] = Field(
        (2.0, 1.0), description="Mean wind, the velocity of the air, ENU (x, y)."
    )
    gust_sigma_mps: float = Field(0.8, ge=0, le=15, description="Standard deviation of each gust component.")
    gust_time_s: float = Field(3.0, gt=0, le=120, description="Correlation time of gusts.")
    pose_jitter_m: float = Field(
        0.4, ge=0, le=20, description="Standard deviation of each drone's true offset from its slot, per axis."
    )
    pose_jitter_time_s: float = Field(2.5, gt=0, le=120, description="Correlation time of the offset.")
    pose_error_m: float = Field(
        0.2, ge=0, le=20, description="Standard deviation of the horizontal position estimate's error, per axis."
    )
    heading_error_deg: float = Field(
        0.2,
        ge=0,
        le=45,
        description="Standard deviation of the heading estimate's error; 0.2° is a dual-antenna receiver, a magnetometer has degrees.",
    )


class Viewpoints(Section):
    """How far the formation gives way to a policy that chooses viewpoints; the others are asked nothing."""

    reach_m: float = Field(
        40.0, ge=0, le=50, description="How far from its slot a drone may stand when its policy asks; 0: nowhere else."
    )
    speed_mps: float = Field(3.0, gt=0, le=15, description="Fastest that it moves within the formation.")
    acceleration_mps2: float = Field(1.0, gt=0, le=5, description="Most that it accelerates for it.")
    separation_m: float = Field(
        10.0, gt=0, le=500, description="No two drones closer than this, unless their slots are."
    )
    fence_m: tuple[float, float, float, float] | None = Field(
        None, description="Geofence that every drone keeps within, ENU (x_min, y_min, x_max, y_max); left out, none."
    )

    @model_validator(mode="after")
    def _fence_holds_something(self) -> Viewpoints:
        check_fence(self.fence_m)
        return self


class Origin(Section):
    """Where ENU (0, 0, 0) lies on the globe, WGS-84."""

    latitude_deg: float = Field(ge=-85, le=85, description="Latitude; a local east means nothing at a pole.")
    longitude_deg: float = Field(ge=-180, le=180, description="Longitude.")
    altitude_m: float = Field(0.0, ge=-500, le=9000, description="Altitude of the ground there.")


class Steering(Section):
    """What planners of one's own are held to (docs/guide/mobility.md), and when two groups are too near."""

    reach_m: float = Field(200.0, gt=0, le=5000, description="How far from where it began a drone may fly.")
    speed_mps: float = Field(8.0, gt=0, le=30, description="Fastest over ground.")
    climb_mps: float = Field(3.0, gt=0, le=10, description="Fastest up and down.")
    acceleration_mps2: float = Field(2.0, gt=0, le=8, description="Most that it accelerates, in any direction.")
    separation_m: float = Field(
        5.0,
        gt=0,
        le=500,
        description="No nearer to any other member of the fleet, unless it is so already. Where groups, models or ground "
        "stations are nearer to each other, an event says so.",
    )
    altitude_m: tuple[Height, Height] = Field((10.0, 120.0), description="Lowest and highest flight.")
    fence_m: tuple[float, float, float, float] | None = Field(
        None, description="Geofence, ENU (x_min, y_min, x_max, y_max); left out, none."
    )

    @model_validator(mode="after")
    def _holds_something(self) -> Steering:
        if self.altitude_m[0] > self.altitude_m[1]:
            raise inconsistent(("altitude_m",), f"{self.altitude_m}", "the lowest first")
        check_fence(self.fence_m)
        return self


def check_fence(fence_m: tuple[float, float, float, float] | None) -> None:
    """A fence holds something.

    Raises:
        ValidationError: its edges are in the wrong order.
    """
    if fence_m is not None and not (fence_m[0] < fence_m[2] and fence_m[1] < fence_m[3]):
        raise inconsistent(("fence_m",), f"{fence_m}", "x_min < x_max and y_min < y_max")


class Leg(Section):
    """One step of a way that is flown step by step."""

    action: Literal["go", "hold", "return", "land"] = Field(
        "go",
        description="go: fly to to_m; hold: stay for for_s; return: fly to the route's first waypoint; land: descend to the ground here, the last leg.",
    )
    to_m: PointM | None = Field(None, description="Where to go, ENU (x, y); only for go.")
    for_s: float | None = Field(None, gt=0, le=7200, description="How long to hold; only for hold.")
    altitude_m: float | None = Field(
        None, ge=10, le=400, description="Height at the end of a go or return; left out, it stays as it is."
    )
    speed_mps: float | None = Field(
        None, gt=0, le=30, description="Ground speed of a go or return; left out, the route's."
    )

    @model_validator(mode="after")
    def _fits_its_action(self) -> Leg:
        moves = self.action in ("go", "return")
        for name, there in (
            ("to_m", self.action == "go"),
            ("for_s", self.action == "hold"),
            ("altitude_m", moves),
            ("speed_mps", moves),
        ):
            value = getattr(self, name)
            if value is not None and not there:
                raise inconsistent((name,), f"{value}", f"left out for {self.action}")
            if value is None and there and name in ("to_m", "for_s"):
                raise inconsistent((name,), "missing", f"given for {self.action}")
        return self


class FlightGroup(Section):
    """Drones that fly apart from the fleet's formation; one alone flies a route of its own."""

    drones: tuple[DroneId, ...] = Field(
        min_length=1, max_length=MOST_DRONES, description="Who flies in it; they take its slots in this order."
    )
    formation: Formation = Field(Formation(), description="In place of fleet.formation, as a whole.")
    route: Route = Field(Route(), description="In place of fleet.route, as a whole.")
    take_off: bool = Field(
        False, description="It begins on the ground at the route's first waypoint and climbs to its altitude first."
    )
    climb_mps: float = Field(3.0, gt=0, le=10, description="How fast it changes its altitude, at most.")
    legs: tuple[Leg, ...] = Field(
        (), max_length=1000, description="What it does after the route's last waypoint, step by step."
    )
    mobility: Mobility = Field("formation", description="As fleet.mobility, for this group.")
    mobility_params: Params = Field({}, description="Keyword arguments of its mobility model.")

    @model_validator(mode="after")
    def _one_way(self) -> FlightGroup:
        if self.mobility != "formation":
            for name in ("legs", "take_off"):
                if getattr(self, name):
                    bound = f"left out where mobility is {self.mobility}"
                    raise inconsistent((name,), f"{len(self.legs)} of them" if name == "legs" else "true", bound)
        for k, leg in enumerate(self.legs[:-1]):
            if leg.action == "land":
                raise inconsistent(("legs", k, "action"), "land", "the last leg")
        return self


class GroundStation(Section):
    """A member of the fleet that does not fly: a ground station or a relay on a mast."""

    drone: DroneId = Field(description="Which member of the fleet it is.")
    position_m: tuple[
        Annotated[float, Field(ge=-20000, le=20000)],
        Annotated[float, Field(ge=-20000, le=20000)],
        Annotated[float, Field(ge=0, le=400)],
    ] = Field((0.0, 0.0, 2.0), description="Its antenna, ENU (x, y, z).")
    mains: bool = Field(True, description="It draws from the mains; false: from its battery, until that is empty.")
    camera: bool = Field(
        False, description="Whether it has cameras; without, it sends context alone and uses what it is sent."
    )
    scored: bool = Field(False, description="Whether its boxes count in the fleet's accuracy.")
