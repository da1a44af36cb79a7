"""Numbers that an SMT solver follows, for policies that combine inputs: sums, products, the best of several.

A `Solved` number has a term of z3 over the inputs of its path. A comparison asks the solver which results are possible.
If both are, the run forks, as with ranges. Sums and products are followed over the reals, without the rounding of floats:
a search with them is not exact. Comparisons of plain inputs are. z3 is an optional dependency, the extra `verify`.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from sortie.policies.verification.symbols import MARK, Path, Ranged, Refused, Text

STEP_MS = 2000
"""The longest time for one question to the solver."""


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
    solver.set("timeout", STEP_MS)
    return lambda script: SolvedPath(script, z3, solver)


class SolvedPath(Path):
    """A run whose numbers a solver follows."""

    def __init__(self, script: Sequence[int], z3: Any, solver: Any) -> None:
        super().__init__(script)
        self.z3, self._solver = z3, solver
        solver.reset()
        solver.set("timeout", STEP_MS)
        self.facts: list[Any] = []
        self._terms: dict[str, Any] = {}
        self._model: Any = None
        """Values that satisfy all facts so far, which answer one side of most questions."""

    def number(self, axis: str, low: float, high: float) -> Any:
        """The number of an axis within its bounds."""
        return Solved(self, axis, self._term(axis, low, high), is_plain=True)

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
            self.refuse(f"combines inputs in a way that the solver does not decide within {STEP_MS / 1e3:g} s")
        if model is not None:
            self._model = model
        return model is not None

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
        self._solver.set("timeout", STEP_MS)
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
        """A plain view of the cell that the floats still satisfy; None where rounding leaves none at hand."""
        if not self.exact:
            return system.example()
        values: dict[str, float] = {}

        def kept(axis: str, low: float, high: float) -> float:
            values[axis] = choose(axis, low, high)
            return values[axis]

        view = system.example(kept)
        pairs = [(self._terms[axis], self.constant(x)) for axis, x in values.items()]
        still = all(self.z3.is_true(self.z3.simplify(self.z3.substitute(fact, *pairs))) for fact in self.facts)
        return view if still else None


class Solved(Ranged):
    """A number with a term over the inputs of its path."""

    __slots__ = ("_is_plain", "_term")

    def __init__(self, path: SolvedPath, axis: str, term: Any, is_plain: bool = False) -> None:
        super().__init__(path, axis)
        self._term, self._is_plain = term, is_plain

    def _other(self, other: object) -> Any:
        """The other operand as a term; None if it is not a number."""
        path: Any = self._path
        if isinstance(other, Solved):
            return other._term
        c = self._constant(other)
        if c is None:
            return None
        if not math.isfinite(c):
            path.refuse(f"computes with {c} and {self._axis}")
        return path.constant(c)

    def _compare(self, other: object, make: Callable[[Any, Any], Any], infinite: Callable[[float, float], bool]) -> Any:
        if type(other) is float and not math.isfinite(other):
            return infinite(0.0, other)
        term = self._other(other)
        path: Any = self._path
        return NotImplemented if term is None else path.holds(make(self._term, term))

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

    def _combined(self, other: object, make: Callable[[Any, Any], Any]) -> Any:
        term = self._other(other)
        if term is None:
            return NotImplemented
        self._path.exact = False
        return Solved(self._path, self._axis, make(self._term, term))  # type: ignore[arg-type]

    def __add__(self, other: object) -> Any:
        return self._combined(other, lambda a, b: a + b)

    __radd__ = __add__

    def __sub__(self, other: object) -> Any:
        return self._combined(other, lambda a, b: a - b)

    def __rsub__(self, other: object) -> Any:
        return self._combined(other, lambda a, b: b - a)

    def __mul__(self, other: object) -> Any:
        return self._combined(other, lambda a, b: a * b)

    __rmul__ = __mul__

    def __truediv__(self, other: object) -> Any:
        if other == 0:
            return 1.0 / 0  # the error of a plain number
        return self._combined(other, self._quotient)

    def __rtruediv__(self, other: object) -> Any:  # type: ignore[override]
        if self == 0:
            return 1.0 / 0
        return self._combined(other, lambda a, b: self._quotient(b, a))

    def _quotient(self, a: Any, b: Any) -> Any:
        path: Any = self._path
        return path.z3.ToReal(a) / b if path.z3.is_int(a) else a / b

    def __pow__(self, other: object) -> Any:  # type: ignore[override]
        return self * self if other == 2 and type(other) is int else self._cannot()

    def __neg__(self) -> Any:
        return Solved(self._path, self._axis, -self._term)  # type: ignore[arg-type]  # exact for floats too

    def __floordiv__(self, other: object) -> Any:
        return self._cannot()

    def _rounded(self, how: str) -> Any:
        return self._cannot()

    def __abs__(self) -> Any:
        return self if self >= 0 else -self

    def _text(self, spec: str = "") -> str:
        format(0.0 if isinstance(self, float) else 0, spec)  # a wrong spec must raise
        return Text(self._path, self._axis, f"{MARK}{self._axis}{MARK}")

    def _value_in(self, values: Mapping[str, float]) -> float:
        path: Any = self._path
        pairs = [(path._terms[axis], path.constant(x)) for axis, x in values.items() if axis in path._terms]
        value: float = path._float(path.z3.simplify(path.z3.substitute(self._term, *pairs)))
        return value

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        path: Any = self._path
        return int if path.z3.is_int(self._term) else float
