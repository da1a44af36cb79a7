"""`limits`: how long a flight may take by the clock on the wall."""

from __future__ import annotations

from pydantic import Field

from sortie.scenarios.schema.base import Section


class Limits(Section):
    decision_s: float = Field(
        10.0,
        gt=0,
        le=3600,
        description="Wall-clock time for one decision of a policy in a file or a function of one's own; the flight fails after it.",
    )
    run_s: float = Field(
        86400.0,
        gt=0,
        le=1e7,
        description="Wall-clock time for the whole flight; it fails at the next simulated second.",
    )
