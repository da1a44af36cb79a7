"""The classes of targets: cars, trucks and people. Free of torch.

A box of one class never matches a box of another: not in joining, not in tracking, not in AP. Boxes of vehicles match by
overlap. A person's box is smaller than the error of its place, so boxes of people match by distance.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class TargetClass(IntEnum):
    """The class of a box; payloads name it in one byte."""

    CAR = 0
    TRUCK = 1
    PERSON = 2


CAR, TRUCK, PERSON = TargetClass  # members of an enumeration are slow to look up
NEAR_M = 2.0
"""A box of a person within this distance of a person may be of that person."""
PERSON_SIZE_M = (0.5, 0.5, 1.75)
"""Length, width and height of a person's box."""
TRUCK_FROM_M = 6.0
"""A vehicle of the scene that is as long as this is a truck; vans are shorter. It holds for truth alone: the shipped networks
give every box a car's length (`perception/README.md`)."""


def vehicle_classes(length_m: NDArray[np.floating]) -> NDArray[np.int8]:
    """The class of each vehicle of a scene, by its true length."""
    return np.where(length_m >= TRUCK_FROM_M, TRUCK, CAR).astype(np.int8)
