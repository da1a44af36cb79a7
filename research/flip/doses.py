"""The dose–response study: weight that silent peers draw is raised by intervention, and the flip looked for. Free of torch.

`doses.toml` is the plan. The networks stay as they were trained; only their fusion's softmax is changed
(`fusion.DosedDiscoNet`), so a difference between two doses has no other cause.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError
from scipy.stats import spearmanr

from research.paper.measures import Contrast, Scores
from research.paper.ways import SINGLE, Absent, Sharing, Ways
from sortie.perception.errors import InputError
from sortie.perception.evaluation.sharing import Unsent
from sortie.scenarios.regular import regular
from sortie.scenarios.schema.base import Params

PLAN = Path(__file__).parent / "doses.toml"


@dataclass(frozen=True, slots=True)
class Dose:
    """One intervention on the fusion."""

    temperature: float = 1.0
    silent_weight: float = 0.0
    unsent: Unsent = "zero"
    absent: Absent = "excluded"

    @property
    def params(self) -> Params:
        """`fusion_params` of the network."""
        return {"temperature": self.temperature, "silent_weight": self.silent_weight}

    @property
    def ways(self) -> Ways:
        """What peers that were not chosen count as."""
        return Ways(absent=self.absent)

    @property
    def label(self) -> str:
        """A short name.

        Example:
            >>> Dose(math.inf, 0.35).label, Dose(unsent="masked").label
            ('T ∞, β 0.35', 'T 1, masked')
        """
        parts = [f"T {'∞' if math.isinf(self.temperature) else format(self.temperature, 'g')}"]
        parts += [f"β {self.silent_weight:g}"] if self.silent_weight else []
        parts += ["masked"] if self.unsent == "masked" else []
        parts += ["absent as zeros"] if self.absent == "zeros" else []
        return ", ".join(parts)


@dataclass(frozen=True, slots=True)
class FrameRange:
    """Frames of one benchmark's test split, the last included."""

    bench_seed: int
    first: int
    last: int

    @classmethod
    def parse(cls, text: str) -> FrameRange:
        """As the command line writes it.

        Raises:
            InputError: not of this form.

        Example:
            >>> FrameRange.parse("1:0-239")
            FrameRange(bench_seed=1, first=0, last=239)
        """
        found = re.fullmatch(r"(\d{1,9}):(\d{1,9})-(\d{1,9})", text)
        if found is None:
            raise InputError(f"frames is {text!r}, must be a benchmark's seed and frames, such as 7:0-239")
        return cls(*map(int, found.groups()))


@dataclass(frozen=True, slots=True)
class DosePlan:
    """The whole study."""

    question: str
    hypotheses: tuple[str, str, str, str, str]
    networks: tuple[str, ...]
    budgets: tuple[float, ...]
    starved: float
    many: str
    few: str
    frames: tuple[FrameRange, ...]
    dose: tuple[Dose, ...] = field(default=())

    def sharing(self, dose: Dose, peers: str, budget: float) -> Sharing:
        """A way of sharing under a dose."""
        return Sharing(budget, peers, unsent=dose.unsent, absent=dose.absent)

    def conditions(self, dose: Dose) -> Iterator[Sharing]:
        """What has to be evaluated of one dose."""
        yield SINGLE
        yield self.sharing(dose, self.many, self.starved)
        for budget in (0.0, *self.budgets):
            for peers in (self.few, self.many):
                yield self.sharing(dose, peers, budget)


def read_plan(path: Path = PLAN) -> DosePlan:
    """The plan in a TOML file.

    Raises:
        InputError: naming the file, the place and what must be there.
    """
    try:
        return TypeAdapter(DosePlan).validate_python(tomllib.loads(regular(path).read_text("utf-8")))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not TOML ({error})") from None
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{path}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None


@dataclass(frozen=True, slots=True)
class Effect:
    """A difference of two APs in points, with its 95 % interval over frames."""

    value: float
    low: float
    high: float

    @property
    def sign(self) -> int:
        """+1 or −1 where the interval leaves out zero, else 0."""
        return (self.low > 0) - (self.high < 0)


@dataclass(frozen=True, slots=True)
class DoseRow:
    """One network at one dose."""

    network: str
    dose: Dose
    weight_on_zeros: float
    """What four silent peers draw together of the softmax weight in cells with a car, 0 … 1, mean; 0 where masked."""
    starved: Effect
    """Four peers at the least budget minus a drone alone."""
    silent: Effect
    """Two silent peers minus four silent peers."""
    contrasts: tuple[Effect, ...]
    """Two peers minus four at each budget."""
    frames: int


def row_of(plan: DosePlan, network: str, dose: Dose, weight: float, scores: Scores, frames: int) -> DoseRow:
    """The figures of one network at one dose."""

    def minus(a: Sharing, b: Sharing) -> Effect:
        found = Contrast((a,), (b,)).measure(scores)
        return Effect(found.value, *(found.value if end is None else end for end in (found.low, found.high)))

    def contrast(budget: float) -> Effect:
        return minus(plan.sharing(dose, plan.few, budget), plan.sharing(dose, plan.many, budget))

    starved = minus(plan.sharing(dose, plan.many, plan.starved), SINGLE)
    contrasts = tuple(contrast(budget) for budget in plan.budgets)
    return DoseRow(network, dose, weight, starved, contrast(0.0), contrasts, frames)


def verdicts(rows: Sequence[DoseRow]) -> dict[str, tuple[bool, ...]]:
    """By network: which of the plan's hypotheses hold, in the plan's order.

    Raises:
        InputError: a network without zero fill at two doses, or without a masked control.
    """
    return {name: _hold([r for r in rows if r.network == name]) for name in dict.fromkeys(r.network for r in rows)}


def _hold(rows: Sequence[DoseRow]) -> tuple[bool, ...]:
    filled = sorted(
        (r for r in rows if r.dose.unsent == "zero" and r.dose.absent == "excluded"), key=lambda r: r.weight_on_zeros
    )
    masked = [r for r in rows if r.dose.unsent == "masked"]
    if len(filled) < 2 or not masked:
        raise InputError("the plan needs zero fill at two doses or more, and a masked control")
    least, most = filled[0], filled[-1]
    rises = spearmanr([r.weight_on_zeros for r in filled], [r.contrasts[0].value for r in filled]).statistic
    return (
        bool(rises > 0),
        most.contrasts[0].sign > 0 and most.contrasts[-1].sign < 0,
        most.starved.sign < 0,
        all(r.starved.sign > 0 and all(c.sign < 0 for c in r.contrasts) for r in masked),
        most.silent.low > least.silent.high,
    )


def facts(row: DoseRow) -> dict[str, Any]:
    """A row as plain values, for tables."""
    effects = {"starved": row.starved, "silent": row.silent}
    return {
        "network": row.network,
        "dose": row.dose.label,
        "weight_on_zeros": row.weight_on_zeros,
        **{name: (e.value, e.low, e.high) for name, e in effects.items()},
        "contrasts": [(e.value, e.low, e.high) for e in row.contrasts],
        "frames": row.frames,
    }
