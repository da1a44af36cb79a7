"""Views with ranges as fields, for the search of `sortie.policies.verification.proof.proof`, and plain examples of their cells."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NoReturn

import numpy as np

from sortie.policies import geometry
from sortie.policies.contract import COVERAGE_BYTES, Descriptor, Disc, FleetView, LinkState, TaskPhase
from sortie.policies.geometry import peers_by_overlap
from sortie.policies.verification.kit.views import LONGEST_S, OTHER_CODEBOOK
from sortie.policies.verification.proof.stand_ins import (
    FLAGS,
    ORDER_IN_VIEW,
    Flags,
    InAnyOrder,
    Space,
    TargetIds,
    Unsearchable,
    flag_axis,
    is_blind,
    orders,
    space_of,
)
from sortie.policies.verification.proof.symbols import Path, Ranged
from sortie.scenarios.disc import disc_overlap
from sortie.scenarios.link_state import state_of

Choose = Callable[[str, float, float], float]
"""Picks a number of an axis between its bounds."""

_FOOTPRINT_M = 42.0
_LEAST_RADIUS_M = math.ulp(0.0)
"""The least float above 0: a region may be as small as its file likes."""
_SEARCHED_UP_TO: dict[str, float] = {"goodput": 1e5, "age": 2.0**32}
"""Clocks that drift make ages longer than a sortie; the seconds of a stamp have 32 bits."""


class FleetOfRanges:
    """A fleet's view over the ranges of one path."""

    def __init__(self, path: Path, drones: int, ego: int, heard: tuple[int, ...], period_s: float) -> None:
        self.path, self.drones, self.ego, self.heard, self.period_s = path, drones, ego, heard, period_s
        self.peers = tuple(i for i in heard if i != ego)
        self.is_older = False
        self._descriptors: Mapping[int, Any] | None = None

    def view(self) -> FleetView:
        """The view; its mappings can be read only, as in flight."""
        return self._view({i: self._age(i) for i in self.heard})

    def just_heard(self) -> FleetView:
        """The view with every age 0."""
        return self._view(dict.fromkeys(self.heard, 0.0))

    def _view(self, age_s: dict[int, Any]) -> FleetView:
        if self._descriptors is None:
            self._descriptors = _in_any_order(self, {i: DescriptorOfRanges(self, i) for i in self.heard})
        return ViewOfRanges(self.ego, self.period_s, self._descriptors, _in_any_order(self, age_s))

    def _age(self, i: int) -> Ranged:
        return self.path.number(f"age_s of drone {i}", 0.0, _SEARCHED_UP_TO["age"])

    def older_view(self) -> FleetView:
        """The view with ages of at least the lowest ages of the cell reached so far.

        This is exact. Within the cell the policy decides the same, so the lowest age represents the cell, and every
        age above it is a raise of it.
        """
        self.is_older = True
        ages: dict[int, Any] = {}
        for i in self.heard:
            self._age(i)
            ages[i] = self.path.raised(f"age_s of drone {i}", f"raised age_s of drone {i}", _SEARCHED_UP_TO["age"])
        return self._view(ages)

    @contextmanager
    def ranked(self) -> Iterator[None]:
        """Within it, `peers_by_overlap` ranks plain views as this run ranked its own.

        A run may rank the peers of several drones. The positions of its example show the first of these orders.
        """
        picks, usual, placed = self.path.picks, geometry.rank_loop, self._placed

        def ranked(of: int, ids: Any, *circles: Any) -> Any:
            label = _order_of(of)
            if label == placed or label not in picks:
                return usual()(of, ids, *circles)
            return np.array([p for p in picks[label] if p in ids])

        geometry.rank_loop = lambda: ranked  # type: ignore[assignment]
        try:
            yield
        finally:
            geometry.rank_loop = usual

    @property
    def _placed(self) -> str:
        """The order that the positions of an example show."""
        return next((label for label in self.path.picks if label.startswith(_ORDER)), _order_of(self.ego))

    def example(self, choose: Choose | None = None) -> FleetView:
        """A plain view of the cell, with usual values if they lie in it, otherwise with round ones.

        Args:
            choose: picks a number of an axis from its bounds, in place of the usual value.
        """
        path = self.path

        def number(axis: str, usual: float) -> float:
            low, high = path.bounds(axis, usual)
            if choose is not None and axis in path.ranges:
                return choose(axis, low, high)
            return usual if low <= usual <= high else _round_within(low, high)

        ranked = self._placed
        receiver = int(ranked.rpartition(" ")[2])
        order = path.picks.get(ranked, tuple(i for i in self.heard if i != receiver))
        places = _places(receiver, order)
        descriptors = {}
        for i in self.heard:
            region = path.picks.get(f"region of drone {i}", False)
            names = region_axes(i)
            targets = number(f"targets of drone {i}", 0)
            descriptors[i] = Descriptor(
                stamp_ns=0,
                agent_id=i,
                position_m=places[i],
                orientation_xyzw=(0.0, 0.0, 0.0, 1.0),
                velocity_mps=(0.0, 0.0, 0.0),
                footprint_radius_m=_FOOTPRINT_M,
                battery_soc=number(f"battery_soc of drone {i}", 1.0),
                cpu_headroom=number(f"cpu_headroom of drone {i}", 1.0),
                gpu_headroom=number(f"gpu_headroom of drone {i}", 1.0),
                peer_goodput_mbps=tuple(
                    number(goodput_axis(i, other), 100.0) for other in range(self.drones) if other != i
                ),
                coverage_grid=bytes(COVERAGE_BYTES),
                novelty_flags=sum(path.picks.get(flag_axis(bit, i), 0) for bit in range(FLAGS)),
                task_phase=path.picks.get(f"task_phase of drone {i}", TaskPhase.SEARCH),
                region=Disc(number(names[0], 0.0), number(names[1], 0.0), number(names[2], 32.0)) if region else None,
                priority_target_ids=tuple(range(int(targets))),
                feature_space="" if path.picks.get(space_of(i), True) else "other",
                codebook="" if path.picks.get(space_of(i, "codebook"), True) else OTHER_CODEBOOK,
            )
        ages_s = self._example_ages(choose)
        ids = path.picks.get(ORDER_IN_VIEW, self.heard)
        return FleetView(self.ego, self.period_s, {i: descriptors[i] for i in ids}, {i: ages_s[i] for i in ids}).frozen

    def _example_ages(self, choose: Choose | None = None) -> dict[int, float]:
        ages = {}
        for i in self.heard:
            axis = f"age_s of drone {i}"
            low, high = self.path.bounds(axis, 0.0)
            # If ages were raised, this is the lowest age of the cell, from which they were raised.
            usual = low if self.is_older or low == 0.0 else _round_age_s(low, high)
            ages[i] = usual if choose is None or self.is_older else choose(axis, low, high)
        return ages

    def raised_example(self) -> dict[int, float] | None:
        """The raised ages of the example; None if the property raised none."""
        if not self.is_older:
            return None
        from_s = self._example_ages()
        raised = {}
        for i in self.heard:
            low, high = self.path.bounds(f"raised age_s of drone {i}", from_s[i])
            raised[i] = from_s[i] if low <= from_s[i] <= high else _round_age_s(low, high)
        return raised


def _refused(name: str) -> Any:
    """A field that cannot be searched."""
    return property(lambda descriptor: _refusing(descriptor, name))


def _share(name: str) -> Any:
    """A field between 0 and 1."""
    return property(lambda descriptor: descriptor._number(name, 0.0, 1.0))


class DescriptorOfRanges(Descriptor):
    """A descriptor with ranges as fields. Fields without order fork the run; fields that cannot be searched raise `Refused`.

    It is a `Descriptor`, so indices, patterns, its length and assignments answer as in flight. What is stored in the
    tuple itself refuses every use; all reading goes through the properties.
    """

    __slots__ = ()

    def __new__(cls, system: FleetOfRanges, agent_id: int) -> DescriptorOfRanges:
        stored = [Unsearchable(system, agent_id, name) for name in Descriptor._fields]
        return tuple.__new__(cls, stored)

    @property
    def _origin(self) -> Unsearchable:
        found: Unsearchable = tuple.__getitem__(self, 0)  # type: ignore[assignment]
        return found

    def _number(self, name: str, low: float, high: float) -> Any:
        origin = self._origin
        return origin.system.path.number(f"{name} of drone {origin.drone}", low, high)

    @property
    def agent_id(self) -> int:
        return self._origin.drone

    battery_soc = _share("battery_soc")
    cpu_headroom = _share("cpu_headroom")
    gpu_headroom = _share("gpu_headroom")

    @property
    def peer_goodput_mbps(self) -> tuple[Any, ...]:
        system, me = self._origin.system, self._origin.drone
        others = (i for i in range(system.drones) if i != me)
        return tuple(self._number_to(other) for other in others)

    def _number_to(self, other: int) -> Any:
        return self._origin.system.path.number(goodput_axis(self._origin.drone, other), 0.0, _SEARCHED_UP_TO["goodput"])

    def link_state(self, peer: int) -> LinkState:
        return state_of(self.goodput_to(peer))

    def goodput_to(self, peer: int) -> Any:
        # a drone off a roster reads 0, which is in the range too
        if type(peer) is not int or not 0 <= peer < self._origin.system.drones:
            self._origin._reached()
        return 0.0 if peer == self._origin.drone else self._number_to(peer)

    def counts(self, drone: int) -> bool:
        return _refusing(self, "roster")

    @property
    def task_phase(self) -> TaskPhase:
        path: Path = self._origin.system.path
        return path.pick(f"task_phase of drone {self._origin.drone}", tuple(TaskPhase))

    @property
    def feature_space(self) -> Any:
        return Space(self._origin.system, self._origin.drone)

    @property
    def codebook(self) -> Any:
        return Space(self._origin.system, self._origin.drone, "codebook")

    @property
    def novelty_flags(self) -> Any:
        return Flags(self._origin.system.path, self._origin.drone)

    @property
    def region(self) -> Disc | None:
        if not self._origin.system.path.pick(f"region of drone {self._origin.drone}", (False, True)):
            return None
        return Disc(
            self._number("region x_m", -1e5, 1e5),
            self._number("region y_m", -1e5, 1e5),
            self._number("region radius_m", _LEAST_RADIUS_M, 1e5),
        )

    @property
    def priority_target_ids(self) -> Any:
        return TargetIds(self._number("targets", 0, 16), self._origin.system.path)

    @property
    def position_m(self) -> tuple[float, float, float]:
        receiver = self._only_for_order("position_m")
        system = self._origin.system
        peers = tuple(i for i in system.heard if i != receiver)
        order = system.path.pick(_order_of(receiver), orders(peers))
        return _places(receiver, order)[self._origin.drone]

    @property
    def footprint_radius_m(self) -> float:
        self._only_for_order("footprint_radius_m")
        return _FOOTPRINT_M

    def _only_for_order(self, field: str) -> int:
        """The drone whose peers are ranked. Geometry may only be read through `peers_by_overlap`, for the order alone.

        The orders of two receivers are searched as if they were independent. Some pairs of orders have no geometry.
        """
        frame = sys._getframe(2)
        while frame is not None:
            if frame.f_code is peers_by_overlap.__code__:
                return int(frame.f_locals["of"])
            frame = frame.f_back  # type: ignore[assignment]
        self._origin.system.path.refuse(f"reads {field} without peers_by_overlap")

    def __getitem__(self, at: Any) -> Any:
        return getattr(self, Descriptor._fields[at]) if type(at) is int else self._whole()

    def __iter__(self) -> Any:
        return (getattr(self, name) for name in Descriptor._fields)

    def __eq__(self, other: object) -> bool:
        return self is other or self._whole()

    def __ne__(self, other: object) -> bool:
        return not self.__eq__(other)

    def _whole(self, *_: object, **__: object) -> NoReturn:
        path: Path = self._origin.system.path
        path.refuse("uses a whole descriptor, which cannot be searched")

    __lt__ = __le__ = __gt__ = __ge__ = __add__ = __radd__ = __mul__ = __rmul__ = __contains__ = __hash__ = __repr__ = (
        _whole
    )
    __reduce__ = __reduce_ex__ = __getnewargs__ = __copy__ = __deepcopy__ = count = index = _whole
    _replace = _asdict = _make = with_roster = goodput_by_id = _whole

    coverage_corner = _refused("coverage_corner")
    stamp_ns = _refused("stamp_ns")
    orientation_xyzw = _refused("orientation_xyzw")
    velocity_mps = _refused("velocity_mps")
    coverage_grid = _refused("coverage_grid")
    roster = _refused("roster")

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return Descriptor


def _refusing(descriptor: DescriptorOfRanges, name: str) -> NoReturn:
    path: Path = descriptor._origin.system.path
    path.refuse(f"reads {name}, which cannot be searched")


class ViewOfRanges(FleetView):
    """A view over ranges. As in flight its mappings can be read only, those of `attached` peers cannot. They have any order."""

    __slots__ = ()

    def _replace(self, **fields: Any) -> Any:
        if not is_blind(sys._getframe(1)):
            self.descriptors[self.ego]._origin.system.path.refuse("makes a view of its own")  # type: ignore[attr-defined]
        return FleetView._replace(self, **fields)

    @property
    def attached(self) -> FleetView:
        near: FleetView = FleetView.attached.fget(_without_order(self))  # type: ignore[attr-defined]
        if len(near.age_s) == len(self.age_s):
            return self
        system = self.descriptors[self.ego]._origin.system  # type: ignore[attr-defined]
        descriptors, age_s = (InAnyOrder(system.path, m, system.heard) for m in (near.descriptors, near.age_s))
        return FleetView._replace(self, descriptors=descriptors, age_s=age_s)  # which can be changed, as in flight

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return FleetView


def _without_order(view: FleetView) -> FleetView:
    """The view by ascending id, which no policy may see."""
    descriptors = {i: view.descriptors[i] for i in sorted(view.descriptors)}
    age_s = {i: view.age_s[i] for i in sorted(view.age_s)}
    return FleetView(view.ego, view.period_s, descriptors, age_s, view.detached_after_periods)


_ORDER = "peers by overlap with drone "


def _order_of(receiver: int) -> str:
    return f"{_ORDER}{receiver}"


def goodput_axis(source: int, destination: int) -> str:
    """The name of a goodput's axis."""
    return f"goodput of drone {source} to drone {destination}"


def region_axes(drone: int) -> list[str]:
    """The names of the axes of a drone's region."""
    return [f"region {part} of drone {drone}" for part in Disc._fields]


def _in_any_order(system: FleetOfRanges, content: Mapping[int, Any]) -> Mapping[int, Any]:
    return MappingProxyType(InAnyOrder(system.path, content, system.heard))


@lru_cache(maxsize=4096)
def _places(ego: int, order: tuple[int, ...]) -> dict[int, tuple[float, float, float]]:
    """Positions with footprints that overlap the ego's in that order, each clearly less than the one before."""
    places = {ego: (0.0, 0.0, 60.0)}
    for rank, peer in enumerate(order):
        wanted = 0.95 - 0.9 * (rank + 1) / (len(order) + 1)
        near_m, far_m = 0.0, 2 * _FOOTPRINT_M
        for _ in range(40):
            middle_m = (near_m + far_m) / 2
            if disc_overlap(middle_m, _FOOTPRINT_M, _FOOTPRINT_M) > wanted:
                near_m = middle_m
            else:
                far_m = middle_m
        places[peer] = (round(near_m, 2), 0.0, 60.0)
    return places


def _round_age_s(low: float, high: float) -> float:
    """An age with few digits, no longer than a sortie where there is one."""
    return _round_within(low, high if low > LONGEST_S else min(high, LONGEST_S))


def _round_within(low: float, high: float) -> float:
    """A number of [low, high] with few digits."""
    middle = low / 2 + high / 2
    for digits in range(17):
        candidate = round(middle, digits)
        if low <= candidate <= high:
            return candidate
    return low
