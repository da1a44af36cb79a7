"""Sections that may be given as a preset's name: a drone's airframe and the form of its descriptors."""

from __future__ import annotations

import json

import pytest

from sortie.scenarios.reading.load import ScenarioError, dump, loads
from sortie.scenarios.schema import Airframe, DescriptorForm, json_schema


def test_a_name_stands_for_the_presets_values() -> None:
    scenario = loads("name: a\ncontext: {form: small}\nfleet: {airframe: solo}\n")
    assert scenario.context.form == DescriptorForm(grid_cells=8, grid_bits=1, number_bits=16)
    assert scenario.fleet.airframe.mass_kg == 1.88
    assert loads(dump(scenario)) == scenario


def test_without_a_name_the_values_are_those_of_the_first_preset() -> None:
    first = loads("name: a\ncontext: {form: paper}\nfleet: {airframe: zeng_2019}\n")
    assert first == loads("name: a\n")


def test_single_values_stay_settable() -> None:
    scenario = loads("name: a\ncontext: {form: {grid_cells: 4}}\n", overrides=["fleet.airframe.payload_kg=0.3"])
    assert scenario.context.form == DescriptorForm(grid_cells=4)
    assert scenario.fleet.airframe == Airframe(payload_kg=0.3)


def test_an_override_changes_one_value_of_a_preset() -> None:
    scenario = loads("name: a\n", overrides=["context.form=small", "context.form.number_bits=12"])
    assert scenario.context.form == DescriptorForm(grid_cells=8, grid_bits=1, number_bits=12)


@pytest.mark.parametrize("section", [Airframe, DescriptorForm])
def test_every_preset_is_valid_and_differs_from_the_others(section: type[Airframe] | type[DescriptorForm]) -> None:
    made = [section.model_validate(name).model_dump_json() for name in section.presets]
    assert len(set(made)) == len(made)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("context: {form: papers}", "2: context.form: 'papers', must be paper, grid_8"),
        ("context: {form: 3}", "2: context.form: 3, must be a section"),
        ("fleet: {airframe: {mass: 3}}", "2: fleet.airframe.mass: unknown key, did you mean mass_kg?"),
        ("context: {grid_cells: 8}", "2: context.grid_cells: unknown key, it belongs in context.form"),
        ("context: {grid_bits: 1}", "2: context.grid_bits: unknown key, it belongs in context.form"),
        ("context: {number_bits: 8}", "2: context.number_bits: unknown key, it belongs in context.form"),
        (
            "fleet: {battery: {polarisation_mohm: 5}}",
            "2: fleet.battery.polarisation_mohm: unknown key, did you mean polarisation?",
        ),
        (
            "fleet: {battery: {polarisation_time_s: 5}}",
            "2: fleet.battery.polarisation_time_s: unknown key, did you mean polarisation?",
        ),
    ],
)
def test_wrong_names_and_old_keys_are_refused(text: str, what: str) -> None:
    with pytest.raises(ScenarioError) as error:
        loads(f"name: a\n{text}\n", "s.yaml")
    assert f"s.yaml:{what}" in str(error.value)


def test_editors_accept_a_name_or_a_section() -> None:
    schema = json_schema()
    form = schema["$defs"]["Context"]["properties"]["form"]
    assert form["anyOf"] == [{"enum": list(DescriptorForm.presets)}, {"$ref": "#/$defs/DescriptorForm"}]
    assert json.dumps(schema)


def test_an_override_changes_one_value_of_a_makes_preset() -> None:
    text = "name: a\nfleet: {makes: [{name: m, drones: [1], airframe: {mass_kg: 5}}, {name: k, drones: [2], airframe: solo}]}\n"
    _, make = loads(text, overrides=["fleet.makes.1.airframe.payload_kg=0.3"]).fleet.makes
    assert make.airframe == Airframe.model_validate({**Airframe.presets["solo"], "payload_kg": 0.3})
