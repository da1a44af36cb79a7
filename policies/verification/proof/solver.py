"""Numbers that an SMT solver follows, for policies that combine inputs: sums, products, the best of several.

A `Solved` number has a term of z3 over the inputs of its path. A comparison asks the solver which results are possible.
If both are, the run forks, as with ranges. Sums and products are followed over the reals, without the rounding of floats:
a search with them is not exact. Comparisons of plain inputs are. Every number also keeps how the policy computes it, so that
an example of the run can be computed in floats. z3 is an optional dependency, the extra `verify`.
"""

from __future__ import annotations

import importlib
import math
import operator
import random
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from sortie.policies.verification.proof.symbols import LONGEST_TEXT, MARK, Path, Ranged, Refused

STEP = 3_000_000
"""The most steps of the solver, as it counts them (`rlimit`), for one question."""
_EXAMPLES = 60
"""How many examples of a run are tried before none is found that floats do not round out of it."""
_LEAST_MARGIN = 1e-13
"""Numbers that are closer in all examples cannot be kept apart."""


_Compared = tuple[Callable[[Any, Any], Any], Any, Any, bool]
"""A comparison: of which kind, of which numbers, with which result."""


def solver_paths(why: str = "combines inputs") -> Callable[[Sequence[int]], Path]:
    """What makes paths that a solver follows.

    Args:
        why: what needs the solver, for the error.

    Raises:
        Refused: z3 is not installed.
    """
    try:
        z3 = importlib.import_module("z3")
    except ImportError:
        raise Refused(f"{why}, and z3 is not installed (pip install sortie-sim[verify])") from None
    solver = z3.Solver()
    solver.set("rlimit", STEP)
    return lambda script: SolvedPath(script, z3, solver)


class SolvedPath(Path):
    """A run whose numbers a solver follows."""

    def __init__(self, script: Sequence[int], z3: Any, solver: Any) -> None:
        super().__init__(script)
        self.z3, self._solver = z3, solver
        solver.reset()
        solver.set("rlimit", STEP)
        self.facts: list[Any] = []
        self._terms: dict[str, Any] = {}
        self._model: Any = None
        """Values that satisfy all facts so far, which answer one side of most questions."""
        self._computed: list[tuple[Callable[..., Any], Sequence[Any]]] = []
        """Of each number that is no plain input: how the policy computes it, and from what."""
        self._compared: list[_Compared] = []
        """The comparisons of the run."""

    def number(self, axis: str, low: float, high: float) -> Any:
        """The number of an axis within its bounds."""
        return Solved(self, axis, self._term(axis, low, high), max(abs(low), abs(high)))

    def _term(self, axis: str, low: float, high: float) -> Any:
        if axis not in self._terms or axis not in self.ranges:
            whole = isinstance(low, int) and isinstance(high, int)
            self._terms[axis] = term = (self.z3.Int if whole else self.z3.Real)(axis)
            self.ranges[axis] = (low, high)
            self._add(self.z3.And(term >= self.constant(low), term <= self.constant(high)))
        return self._terms[axis]

    def constant(self, x: float) -> Any:
        """A plain number as a term, exactly."""
        if isinstance(x, int):
            return self.z3.RealVal(int(x))  # of True it would read the text
        top, bottom = x.as_integer_ratio()
        return self.z3.RealVal(f"{top}/{bottom}")

    def _add(self, fact: Any) -> None:
        self.facts.append(fact)
        self._solver.add(fact)
        self._model = None

    def _possible(self, fact: Any) -> bool:
        if self._model is not None and self.z3.is_true(self._model.eval(fact, model_completion=True)):
            return True
        self._solver.push()
        self._solver.add(fact)
        answer = self._solver.check()
        model = self._solver.model() if answer == self.z3.sat else None
        self._solver.pop()
        if answer == self.z3.unknown:
            self.refuse("combines inputs in a way that the solver does not decide")
        if model is not None:
            self._model = model
        return model is not None

    def compares(self, make: Callable[[Any, Any], Any], one: Solved, other: Any, term: Any) -> bool:
        """The result of a comparison with another number, of which `term` is the term."""
        found = self._holds(make(one._term, term))
        self._compared.append((make, one, other, found))
        return found

    def computes(self, act: Callable[..., Any], given: Sequence[Any]) -> int:
        """Keep how a number is computed, and return its place among such numbers."""
        self._computed.append((act, given))
        return len(self._computed) - 1

    def _holds(self, fact: Any) -> bool:
        """Whether a fact holds. If both are possible, the run takes a side."""
        not_so = self.z3.Not(fact)
        if not self._possible(fact):
            return False
        if not self._possible(not_so):
            return True
        holds = self.choose(2) == 0
        self._add(fact if holds else not_so)
        return holds

    def raised(self, axis: str, name: str, high: float) -> Any:
        """A second number of an axis that is not below the first."""
        first = self._terms[axis]
        second = self.number(name, 0.0, high)
        self._add(second._term >= first)
        return second

    def _save(self) -> tuple[Any, ...]:
        return *super()._save(), list(self.facts)

    def _restore(self, saved: tuple[Any, ...]) -> None:
        *rest, facts = saved
        super()._restore(tuple(rest))
        self.facts = list(facts)
        self._solver.reset()
        self._solver.set("rlimit", STEP)
        self._solver.add(*facts)
        self._model = None

    def bounds(self, axis: str, usual: float) -> tuple[float, float]:
        """The value of an axis in the present example; `usual` where the run never read it."""
        if axis not in self.ranges:
            return usual, usual
        if self._model is None and not self._possible(self.z3.BoolVal(True)):
            return usual, usual
        value = self._float(self._model.eval(self._terms[axis], model_completion=True))
        low, high = self.ranges[axis]
        value = min(max(value, low), high)
        return value, value

    def _float(self, value: Any) -> Any:
        if self.z3.is_algebraic_value(value):
            value = value.approx(20)
        if self.z3.is_int_value(value):
            return value.as_long()
        return value.numerator_as_long() / value.denominator_as_long()

    def corner(self, system: Any, choose: Callable[[str, float, float], float]) -> Any:
        """A plain view on which floats give the policy's comparisons the same results; None if no such view was found."""
        draw = random.Random(str(self.taken))  # noqa: S311
        close: list[_Compared] = []
        margin = 1e-3
        for _ in range(_EXAMPLES):
            found = {axis: self.bounds(axis, 0.0)[0] for axis in self.ranges}
            if margin < _LEAST_MARGIN:
                found = {axis: self._moved(axis, x, draw) for axis, x in found.items()}
            values = {axis: choose(axis, x, x) for axis, x in found.items()}
            others = self._others_in_floats(values)
            if not others:
                return system.example(lambda axis, low, _, values=values: values.get(axis, low))
            close += others
            while margin >= _LEAST_MARGIN and not self._keeps_apart(close, margin):
                margin /= 1e3
        return None

    def _keeps_apart(self, close: Sequence[_Compared], margin: float) -> bool:
        """Whether the run has an example in which these comparisons have a margin. It becomes the present one."""
        least = self.constant(margin)
        self._solver.push()
        for act, a, b, result in close:
            one, other = self._term_of(a), self._term_of(b)
            sides = ((one, other, act(0, 1)), (other, one, act(1, 0)))
            self._solver.add(self.z3.Or(*[low + least <= high for low, high, holds in sides if holds == result]))
        is_possible: bool = self._solver.check() == self.z3.sat
        if is_possible:
            self._model = self._solver.model()
        self._solver.pop()
        return is_possible

    def _term_of(self, number: Any) -> Any:
        return number._term if isinstance(number, Solved) else self.constant(number)

    def _moved(self, axis: str, value: float, draw: random.Random) -> float:
        """A number of an axis near another one, be it by a few floats; every second time the same."""
        low, high = self.ranges[axis]
        if isinstance(low, int) or draw.random() < 0.5:
            return value
        moved = value + max(abs(value), 1e-3) * draw.choice((-1, 1)) * 10 ** draw.uniform(-17.0, 0.0)
        return min(max(draw.choice((moved, round(moved * 1024) / 1024)), low), high)

    def _others_in_floats(self, values: Mapping[str, float]) -> list[_Compared]:
        """The comparisons that have another result in floats.

        All numbers of the run are computed from its inputs, rounded as the policy rounds.
        """
        self._floats = []
        for act, given in self._computed:
            try:
                self._floats.append(act(*[self.value_of(x, values) for x in given]))
            except (ArithmeticError, ValueError):  # a divisor that is zero, which another comparison excludes
                self._floats.append(math.nan)
        return [
            (act, a, b, result)
            for act, a, b, result in self._compared
            if act(self.value_of(a, values), self.value_of(b, values)) != result
        ]

    def value_of(self, number: Any, values: Mapping[str, float]) -> float:
        """A number where the inputs have the values of the last example."""
        if not isinstance(number, Solved):
            return number  # type: ignore[no-any-return]
        return values[number._axis] if number._place is None else self._floats[number._place]


_LARGEST = sys.float_info.max / 2
"""Half of the largest float: rounding does not lead beyond it."""


class Solved(Ranged):
    """A number with a term over the inputs of its path."""

    __slots__ = ("_most", "_place", "_term")

    def __init__(self, path: SolvedPath, axis: str, term: Any, most: float, place: int | None = None) -> None:
        super().__init__(path, axis)
        self._term, self._place = term, place
        self._most = most
        """It is no farther from 0 than this."""

    def _other(self, other: object) -> tuple[Any, Any]:
        """The other operand and its term; None if it is not a number."""
        path: Any = self._path
        if isinstance(other, Solved):
            return other, other._term
        c = self._constant(other)
        if c is None:
            return None, None
        if not math.isfinite(c):
            path.refuse(f"computes with {c} and {self._axis}")
        return c, path.constant(c)

    def _compare(self, other: object, make: Callable[[Any, Any], Any], infinite: Callable[[float, float], bool]) -> Any:
        if type(other) is float and not math.isfinite(other):
            return infinite(0.0, other)
        number, term = self._other(other)
        path: Any = self._path
        return NotImplemented if term is None else path.compares(make, self, number, term)

    def __lt__(self, other: object) -> Any:
        return self._compare(other, lambda a, b: a < b, lambda a, b: a < b)

    def __le__(self, other: object) -> Any:
        return self._compare(other, lambda a, b: a <= b, lambda a, b: a <= b)

    def __gt__(self, other: object) -> Any:
        return self._compare(other, lambda a, b: a > b, lambda a, b: a > b)

    def __ge__(self, other: object) -> Any:
        return self._compare(other, lambda a, b: a >= b, lambda a, b: a >= b)

    def __eq__(self, other: object) -> Any:
        return self._compare(other, lambda a, b: a == b, lambda a, b: a == b)

    def __ne__(self, other: object) -> Any:
        equal = self.__eq__(other)
        return equal if equal is NotImplemented else not equal

    __hash__ = Ranged.__hash__  # type: ignore[assignment]

    def _combined(
        self,
        other: object,
        make: Callable[[Any, Any], Any],
        act: Callable[[Any, Any], Any],
        most: Callable[[float, float], float] | None = None,
    ) -> Any:
        """A number of two. `most` bounds how far it is from 0, by how far they are; None asks the solver."""
        number, term = self._other(other)
        if term is None:
            return NotImplemented
        self._path.exact = False
        others = number._most if isinstance(number, Solved) else abs(number)
        return self._made(
            make(self._term, term), act, (self, number), math.inf if most is None else most(self._most, others)
        )

    def _made(self, term: Any, act: Callable[..., Any], given: Sequence[Any], most: float) -> Solved:
        """A number that the policy computes by `act`."""
        path: Any = self._path
        if most > _LARGEST:
            largest = path.constant(_LARGEST)
            if not path._holds(path.z3.And(term <= largest, term >= -largest)):
                path.refuse(f"may compute numbers beyond the largest float from {self._axis}")
            most = _LARGEST
        return Solved(path, self._axis, term, most, path.computes(act, given))

    def __add__(self, other: object) -> Any:
        return self._combined(other, lambda a, b: a + b, operator.add, operator.add)

    __radd__ = __add__

    def __sub__(self, other: object) -> Any:
        return self._combined(other, lambda a, b: a - b, operator.sub, operator.add)

    def __rsub__(self, other: object) -> Any:
        return self._combined(other, lambda a, b: b - a, lambda a, b: b - a, operator.add)

    def __mul__(self, other: object) -> Any:
        return self._combined(other, lambda a, b: a * b, operator.mul, operator.mul)

    __rmul__ = __mul__

    def __truediv__(self, other: object) -> Any:
        if other == 0:
            return 1.0 / 0  # the error of a plain number
        return self._combined(other, self._quotient, operator.truediv)

    def __rtruediv__(self, other: object) -> Any:  # type: ignore[override]
        if self == 0:
            return 1.0 / 0
        return self._combined(other, lambda a, b: self._quotient(b, a), lambda a, b: b / a)

    def _quotient(self, a: Any, b: Any) -> Any:
        path: Any = self._path
        return path.z3.ToReal(a) / b if path.z3.is_int(a) else a / b

    def __pow__(self, other: object) -> Any:  # type: ignore[override]
        if other != 2 or type(other) is not int:
            self._cannot()
        return self._combined(self, lambda a, b: a * b, lambda a, _: a**2, operator.mul)

    def __neg__(self) -> Any:
        return self._made(-self._term, operator.neg, (self,), self._most)  # exact for floats too

    def __floordiv__(self, other: object) -> Any:
        return self._cannot()

    def _whole(self, *_: object) -> Any:
        return self._cannot()

    __int__ = __floor__ = __ceil__ = __trunc__ = __round__ = _whole  # type: ignore[assignment]

    def __abs__(self) -> Any:
        return self if self >= 0 else -self

    def __format__(self, spec: str) -> str:
        return format(0.0 if isinstance(self, float) else 0, spec).rjust(LONGEST_TEXT, MARK)

    def _value_in(self, values: Mapping[str, float]) -> float:
        path: Any = self._path
        value: float = path.value_of(self, values)
        return value

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        path: Any = self._path
        return int if path.z3.is_int(self._term) else float
