"""Views with ranges as fields, for the search of `sortie.policies.verification.proof`, and plain examples of their cells."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, NoReturn

from sortie.policies.contract import COVERAGE_BYTES, Descriptor, Disc, FleetView, LinkState, TaskPhase, goodput_in
from sortie.policies.geometry import peers_by_overlap
from sortie.policies.verification.symbols import Path, Ranged
from sortie.scenarios.disc import disc_overlap

_FOOTPRINT_M = 42.0
_FLAGS = 8
"""The bits of a descriptor's novelty flags; the plane uses three of them."""
_SEARCHED_UP_TO: dict[str, float] = {"goodput": 1e5, "age": 3600.0}


class FleetOfRanges:
    """A fleet's view over the ranges of one path."""

    def __init__(self, path: Path, drones: int, ego: int, heard: tuple[int, ...], period_s: float) -> None:
        self.path, self.drones, self.ego, self.heard, self.period_s = path, drones, ego, heard, period_s
        self.peers = tuple(i for i in heard if i != ego)
        self._older = False

    def view(self) -> FleetView:
        descriptors: dict[int, Any] = {i: DescriptorOfRanges(self, i) for i in self.heard}
        ages: Mapping[int, Any] = {i: self._age(i) for i in self.heard}
        return FleetView(self.ego, self.period_s, descriptors, ages)

    def _age(self, i: int) -> Ranged:
        return self.path.number(f"age_s of drone {i}", 0.0, _SEARCHED_UP_TO["age"])

    def older_view(self) -> FleetView:
        """The view with ages of at least the lowest ages of the cell reached so far.

        This is exact. Within the cell the policy decides the same, so the lowest age represents the cell, and every
        age above it is a raise of it.
        """
        self._older = True
        ages: dict[int, Any] = {}
        for i in self.heard:
            self._age(i)
            low, _ = self.path.ranges[f"age_s of drone {i}"]
            ages[i] = self.path.number(f"raised age_s of drone {i}", low, _SEARCHED_UP_TO["age"])
        return self.view()._replace(age_s=ages)

    def example(self) -> FleetView:
        """A plain view of the cell, with usual values if they lie in it, otherwise with round ones."""
        path = self.path

        def number(axis: str, usual: float) -> float:
            low, high = path.ranges.get(axis, (usual, usual))
            return usual if low <= usual <= high else _round_within(low, high)

        order = path.picks.get(_order_of(self.ego), self.peers)
        places = _places(self.ego, order)
        descriptors = {}
        for i in self.heard:
            region = path.picks.get(f"region of drone {i}", False)
            names = [f"region {part} of drone {i}" for part in ("x_m", "y_m", "radius_m")]
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
                    number(f"goodput of drone {i} to slot {slot}", 100.0) for slot in range(self.drones - 1)
                ),
                coverage_grid=bytes(COVERAGE_BYTES),
                novelty_flags=sum(path.picks.get(_flag(bit, i), 0) for bit in range(_FLAGS)),
                task_phase=path.picks.get(f"task_phase of drone {i}", TaskPhase.SEARCH),
                region=Disc(number(names[0], 0.0), number(names[1], 0.0), number(names[2], 32.0)) if region else None,
                priority_target_ids=tuple(range(int(targets))),
                feature_space="" if path.picks.get(_space_of(i), True) else "other",
            )
        return FleetView(self.ego, self.period_s, descriptors, self._example_ages())

    def _example_ages(self) -> dict[int, float]:
        ages = {}
        for i in self.heard:
            low, high = self.path.ranges.get(f"age_s of drone {i}", (0.0, 0.0))
            # If ages were raised, this is the lowest age of the cell, from which they were raised.
            ages[i] = low if self._older or low == 0.0 else _round_within(low, high)
        return ages

    def raised_example(self) -> dict[int, float] | None:
        """The raised ages of the example; None if the property raised none."""
        if not self._older:
            return None
        from_s = self._example_ages()
        raised = {}
        for i in self.heard:
            low, high = self.path.ranges[f"raised age_s of drone {i}"]
            raised[i] = from_s[i] if low <= from_s[i] <= high else _round_within(low, high)
        return raised


class DescriptorOfRanges:
    """A descriptor with ranges as fields. Fields without order fork the run; fields that cannot be searched raise `Refused`."""

    def __init__(self, system: FleetOfRanges, agent_id: int) -> None:
        self._system = system
        self.agent_id = agent_id

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
        path, me, high = self._system.path, self.agent_id, _SEARCHED_UP_TO["goodput"]
        slots = range(self._system.drones - 1)
        return tuple(path.number(f"goodput of drone {me} to slot {slot}", 0.0, high) for slot in slots)

    def link_state(self, peer: int) -> LinkState:
        return Descriptor.link_state(self, peer)  # type: ignore[arg-type]

    def goodput_to(self, peer: int) -> Any:
        # a drone off a roster reads 0, which is in the range too
        return goodput_in(self.peer_goodput_mbps, self.agent_id, None, peer)

    @property
    def task_phase(self) -> TaskPhase:
        return self._system.path.pick(f"task_phase of drone {self.agent_id}", tuple(TaskPhase))

    @property
    def feature_space(self) -> Any:
        return _Space(self._system, self.agent_id)

    @property
    def novelty_flags(self) -> Any:
        return _Flags(self._system.path, self.agent_id)

    @property
    def region(self) -> Disc | None:
        if not self._system.path.pick(f"region of drone {self.agent_id}", (False, True)):
            return None
        return Disc(
            self._number("region x_m", -1e5, 1e5),
            self._number("region y_m", -1e5, 1e5),
            self._number("region radius_m", 0.001, 1e5),
        )

    @property
    def priority_target_ids(self) -> Any:
        return _TargetIds(self._number("targets", 0, 16), self._system.path)

    @property
    def position_m(self) -> tuple[float, float, float]:
        receiver = self._only_for_order("position_m")
        peers = tuple(i for i in self._system.heard if i != receiver)
        order = self._system.path.pick(_order_of(receiver), _orders(peers))
        return _places(receiver, order)[self.agent_id]

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
        self._system.path.refuse(f"reads {field} without peers_by_overlap")

    def __getattr__(self, name: str) -> NoReturn:
        self._system.path.refuse(f"reads {name}, which cannot be searched")

    def __eq__(self, other: object) -> bool:
        return self is other or self.__getattr__("whole descriptors")

    __hash__ = None  # type: ignore[assignment]

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return Descriptor  # so that `isinstance` gives the same result as in flight


class _Flags:
    """A byte of flags. A mask forks the run for the bits that it reads; any other use forks it for all bits."""

    def __init__(self, path: Path, agent_id: int) -> None:
        self._path, self._id = path, agent_id

    def _bits(self, mask: int) -> int:
        read = [bit for bit in range(_FLAGS) if mask >> bit & 1]
        return sum(self._path.pick(_flag(bit, self._id), (0, 1 << bit)) for bit in read)

    def __and__(self, mask: object) -> Any:
        return self._bits(mask) if isinstance(mask, int) else NotImplemented

    __rand__ = __and__

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bits(-1), name)

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return int


def _by_value(name: str) -> Callable[..., Any]:
    def operator(*operands: Any) -> Any:
        return getattr(int, name)(*(x._bits(-1) if type(x) is _Flags else x for x in operands))

    return operator


_OWN_METHODS = {*vars(_Flags), "__new__", "__getattribute__", "__init_subclass__", "__subclasshook__"}
for _method in {n for n, of in vars(int).items() if n.startswith("__") and callable(of)} - _OWN_METHODS:
    setattr(_Flags, _method, _by_value(_method))  # where Python looks for operators


def _order_of(receiver: int) -> str:
    return f"peers of drone {receiver} by overlap"


def _flag(bit: int, agent_id: int) -> str:
    return f"novelty flag {bit} of drone {agent_id}"


class _TargetIds:
    """Target ids with a known range of their number. The ids themselves are not known."""

    def __init__(self, count: Any, path: Path) -> None:
        self._count, self._path = count, path

    def __bool__(self) -> bool:
        return bool(self._count > 0)

    def __len__(self) -> int:
        for n in range(16):
            if self._count <= n:
                return n
        return 16

    def _cannot(self, *_: object) -> NoReturn:
        self._path.refuse("reads the ids of targets")

    __iter__ = __contains__ = __getitem__ = __eq__ = __hash__ = __getattr__ = _cannot

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return tuple


class _Space:
    """A drone's feature space, known only by whether it is the ego's."""

    def __init__(self, system: FleetOfRanges, agent_id: int) -> None:
        self._system, self._id = system, agent_id

    def __eq__(self, other: object) -> bool:
        path, ego = self._system.path, self._system.ego
        if not isinstance(other, _Space) or ego not in (self._id, other._id):
            path.refuse("compares feature_space with anything but the ego's")
        peer = other._id if self._id == ego else self._id
        return peer == ego or path.pick(_space_of(peer), (True, False))

    def _cannot(self, *_: object) -> NoReturn:
        self._system.path.refuse("reads the name of a feature_space")

    __bool__ = __iter__ = __len__ = __contains__ = __getitem__ = __hash__ = __lt__ = __str__ = __format__ = (
        __getattr__
    ) = _cannot


def _space_of(peer: int) -> str:
    return f"drone {peer} has the ego's feature_space"


def _orders(peers: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    return tuple(itertools.permutations(peers))


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


def _round_within(low: float, high: float) -> float:
    """A number of [low, high] with few digits."""
    middle = low / 2 + high / 2
    for digits in range(17):
        candidate = round(middle, digits)
        if low <= candidate <= high:
            return candidate
    return low
