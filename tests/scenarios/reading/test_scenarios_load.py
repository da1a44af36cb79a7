"""Good scenarios load and come back equal; broken ones give exactly the line that their first line promises."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

import sortie.scenarios.reading.load as loader
from sortie.scenarios.reading import strict_yaml
from sortie.scenarios.reading.campaign import read_any
from sortie.scenarios.reading.load import ScenarioError, as_texts, build, dump, library, load, load_conditions, loads
from sortie.scenarios.schema import PolicySection, Scenario

BROKEN = sorted((Path(__file__).parent / "broken").glob("*.yaml"))
PARSERS = {"python": yaml.SafeLoader, "libyaml": getattr(yaml, "CSafeLoader", None)}


def error_of(text: str, *overrides: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        loads(textwrap.dedent(text), "my.yaml", overrides)
    return str(caught.value)


# --- broken scenarios ----------------------------------------------------------------------------


def expected_of(path: Path) -> str:
    sidecar = path.with_suffix(".expected")  # for files that cannot hold a comment
    if sidecar.exists():
        return sidecar.read_text("utf-8").rstrip("\n")
    return path.read_text("utf-8").split("\n", 1)[0].removeprefix("# ")


@pytest.mark.parametrize("parser", PARSERS)
@pytest.mark.parametrize("path", BROKEN, ids=lambda path: path.stem)
def test_a_broken_scenario_gives_its_one_line(path: Path, parser: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if PARSERS[parser] is None:
        pytest.skip("PyYAML without libyaml")
    monkeypatch.setattr(strict_yaml, "_Parser", PARSERS[parser])
    with pytest.raises(ScenarioError) as caught:
        load(path)
    said, expected = str(caught.value).removeprefix(f"{path.parent}/"), expected_of(path)
    if parser == "python":  # the two parsers word syntax errors differently; the place is the same
        said, expected = said.partition("not YAML")[0], expected.partition("not YAML")[0]
    assert said == expected


def test_there_are_enough_broken_scenarios() -> None:
    assert len(BROKEN) >= 80


@pytest.mark.parametrize("path", BROKEN, ids=lambda path: path.stem)
def test_a_broken_scenario_is_broken_by_its_rule_alone(path: Path) -> None:
    """`(and N more)` stands only where several errors are the point."""
    assert ("more)" in expected_of(path)) == (path.stem in {"several", "nothing_for_section"})


def test_a_missing_file_names_what_was_probably_meant(tmp_path: Path) -> None:
    (tmp_path / "valley.yaml").write_text("name: valley")
    for name, hint in (
        (tmp_path / "valey.yaml", "did you mean valley.yaml?"),
        ("track_targt", "did you mean track_target?"),
        ("link_batery", "did you mean link_battery?"),  # a campaign
        (
            "zzz.yaml",
            "the library has paper_context, paper_replay, person_crossing, search_grid, track_target, two_groups, two_makes",
        ),
    ):
        with pytest.raises(ScenarioError) as caught:
            load(name)
        assert str(caught.value) == f"{name}: no such file, {hint}"


def test_files_that_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    big = tmp_path / "big.yaml"
    big.write_text("name: big\n#" + "x" * loader.MAX_BYTES)
    for path, what in (
        (tmp_path, "is a directory, must be a scenario file"),
        (big, "more than 1000000 bytes, a scenario must have at most that"),
        (tmp_path / ("x" * 300), "cannot be read, File name too long"),
    ):
        with pytest.raises(ScenarioError) as caught:
            load(path)
        assert str(caught.value) == f"{path}: {what}"

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, os.strerror(13))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(ScenarioError, match=r"big\.yaml: cannot be read, Permission denied$"):
        load(big)


def test_an_error_is_one_line_whatever_the_file_holds() -> None:
    said = error_of('name: a\n"x\\ny\\u2028\\e[2J": 3\n')
    assert said.startswith("my.yaml:2: x\\ny\\u2028\\x1b[2J: unknown key")
    assert said.isprintable()


def test_the_first_error_in_the_order_of_the_file_is_shown() -> None:
    said = error_of("""\
        policy: {params: {a: yes}}
        name: a
        radio: {bandwidth: 80}
        duration_s: -1
        """)
    assert (
        said == "my.yaml:1: policy.params.a: yes, write true or false, or put it in quotes if it is text (and 2 more)"
    )


def test_an_error_inside_an_alias_points_to_the_text_it_stands_for() -> None:
    said = error_of("""\
        name: a
        mission:
          target: {waypoints_m: &way [[0, 0], [9e9, 0]]}
        fleet: {route: {waypoints_m: *way}}
        """)
    assert said == "my.yaml:3: fleet.route.waypoints_m.1.0: 9e9, must be ≤ 5000 (and 1 more)"


# --- what is read --------------------------------------------------------------------------------


PLAIN: dict[str, Any] = {
    "-3": -3,
    "0": 0,
    "+2": 2,
    "1e3": 1000.0,
    ".5": 0.5,
    "5.": 5.0,
    "true": True,
    "FALSE": False,
    "word": "word",
    "'0.5'": "0.5",
    "'yes'": "yes",
    "2026-11-20": "2026-11-20",
    "1.2.3": "1.2.3",
    "null_": "null_",
    "1e": "1e",
    "~x": "~x",
    "y": "y",
}


@pytest.mark.parametrize("text", PLAIN)
def test_plain_values_are_read_as_yaml_1_2_has_them(text: str) -> None:
    value = loads("name: a", overrides=[f"policy.params.v={text}"]).policy.params["v"]
    assert (type(value), value) == (type(PLAIN[text]), PLAIN[text])


AMBIGUOUS = [
    "yes",
    "No",
    "ON",
    "off",
    "1_000",
    "0x1F",
    "0b1",
    "0o17",
    "017",
    "-007",
    "1:30",
    "190:20:30.15",
    "01.5",
    "1__0",
]


@pytest.mark.parametrize("text", AMBIGUOUS)
def test_what_yaml_1_1_and_1_2_read_differently_is_refused_as_text_and_as_number(text: str) -> None:
    assert error_of(f"name: a\npolicy: {{name: {text}}}").startswith(f"my.yaml:2: policy.name: {text}, write ")
    assert error_of(f"name: a\nduration_s: {text}").startswith(f"my.yaml:2: duration_s: {text}, must be a number")
    assert loads(f"name: a\npolicy: {{name: '{text}'}}").policy.name == text


def test_a_whole_number_does_for_a_number_and_no_other_way_round() -> None:
    assert loads("name: a\nduration_s: 30").duration_s == 30.0
    assert "must be a whole number" in error_of("name: a\nseed: 30.0")


def test_anchors_within_bounds_may_be_used() -> None:
    scenario = loads("""
        name: a
        mission: {target: {waypoints_m: &way [[0, 0], [80, 0]]}}
        fleet: {route: {waypoints_m: *way}}
        """)
    assert scenario.fleet.route.waypoints_m == ((0.0, 0.0), (80.0, 0.0))


def test_a_byte_order_mark_and_windows_line_ends_do_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xef\xbb\xbfname: a\r\nduration_s: 0\r\n")
    with pytest.raises(ScenarioError, match=r"a\.yaml:2: duration_s: 0, must be ≥ 0\.001$"):
        load(path)


# --- overrides -----------------------------------------------------------------------------------

BASE = """\
name: a
fleet: {battery: {initial_soc: 0.9}}
events:
  - {kind: drone_lost, at_s: 3, drone: 1}
  - {kind: drone_lost, at_s: 5, drone: 2}
"""


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


@pytest.mark.parametrize(
    "field",
    ["duration_s", "context.rate_hz", "perception.sample_rate_hz", "perception.tracking_rate_hz", "events.0.rate_hz"],
)
def test_durations_and_rates_are_no_smaller_than_a_flight_can_count(field: str) -> None:
    text = "name: a\nevents: [{kind: spoof, at_s: 0, drone: 0, rate_hz: 1}]"
    with pytest.raises(ScenarioError, match=f"{field}: 0.00099, must be ≥ 0.001"):
        loads(text, overrides=[f"{field}=0.00099"])


@pytest.mark.parametrize("written", ["", "fleet:\n", "fleet: {}\n", "fleet: {drones: 4}\n"])
def test_an_override_sets_a_field_of_a_section_whether_it_is_there_empty_or_not(written: str) -> None:
    assert loads(f"name: mine\n{written}", overrides=("fleet.drones=3",)).fleet.drones == 3
    assert build({"name": "mine", "fleet": None}, {"fleet.formation.spacing_m": 7.0}).fleet.formation.spacing_m == 7.0


def test_an_override_mends_what_the_file_has_wrong() -> None:
    assert loads("name: a\nduration_s: yes", overrides=["duration_s=5"]).duration_s == 5


def test_an_override_of_an_alias_leaves_its_anchor_alone() -> None:
    text = """
        name: a
        mission: {target: {waypoints_m: &way [[0, 0], [80, 0]]}}
        fleet: {route: {waypoints_m: *way}}
        """
    scenario = loads(text, overrides=["fleet.route.waypoints_m.1.0=160"])
    assert scenario.fleet.route.waypoints_m[1] == (160, 0)
    assert scenario.mission.target is not None
    assert scenario.mission.target.waypoints_m[1] == (80, 0)


@pytest.mark.parametrize(
    ("override", "what"),
    [
        ("fleet.batery.initial_soc=0.5", "fleet.batery: unknown key, did you mean battery?"),
        ("fleet.battery.initial_soc=1.5", "fleet.battery.initial_soc: 1.5, must be ≤ 1"),
        ("fleet.battery.initial_soc='0.5'", 'fleet.battery.initial_soc: "0.5", must be a number, write it without quotes'),
        ("fleet.drones=yes", "fleet.drones: yes, must be a whole number"),
        ("fleet.drones=", "fleet.drones: nothing, must be a whole number"),
        ("fleet={drones: 3, dornes: 4}", "fleet.dornes: unknown key, did you mean drones?"),
        ("events.2.at_s=30", "events.2: no such entry, events has 0 … 1"),
        ("events.-1.at_s=30", "events.-1: no such entry, events has 0 … 1"),
        ("events.at_s=30", "events.at_s: no such entry, events has 0 … 1"),
        ("events.1.drone=9", "events.1.drone: 9, must be below fleet.drones = 5"),
        ("mission.phases.0.at_s=3", "mission.phases.0: no such entry, the scenario does not write mission.phases; set it whole"),
        ("name.x=3", 'name.x: no such field, name is the value "a"'),
        ("seed", "must be key.path=value"),
        ("=3", "must be key.path=value"),
        ("a..b=3", "must be key.path=value"),
        ("seed=!!int 3", "seed: tag !!int is not allowed, values are plain"),
        ("seed=*x", "alias *x has no anchor before it"),
        ("a.b.c.d.e.f.g.h.i.j.k.l.m.n.o.p.q.r.s.t.u=3", "21 levels deep, must be at most 20"),
        ("seed=\x07", "character U+0007 is not allowed in YAML"),
    ],
)  # fmt: skip
def test_a_broken_override_gives_one_line(override: str, what: str) -> None:
    shown = override.replace("\x07", "\\x07")
    assert error_of(BASE, override) == f"--set {shown}: {what}"


def test_errors_of_the_file_come_before_those_of_overrides() -> None:
    assert error_of("name: a\nseed: -1", "radio.x=1") == "my.yaml:2: seed: -1, must be ≥ 0 (and 1 more)"


# --- there and back ------------------------------------------------------------------------------

names = st.from_regex(r"[a-z0-9_]{1,20}", fullmatch=True)
texts = st.text(max_size=80) | st.sampled_from(
    ["yes", "off", "1e3", "0.5", "017", "1:30", ".inf", "~", "null", "true", "- a", "a: b", "# c", "<<", "=", "2026-11-20", "\x07\n"]
)  # fmt: skip
numbers = st.floats(allow_nan=False, allow_infinity=False)
params = st.dictionaries(texts, numbers | st.integers(-(10**28), 10**28) | st.booleans() | texts, max_size=4)


@settings(max_examples=100, deadline=None)
@given(
    name=names,
    text=texts,
    params=params,
    x=st.floats(-5000, 5000),
    at_s=st.floats(0, 100),
    seed=st.integers(0, 2**63 - 1),
)
def test_a_dumped_scenario_loads_to_an_equal_one(
    name: str, text: str, params: dict[str, Any], x: float, at_s: float, seed: int
) -> None:
    scenario = Scenario.model_validate(
        {
            "name": name,
            "description": text,
            "seed": seed,
            "fleet": {"route": {"waypoints_m": [(x, 0.0), (0.0, -x)]}},
            "policy": {"params": params},
            "events": [{"kind": "jam", "at_s": at_s, "position_m": (x, x, 2.0)}],
            "expect": [{"metric": "m", "equals": text}, {"metric": "m", "equals": True}, {"metric": "m", "at_most": x}],
        }
    )
    again = loads(dump(scenario))
    assert again == scenario
    assert {k: type(v) for k, v in again.policy.params.items()} == {k: type(v) for k, v in params.items()}


LOOK_ALIKES = [
    *AMBIGUOUS,
    "0.5",
    "1e3",
    ".5",
    "5.",
    "true",
    "FALSE",
    "null",
    "~",
    "",
    ".inf",
    ".NaN",
    "9" * 40,
    "1e999",
    "<<",
    "y",
]


@pytest.mark.parametrize("text", LOOK_ALIKES)
def test_text_that_looks_like_something_else_comes_back_as_text(text: str) -> None:
    scenario = Scenario(name="a", description=text, policy=PolicySection(params={"v": text, "k" + text: 1}))
    assert loads(dump(scenario)) == scenario


# --- the library ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", library())
def test_a_library_scenario_loads_and_comes_back(name: str) -> None:
    scenario = load(name)
    assert scenario.name == name
    assert scenario.description
    assert scenario.expect
    assert loads(dump(scenario)) == scenario
    assert load(library()[name]) == scenario


def test_the_library_is_what_the_design_names() -> None:
    assert sorted(library()) == [
        "paper_context",
        "paper_replay",
        "person_crossing",
        "search_grid",
        "track_target",
        "two_groups",
        "two_makes",
    ]


@pytest.mark.parametrize("name", ["track_target", "paper_replay"])
def test_the_target_stays_near_the_fleet_and_keeps_to_its_lane(name: str) -> None:
    scenario = load(name)
    target, route = scenario.mission.target, scenario.fleet.route
    assert target is not None
    block_m = scenario.perception.scene.block_m
    for second in range(int(scenario.duration_s) + 1):
        car, heading = along(target.waypoints_m, second * target.speed_mps)
        fleet, _ = along(route.waypoints_m, second * route.speed_mps)
        assert abs(car - fleet) < 15, f"at {second} s"
        right = heading * -1j  # of the road's centre line, 1.75 m away
        across = ((car - 1.75 * right) / heading).imag
        assert across % block_m == pytest.approx(0, abs=1e-9) or across % block_m == pytest.approx(block_m)


def along(waypoints_m: tuple[tuple[float, float], ...], s_m: float) -> tuple[complex, complex]:
    """Point (x + iy) and unit heading after s metres of a polyline that must be long enough."""
    points = [complex(*p) for p in waypoints_m]
    for a, b in pairwise(points):
        if s_m <= abs(b - a):
            return a + (b - a) / abs(b - a) * s_m, (b - a) / abs(b - a)
        s_m -= abs(b - a)
    raise AssertionError("the path ends before the sortie")


def test_the_replay_has_the_papers_three_changes() -> None:
    scenario = load("paper_replay")
    assert [(p.at_s, p.phase) for p in scenario.mission.phases] == [(0, "search"), (45, "track")]
    region = scenario.mission.phases[1].region
    assert region is not None
    assert (region.radius_m, region.centre_m) == (32, None)
    assert [(e.kind, e.at_s, getattr(e, "drone", None)) for e in scenario.events] == [("link_drop", 60, 2)]
    (pack,) = scenario.fleet.overrides
    assert pack.drone == 1
    assert pack.initial_soc is not None
    assert pack.initial_soc > 0.6


# --- nothing but ScenarioError -------------------------------------------------------------------


def outcome(read: Callable[[], Scenario]) -> str:
    """What a reader gives: a scenario's name or its error's line. Anything else is raised."""
    try:
        return read().name
    except ScenarioError as error:
        return str(error)


def only_scenario_errors(text: str, *overrides: str) -> None:
    assert outcome(lambda: loads(text, "fuzz.yaml", overrides)).isprintable()  # one line


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=200))
def test_random_bytes_raise_nothing_else(data: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.yaml"
    path.write_bytes(data)
    assert outcome(lambda: load(path)).isprintable()


yaml_pieces = st.sampled_from(
    [*"[]{},:-?&*!|>'\"%@`#~ \t\n", "\n  ", "\n- ", ": ", "name", "fleet", "drones", "events", "kind", "jam", "&a", "*a", "!!x", "<<: ",
     "--- ", "...", "1", "yes", ".nan", "1e999", "é", "\u2028", "\ufeff", "\x85", "%YAML 1.1\n"]
)  # fmt: skip


@settings(max_examples=500, deadline=None)
@given(text=st.text(max_size=100) | st.lists(yaml_pieces, max_size=40).map("".join))
@example(text="\ud800")
@example(text="? ")
@example(text="%TAG ! tag:x,2000:\n---\n!a b")
@example(text="name: !")
@example(text="{[]: 1}")
def test_random_text_raises_nothing_else(text: str) -> None:
    only_scenario_errors(text)
    only_scenario_errors("name: a\n" + text)
    only_scenario_errors(BASE, text)
    only_scenario_errors(BASE, "fleet.battery=" + text)
    only_scenario_errors(BASE, text + "=3")


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_any_value_at_any_field_raises_nothing_else(data: st.DataObject) -> None:
    fields = [
        "name",
        "seed",
        "duration_s",
        "fleet.drones",
        "fleet.route.waypoints_m",
        "mission.phases",
        "mission.target",
        "events",
        "expect",
        "policy.params",
        "events.0",
        "events.1.kind",
        "radio.bandwidth_mhz",
        "context.authentication",
        "fleet",
        "fleet.overrides",
        "policy",
        "perception.scene",
        "events.0.peer",
    ]
    scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10)
    values = st.recursive(scalars, lambda x: st.lists(x, max_size=3) | st.dictionaries(st.sampled_from(
        ["at_s", "kind", "drone", "phase", "region", "metric", "waypoints_m", "x"]), x, max_size=3), max_leaves=8)  # fmt: skip
    value = yaml.safe_dump(data.draw(values), default_flow_style=True)
    only_scenario_errors(BASE, f"{data.draw(st.sampled_from(fields))}={value}")


# --- sets of conditions, and overrides as text ------------------------------------------------------


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
    path.write_text(
        "base: track_target\nset: [fleet.dronez=3]\nconditions:\n"
        "  - {name: a, budget: 0.1, set: [duration_s=-1]}\n  - {name: b, budget: 0.1, set: [context.rate_hz=0]}\n"
    )
    with pytest.raises(ScenarioError) as caught:
        read_any(path)
    assert [issue.partition(": ")[2].partition(", ")[0] for issue in caught.value.issues] == [
        "condition a: --set duration_s=-1: duration_s: -1",
        "condition a: --set fleet.dronez=3: fleet.dronez: unknown key",
        "condition b: --set context.rate_hz=0: context.rate_hz: 0",
    ]


def test_overrides_of_a_map_are_the_same_as_texts() -> None:
    formation = {"shape": "line", "spacing_m": 10}
    overrides = {
        "name": "on",
        "description": "a: b, é # 1",
        "duration_s": 1.5,
        "fleet.formation": formation,
        "expect": [],
    }
    sections = {"name": "a", "radio": {"tx_power_dbm": 1}}
    assert build(sections, as_texts(overrides)) == build(sections, overrides)
    assert as_texts(["duration_s=3"]) == ["duration_s=3"]
