"""What of a scenario a live flight leaves out, so that it can say so before it flies."""

from __future__ import annotations

from collections.abc import Collection

from pydantic import BaseModel

from sortie.scenarios.schema import Scenario

UNUSED = (
    "context.form",  # descriptors have the paper's form
    "radio.framing",  # payloads go whole
    "fleet.sensor",  # live drones believe what the replayed models of motion give them
    "fleet.sensor_params",
    "perception.detector",  # no network runs, and nothing is scored
    "perception.detector_params",
    "perception.fusion",
    "perception.fusion_params",
    "perception.weights",
    "perception.codebook",
    "perception.recording",
    "perception.recorded_fusion",
    "perception.precision",
    "perception.sample_rate_hz",
    "perception.egos",
    "perception.fusion_delay_s",
    "perception.max_age_s",
    "perception.motion_compensation",
    "perception.join",
    "perception.match_poses",
    "perception.maps_bring_boxes",
    "perception.score_threshold",
    "perception.unsent_cells",
    "policy.replays",
    "record.views",
    "record.disagreement",
    "record.beliefs",
    "limits.run_s",  # it lasts as long as it is to last
    "metrics",
    "expect",
    "expect_decisions",
    "expect_no_other_changes",
)
"""Fields that change nothing in a live flight."""


def left_out(scenario: Scenario, vehicles: Collection[int] = ()) -> str:
    """One line that names what the scenario sets and the flight does not use; empty where that is nothing.

    Args:
        vehicles: drones with a MAVLink vehicle, which flies as its pilot wants.
    """
    fields = [path for path in UNUSED if _is_set(scenario, path)]
    fields += [f"fleet.makes.{k}.weights" for k, make in enumerate(scenario.fleet.makes) if make.weights is not None]
    events = [
        f"events.{k} ({event.kind}: {why})"
        for k, event in enumerate(scenario.events)
        if (why := event.why_not_live(getattr(event, "drone", None) in vehicles))
    ]
    return f"a live flight does not use {', '.join([*fields, *events])}" if fields or events else ""


def _is_set(scenario: Scenario, path: str) -> bool:
    """Whether a field differs from its default; a detector does where there is one."""
    section: BaseModel = scenario
    *sections, name = path.split(".")
    for each in sections:
        section = getattr(section, each)
    value = getattr(section, name)
    return bool(value != ("none" if path == "perception.detector" else type(section).model_fields[name].get_default()))
