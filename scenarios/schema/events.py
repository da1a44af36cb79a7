"""`events`: what goes wrong, and when."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId, ModelName, Params, Section


class BaseEvent(Section):
    at_s: float = Field(ge=0, description="When it begins.")


class LinkDrop(BaseEvent):
    kind: Literal["link_drop"]
    drone: DroneId = Field(description="Whose links fade.")
    peer: DroneId | None = Field(None, description="The other end; left out, every link of the drone.")
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")
    loss_db: float = Field(30.0, gt=0, le=200, description="Extra loss, both directions.")


class Jam(BaseEvent):
    kind: Literal["jam"]
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")
    position_m: tuple[float, float, float] = Field(description="The jammer, ENU (x, y, z).")
    power_dbm: float = Field(20.0, ge=-50, le=60, description="Its power in the channel.")


class DroneLost(BaseEvent):
    kind: Literal["drone_lost"]
    drone: DroneId = Field(description="Who falls silent and leaves.")


class DroneJoins(BaseEvent):
    kind: Literal["drone_joins"]
    drone: DroneId = Field(
        description="The drone that joins. It begins on the ground, unless an earlier event made it leave or lost it."
    )


class DroneLeaves(BaseEvent):
    kind: Literal["drone_leaves"]
    drone: DroneId = Field(description="Who goes home: it publishes landing, descends and leaves.")


class BatteryFault(BaseEvent):
    kind: Literal["battery_fault"]
    drone: DroneId = Field(description="Whose battery fails.")
    lost_fraction: float = Field(gt=0, le=1, description="Fraction of the remaining energy that is gone at once.")


class CellFailure(BaseEvent):
    kind: Literal["cell_failure"]
    drone: DroneId = Field(description="Whose pack loses a cell: its voltage and its energy are gone.")


class ClockSkew(BaseEvent):
    kind: Literal["clock_skew"]
    drone: DroneId = Field(description="Whose clock is off.")
    skew_s: float = Field(
        ge=-3600, le=3600, description="Added to its stamps; negative makes its descriptors look old."
    )


class ClockDrift(BaseEvent):
    kind: Literal["clock_drift"]
    drone: DroneId = Field(description="Whose clock drifts, and follows GNSS no more.")
    drift_ppm: float = Field(ge=-100000, le=100000, description="How much too fast it runs from then on.")


class GnssLoss(BaseEvent):
    kind: Literal["gnss_loss"]
    drone: DroneId | None = Field(None, description="Who loses it; left out, all drones.")
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")
    position_walk_m: float = Field(
        0.0,
        ge=0,
        le=100,
        description="Dead reckoning: standard deviation of the believed position's error after one second, per horizontal axis; it grows with the square root of time.",
    )


Metres = Annotated[float, Field(ge=-10000, le=10000)]
Speed = Annotated[float, Field(ge=-1000, le=1000)]


class PositionFault(BaseEvent):
    kind: Literal["position_fault"]
    drone: DroneId = Field(description="Who believes to be somewhere else.")
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")
    offset_m: tuple[Metres, Metres, Metres] = Field(
        (0.0, 0.0, 0.0), description="A jump of the believed position, ENU (x, y, z)."
    )
    drift_mps: tuple[Speed, Speed, Speed] = Field(
        (0.0, 0.0, 0.0), description="How fast the believed position drifts from then on, ENU."
    )


class HeadingFault(BaseEvent):
    kind: Literal["heading_fault"]
    drone: DroneId = Field(description="Who believes to look elsewhere.")
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")
    offset_deg: float = Field(0.0, ge=-180, le=180, description="Added to the believed heading, counter-clockwise.")
    drift_degps: float = Field(0.0, ge=-90, le=90, description="Degrees a second by which it drifts from then on.")


class CameraBlocked(BaseEvent):
    kind: Literal["camera_blocked"]
    drone: DroneId = Field(description="Whose cameras see nothing.")
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")


class SlowPerception(BaseEvent):
    kind: Literal["slow_perception"]
    drone: DroneId = Field(description="The drone with features and boxes that are ready later.")
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")
    extra_s: float = Field(0.2, gt=0, le=10, description="Added to the time from sensing to features ready to send.")


class Spoof(BaseEvent):
    kind: Literal["spoof"]
    drone: DroneId = Field(description="Whose descriptors are imitated.")
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")
    attack: Literal["forged", "replayed", "malformed", "oversized"] = Field(
        "forged", description="What is put on the air."
    )
    rate_hz: float = Field(10.0, ge=1e-3, le=1000, description="Datagrams a second.")


class Lie(BaseEvent):
    kind: Literal["lie"]
    drone: DroneId = Field(description="Who lies, in its own descriptors.")
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")
    about: Literal["coverage", "goodput", "battery"] = Field("coverage", description="What is false.")
    claim: Literal["much", "little"] = Field(
        "much",
        description="All cells new, 500 Mb/s to everyone, a full battery; or nothing seen, 0.1 Mb/s, an empty one.",
    )


class Own(BaseEvent):
    kind: Literal["own"]
    model: Annotated[str, ModelName("event")] = Field(description="The event's class (docs/guide/event.md).")
    params: Params = Field({}, description="Its keyword arguments.")
    until_s: float | None = Field(None, ge=0, description="When it ends; left out, never.")


Event = Annotated[
    LinkDrop
    | Jam
    | DroneLost
    | DroneJoins
    | DroneLeaves
    | BatteryFault
    | CellFailure
    | ClockSkew
    | ClockDrift
    | GnssLoss
    | Spoof
    | Lie
    | PositionFault
    | HeadingFault
    | CameraBlocked
    | SlowPerception
    | Own,
    Field(discriminator="kind"),
]
