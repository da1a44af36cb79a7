"""`expect` and `expect_decisions`: what the outcome must satisfy."""

from __future__ import annotations

from pydantic import Field, model_validator

from sortie.scenarios.representation import RepresentationName
from sortie.scenarios.schema.base import DroneId, Section, inconsistent


class Expectation(Section):
    metric: str = Field(min_length=1, description="A dotted field of outcome.json, for example ap50.mission.")
    over: str | None = Field(
        None,
        min_length=1,
        description="A policy, as `silence`: the bounds are of the metric minus that of the same sortie flown by it.",
    )
    at_least: float | None = Field(None, description="Lower bound, inclusive.")
    at_most: float | None = Field(None, description="Upper bound, inclusive.")
    equals: float | str | bool | None = Field(None, description="The exact value.")
    tolerance: float = Field(
        0.0, ge=0, description="How far a number may lie beyond its bound, or off its exact value."
    )
    replications: int | None = Field(
        None, ge=2, le=10_000, description="Fly so many and hold their mean to the bounds; left out, the one sortie."
    )
    confidence: float | None = Field(
        None,
        ge=0.5,
        le=0.9999,
        description="How sure the mean must be within each bound (one-sided, Student); goes with replications.",
    )
    because: str = Field("", description="Why it is expected; shown when it fails.")

    @model_validator(mode="after")
    def _bounded(self) -> Expectation:
        if (self.replications is None) != (self.confidence is None):
            missing, given = ("confidence", "replications")[:: 1 if self.confidence is None else -1]
            raise inconsistent((missing,), "missing", f"given where {given} is")
        if self.replications is not None and self.equals is not None:
            raise inconsistent(("equals",), f"{self.equals}", "at_least or at_most where replications is given")
        if self.over is not None and isinstance(self.equals, str | bool):
            raise inconsistent(("equals",), f"{self.equals!r}", "a number where over is given, it is a difference")
        if self.tolerance and isinstance(self.equals, str | bool):
            bound = f"left out where equals is {self.equals!r}, it goes with numbers"
            raise inconsistent(("tolerance",), f"{self.tolerance:g}", bound)
        if self.at_least is None and self.at_most is None and self.equals is None:
            raise inconsistent((), "no bound", "at_least, at_most or equals")
        if self.at_least is not None and self.at_most is not None and self.at_least > self.at_most:
            raise inconsistent(("at_least",), f"{self.at_least:g}", f"≤ at_most = {self.at_most:g}")
        return self


class DecisionExpectation(Section):
    """Some directive that a drone's gate takes up within a window, or how many links change to it."""

    drone: DroneId | None = Field(None, description="Whose gate; left out, any drone's.")
    peer: DroneId | None = Field(None, description="The link's other end; left out, any.")
    from_s: float = Field(ge=0, description="Begin of the window, inclusive.")
    until_s: float = Field(ge=0, description="End of the window, inclusive.")
    representation: RepresentationName | None = Field(None, description="What the link is to carry.")
    rate_at_most_hz: float | None = Field(None, ge=0, le=30, description="Its highest rate.")
    roi: bool | None = Field(None, description="Whether it is confined to a region.")
    reason: str = Field("", description="Text that its reason contains.")
    changes: int | None = Field(
        None,
        ge=0,
        description="How often links change to it in the window, counted link by link; left out, any number.",
    )
    because: str = Field("", description="Why it is expected; shown when it fails.")

    @model_validator(mode="after")
    def _window(self) -> DecisionExpectation:
        if self.until_s < self.from_s:
            raise inconsistent(("until_s",), f"{self.until_s:g}", f"at least from_s = {self.from_s:g}")
        return self
