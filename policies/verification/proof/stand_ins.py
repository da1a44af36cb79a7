"""What stands for the parts of a view in a search: they answer as real objects do, fork the run, or refuse.

What they have no method for raises an error that real objects do not raise. Nothing is proved then, because each cell is
replayed on real objects (`search.Run.compare`).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any, NoReturn

from sortie.policies.verification.proof.symbols import Path

FLAGS = 8
"""The bits of a descriptor's novelty flags; the plane uses three of them."""
ORDER_IN_VIEW = "order of drones in the view"


class InAnyOrder(dict[int, Any]):
    """A mapping by drone, in any order: the run forks where a user's policy may see the order.

    Sortie's own code does not depend on the order, which the kit tests, so it does not fork the run.
    """

    def __init__(self, system: Any, content: Mapping[int, Any]) -> None:
        super().__init__(content)
        self._system = system

    def _arranged(self) -> dict[int, Any]:
        ids = sorted(dict.keys(self))
        if len(ids) > 1 and self._system.shows_order:
            ids = [i for i in self._system.path.pick(ORDER_IN_VIEW, orders(self._system.heard)) if i in ids]
        return {i: dict.__getitem__(self, i) for i in ids}

    def __iter__(self) -> Any:
        return iter(self._arranged())

    def __reversed__(self) -> Any:
        return reversed(self._arranged())

    def keys(self) -> Any:
        return self._arranged().keys()

    def values(self) -> Any:
        return self._arranged().values()

    def items(self) -> Any:
        return self._arranged().items()

    def copy(self) -> Any:
        return self._arranged()

    def _whole(self, *_: object) -> NoReturn:
        path: Path = self._system.path
        path.refuse("joins or writes out a whole mapping of drones")

    __or__ = __ror__ = __repr__ = _whole


class Flags:
    """A byte of flags. A mask forks the run for the bits that it reads; a comparison forks it for all bits."""

    def __init__(self, path: Path, agent_id: int) -> None:
        self._path, self._id = path, agent_id

    def _bits(self, mask: int) -> int:
        read = [bit for bit in range(FLAGS) if mask >> bit & 1]
        return sum(self._path.pick(flag_axis(bit, self._id), (0, 1 << bit)) for bit in read)

    def __and__(self, mask: Any) -> Any:
        return self._bits(int(mask))

    __rand__ = __and__

    def __int__(self) -> int:
        return self._bits(-1)

    __index__ = __hash__ = __int__

    def __bool__(self) -> bool:
        return int(self) != 0

    def __eq__(self, other: object) -> bool:
        return int(self) == (int(other) if isinstance(other, Flags) else other)

    def __lt__(self, other: Any) -> bool:
        return bool(int(self) < other)

    def __le__(self, other: Any) -> bool:
        return bool(int(self) <= other)

    def __gt__(self, other: Any) -> bool:
        return bool(int(self) > other)

    def __ge__(self, other: Any) -> bool:
        return bool(int(self) >= other)


def flag_axis(bit: int, agent_id: int) -> str:
    return f"novelty flag {bit} of drone {agent_id}"


class TargetIds:
    """Target ids with a known range of their number. The ids themselves are not known."""

    def __init__(self, count: Any, path: Path) -> None:
        self._count, self._path = count, path

    def __bool__(self) -> bool:
        return bool(self._count > 0)

    def __len__(self) -> int:
        return next((n for n in range(16) if self._count <= n), 16)

    def _cannot(self, *_: object) -> NoReturn:
        self._path.refuse("reads the ids of targets")

    __eq__ = __iter__ = __getitem__ = __contains__ = _cannot


class Space:
    """A drone's feature space or codebook, known only by whether it is the ego's."""

    def __init__(self, system: Any, agent_id: int, field: str = "feature_space") -> None:
        self._system, self._id, self._field = system, agent_id, field

    def __eq__(self, other: object) -> bool:
        path: Path = self._system.path
        ego: int = self._system.ego
        if not isinstance(other, Space) or ego not in (self._id, other._id) or self._field != other._field:
            path.refuse(f"compares {self._field} with anything but the ego's")
        peer = other._id if self._id == ego else self._id
        return peer == ego or path.pick(space_of(peer, self._field), (True, False))

    def _cannot(self) -> NoReturn:
        path: Path = self._system.path
        path.refuse(f"reads the name of a {self._field}")

    __hash__ = __bool__ = _cannot


def space_of(peer: int, field: str = "feature_space") -> str:
    return f"drone {peer} has the ego's {field}"


def orders(peers: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    return tuple(itertools.permutations(peers))
