"""Places on the globe and in a local east, north, up frame (ENU).

They lie on a plane through a stated origin, with the WGS-84 ellipsoid's two radii of curvature there. Within 5 km of the
origin the error stays below 2 m · tan(latitude) horizontally. Height is height above the plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sortie.scenarios.errors import SortieError

_FARTHEST_UP_M = 100_000.0
"""Of an origin; MAVLink's altitudes are 32-bit millimetres."""

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Origin:
    """Where ENU (0, 0, 0) lies: WGS-84 degrees, metres above mean sea level."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0

    def __post_init__(self) -> None:
        if not (abs(self.latitude_deg) <= 85 and abs(self.longitude_deg) <= 180):
            raise SortieError(
                f"origin is ({self.latitude_deg}, {self.longitude_deg}), must lie within ±85° and ±180°: a local "
                "east and north mean nothing at a pole"
            )
        if not abs(self.altitude_m) <= _FARTHEST_UP_M:
            raise SortieError(f"its altitude is {self.altitude_m} m, must be within ±{_FARTHEST_UP_M:g} m")


def geodetic(position_m: tuple[float, float, float], origin: Origin) -> tuple[float, float, float]:
    """ENU metres to latitude and longitude in degrees and altitude in metres."""
    east_m, north_m = metres_per_radian(origin.latitude_deg, origin.altitude_m)
    east, north, up = position_m
    latitude = origin.latitude_deg + math.degrees(north / north_m)
    longitude = origin.longitude_deg + math.degrees(east / east_m)
    return latitude, (longitude + 180) % 360 - 180, origin.altitude_m + up


def local_enu(latitude_deg: float, longitude_deg: float, altitude_m: float, origin: Origin) -> Vector:
    """The inverse of `geodetic`: ENU metres."""
    east_m, north_m = metres_per_radian(origin.latitude_deg, origin.altitude_m)
    east_deg = (longitude_deg - origin.longitude_deg + 180) % 360 - 180
    north_deg = latitude_deg - origin.latitude_deg
    return math.radians(east_deg) * east_m, math.radians(north_deg) * north_m, altitude_m - origin.altitude_m


def metres_per_radian(latitude_deg: float, altitude_m: float) -> tuple[float, float]:
    """Metres eastward per radian of longitude and northward per radian of latitude, on the WGS-84 ellipsoid."""
    a, e2 = 6378137.0, 6.69437999014e-3
    phi = math.radians(latitude_deg)
    w = math.sqrt(1 - e2 * math.sin(phi) ** 2)
    meridian_m = a * (1 - e2) / w**3 + altitude_m
    normal_m = a / w + altitude_m
    return normal_m * math.cos(phi), meridian_m
