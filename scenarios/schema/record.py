"""`record`: what a run keeps beside its tables."""

from __future__ import annotations

from pydantic import Field

from sortie.scenarios.schema.base import Section


class RecordSection(Section):
    views: bool = Field(
        False,
        description="Keep the exact view and answer of every decision, for `sortie replay`; `sim/README.md` says what it costs.",
    )
    beliefs: bool = Field(
        False, description="Keep the pose that each drone believes to have in each frame, as the table `beliefs`."
    )
    disagreement: bool = Field(
        False,
        description="Measure how often two drones' views lead to different choices about a link; takes time after the flight.",
    )
