"""What editors and readers are shown is what the schema says."""

from __future__ import annotations

import json
from pathlib import Path

import fields_page
import pytest

from sortie.scenarios.reading.load import library, loads
from sortie.scenarios.schema import Scenario

REMEDY = "run python docs/site/fields_page.py"


def test_schema_json_is_current() -> None:
    assert (fields_page.SCENARIOS / "schema.json").read_text("utf-8") == fields_page.schema_text(), REMEDY


def test_the_readmes_tables_are_current() -> None:
    readme = (fields_page.SCENARIOS / "README.md").read_text("utf-8")
    assert readme == fields_page.readme_text(readme), REMEDY
    assert fields_page.fields_markdown() in readme


def test_the_readmes_example_is_a_scenario() -> None:
    readme = (fields_page.SCENARIOS / "README.md").read_text("utf-8")
    example = readme.partition("```yaml\n")[2].partition("```")[0]
    assert loads(example).name == "over_the_valley"


def test_every_field_of_the_schema_is_described() -> None:
    schema = json.loads(fields_page.schema_text())
    for section in (schema, *schema["$defs"].values()):
        for name, field in section["properties"].items():
            assert "description" in field or "$ref" in field or name == "kind", f"{section['title']}.{name}"


def test_the_tables_show_bounds_and_defaults() -> None:
    tables = fields_page.fields_markdown()
    assert "| `initial_soc` | number, > 0, ≤ 1 | 0.95 |" in tables
    assert "| `waypoints_m` | list of (2 × number, ≥ -5000, ≤ 5000) | must be given |" in tables


def test_write_makes_both_files_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "README.md").write_text(f"# before\n{fields_page.BEGIN}\nstale table\n{fields_page.END}\nafter\n")
    monkeypatch.setattr(fields_page, "SCENARIOS", tmp_path)
    fields_page.write()
    readme = (tmp_path / "README.md").read_text("utf-8")
    assert readme.startswith("# before\n")
    assert readme.endswith("\nafter\n")
    assert "stale table" not in readme
    assert "**fleet.battery**" in readme
    assert json.loads((tmp_path / "schema.json").read_text("utf-8"))["title"] == "Scenario"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["README.md", "schema.json"]


@pytest.mark.parametrize("name", library())
def test_library_files_point_editors_to_the_schema(name: str) -> None:
    first = library()[name].read_text("utf-8").split("\n", 1)[0]
    assert first == "# yaml-language-server: $schema=../schema.json"
    assert (library()[name].parent / "../schema.json").samefile(fields_page.SCENARIOS / "schema.json")


def test_units_stand_in_names() -> None:
    """A number that has a dimension says so in its name."""
    unitless = {
        "seed",
        "drones",
        "drone",
        "egos",
        "peer",
        "cells",
        "cpu_cores",
        "driving_cores",
        "initial_soc",
        "drivetrain_efficiency",
        "landing_soc",
        "path_loss_exponent",
        "retry_limit",
        "max_ampdu_frames",
        "overcast",
        "brightness",
        "degraded_after_periods",
        "detached_after_periods",
        "score_threshold",
        "building_density",
        "tree_density",
        "trucks",
        "parked_density",
        "lost_fraction",
        "at_least",
        "hysteresis",
        "at_most",
        "tolerance",
        "publish_every",
        "grid_cells",
        "grid_bits",
        "number_bits",
        "confidence",
        "moving_cars_per_km",
        "near_probability",
        "relay_max_hops",
        "aifsn",  # slots, by the standard's own names
        "cw_min",
        "cw_max",
        "block_ack_window",
        "good_to_bad",
        "bad_to_good",
        "loss_good",
        "loss_bad",
        "figure_of_merit",
        "cycles",
        "life_cycles",
        "target",
    }
    units = {
        "m",
        "s",
        "hz",
        "mps",
        "degps",
        "mps2",
        "db",
        "dbm",
        "ghz",
        "mhz",
        "mbps",
        "w",
        "wh",
        "mohm",
        "deg",
        "bytes",
        "px",
        "kg",
        "m2",
        "kgpm3",
        "ppm",
        "min",
        "v",
        "c",
    }
    schema = Scenario.model_json_schema()
    for section in (schema, *schema["$defs"].values()):
        for name, field in section["properties"].items():
            kinds = {field.get("type"), *(member.get("type") for member in field.get("anyOf", []))}
            if kinds & {"number", "integer"} and kinds <= {"number", "integer", "null"}:
                assert name in unitless or name.rpartition("_")[2] in units, f"{section['title']}.{name}"
