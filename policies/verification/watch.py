"""What stops a decision of an instrumented policy, and the sets and foreign objects that are watched meanwhile."""

from __future__ import annotations

import collections
import functools
import itertools
import types
from collections.abc import Callable
from typing import Any, NoReturn

from sortie.policies.verification.confine import Reached
from sortie.policies.verification.kept import fingerprint
from sortie.policies.verification.symbols import Path, Refused


class Watch:
    """What one decision of an instrumented policy did that it may not do, or that cannot be searched."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Forget the policy before."""
        self.stopped: Reached | Refused | None = None
        self.is_loading = False
        self.path: Path | None = None
        """The run that the decision belongs to."""
        self._others: dict[str, tuple[Any, Any]] = {}

    def stop(self, why: Reached | Refused) -> NoReturn:
        self.stopped = self.stopped or why
        raise why

    def sees(self, name: str, value: Any) -> None:
        """Keep how an object of another module is now: it outlasts the decision."""
        if name not in self._others:
            try:
                self._others[name] = value, fingerprint(value)
            except Refused as refused:
                self.stop(refused)

    def changed(self) -> str:
        """Which object of another module is no longer as it was, in words; empty if none."""
        return next((f"changes {n}" for n, (value, was) in self._others.items() if fingerprint(value) != was), "")


WATCH = Watch()
"""Of the decision that runs now; a process verifies one policy at a time."""


def stop(why: str) -> NoReturn:
    """The search cannot follow this."""
    WATCH.stop(Refused(why))


def reach(what: str) -> NoReturn:
    """The policy uses this, which is not in its view."""
    WATCH.stop(Reached(what))


# --- sets: hashes decide their order, and those of texts differ from process to process ---------------


def _see_order(members: list[Any]) -> list[Any]:
    if len(members) > 1:
        reach("the order of a set, which hashes decide")
    return members


def _through(watched: set[Any], members: list[Any]) -> Any:
    """The members one after another, as long as the set stays as it is."""
    for k in range(len(members) + 1):
        if set.__len__(watched) != len(members):
            raise RuntimeError("Set changed size during iteration")
        if not all(set.__contains__(watched, member) for member in members):
            stop("changes a set while it goes through it")
        if k < len(members):
            yield members[k]


class Unordered(set[Any]):
    """A set that stops the run as soon as someone sees its order, be it compiled code."""

    def __iter__(self) -> Any:
        return _through(self, _see_order(list(set.__iter__(self))))

    def pop(self) -> Any:
        _see_order(list(set.__iter__(self)))
        return set.pop(self)

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return set


class UnorderedFrozen(frozenset[Any]):
    """The same of a frozen set."""

    def __iter__(self) -> Any:
        return iter(_see_order(list(frozenset.__iter__(self))))

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return frozenset


WATCHED = (Unordered, UnorderedFrozen)


def unordered(value: Any) -> Any:
    """A plain set as one that watches its order; anything else as it is."""
    return Unordered(value) if type(value) is set else UnorderedFrozen(value) if type(value) is frozenset else value


def plain_set(value: Any) -> Any:
    """A watched set as the plain one, as an operand: mappings' keys treat no other alike."""
    if type(value) is Unordered:
        return set.union(set(), value)
    return frozenset.union(frozenset(), value) if type(value) is UnorderedFrozen else value


def _watched(method: Callable[..., Any]) -> Callable[..., Any]:
    def act(*operands: Any) -> Any:
        return unordered(method(*operands))

    return act


_MAKE_SETS = (
    "__and__ __or__ __sub__ __xor__ __rand__ __ror__ __rsub__ __rxor__ union intersection difference "
    "symmetric_difference copy"
)
for _name in _MAKE_SETS.split():
    setattr(Unordered, _name, _watched(getattr(set, _name)))
    setattr(UnorderedFrozen, _name, _watched(getattr(frozenset, _name)))
_BLIND = (sorted, min, max, any, all, sum)
_COMPARABLE = ({str}, {bytes}, {int, float, bool})


_CALLS_AT: dict[Any, int] = {
    map: 0, filter: 0, functools.reduce: 0, functools.partial: 0, collections.defaultdict: 0, itertools.starmap: 0,
    itertools.takewhile: 0, itertools.dropwhile: 0, itertools.filterfalse: 0, itertools.accumulate: 1, itertools.groupby: 1,
}  # fmt: skip
"""Which argument compiled code calls."""
_CALLED = {"key", "func", "default_factory"}


def ordered_for(
    function: Any, args: tuple[Any, ...], kwargs: dict[str, Any], text: Any = str
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Arguments of a call, with plain sets for functions that sort them, and watched ones to be made by others.

    `text` is what others call in place of `str`.
    """
    # Equal keys would show the order, and so do several sets, or a default that is one.
    is_blind = any(function is f for f in _BLIND) and len(args) == 1 and not kwargs.keys() - {"reverse"}
    called_at = _CALLS_AT.get(function) if isinstance(function, type | types.BuiltinFunctionType) else None

    def one(value: Any, is_called: bool) -> Any:
        if (value is set or value is frozenset or value is str) and function is not isinstance:
            if not is_called:
                stop(f"hands on {value.__name__}")
            return Unordered if value is set else UnorderedFrozen if value is frozenset else text
        if is_blind and type(value) in WATCHED:
            members = list((set if type(value) is Unordered else frozenset).__iter__(value))
            comparable = ({int, bool},) if function is sum else _COMPARABLE  # sums of floats depend on the order
            alike = any({type(x) for x in members} <= kinds for kinds in comparable)
            return members if alike and all(x == x for x in members) else value  # NaN leaves the order as it was
        return value

    listed = tuple([one(value, k == called_at) for k, value in enumerate(args)])
    return listed, {name: one(value, name in _CALLED) for name, value in kwargs.items()}
