"""The outcome's reference is what the code says, and what the code says is what a sortie gives."""

from __future__ import annotations

import math
import re
from pathlib import Path

import outcome_page
import pytest
from pydantic import ValidationError
from recorded import recorded
from sim_examples import example

from sortie import radio
from sortie.sim.check.golden import figures
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.engine.transport import OTHER_SPACE
from sortie.sim.results.outcome import OutcomeDict, check_number, fields, open_keys, outcome
from sortie.sim.results.outcome_fields import WALL, Outcome
from sortie.sim.results.record import ABOUT, TABLES
from sortie.sim.results.traffic import REASONS


def test_a_sortie_s_outcome_has_the_fields_of_the_reference() -> None:
    for name in ("broken_link", "person", "members", "faults", "surrogate"):
        outcome(recorded(name)).model()
    result = outcome(recorded("broken_link"))
    assert all(result[k] for k in ("transitions", "phases", "events", "drones", "payload_fates"))
    assert list(result) == list(Outcome.model_fields)
    wrong = {}
    for change, where, why in (
        ({"extra": 1}, ("extra",), "extra_forbidden"),
        ({"seed": 1.0}, ("seed",), "int_type"),
        ({"seed": -1}, ("seed",), "greater_than_equal"),
        ({"switches": "few"}, ("switches",), "float_type"),
        ({"context_share": 1.5}, ("context_share",), "less_than_equal"),
        ({"battery": {"0": 2.0}}, ("battery", "0"), "less_than_equal"),
        ({"metrics": {"own": math.inf}}, ("metrics", "own"), "finite_number"),
        ({"age_s": {"p50": 0.1}}, ("age_s", "p99"), "missing"),
        ({"events": [{"t_s": 1.0, "drone": True, "kind": "", "text": ""}]}, ("events", 0, "drone"), "int_type"),
    ):
        with pytest.raises(ValidationError) as caught:
            OutcomeDict({**result, **change}).model()
        if (found := [(e["loc"], e["type"]) for e in caught.value.errors()]) != [(where, why)]:
            wrong[where] = found
    assert wrong == {}


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
    found = {name for name, _, here in fields() if here.get("additionalProperties")}
    assert open_keys(1, 1, (), traced=False).keys() == found | {"phases"}
    rows = {name: (outcome_page.value(kind), outcome_page.unit(kind)) for name, kind, _ in fields()}
    wanted = {
        "ap50": ("object", ""),
        "ap50.mission": ("number, null", "share"),
        "drones": ("object", ""),
        "drones.*.voltage_v": ("number", "V"),
        "drones.*.airborne": ("true, false", ""),
        "battery": ("object of numbers", "share"),
        "payload_fates": ("object of whole numbers", ""),
        "own_files": ("object of texts", ""),
        "metrics": ("object of numbers or null", ""),
        "phases": ("list", ""),
        "phases[].context.lost_to.hidden": ("number, null", "share"),
        "transitions[].peers": ("list of whole numbers", ""),
        "transitions[].from": ("text", ""),
        "ap50.fusion": ("text, null", ""),
        "policy_eval_us.p99": ("number, null", "µs"),
    }
    assert {name: rows.get(name) for name in wanted} == wanted


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
