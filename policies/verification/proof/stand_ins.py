"""What stands for the parts of a view in a search: they answer as real objects do, fork the run, or refuse."""

from __future__ import annotations

import itertools
import operator
import sys
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

from sortie.policies.contract import plain_copy
from sortie.policies.verification.proof.symbols import Path

FLAGS = 8
"""The bits of a descriptor's novelty flags; the plane uses three of them."""


class Unsearchable:
    """What stands in a descriptor's tuple. Code in C that reads the tuple directly meets it, and every use refuses."""

    __slots__ = ("drone", "name", "system")

    def __init__(self, system: Any, drone: int, name: str) -> None:
        self.system, self.drone, self.name = system, drone, name

    def _reached(self, *_: object, **__: object) -> NoReturn:
        path: Path = self.system.path
        path.refuse(f"reads {self.name} in a way that cannot be searched")


class InAnyOrder(dict[int, Any]):
    """A mapping by drone, in any order: the run forks as soon as someone sees the order.

    Sortie's own code does not depend on the order, which the kit tests, so it does not fork the run.
    """

    def __init__(self, path: Path, content: Mapping[int, Any], heard: tuple[int, ...]) -> None:
        super().__init__(content)
        self._path, self._heard = path, heard

    def _arranged(self) -> dict[int, Any]:
        ids = tuple(sorted(dict.keys(self)))
        if len(ids) > 1 and not is_blind(sys._getframe(2)):
            ids = tuple(i for i in self._path.pick(ORDER_IN_VIEW, orders(self._heard)) if i in ids)
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
        return self._arranged().copy()

    def _whole(self, *_: object) -> NoReturn:
        self._path.refuse("compares or writes out a whole mapping of drones")

    __eq__ = __ne__ = __or__ = __ror__ = __repr__ = __hash__ = _whole  # type: ignore[assignment]
    __reduce__ = __reduce_ex__ = __copy__ = __deepcopy__ = _whole

    def _changes(self, *_: object, **__: object) -> NoReturn:
        self._path.refuse("changes a mapping of drones in place of a copy")

    __setitem__ = __delitem__ = __ior__ = pop = popitem = clear = update = setdefault = _changes

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return dict


def is_blind(frame: Any) -> bool:
    """Whether the code that iterates is Sortie's own. A copy has the order of its original, which whoever gets it can see."""
    home = str(frame.f_globals.get("__name__", ""))
    return home.startswith("sortie.") and frame.f_code is not plain_copy.__code__


class Flags:
    """A byte of flags. A mask forks the run for the bits that it reads; any other use forks it for all bits."""

    def __init__(self, path: Path, agent_id: int) -> None:
        self._path, self._id = path, agent_id

    def _bits(self, mask: int) -> int:
        read = [bit for bit in range(FLAGS) if mask >> bit & 1]
        return sum(self._path.pick(flag_axis(bit, self._id), (0, 1 << bit)) for bit in read)

    def __and__(self, mask: object) -> Any:
        return self._bits(mask) if type(mask) is int else self._bits(-1) & mask  # type: ignore[operator]

    def __rand__(self, mask: object) -> Any:
        return self._bits(mask) if type(mask) is int else mask & self._bits(-1)  # type: ignore[operator]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bits(-1), name)

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return int


def _by_value(name: str) -> Callable[..., Any]:
    """A method of `int` on the plain number. An operator gives the other operand its say, as Python does."""
    plain_name = f"__{name[3:]}" if name[:3] == "__r" and hasattr(int, f"__{name[3:]}") else name
    operates = divmod if plain_name == "__divmod__" else vars(operator).get(plain_name)

    def act(*operands: Any) -> Any:
        plain = [x._bits(-1) if type(x) is Flags else x for x in operands]
        if len(plain) != 2 or operates is None:
            return getattr(int, name)(*plain)
        return operates(*plain) if plain_name == name else operates(*reversed(plain))

    return act


_OWN_METHODS = {*vars(Flags), "__new__", "__getattribute__", "__init_subclass__", "__subclasshook__"}
for _method in {n for n, of in vars(int).items() if n.startswith("__") and callable(of)} - _OWN_METHODS:
    setattr(Flags, _method, _by_value(_method))  # where Python looks for operators


ORDER_IN_VIEW = "order of drones in the view"


def flag_axis(bit: int, agent_id: int) -> str:
    return f"novelty flag {bit} of drone {agent_id}"


class TargetIds:
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

    def _cannot(self, *_: object, **__: object) -> NoReturn:
        self._path.refuse("reads the ids of targets")

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return tuple


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

    def __ne__(self, other: object) -> bool:
        return not self.__eq__(other)

    def _cannot(self, *_: object, **__: object) -> NoReturn:
        path: Path = self._system.path
        path.refuse(f"reads the name of a {self._field}")

    __hash__ = _cannot

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return str


_OPERATORS = (
    "getitem setitem delitem iter reversed len bool eq ne lt le gt ge add radd sub rsub mul rmul mod rmod truediv "
    "rtruediv floordiv pow neg abs float int index round hash str repr format contains and or xor reduce reduce_ex copy "
    "deepcopy sizeof dir bytes getattr"
)
for _kind, _refusal in (
    (Unsearchable, Unsearchable._reached),
    (TargetIds, TargetIds._cannot),
    (Space, Space._cannot),
):
    for _operator in _OPERATORS.split():
        if f"__{_operator}__" not in vars(_kind):
            setattr(_kind, f"__{_operator}__", _refusal)


def space_of(peer: int, field: str = "feature_space") -> str:
    return f"drone {peer} has the ego's {field}"


def orders(peers: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    return tuple(itertools.permutations(peers))
