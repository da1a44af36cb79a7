"""The schema of a set of conditions: one base scenario under many conditions, on which policies are compared.

`sortie.scenarios.reading.load.load_conditions` reads the file; `sortie compare FILE --policies …` flies it.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from sortie.scenarios.schema.base import Section, inconsistent

Override = Annotated[str, Field(min_length=3, description="As after `--set`.")]


class Condition(Section):
    """One condition."""

    name: str = Field(pattern=r"^[a-z0-9_]+$", max_length=64, description="Short name.")
    budget: float = Field(
        gt=0,
        le=1,
        description="Feature cells that the fleet may send a frame, as a share of full sharing (each drone's whole map to each other drone). A policy gets it as its received_budget (an ego's), its sent_budget (a drone's) or its rho (a link's), whichever it has.",
    )
    metric: Literal["full_scene", "mission"] = Field(
        "full_scene", description="The AP that counts: everywhere, or in the mission disc."
    )
    set: tuple[Override, ...] = Field((), max_length=50, description="What differs from the base scenario.")


class ConditionSet(Section):
    """A set of conditions, compared as a whole."""

    description: str = Field("", max_length=2000, description="One paragraph for people.")
    base: str = Field(min_length=1, description="A library scenario's name, or a file, relative to this one.")
    set: tuple[Override, ...] = Field((), max_length=50, description="What holds in every condition.")
    seeds: tuple[Annotated[int, Field(ge=0, lt=2**63)], ...] = Field(
        (1,),
        max_length=100,
        description="Each condition is flown once with each; an empty list: once, with its scenario's own seed.",
    )
    conditions: tuple[Condition, ...] = Field(min_length=1, max_length=1000, description="The conditions.")

    @model_validator(mode="after")
    def _named_once(self) -> ConditionSet:
        names = [c.name for c in self.conditions]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise inconsistent(("conditions", i, "name"), repr(name), "named once")
        return self
