"""What makes the benchmark hard, by name: each parameter's range, and where test scenes leave the training's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Split = Literal["train", "validation", "tau", "test"]
Density = Literal["sparse", "default", "dense"]
Range = tuple[float, float]
"""Drawn evenly between the two, once a scene (or once a frame where said)."""


@dataclass(frozen=True, slots=True)
class CarRanges:
    """How many cars there are."""

    parked_density: Range
    """Fraction of kerb spots that hold a car."""
    moving_cars_per_km: Range
    """Moving cars per kilometre of lane."""


DENSITIES: dict[Density, CarRanges] = {
    "sparse": CarRanges((0.02, 0.12), (1.5, 4.0)),
    "default": CarRanges((0.1, 0.3), (3.0, 8.0)),
    "dense": CarRanges((0.35, 0.65), (9.0, 16.0)),
}
"""About 10, 25 and 60 cars within ±102.4 m of a drone; the middle one is near what UAV3D's frames hold."""


@dataclass(frozen=True, slots=True)
class Layout:
    """How a town is laid out."""

    styles: tuple[str, ...]
    """Names of `sortie.perception.scene.town.STYLES`, taken in turn."""
    block_m: Range
    """Distance between parallel roads."""


@dataclass(frozen=True, slots=True)
class Difficulty:
    """The benchmark's parameters; units stand in the names, σ are standard deviations."""

    density: Density = "default"
    seen: Layout = Layout(("town", "old_town", "suburb"), (60.0, 100.0))
    """Layouts of the train, validation and tau splits."""
    unseen: Layout = Layout(("yard", "town", "old_town", "suburb"), (105.0, 135.0))
    """Layouts of the test split: a style and block sizes that no other split has."""
    building_density: Range = (0.3, 0.9)
    """Fraction of lots that are built on: what can hide a car."""
    building_height_m: Range = (5.0, 15.0)
    """Mean height of a scene's buildings: how far they hide, and how far they lean in the lift."""
    tree_density: Range = (0.2, 0.8)
    """Fraction of tree spots that hold one; crowns hide kerb parking."""
    moving_speed_mps: Range = (4.0, 12.0)
    sun_elevation_deg: Range = (25.0, 75.0)
    """Low suns cast long shadows."""
    overcast: Range = (0.0, 1.0)
    brightness: Range = (0.7, 1.1)
    spacing_m: Range = (17.0, 23.0)
    """Arms of the cross, a frame: about 20 m."""
    altitude_m: Range = (55.0, 65.0)
    """Of the fleet, a frame: about 60 m."""
    slot_sigma_m: float = 0.6
    """How far each drone is from its slot, each axis."""
    yaw_sigma_deg: float = 1.5
    """How far each drone's heading is from the fleet's."""
    tilt_sigma_deg: float = 4.0
    """Roll and pitch."""
    position_error_sigma_m: float = 0.2
    """Estimated minus true position, each axis."""
    heading_error_sigma_deg: float = 0.2
    """Estimated minus true heading."""

    def layout(self, split: Split) -> Layout:
        """What the towns of a split are laid out like."""
        return self.unseen if split == "test" else self.seen


VARIED = Difficulty(density="dense", altitude_m=(35.0, 90.0), yaw_sigma_deg=30.0)
"""For training: cars close beside each other, fleets at any height, and drones that look different ways."""
