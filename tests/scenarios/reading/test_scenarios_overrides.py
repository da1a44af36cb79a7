"""Overrides of a scenario's fields, and sets of conditions."""

from __future__ import annotations

from pathlib import Path

import pytest

from sortie.scenarios.reading.campaign import read_any
from sortie.scenarios.reading.load import ScenarioError, as_texts, build, load, load_conditions, loads

BASE = """\
name: a
fleet: {battery: {initial_soc: 0.9}}
events:
  - {kind: drone_lost, at_s: 3, drone: 1}
  - {kind: drone_lost, at_s: 5, drone: 2}
"""


def error_of(text: str, *overrides: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        loads(text, "my.yaml", overrides)
    return str(caught.value)


def test_overrides_replace_and_add() -> None:
    scenario = loads(
        BASE,
        overrides=[
            "fleet.battery.initial_soc=0.5",
            "events.1.at_s=30",
            "radio.bandwidth_mhz=20",
            "policy.params={rho: 0.25}",
            "policy.params.k=2",
            "fleet.route.waypoints_m=[[0, 0], [80, 0]]",
            "seed=2",
            "seed=3",
        ],
    )
    assert scenario.fleet.battery.initial_soc == 0.5
    assert [event.at_s for event in scenario.events] == [3, 30]
    assert scenario.radio.bandwidth_mhz == 20
    assert scenario.policy.params == {"rho": 0.25, "k": 2}
    assert scenario.fleet.route.waypoints_m == ((0, 0), (80, 0))
    assert scenario.seed == 3, "the last one wins"


def test_an_override_sets_a_field_of_a_section_whether_it_is_there_empty_or_not() -> None:
    for written in ("", "fleet:\n", "fleet: {}\n", "fleet: {drones: 4}\n"):
        assert loads(f"name: mine\n{written}", overrides=("fleet.drones=3",)).fleet.drones == 3
    assert build({"name": "mine", "fleet": None}, {"fleet.formation.spacing_m": 7.0}).fleet.formation.spacing_m == 7.0
    assert loads("name: a\nduration_s: yes", overrides=["duration_s=5"]).duration_s == 5, "it mends the file"


def test_an_override_of_an_alias_leaves_its_anchor_alone() -> None:
    target = "mission: {target: {waypoints_m: &way [[0, 0], [80, 0]]}}"
    text = f"name: a\n{target}\nfleet: {{route: {{waypoints_m: *way}}}}\n"
    assert loads(text).fleet.route.waypoints_m == ((0.0, 0.0), (80.0, 0.0))
    scenario = loads(text, overrides=["fleet.route.waypoints_m.1.0=160"])
    assert scenario.fleet.route.waypoints_m[1] == (160, 0)
    assert scenario.mission.target is not None
    assert scenario.mission.target.waypoints_m[1] == (80, 0)


PHASES = "mission.phases.0: no such entry, the scenario does not write mission.phases; set it whole"
BROKEN = {
    "fleet.batery.initial_soc=0.5": "fleet.batery: unknown key, did you mean battery?",
    "fleet.battery.initial_soc=1.5": "fleet.battery.initial_soc: 1.5, must be ≤ 1",
    "fleet.battery.initial_soc='0.5'": 'fleet.battery.initial_soc: "0.5", must be a number, write it without quotes',
    "fleet.drones=yes": "fleet.drones: yes, must be a whole number",
    "fleet.drones=": "fleet.drones: nothing, must be a whole number",
    "fleet={drones: 3, dornes: 4}": "fleet.dornes: unknown key, did you mean drones?",
    "events.2.at_s=30": "events.2: no such entry, events has 0 … 1",
    "events.-1.at_s=30": "events.-1: no such entry, events has 0 … 1",
    "events.at_s=30": "events.at_s: no such entry, events has 0 … 1",
    "events.1.drone=9": "events.1.drone: 9, must be below fleet.drones = 5",
    "mission.phases.0.at_s=3": PHASES,
    "name.x=3": 'name.x: no such field, name is the value "a"',
    "seed": "must be key.path=value",
    "=3": "must be key.path=value",
    "a..b=3": "must be key.path=value",
    "seed=!!int 3": "seed: tag !!int is not allowed, values are plain",
    "seed=*x": "alias *x has no anchor before it",
    "a.b.c.d.e.f.g.h.i.j.k.l.m.n.o.p.q.r.s.t.u=3": "21 levels deep, must be at most 20",
    "seed=\x07": "character U+0007 is not allowed in YAML",
}


def test_a_broken_override_gives_one_line() -> None:
    said = {override: error_of(BASE, override) for override in BROKEN}
    shown = {override: override.replace("\x07", "\\x07") for override in BROKEN}
    assert said == {override: f"--set {shown[override]}: {what}" for override, what in BROKEN.items()}


def test_mistakes_are_told_in_the_file_s_order_and_those_of_overrides_last() -> None:
    assert error_of("name: a\nseed: -1", "radio.x=1") == "my.yaml:2: seed: -1, must be ≥ 0 (and 1 more)"
    with pytest.raises(ScenarioError) as caught:
        loads("name: a\nseed: -1\nduration_s: 0\n", "f.yaml", ["fleet.drones=0"])
    assert [issue.split(":")[1] for issue in caught.value.issues][:2] == ["2", "3"]
    assert "fleet.drones" in caught.value.issues[-1]


def test_only_what_an_override_shortens_is_left_out() -> None:
    """What the file itself, or another override, does after the end is a mistake."""
    lost = "events: [{kind: drone_lost, drone: 0, at_s: 3}]"
    text = f"name: a\nduration_s: 9\n{lost}\n"
    assert loads(text, overrides=["duration_s=3"]).events == ()
    assert len(loads(text, overrides=["duration_s=3.1"]).events) == 1
    late = 'events=[{"kind": "drone_lost", "drone": 0, "at_s": 4}]'
    assert "must be below duration_s = 4" in error_of(text, "duration_s=4", late)
    assert "must be below duration_s = 3" in error_of(f"name: a\nduration_s: 3\n{lost}\n", "seed=2")


def test_overrides_of_a_map_are_the_same_as_texts() -> None:
    overrides = {"name": "on", "description": "a: b, é # 1", "duration_s": 1.5, "expect": []}
    overrides["fleet.formation"] = {"shape": "line", "spacing_m": 10}
    sections = {"name": "a", "radio": {"tx_power_dbm": 1}}
    assert build(sections, as_texts(overrides)) == build(sections, overrides)
    assert as_texts(["duration_s=3"]) == ["duration_s=3"]


def test_the_base_of_a_set_of_conditions_lies_beside_its_file(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("base: mine.yaml\nconditions: [{name: a, budget: 0.1}]\n")
    with pytest.raises(ScenarioError, match=r"c\.yaml:1: base: .*mine\.yaml: no such file"):
        load_conditions(path)
    (tmp_path / "mine.yaml").write_text("name: mine\n")
    conditions = load_conditions(path)
    assert conditions is not None
    assert load(conditions.base).name == "mine"


def test_to_read_a_set_of_conditions_finds_what_is_wrong_with_each_of_its_scenarios(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    one, other = "{name: a, budget: 0.1, set: [duration_s=-1]}", "{name: b, budget: 0.1, set: [context.rate_hz=0]}"
    path.write_text(f"base: track_target\nset: [fleet.dronez=3]\nconditions:\n  - {one}\n  - {other}\n")
    with pytest.raises(ScenarioError) as caught:
        read_any(path)
    assert [issue.partition(": ")[2].partition(", ")[0] for issue in caught.value.issues] == [
        "condition a: --set duration_s=-1: duration_s: -1",
        "condition a: --set fleet.dronez=3: fleet.dronez: unknown key",
        "condition b: --set context.rate_hz=0: context.rate_hz: 0",
    ]
