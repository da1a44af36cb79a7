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
from fractions import Fraction
from typing import Any

from sortie.policies.verification.proof.symbols import LONGEST_TEXT, Path, Ranged, Refused

STEP = 3_000_000
"""The most steps of the solver, as it counts them (`rlimit`), for one question."""
_ROUNDED = 16
"""At so many other places of a run it is tried whether floats decide there as the reals do."""
_MARGINS = (1e-3, 1e-6, 1e-9, 1e-12, 0.0)
"""By so much an example keeps numbers apart, if floats round a closer one out of its run."""


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
        self.questions += 1
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

    def compares(self, act: Callable[[Any, Any], Any], one: Solved, other: Any, term: Any) -> bool:
        """The result of a comparison with another number, of which `term` is the term."""
        found = self.holds(act(one._term, term))
        self._compared.append((act, one, other, found))
        return found

    def holds(self, fact: Any) -> bool:
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
        values = self._present()
        for _ in range(0 if self.exact else _ROUNDED):
            free = [axis for axis, (low, _) in self.ranges.items() if isinstance(low, float) and draw.random() < 0.8]
            other = values | {axis: draw.uniform(*self.ranges[axis]) for axis in free}
            if self._decides_alike({axis: Fraction(x) for axis, x in other.items()}) and not self._decides_alike(other):
                values = other  # only rounding makes the difference
                break
        else:
            for margin in _MARGINS:
                if self._decides_alike(values):
                    break
                values = self._present(margin)
            else:
                return None
        shown = {axis: choose(axis, x, x) for axis, x in values.items()}
        return system.example(lambda axis, low, _: shown.get(axis, low))

    def _present(self, margin: float = 0.0) -> dict[str, float]:
        """The present example, or one in which no two numbers that the run compares are closer than this, if there is one."""
        if margin:
            least = self.constant(margin)
            self._solver.push()
            for act, a, b, result in self._compared:
                one, other = self._term_of(a), self._term_of(b)
                sides = ((one, other, act(0, 1)), (other, one, act(1, 0)))
                self._solver.add(self.z3.Or(*[low + least <= high for low, high, holds in sides if holds == result]))
            if self._solver.check() == self.z3.sat:
                self._model = self._solver.model()
            self._solver.pop()
        return {axis: self.bounds(axis, 0.0)[0] for axis in self.ranges}

    def _term_of(self, number: Any) -> Any:
        return number._term if isinstance(number, Solved) else self.constant(number)

    def _decides_alike(self, values: Mapping[str, Any]) -> bool:
        """Whether the run's comparisons have the same results where its inputs have these values, computed as the policy does."""
        try:
            return all(act(value_of(a, values), value_of(b, values)) == result for act, a, b, result in self._compared)
        except (ArithmeticError, ValueError):  # a divisor that is zero
            return False


def value_of(number: Any, values: Mapping[str, Any]) -> Any:
    """A number where the inputs have these values; fractions give exact results, floats rounded ones."""
    if not isinstance(number, Solved):
        exact = any(isinstance(x, Fraction) for x in values.values())
        return Fraction(number) if exact else number
    if number._made is None:
        return values[number._axis]
    act, given = number._made
    return act(*[value_of(x, values) for x in given])


_LARGEST = sys.float_info.max / 2
"""Half of the largest float: rounding does not lead beyond it."""


class Solved(Ranged):
    """A number with a term over the inputs of its path."""

    __slots__ = ("_made", "_most", "_term")

    def __init__(self, path: SolvedPath, axis: str, term: Any, most: float, made: Any = None) -> None:
        super().__init__(path, axis)
        self._term, self._made = term, made
        """How the policy computes it, and from what; None for an input."""
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

    def _ask(self, other: object, act: Callable[[Any, Any], Any]) -> Any:
        if type(other) is float and not math.isfinite(other):
            return act(0.0, other)
        number, term = self._other(other)
        path: Any = self._path
        return NotImplemented if term is None else path.compares(act, self, number, term)

    def __lt__(self, other: object) -> Any:
        return self._ask(other, operator.lt)

    def __le__(self, other: object) -> Any:
        return self._ask(other, operator.le)

    def __gt__(self, other: object) -> Any:
        return self._ask(other, operator.gt)

    def __ge__(self, other: object) -> Any:
        return self._ask(other, operator.ge)

    def __eq__(self, other: object) -> Any:
        return self._ask(other, operator.eq)

    __hash__ = Ranged.__hash__  # type: ignore[assignment]

    def _combined(
        self, other: object, act: Callable[[Any, Any], Any], most: Callable[[float, float], float] | None = None
    ) -> Any:
        """A number of two. `most` bounds how far it is from 0, by how far they are; None asks the solver."""
        number, term = self._other(other)
        if term is None:
            return NotImplemented
        self._path.exact = False
        others = number._most if isinstance(number, Solved) else abs(number)
        bound = math.inf if most is None else most(self._most, others)
        return self._new(act(self._term, term), act, (self, number), bound)

    def _new(self, term: Any, act: Callable[..., Any], given: Sequence[Any], most: float) -> Solved:
        """A number that the policy computes by `act`."""
        path: Any = self._path
        if most > _LARGEST:
            largest = path.constant(_LARGEST)
            if not path.holds(path.z3.And(term <= largest, term >= -largest)):
                path.refuse(f"may compute numbers beyond the largest float from {self._axis}")
            most = _LARGEST
        return Solved(path, self._axis, term, most, (act, given))

    def __add__(self, other: object) -> Any:
        return self._combined(other, operator.add, operator.add)

    __radd__ = __add__

    def __sub__(self, other: object) -> Any:
        return self._combined(other, operator.sub, operator.add)

    def __rsub__(self, other: object) -> Any:
        return self._combined(other, lambda a, b: b - a, operator.add)

    def __mul__(self, other: object) -> Any:
        return self._combined(other, operator.mul, operator.mul)

    __rmul__ = __mul__

    def __truediv__(self, other: object) -> Any:
        if other == 0:
            return 1.0 / 0  # the error of a plain number
        return self._combined(other, operator.truediv)

    def __rtruediv__(self, other: object) -> Any:  # type: ignore[override]
        if self == 0:
            return 1.0 / 0
        return self._combined(other, lambda a, b: b / a)

    def __pow__(self, other: object) -> Any:  # type: ignore[override]
        return self * self if other == 2 and isinstance(other, int) else self._cannot()

    def __neg__(self) -> Any:
        return self._new(-self._term, operator.neg, (self,), self._most)  # exact for floats too

    def __floordiv__(self, other: object) -> Any:
        return self._cannot()

    def _then(self, step: str, c: float = 0.0) -> Any:
        return self._cannot()

    def __format__(self, spec: str) -> str:
        return format(0.0, spec).rjust(LONGEST_TEXT)

    def _value_in(self, values: Mapping[str, float]) -> float:
        value: float = value_of(self, values)
        return value
