"""Views with ranges as fields, for the search of `sortie.policies.verification.proof.proof`, and plain examples of their cells."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NoReturn

from sortie.policies import geometry
from sortie.policies.contract import COVERAGE_BYTES, Descriptor, Disc, FleetView, LinkState, TaskPhase
from sortie.policies.verification.kit.views import LONGEST_S, OTHER_CODEBOOK
from sortie.policies.verification.proof.stand_ins import (
    FLAGS,
    ORDER_IN_VIEW,
    Flags,
    InAnyOrder,
    Space,
    TargetIds,
    flag_axis,
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
        self.shows_order = True
        """Whether the run forks where the order of the drones in the view is read."""
        self._descriptors = self.in_any_order({i: DescriptorOfRanges(self, i) for i in heard})

    def in_any_order(self, content: Mapping[int, Any]) -> Mapping[int, Any]:
        """A mapping by drone that can be read only."""
        return MappingProxyType(InAnyOrder(self, content))

    def view(self) -> FleetView:
        """The view; its mappings can be read only, as in flight."""
        return self._view({i: self._age(i) for i in self.heard})

    def just_heard(self) -> FleetView:
        """The view with every age 0."""
        return self._view(dict.fromkeys(self.heard, 0.0))

    def _view(self, age_s: dict[int, Any]) -> FleetView:
        return ViewOfRanges(self.ego, self.period_s, self._descriptors, self.in_any_order(age_s))

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
        """Within it, `peers_by_overlap` ranks views by the orders of this run: stand-ins fork it, plain views follow it.

        A run may rank the peers of several drones. The positions of its example show the first of these orders, the
        others are searched as if they were independent of it. Some pairs of orders have no geometry.
        """
        usual, placed = geometry.ranking, self._placed

        def ranking(view: FleetView, of: int) -> list[int]:
            label, picks = _order_of(of), self.path.picks
            if isinstance(view, ViewOfRanges):
                self.path.pick(label, orders(tuple(i for i in self.heard if i != of)))
            elif label == placed or label not in picks:
                return usual(view, of)
            return [p for p in picks[label] if p in view.descriptors]

        geometry.ranking = ranking
        try:
            yield
        finally:
            geometry.ranking = usual

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


class DescriptorOfRanges:
    """A descriptor with ranges as fields. Fields without order fork the run; fields that cannot be searched refuse."""

    def __init__(self, system: FleetOfRanges, agent_id: int) -> None:
        self._system, self.agent_id = system, agent_id

    def _number(self, name: str, low: float, high: float) -> Any:
        return self._system.path.number(f"{name} of drone {self.agent_id}", low, high)

    @property
    def battery_soc(self) -> Any:
        return self._number("battery_soc", 0.0, 1.0)

    @property
    def cpu_headroom(self) -> Any:
        return self._number("cpu_headroom", 0.0, 1.0)

    @property
    def gpu_headroom(self) -> Any:
        return self._number("gpu_headroom", 0.0, 1.0)

    @property
    def peer_goodput_mbps(self) -> tuple[Any, ...]:
        return tuple(self.goodput_to(other) for other in range(self._system.drones) if other != self.agent_id)

    def goodput_to(self, peer: int) -> Any:
        if type(peer) is not int or not 0 <= peer < self._system.drones:
            self._refuse("goodput to a drone outside the fleet")
        axis = goodput_axis(self.agent_id, peer)
        return 0.0 if peer == self.agent_id else self._system.path.number(axis, 0.0, _SEARCHED_UP_TO["goodput"])

    def link_state(self, peer: int) -> LinkState:
        return state_of(self.goodput_to(peer))

    @property
    def task_phase(self) -> TaskPhase:
        return self._system.path.pick(f"task_phase of drone {self.agent_id}", tuple(TaskPhase))

    @property
    def feature_space(self) -> Any:
        return Space(self._system, self.agent_id)

    @property
    def codebook(self) -> Any:
        return Space(self._system, self.agent_id, "codebook")

    @property
    def novelty_flags(self) -> Any:
        return Flags(self._system.path, self.agent_id)

    @property
    def region(self) -> Disc | None:
        if not self._system.path.pick(f"region of drone {self.agent_id}", (False, True)):
            return None
        return Disc(
            self._number("region x_m", -1e5, 1e5),
            self._number("region y_m", -1e5, 1e5),
            self._number("region radius_m", _LEAST_RADIUS_M, 1e5),
        )

    @property
    def priority_target_ids(self) -> Any:
        return TargetIds(self._number("targets", 0, 16), self._system.path)

    def __getitem__(self, at: int) -> Any:
        return getattr(self, Descriptor._fields[at])

    def __eq__(self, other: object) -> bool:
        return self is other or self._refuse("a whole descriptor")

    def __getattr__(self, name: str) -> NoReturn:
        by_rank = name in ("position_m", "footprint_radius_m")
        self._system.path.refuse(
            f"reads {name}{' without peers_by_overlap' if by_rank else ', which cannot be searched'}"
        )

    _refuse = __getattr__


def _without_order(name: str) -> Any:
    """A property of `FleetView` that does not depend on the order of drones, so that it does not fork the run."""

    def read(view: Any) -> Any:
        system = view.descriptors[view.ego]._system
        shown, system.shows_order = system.shows_order, False
        try:
            return getattr(FleetView, name).fget(view)
        finally:
            system.shows_order = shown

    return property(read)


class ViewOfRanges(FleetView):
    """A view over ranges. Its mappings can be read only, and have any order."""

    __slots__ = ()

    peers = _without_order("peers")
    human_in_region = _without_order("human_in_region")
    _near = _without_order("attached")

    @property
    def attached(self) -> ViewOfRanges:
        near = self._near
        if len(near.age_s) == len(self.age_s):
            return self
        system: Any = near.descriptors[self.ego]._system
        found: ViewOfRanges = self._replace(
            descriptors=system.in_any_order(near.descriptors), age_s=system.in_any_order(near.age_s)
        )
        return found


_ORDER = "peers by overlap with drone "


def _order_of(receiver: int) -> str:
    return f"{_ORDER}{receiver}"


def goodput_axis(source: int, destination: int) -> str:
    """The name of a goodput's axis."""
    return f"goodput of drone {source} to drone {destination}"


def region_axes(drone: int) -> list[str]:
    """The names of the axes of a drone's region."""
    return [f"region {part} of drone {drone}" for part in Disc._fields]


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
