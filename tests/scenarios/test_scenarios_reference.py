"""What editors are shown is what the schema says, and a number with a dimension says so in its name."""

from __future__ import annotations

import json

import fields_page

from sortie.scenarios.reading.load import library
from sortie.scenarios.schema import Scenario

UNITLESS = """
    seed drones drone egos peer cells cpu_cores driving_cores initial_soc drivetrain_efficiency landing_soc
    path_loss_exponent retry_limit max_ampdu_frames overcast brightness degraded_after_periods detached_after_periods
    score_threshold building_density tree_density trucks parked_density lost_fraction at_least hysteresis at_most
    tolerance publish_every grid_cells grid_bits number_bits confidence moving_cars_per_km near_probability
    relay_max_hops aifsn cw_min cw_max block_ack_window good_to_bad bad_to_good loss_good loss_bad figure_of_merit
    cycles life_cycles target
"""
UNITS = "m s hz mps degps mps2 db dbm ghz mhz mbps w wh mohm deg bytes px kg m2 kgpm3 ppm min v c"


def test_schema_json_is_current_and_library_files_point_editors_to_it() -> None:
    written = (fields_page.SCENARIOS / "schema.json").read_text("utf-8")
    readme = (fields_page.SCENARIOS / "README.md").read_text("utf-8")
    assert written == fields_page.schema_text(), "run python docs/site/fields_page.py"
    assert readme == fields_page.readme_text(readme), "run python docs/site/fields_page.py"
    for path in library().values():
        assert path.read_text("utf-8").split("\n", 1)[0] == "# yaml-language-server: $schema=../schema.json"
        assert (path.parent / "../schema.json").samefile(fields_page.SCENARIOS / "schema.json")


def test_every_field_of_the_schema_is_described() -> None:
    schema = json.loads(fields_page.schema_text())
    for section in (schema, *schema["$defs"].values()):
        for name, field in section["properties"].items():
            assert "description" in field or "$ref" in field or name == "kind", f"{section['title']}.{name}"


def test_units_stand_in_names() -> None:
    schema, without = Scenario.model_json_schema(), set()
    for section in (schema, *schema["$defs"].values()):
        for name, field in section["properties"].items():
            kinds = {field.get("type"), *(member.get("type") for member in field.get("anyOf", []))}
            is_number = kinds & {"number", "integer"} and kinds <= {"number", "integer", "null"}
            if is_number and name not in UNITLESS.split() and name.rpartition("_")[2] not in UNITS.split():
                without.add(f"{section['title']}.{name}")
    assert without == set()
