"""Numbers that represent a whole range of inputs, and the search over all paths of a policy through its comparisons.

A `Ranged` number can be compared with constants. If the result is the same for its whole range, it returns the result.
Otherwise the run takes one side and narrows the range to it, and the search visits the other side later. The policy's
own comparisons thus give its decision boundaries. Every run represents a cell of views on which the policy decides the
same. The search is complete when no side is left.

A range cannot answer everything exactly: a comparison of two axes or a square root raises `Refused`. Arithmetic with
constants is stored as steps. Every step is monotone, rounding included, and stays finite. So a bisection over the floats
finds the last float below a boundary.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Any, NoReturn, TypeVar

from sortie.policies.checks import StandIn

T = TypeVar("T")


class Refused(BaseException):
    """The search cannot follow the policy; the message says why. No check with `except Exception` catches it."""


class Combined(Refused):
    """Two inputs are compared or combined, which an interval of one input cannot follow; the solver may (`solver`)."""


class Path:
    """One run: the side that it took at every fork, and the remaining range of each axis."""

    def __init__(self, script: Sequence[int]) -> None:
        self.ranges: dict[str, tuple[float, float]] = {}
        self.picks: dict[str, Any] = {}
        self.exact = True
        """Whether every number was followed as the floats that it can be, not over the reals."""
        self.questions = 0
        """How often the solver was asked."""
        self.taken: list[tuple[int, int]] = []
        self._script = script

    def choose(self, options: int) -> int:
        """The side that this run takes at a fork: by the script, after its end always the first."""
        k = len(self.taken)
        choice = self._script[k] if k < len(self._script) else 0
        if choice >= options:
            self.refuse("decides differently on the same view")
        self.taken.append((choice, options))
        return choice

    def pick(self, label: str, options: Sequence[T]) -> T:
        """One of a few values of an axis without order; always the same one within a run."""
        if label not in self.picks:
            self.picks[label] = options[self.choose(len(options))]
        found: T = self.picks[label]
        return found

    def number(self, axis: str, low: float, high: float) -> Ranged:
        """The number of an axis with the floats of [low, high] as its values, or with the ints if both bounds are ints."""
        self.ranges.setdefault(axis, (low, high))
        return Ranged(self, axis)

    def bounds(self, axis: str, usual: float) -> tuple[float, float]:
        """The range that is left of an axis; `usual` alone where the run never read it."""
        return self.ranges.get(axis, (usual, usual))

    def corner(self, system: Any, choose: Callable[[str, float, float], float]) -> Any:
        """A plain view of the cell, each number chosen between its bounds; None if there is none."""
        return system.example(choose)

    def raised(self, axis: str, name: str, high: float) -> Any:
        """A second number of an axis that is not below the first.

        Within a cell the policy decides the same, so the lowest value stands for the cell, and every value above it is a
        raise of it.
        """
        return self.number(name, self.ranges[axis][0], high)

    def within(self, act: Callable[[], T]) -> Iterator[T]:
        """Every result of a function whose comparisons divide this run's cell further; afterwards the run is as before."""
        before = self._save()
        script: list[int] = []
        try:
            while True:
                self._restore(before)
                self.taken, self._script = [], script
                yield act()
                script = _next_script(self.taken)
                if not script:
                    return
        finally:
            self._restore(before)

    def _save(self) -> tuple[Any, ...]:
        return dict(self.ranges), dict(self.picks), self.taken, self._script

    def _restore(self, saved: tuple[Any, ...]) -> None:
        ranges, picks, self.taken, self._script = saved
        self.ranges, self.picks = dict(ranges), dict(picks)

    def refuse(self, why: str) -> NoReturn:
        """End the search, because the policy cannot be followed."""
        raise Refused(why)


def explore(run: Callable[[Path], T], make: Callable[[Sequence[int]], Path] = Path) -> Iterator[tuple[Path, T]]:
    """Every run of a deterministic function of one path, depth first, each with its result.

    Args:
        run: the function.
        make: makes a path from the sides that it is to take.

    Raises:
        Refused: the function cannot be followed.
    """
    script: list[int] = []
    while True:
        path = make(script)
        result = run(path)
        if len(path.taken) < len(script):
            raise Refused("decides differently on the same view")
        yield path, result
        script = _next_script(path.taken)
        if not script:
            return


def _next_script(taken: Sequence[tuple[int, int]]) -> list[int]:
    """The sides of the next run, depth first; empty where none is left."""
    left = list(taken)
    while left and left[-1][0] + 1 == left[-1][1]:
        left.pop()
    script = [choice for choice, _ in left]
    if script:
        script[-1] += 1
    return script


class Ranged(StandIn):
    """A number with a known range: an axis, and the arithmetic steps applied to it."""

    __slots__ = ("_axis", "_path", "_steps")

    def __init__(self, path: Path, axis: str, steps: tuple[tuple[str, float], ...] = ()) -> None:
        self._path, self._axis, self._steps = path, axis, steps

    # --- comparing ---------------------------------------------------------------------------

    def _at(self, x: float) -> float:
        for step, c in self._steps:
            x = _STEPS[step](x, c)
        return x

    def _below(self, c: float, or_at: bool) -> bool:
        """Whether the number is < c (≤ c if `or_at`). If both are possible, the run takes a side."""
        path = self._path

        def holds(x: float) -> bool:
            return self._at(x) <= c if or_at else self._at(x) < c

        low, high = path.ranges[self._axis]
        at_low, at_high = holds(low), holds(high)
        if at_low == at_high:
            return at_low
        whole = isinstance(low, int) and isinstance(high, int)
        a, b = (int(low), int(high)) if whole else (_ordinal(low), _ordinal(high))
        if not self._steps and not whole and -_EXACT <= c <= _EXACT:  # the boundary is the constant itself
            a = _ordinal(float(c) if or_at else math.nextafter(c, -math.inf))
            b = a + 1
        while b - a > 1:
            middle = (a + b) // 2
            if holds(middle if whole else _float(middle)) == at_low:
                a = middle
            else:
                b = middle
        last_low, first_high = (a, b) if whole else (_float(a), _float(b))
        if path.choose(2) == 0:
            path.ranges[self._axis] = (low, last_low)
            return at_low
        path.ranges[self._axis] = (first_high, high)
        return at_high

    def _constant(self, other: object) -> float | None:
        """The other operand as a plain number; None if it is not a number."""
        if type(other) is float or type(other) is int:  # mostly
            return other
        if isinstance(other, Ranged):
            low, high = other._path.ranges[other._axis]
            if low == high:
                return other._at(low)
            raise Combined(f"combines {self._axis} and {other._axis}")
        if isinstance(other, IntEnum):
            return int(other)
        return other if isinstance(other, (float, int)) else None

    def _compare(self, other: object, if_same: bool, answer: Callable[[float], bool]) -> bool:
        if isinstance(other, Ranged) and other._axis == self._axis and repr(other._steps) == repr(self._steps):
            return if_same  # equal steps may round otherwise, such as those with 10**16 and 1e16
        c = self._constant(other)
        return NotImplemented if c is None else c == c and answer(c)

    def __lt__(self, other: object) -> bool:
        return self._compare(other, False, lambda c: self._below(c, False))

    def __le__(self, other: object) -> bool:
        return self._compare(other, True, lambda c: self._below(c, True))

    def __gt__(self, other: object) -> bool:
        return self._compare(other, False, lambda c: not self._below(c, True))

    def __ge__(self, other: object) -> bool:
        return self._compare(other, True, lambda c: not self._below(c, False))

    def __eq__(self, other: object) -> bool:
        return self._compare(other, True, lambda c: not self._below(c, False) and self._below(c, True))

    def __bool__(self) -> bool:
        return self != 0

    # --- arithmetic with constants -----------------------------------------------------------

    def _step(self, step: str, other: object) -> Any:
        c = self._constant(other)
        return NotImplemented if c is None else self._then(step, c)

    def _then(self, step: str, c: float = 0.0) -> Ranged:
        """The number after one more step, which must be monotone and stay finite."""
        found = Ranged(self._path, self._axis, (*self._steps, (step, c)))
        try:
            ends = [abs(found._at(x)) for x in self._path.ranges[self._axis]]
            sound = all(map(math.isfinite, ends)) and (step != "whole times" or max(ends) < _WHOLE)
        except (ArithmeticError, ValueError):
            sound = False
        if not sound:
            self._path.refuse(f"computes with {self._axis} beyond what a float can hold")
        return found

    def __add__(self, other: object) -> Any:
        return self._step("plus", other)

    __radd__ = __add__

    def __sub__(self, other: object) -> Any:
        return self._step("minus", other)

    def __rsub__(self, other: object) -> Any:
        return self._step("from", other)

    def __mul__(self, other: object) -> Any:
        return self._step("times", other)

    __rmul__ = __mul__

    def __truediv__(self, other: object) -> Any:
        if other == 0:
            return 1.0 / 0  # the error of a plain number
        return self._step("over", other)

    def __floordiv__(self, other: object) -> Any:
        if other == 0:
            return 1.0 // 0
        return self._step("whole times", other)

    def __neg__(self) -> Any:
        return self._step("times", -1)  # keeps whole numbers whole

    def __pos__(self) -> Ranged:
        return self

    def __abs__(self) -> Any:
        return self if self >= 0 else -self

    def __int__(self) -> int:
        """The whole part. The run forks for each, if they are few."""
        whole = self._then("int")
        low, high = sorted(int(whole._at(x)) for x in self._path.ranges[self._axis])
        if high - low > _MOST_WHOLE:
            self._cannot()
        return next((n for n in range(low, high) if whole <= n), high)

    def __floor__(self) -> Any:
        return self._then("floor")

    def __ceil__(self) -> Any:
        return self._then("ceil")

    def __trunc__(self) -> Any:
        return self._then("int")

    def __round__(self, digits: int | None = None) -> Any:
        return self._then("round") if digits is None else self._cannot()

    # --- what it cannot do -------------------------------------------------------------------

    def _cannot(self, *_: object) -> NoReturn:
        self._path.refuse(f"uses {self._axis} for more than arithmetic with constants and comparisons")

    __float__ = __index__ = __hash__ = __pow__ = __rpow__ = __mod__ = __rmod__ = __divmod__ = _cannot
    __rfloordiv__ = __rtruediv__ = _cannot

    def _value_in(self, values: Mapping[str, float]) -> float:
        """The number's value where `values` gives the value of its axis."""
        return self._at(values[self._axis])

    def __format__(self, spec: str) -> str:
        """A text at least as long as the number's; `allowed` sees to it that it is used for nothing but a reason."""
        return format(self._at(self._path.ranges[self._axis][0]), spec).rjust(LONGEST_TEXT)

    def __repr__(self) -> str:
        return format(self, "")


LONGEST_TEXT = 24
_MOST_WHOLE = 200
"""Into so many whole parts a run forks."""
_WHOLE = 2.0**40
"""Up to here Python's `//` of floats is monotone: it rounds a quotient before it takes its whole part."""
_EXACT = 2.0**53
"""Up to here every whole number is a float."""

_STEPS: dict[str, Callable[[float, float], float]] = {
    "plus": lambda x, c: x + c,
    "minus": lambda x, c: x - c,
    "from": lambda x, c: c - x,
    "times": lambda x, c: x * c,
    "over": lambda x, c: x / c,
    "whole times": lambda x, c: x // c,
    "int": lambda x, _: int(x),
    "floor": lambda x, _: math.floor(x),
    "ceil": lambda x, _: math.ceil(x),
    "round": lambda x, _: round(x),
}


def _ordinal(x: float) -> int:
    """The position of a float in the order of all floats."""
    bits: int = struct.unpack("<q", struct.pack("<d", x))[0]
    return bits if bits >= 0 else -(bits & 0x7FFF_FFFF_FFFF_FFFF)


def _float(ordinal: int) -> float:
    found: float = struct.unpack("<d", struct.pack("<q", abs(ordinal)))[0]
    return found if ordinal >= 0 else -found
