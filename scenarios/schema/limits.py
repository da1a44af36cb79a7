"""`limits`: how long a flight may take by the clock on the wall."""

from __future__ import annotations

from pydantic import Field

from sortie.scenarios.schema.base import Section

IN_CAMPAIGNS = {"decision_s": 10.0, "run_s": 86400.0}
"""The limits of a campaign's run where its scenario sets none."""


class Limits(Section):
    decision_s: float | None = Field(
        None,
        gt=0,
        le=3600,
        description="Wall-clock time for one call of a policy or another model of one's own; the flight fails after it. Without it there is no limit; in a campaign it is 10 s.",
    )
    run_s: float | None = Field(
        None,
        gt=0,
        le=1e7,
        description="Wall-clock time for the whole flight, which fails after it. Without it there is no limit; in a campaign it is a day.",
    )

    @property
    def are_set(self) -> bool:
        """Whether there is any limit."""
        return self.decision_s is not None or self.run_s is not None
