"""The outcome's reference is what the code says, and what the code says is what a sortie gives."""

from __future__ import annotations

import re
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypedDict, get_args, get_origin, get_type_hints, is_typeddict

import outcome_page
import pytest
from recorded import recorded
from sim_examples import example

from sortie import radio
from sortie.sim.check.golden import figures
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.engine.transport import OTHER_SPACE
from sortie.sim.results.outcome import outcome
from sortie.sim.results.outcome_fields import REASONS, WALL, Outcome, check_number, open_keys
from sortie.sim.results.record import ABOUT, TABLES


class Leaf(TypedDict):
    x: Annotated[float | None, "A number."]


class Tree(TypedDict):
    one: Annotated[Leaf, "One."]
    named: Annotated[dict[str, Leaf], "By name."]
    many: Annotated[list[Leaf], "In a row."]
    counts: Annotated[dict[str, int], "Counted."]


def faults(value: Any, kind: Any, path: str) -> list[str]:
    """Where a value is not of its kind; a typed dictionary has all of its keys and no other."""
    origin, of = get_origin(kind), get_args(kind)
    if is_typeddict(kind):
        hints = get_type_hints(kind)
        wrong = [f"{path}: keys {sorted(set(value) ^ set(hints))}"] if set(value) != set(hints) else []
        return wrong + [f for k in set(value) & set(hints) for f in faults(value[k], hints[k], f"{path}.{k}")]
    if origin is dict:
        return [f for k, v in value.items() for f in faults(k, of[0], path) + faults(v, of[1], f"{path}.{k}")]
    if origin is list:
        return [f for k, v in enumerate(value) for f in faults(v, of[0], f"{path}[{k}]")]
    if origin is UnionType:
        return [] if any(not faults(value, member, path) for member in of) else [f"{path}: {value!r}"]
    fits = type(value) in ((int, float) if kind is float else (kind,))
    return [] if fits else [f"{path}: {value!r} is no {kind.__name__}"]


def test_a_sortie_s_outcome_has_the_fields_of_the_reference() -> None:
    for name in ("broken_link", "person", "members", "faults"):
        assert faults(outcome(recorded(name)), Outcome, "outcome") == []
    result = outcome(recorded("broken_link"))
    assert all(result[k] for k in ("transitions", "phases", "events", "drones", "payload_fates"))
    event = {"t_s": 1.0, "drone": True, "kind": "", "text": ""}
    for change, fault in (
        ({"extra": 1}, "outcome: keys ['extra']"),
        ({"seed": 1.0}, "outcome.seed: 1.0 is no int"),
        ({"switches": "few"}, "outcome.switches: 'few'"),
        ({"age_s": {"p50": 0.1}}, "outcome.age_s: keys ['p99']"),
        ({"events": [event]}, "outcome.events[0].drone: True is no int"),
    ):
        assert faults({**result, **change}, Outcome, "outcome") == [fault]


def test_every_number_of_an_outcome_may_be_named() -> None:
    """A flight of its own, with losses, drops and doubts. What is no number, or wall clock, may not."""
    flown = example(
        "radio={framing: tiles, tx_power_dbm: -4, bandwidth_mhz: 20}",
        "policy.changes=[{at_s: 4, name: silence}]",
        "events=[{kind: drone_lost, at_s: 2, drone: 3}, {kind: spoof, at_s: 1, drone: 1, until_s: 3},"
        " {kind: lie, at_s: 1, drone: 1, about: battery}]",
    )
    result = outcome(run_sortie(flown))
    assert {s.partition("/")[0] for s in result["payload_fates"]} >= {"delivered", "lost", "expired", "partial"}
    assert result["distrusted_by"]
    keys = open_keys(5, len(result["phases"]), result["policies"]["decisions"], traced=False)
    numbers = 0
    for name, value in figures(result).items():
        if isinstance(value, int | float) and not name.startswith("policies.decisions.worked("):  # a dot in its rho
            check_number(name, keys)
            numbers += 1
        elif isinstance(value, str):
            with pytest.raises(ValueError, match="is text, a metric must be a number"):
                check_number(name, keys)
    assert numbers > 50
    for name in ("wall_s", "policy_eval_us.p50"):
        assert name.partition(".")[0] in WALL
        with pytest.raises(ValueError, match="is wall clock"):
            check_number(name, keys)


def test_what_may_be_keyed_is_known_of_every_object_that_is_open() -> None:
    found = {path for path, value, _ in outcome_page.fields(Outcome) if value.startswith("object of")}
    found |= {path.partition(".*")[0] for path, _, _ in outcome_page.fields(Outcome) if ".*" in path}
    assert open_keys(1, 1, (), traced=False).keys() == found | {"phases"}
    assert list(outcome_page.fields(Tree)) == [
        ("one", "object", "One."),
        ("one.x", "number, null", "A number."),
        ("named", "object", "By name."),
        ("named.*.x", "number, null", "A number."),
        ("many", "list", "In a row."),
        ("many[].x", "number, null", "A number."),
        ("counts", "object of whole numbers", "Counted."),
    ]


def test_the_reasons_of_fates_are_those_that_the_radio_gives() -> None:
    text = "".join(path.read_text("utf-8") for path in sorted(Path(radio.__path__[0]).glob("*.py")))
    said = re.findall(r"_close\(\w+, _(?:LOST|EXPIRED), (.*)\)|^ +reason = (.*)$", text, re.MULTILINE)
    given = {word for line in said for word in re.findall(r'"(\w+)"', "".join(line))}
    assert given | {OTHER_SPACE} == {reason for reasons in REASONS.values() for reason in reasons if reason}


def test_the_page_is_current_and_describes_every_table() -> None:
    assert outcome_page.PAGE.read_text("utf-8") == outcome_page.page(), "run python docs/site/outcome_page.py"
    assert list(ABOUT) == list(TABLES)
    assert all(ABOUT.values())
    assert [c for columns in TABLES.values() for c in columns if f"`{c}`" not in outcome_page.page()] == []
