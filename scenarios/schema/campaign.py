"""The schema of a campaign: a base scenario, what is varied in it, and how much of it is flown.

Names and bounds only; `sortie.scenarios.reading.campaign` reads the file and holds what is varied against the base scenario.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, JsonValue, model_validator

from sortie.scenarios.schema.base import Section, inconsistent

# --- how a field is spread ------------------------------------------------------------------------


class Uniform(Section):
    kind: Literal["uniform"]
    low: float = Field(description="Smallest value.")
    high: float = Field(description="Largest value.")

    @model_validator(mode="after")
    def _ordered(self) -> Uniform:
        _below("low", self.low, "high", self.high)
        return self


class Integers(Section):
    kind: Literal["integers"]
    low: int = Field(description="Smallest value, inclusive.")
    high: int = Field(description="Largest value, inclusive; all are equally likely.")

    @model_validator(mode="after")
    def _ordered(self) -> Integers:
        _below("low", self.low, "high", self.high)
        return self


class Normal(Section):
    kind: Literal["normal"]
    mean: float = Field(description="Mean, before it is cut.")
    sd: float = Field(gt=0, description="Standard deviation, before it is cut.")
    low: float | None = Field(None, description="The distribution is cut off below; left out, it is not.")
    high: float | None = Field(None, description="The distribution is cut off above; left out, it is not.")

    @model_validator(mode="after")
    def _ordered(self) -> Normal:
        if self.low is not None and self.high is not None:
            _below("low", self.low, "high", self.high)
        return self


class LogNormal(Section):
    kind: Literal["log_normal"]
    median: float = Field(gt=0, description="Median.")
    sigma: float = Field(gt=0, le=10, description="Standard deviation of the natural logarithm.")


class Triangular(Section):
    kind: Literal["triangular"]
    low: float = Field(description="Smallest value.")
    mode: float = Field(description="Most likely value.")
    high: float = Field(description="Largest value.")

    @model_validator(mode="after")
    def _ordered(self) -> Triangular:
        _below("low", self.low, "high", self.high)
        if not self.low <= self.mode <= self.high:
            raise inconsistent(("mode",), f"{self.mode:g}", f"between low = {self.low:g} and high = {self.high:g}")
        return self


class Choice(Section):
    kind: Literal["choice"]
    values: tuple[JsonValue, ...] = Field(min_length=1, max_length=10_000, description="What is drawn from.")
    weights: tuple[float, ...] | None = Field(None, description="How likely each is; left out, all equally.")

    @model_validator(mode="after")
    def _weighted(self) -> Choice:
        if self.weights is not None:
            if len(self.weights) != len(self.values):
                raise inconsistent(("weights",), f"{len(self.weights)} weights", f"{len(self.values)}, one a value")
            if min(self.weights) < 0 or sum(self.weights) <= 0:
                raise inconsistent(("weights",), f"{list(self.weights)}", "at least 0, and one above it")
        return self


class Linspace(Section):
    kind: Literal["linspace"]
    low: float = Field(description="First value.")
    high: float = Field(description="Last value.")
    count: int = Field(ge=2, le=10_000, description="How many, evenly spaced.")

    @model_validator(mode="after")
    def _ordered(self) -> Linspace:
        _below("low", self.low, "high", self.high)
        return self


class Grid(Section):
    kind: Literal["grid"]
    values: tuple[JsonValue, ...] = Field(min_length=1, max_length=10_000, description="Every one of them is flown.")


class Column(Section):
    kind: Literal["column"]
    file: str = Field(min_length=1, description="A CSV file with a header, relative to the campaign's.")
    column: str = Field(min_length=1, description="Its column; columns of one file go together, row by row.")


Spread = Annotated[
    Uniform | Integers | Normal | LogNormal | Triangular | Choice | Linspace | Grid | Column,
    Field(discriminator="kind"),
]
SAMPLED = (Uniform, Integers, Normal, LogNormal, Triangular, Choice)
"""Drawn by `sample`; the others are grids, of which every value is flown with every draw."""


# --- the campaign ---------------------------------------------------------------------------------

PARAMS = "policy.params."
"""Before the name of a policy's parameter that is varied: it is put over what each policy has of its own."""
_LEFT_TO = {
    "seed": "left to the campaign: its own seed decides every run's, replications are further draws",
    "policy.name": "left to policies, which lists those that fly",
    "policy.changes": "left to policies: one other than the base's own flies to the end",
    "policy.commands": "left to policies: one other than the base's own flies to the end",
}
"""Fields of the base that the plan writes itself: varied, they would stand in the table and not be flown."""


class SampledField(Section):
    method: Literal["random", "latin_hypercube", "sobol", "morris", "saltelli"] = Field(
        "latin_hypercube",
        description="How the drawn fields are spread together; morris and saltelli are designs for sensitivity.",
    )
    count: int = Field(
        1,
        ge=1,
        le=10_000_000,
        description="Draws; for morris trajectories of fields + 1 draws, for saltelli blocks of fields + 2.",
    )

    @property
    def independent(self) -> bool:
        """Whether the draws are one sample, over which a mean has an interval. Draws of a Morris trajectory or a Saltelli block
        share values with one another."""
        return self.method not in ("morris", "saltelli")

    @model_validator(mode="after")
    def _power(self) -> SampledField:
        if self.method in ("sobol", "saltelli") and self.count & (self.count - 1):
            raise inconsistent(("count",), f"{self.count}", f"a power of two where method is {self.method}")
        return self


class StopWhen(Section):
    metric: str = Field(min_length=1, description="One of metrics.")
    half_width: float = Field(
        gt=0,
        description="Enough is flown when every policy's interval is no wider than twice this. Values that are all equal have no interval, and are enough from 30 units on.",
    )
    confidence: float = Field(0.95, ge=0.5, le=0.9999, description="Of the interval of the mean.")
    difference: bool = Field(False, description="Of the paired difference from the first policy, not of the mean.")
    at_least: int = Field(
        30, ge=2, description="Units flown before it is asked: draws, or replications where no field is drawn."
    )


class Campaign(Section):
    """Many sorties: a base scenario, its fields varied, several policies on the same draws."""

    campaign: str = Field(pattern=r"^[a-z0-9_]+$", max_length=64, description="Short name, as in the file's name.")
    description: str = Field("", max_length=2000, description="One paragraph for people.")
    base: str = Field(min_length=1, description="A library scenario's name, or a file, relative to this one.")
    set: dict[str, JsonValue] = Field({}, description="Dotted fields of the base that have another value throughout.")
    vary: dict[str, Spread] = Field(
        {}, max_length=100, description="Dotted fields of the base, and how each is spread."
    )
    sample: SampledField = SampledField()
    policies: tuple[str, ...] = Field(
        ("",), min_length=1, max_length=50, description="As after --policy; left out, the base's own."
    )
    replications: int = Field(1, ge=1, le=1_000_000, description="Sorties of each cell and policy.")
    metrics: tuple[str, ...] = Field(
        min_length=1, max_length=200, description="Dotted fields of outcome.json that are kept, numbers only."
    )
    stop_when: StopWhen | None = Field(None, description="When enough is flown; left out, when all is.")
    seed: int = Field(1, ge=0, lt=2**63, description="Every draw of the campaign follows from it.")

    @model_validator(mode="after")
    def _consistent(self) -> Campaign:
        if self.stop_when is not None and self.stop_when.metric not in self.metrics:
            raise inconsistent(("stop_when", "metric"), self.stop_when.metric, "one of metrics")
        if self.stop_when is not None and self.stop_when.difference and len(self.policies) < 2:
            raise inconsistent(("stop_when", "difference"), "true", "false where there is one policy")
        drawn = [name for name, spread in self.vary.items() if isinstance(spread, SAMPLED)]
        if not drawn and self.sample.count > 1:
            raise inconsistent(
                ("sample", "count"), f"{self.sample.count}", "1 where no field is drawn, see replications"
            )
        if not self.sample.independent and (not drawn or len(drawn) < len(self.vary)):
            bound = "another, or every field of vary drawn, none a grid"
            raise inconsistent(("sample", "method"), self.sample.method, bound)
        if not self.sample.independent and self.stop_when is not None:
            bound = "left out, or another sample.method: its means have no intervals"
            raise inconsistent(("stop_when",), self.sample.method, bound)
        for name in ("policies", "metrics"):
            entries = getattr(self, name)
            for i, entry in enumerate(entries):
                if entry in entries[:i]:
                    raise inconsistent((name, i), entry, "named once")
        for name in self.set.keys() & self.vary.keys():
            raise inconsistent(("set", name), name, "set or varied, not both")
        for name in self.vary:
            if name in ("policy", PARAMS[:-1]):
                raise inconsistent(("vary", name), name, "one of its fields, as in policy.params.rho")
            for field, bound in _LEFT_TO.items():
                if f"{name}.".startswith(f"{field}."):
                    raise inconsistent(("vary", name), name, bound)
        if "seed" in self.set:
            raise inconsistent(("set", "seed"), "seed", _LEFT_TO["seed"])
        return self


def _below(name: str, value: float, other: str, bound: float) -> None:
    if not value < bound:
        raise inconsistent((name,), f"{value:g}", f"below {other} = {bound:g}")
