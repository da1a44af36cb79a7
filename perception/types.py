"""The types that perception exchanges with the other rooms: a capture, a peer's share, boxes. Free of torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.perception.classes import TargetClass
from sortie.perception.geometry import USUAL, Cameras, to_local, to_world
from sortie.perception.motion import Tracks
from sortie.perception.uncertainty import BoxErrors
from sortie.scenarios.disc import Disc
from sortie.scenarios.representation import MAP_NAMES


class Capture(NamedTuple):
    """One drone's images at one instant: a cheap handle, rendered only when they are needed."""

    drone: int
    t_s: float
    """When it was sensed."""
    position_m: tuple[float, float, float]
    """Its true position, ENU."""
    orientation_xyzw: tuple[float, float, float, float]
    """Its true orientation, FLU in ENU."""
    est_position_m: tuple[float, float, float]
    """Its estimated position, ENU."""
    est_yaw_rad: float
    """Its estimated heading, from east towards north."""
    looked: bool = True
    """False: the drone's pose alone. It has no images, so no features and no boxes of its own."""
    cameras: Cameras = USUAL

    @property
    def est_pose(self) -> tuple[float, float, float]:
        """Estimated x, y, yaw: places its features and boxes in the world."""
        return self.est_position_m[0], self.est_position_m[1], self.est_yaw_rad

    @property
    def true_pose(self) -> tuple[float, float, float]:
        """True x, y, yaw: the centre and the turn of the square in which it is scored."""
        return self.position_m[0], self.position_m[1], self.true_yaw_rad

    @property
    def true_yaw_rad(self) -> float:
        """Its true heading, from east towards north."""
        x, y, z, w = self.orientation_xyzw
        return float(np.arctan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z)))


class Share(NamedTuple):
    """One peer's payload as it was delivered."""

    capture: Capture
    representation: str
    """A name of `scenarios.representation`, except none."""
    rho: float
    roi: Disc | None
    """Its region of interest; None is everywhere."""
    weight: float
    """Fusion weight, 0 … 1: the directive's × the receiver's trust."""
    missing: tuple[int, ...] = ()
    """Ranks (0 the best) of the cells that were sent and did not arrive."""
    age_s: float = 0.0
    """From the capture to the fusion, as the receiver knows it. What it leaves of a share is in `perception.lateness`."""
    tracks: Tracks | None = None
    """Of a payload of tracks: the tracks that came. Of boxes: the receiver's own tracks, which say how late boxes move."""
    boxes: Boxes | None = None
    """The sender's boxes, best first, where another network than the receiver's made them, or where it found them by fusing maps
    (`Found`)."""
    people: Boxes | None = None
    """People that the sender's thermal camera found; None where the payload has none to give."""
    errors: BoxErrors | None = None
    """How uncertain the places of `boxes` are, where they are sent with covariances."""
    cut: bool = False
    """Of a payload of tracks: it was full before the people in it were set aside, so weaker tracks may have been left out."""

    @property
    def is_map(self) -> bool:
        """Whether it holds feature cells rather than boxes."""
        return self.representation in MAP_NAMES

    @property
    def is_detected(self) -> bool:
        """Whether it holds boxes that the receiver's detector finds in its capture; tracks bring their own."""
        return self.boxes is None and not self.is_map and (self.representation != "tracks" or self.tracks is None)


class Found(NamedTuple):
    """What a drone found when it last fused the maps that it held; it sends this with its own maps."""

    capture: Capture
    """Its own look, in whose square it fused."""
    number: int
    """How many boxes."""
    boxes: Boxes | None
    """The boxes themselves, best first; None where no detector flies, and they are only counted."""


@dataclass(frozen=True, slots=True)
class Boxes:
    """Oriented boxes on the ground, world frame ENU; float32 arrays over n boxes."""

    xy_m: NDArray[Any]
    """[n, 2] centres."""
    size_m: NDArray[Any]
    """[n, 2] length, width."""
    yaw_rad: NDArray[Any]
    """[n]"""
    score: NDArray[Any]
    """[n]; ones for ground truth."""
    car: NDArray[Any] = None  # type: ignore[assignment]  # filled in below
    """[n] int32: of ground truth, which car or person it is; −1, which left out stands for, where nobody knows."""
    kind: NDArray[Any] = None  # type: ignore[assignment]  # filled in below
    """[n] int8: its class, as `TargetClass`; cars where left out."""

    def __post_init__(self) -> None:
        if self.car is None:
            object.__setattr__(self, "car", np.full(len(self.score), -1, np.int32))
        if self.kind is None:
            object.__setattr__(self, "kind", np.zeros(len(self.score), np.int8))

    def __len__(self) -> int:
        return len(self.score)

    def take(self, which: NDArray[Any] | slice) -> Boxes:
        """The boxes at the given indices, under the given mask or in the given slice, in that order."""
        return Boxes(
            self.xy_m[which],
            self.size_m[which],
            self.yaw_rad[which],
            self.score[which],
            self.car[which],
            self.kind[which],
        )

    def of_class(self, kind: TargetClass) -> Boxes:
        """Those of one class."""
        return self.take(self.kind == kind)

    def inside(self, disc: Disc | None) -> Boxes:
        """The boxes whose centres are in the disc; all of them for None."""
        if disc is None:
            return self
        dx, dy = self.xy_m[:, 0] - disc[0], self.xy_m[:, 1] - disc[1]
        return self.take(dx * dx + dy * dy <= disc[2] ** 2)

    def table(self) -> NDArray[np.float64]:
        """[n, 5] float64: x, y, length, width, yaw."""
        return np.concatenate([self.xy_m, self.size_m, self.yaw_rad[:, None]], axis=1).astype(np.float64)

    def moved(self, placed_by: tuple[float, float, float], pose: tuple[float, float, float]) -> Boxes:
        """The boxes as another pose (x, y, yaw) of their drone places them."""
        if placed_by == pose:
            return self
        x, y = self.xy_m.T.astype(np.float64)
        x, y = to_world(*to_local(x, y, placed_by), pose)
        yaw = self.yaw_rad + np.float32(pose[2] - placed_by[2])
        return replace(self, xy_m=np.stack([x, y], axis=1).astype(np.float32), yaw_rad=yaw)

    def single(self) -> Boxes:
        """The same boxes in float32, as sorties record them."""
        xy, size, yaw, score = (v.astype(np.float32) for v in (self.xy_m, self.size_m, self.yaw_rad, self.score))
        return Boxes(xy, size, yaw, score, self.car, self.kind)

    @classmethod
    def empty(cls) -> Boxes:
        """No boxes."""
        return cls(*(np.zeros(shape, np.float32) for shape in ((0, 2), (0, 2), 0, 0)))

    @classmethod
    def join(cls, several: Sequence[Boxes]) -> Boxes:
        """All boxes of several, in order."""
        if not several:
            return cls.empty()
        return cls(*(np.concatenate([getattr(b, f) for b in several]) for f in cls.__slots__))

    @classmethod
    def placed(cls, local: NDArray[Any], pose: tuple[float, float, float]) -> Boxes:
        """Boxes [n, 6] of a drone's frame (x forward, y left, length, width, yaw, score) in the world, by its pose (x, y, yaw)."""
        xy = np.stack(to_world(local[:, 0], local[:, 1], pose), axis=1)
        return cls(xy, local[:, 2:4], local[:, 4] + pose[2], local[:, 5]).single()
