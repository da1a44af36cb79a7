"""What the context plane lost: the share of descriptor receptions, by cause."""

from __future__ import annotations

from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from sortie.radio.counters import CAUSES
from sortie.scenarios.frames import instants
from sortie.sim.results.section import Flown, OutcomeSection, Share, Span, figure, ratio


class LostTo(OutcomeSection):
    collision_context: Share | None = figure("It met another descriptor on the air.")
    collision_data: Share | None = figure("It met a payload's frame, or the answer to one.")
    hidden: Share | None = figure("A sender that could not hear the first one spoilt it at the receiver.")
    weak_signal: Share | None = figure("Distance, shadowing, fading, a burst or an event made the link too bad.")
    half_duplex: Share | None = figure("The receiver was sending itself.")


class ContextOutcome(OutcomeSection):
    lost: Share | None = figure(
        "Share of descriptor receptions lost on the air; a descriptor counts once for each other drone in the air."
    )
    lost_to: LostTo = figure("The part of it that each cause has; together they are `lost`.")

    @classmethod
    def compute(cls, flown: Flown) -> dict[str, Any]:
        return losses(flown.tables["receptions"], (0.0, flown.scenario.duration_s))


def losses(receptions: pa.Table, span: Span) -> dict[str, Any]:
    """The figures of the frames that begin within a span."""
    at, (begin, end) = instants(receptions["t_s"].to_numpy()), instants(span)
    within = receptions.filter(pa.array((begin <= at) & (at < end)))
    lost, heard = {cause: _sum(within[cause]) for cause in CAUSES}, _sum(within["heard"])
    every = heard + sum(lost.values())
    return {
        "lost": ratio(sum(lost.values()), every),
        "lost_to": {cause: ratio(count, every) for cause, count in lost.items()},
    }


def _sum(column: pa.ChunkedArray) -> int:
    return int(pc.sum(pc.cast(column, pa.int64())).as_py() or 0)
