"""What a scenario says without effect: missions and phases that begin after its end, fields that its other choices leave unread.

None of it is an error: missions are flown shortened, and a file may keep a field for another model. Each is one line.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from typing import Any, NamedTuple

from pydantic import BaseModel

from sortie.scenarios.schema import Scenario


class Unread(NamedTuple):
    """Fields that a flight does not read, by what another field says."""

    fields: tuple[str, ...]
    decider: str
    """The other field, by its dotted name."""
    is_unread: Callable[[Any], bool]
    """Of the other field's value."""


UNREAD = (
    Unread(("radio.path_loss_exponent",), "radio.path_loss", lambda model: model != "log_distance"),
    Unread(("radio.ground_roughness_m",), "radio.path_loss", lambda model: model != "two_ray"),
    Unread(
        ("radio.shadowing_time_s", "radio.shadowing_distance_m"),
        "radio.shadowing_sigma_db",
        lambda sigma_db: sigma_db == 0,
    ),
    Unread(
        ("radio.bursts.bad_to_good", "radio.bursts.step_s", "radio.bursts.loss_bad"),
        "radio.bursts.good_to_bad",
        lambda probability: probability == 0,
    ),
    Unread(("radio.link_params",), "radio.link", lambda model: model is None),
    Unread(
        ("perception.recording", "perception.recorded_fusion"),
        "perception.detector",
        lambda detector: detector != "recorded",
    ),
    Unread(
        ("perception.weights", "perception.fusion", "perception.score_threshold", "perception.join", "perception.egos"),
        "perception.detector",
        lambda detector: detector == "none",
    ),
    Unread(("fleet.battery.life_cycles",), "fleet.battery.cycles", lambda cycles: cycles == 0),
    Unread(
        ("fleet.battery.polarisation.time_s",),
        "fleet.battery.polarisation.resistance_mohm",
        lambda resistance_mohm: resistance_mohm == 0,
    ),
)
EDCA = tuple(
    f"radio.edca.{access}.{name}"
    for access in ("voice", "video", "best_effort", "background")
    for name in ("aifsn", "cw_min", "cw_max")
)
"""Read where descriptors or payloads are of their class."""


def remarks(scenario: Scenario) -> list[str]:
    """A line for each thing that the scenario says without effect.

    >>> from sortie.scenarios.reading.load import build
    >>> remarks(build({"name": "a", "radio": {"path_loss": "free_space", "path_loss_exponent": 3.0}}))
    ['radio.path_loss_exponent is not read, as radio.path_loss is free_space']
    """
    written = [field for rule in UNREAD for field in rule.fields if _is_written(scenario, field)]
    written += [field for field in EDCA if _is_written(scenario, field)]
    return [*_after_the_end(scenario), *(line for field in written if (line := unread(scenario, field)))]


def unread(scenario: Scenario, field: str, varied: Collection[str] = ()) -> str | None:
    """Why a flight does not read a field, by its dotted name, as a line; None if it does.

    A campaign that varies such a field flies the same sortie again and again.

    Args:
        varied: fields that have other values in other flights.
    """
    for rule in UNREAD:
        value = _value(scenario, rule.decider)
        if field in rule.fields and rule.decider not in varied and rule.is_unread(value):
            return f"{field} is not read, as {rule.decider} is {'left out' if value is None else value}"
    access = field.split(".")[2] if field.startswith("radio.edca.") else None
    if access is not None and access not in (scenario.radio.context_class, scenario.radio.payload_class):
        return f"{field} is not read, as neither radio.context_class nor radio.payload_class is {access}"
    return None


def _after_the_end(scenario: Scenario) -> Iterator[str]:
    """A line for each list of what begins at or after the end."""
    begins_s = {"mission.phases": [phase.at_s for phase in scenario.mission.phases]}
    for k, group in enumerate(scenario.mission.groups):
        begins_s[f"mission.groups.{k}.phases"] = [phase.at_s for phase in group.phases]
    begins_s["perception.people"] = [person.begin_s for person in scenario.perception.people]
    for where, each in begins_s.items():
        late = sum(at_s >= scenario.duration_s for at_s in each)
        if late:
            end = f"duration_s = {scenario.duration_s:g}"
            yield f"{where}: {late} of {len(each)} begin at {end} or later, and never come"


def _value(scenario: Scenario, field: str) -> Any:
    value: Any = scenario
    for part in field.split("."):
        value = getattr(value, part)
    return value


def _is_written(scenario: Scenario, field: str) -> bool:
    """Whether the field has another value than it has by itself."""
    *sections, name = field.split(".")
    section: BaseModel = _value(scenario, ".".join(sections))
    return bool(getattr(section, name) != type(section).model_fields[name].get_default())
