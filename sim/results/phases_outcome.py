"""The figures of each phase of the mission."""

from __future__ import annotations

from typing import Any

from sortie.perception.classes import CAR
from sortie.sim.results.accuracy import Accuracy, scored
from sortie.sim.results.context_outcome import ContextOutcome, losses
from sortie.sim.results.section import Flown, Mbps, OutcomeSection, Seconds, Share, Size, figure
from sortie.sim.results.traffic import feature_payload_p50, traffic_of


class PhaseOutcome(OutcomeSection):
    phase: str = figure("A phase of `mission.phases`, for the whole fleet: drones of `mission.groups` too.")
    begin_s: Seconds = figure("From when.")
    end_s: Seconds = figure("Until when, exclusive.")
    ap50: Accuracy = figure("Average precision of cars within it.")
    context: ContextOutcome = figure("Losses of descriptors in the frames that begin within it.")
    data_rate_mbps: Mbps = figure("Payload bytes captured in it, as Mb/s.")
    feature_payload_bytes: Size | None = figure("Median size of a feature payload.")
    deadline_miss_rate: Share | None = figure("As for the whole sortie.")


def phases(flown: Flown) -> list[dict[str, Any]]:
    """The section `phases`."""
    return [
        {
            "phase": name,
            "begin_s": span[0],
            "end_s": span[1],
            "ap50": scored(flown).ap(CAR, *span),
            "context": losses(flown.tables["receptions"], span),
            "data_rate_mbps": sent.sent_bytes * 8e-6 / (span[1] - span[0]),
            "feature_payload_bytes": feature_payload_p50(flown.tables, span),
            "deadline_miss_rate": sent.miss_rate(),
        }
        for (span, name), sent in zip(flown.phases, traffic_of(flown)[1:], strict=True)
    ]
