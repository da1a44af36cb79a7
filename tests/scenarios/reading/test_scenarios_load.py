"""Good scenarios load and come back equal; broken ones give exactly the line that their first line promises."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

import sortie.scenarios.reading.load as loader
from sortie.scenarios.reading import strict_yaml
from sortie.scenarios.reading.load import ScenarioError, dump, library, load, loads
from sortie.scenarios.reading.nodes import MAX_DEPTH, as_node, assign, child, nearest, plain
from sortie.scenarios.reading.strict_yaml import MAX_WEIGHT, read_yaml
from sortie.scenarios.reading.top_keys import top_keys
from sortie.scenarios.schema import KINDS, PolicySection, Scenario

BROKEN = sorted((Path(__file__).parent / "broken").glob("*.yaml"))
PARSERS = {"python": yaml.SafeLoader, "libyaml": getattr(yaml, "CSafeLoader", None)}
LIBRARY = "paper_context, paper_replay, paper_replay_contention, person_crossing, search_grid, track_target, two_groups, two_makes"


def error_of(text: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        loads(textwrap.dedent(text), "my.yaml")
    return str(caught.value)


# --- broken scenarios -----------------------------------------------------------------------------


def expected_of(path: Path) -> str:
    sidecar = path.with_suffix(".expected")  # for files that cannot hold a comment
    if sidecar.exists():
        return sidecar.read_text("utf-8").rstrip("\n")
    *others, last = KINDS
    told = path.read_text("utf-8").split("\n", 1)[0].removeprefix("# ")
    return told.replace("{kinds}", f"{', '.join(others)} or {last}")


@pytest.mark.parametrize("parser", PARSERS)
def test_a_broken_scenario_gives_its_one_line(parser: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if PARSERS[parser] is None:
        pytest.skip("PyYAML without libyaml")
    monkeypatch.setattr(strict_yaml, "_Parser", PARSERS[parser])
    wrong = {}
    for path in BROKEN:
        with pytest.raises(ScenarioError) as caught:
            load(path)
        said, expected = str(caught.value).removeprefix(f"{path.parent}/"), expected_of(path)
        if parser == "python":  # the two parsers word syntax errors differently; the place is the same
            said, expected = said.partition("not YAML")[0], expected.partition("not YAML")[0]
        if said != expected:
            wrong[path.stem] = said
    assert wrong == {}
    assert len(BROKEN) >= 80
    several = {path.stem for path in BROKEN if "more)" in expected_of(path)}
    assert several == {"several", "nothing_for_section"}, "each of the others is broken by its rule alone"


def test_a_missing_file_names_what_was_probably_meant(tmp_path: Path) -> None:
    (tmp_path / "valley.yaml").write_text("name: valley")
    for name, hint in (
        (tmp_path / "valey.yaml", "did you mean valley.yaml?"),
        ("track_targt", "did you mean track_target?"),
        ("link_batery", "did you mean link_battery?"),  # a campaign
        ("zzz.yaml", f"the library has {LIBRARY}"),
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


def test_an_error_is_one_line_that_names_the_first_mistake_and_the_text_it_stands_for() -> None:
    said = error_of('name: a\n"x\\ny\\u2028\\e[2J": 3\n')
    assert said.startswith("my.yaml:2: x\\ny\\u2028\\x1b[2J: unknown key")
    assert said.isprintable()
    first = error_of("policy: {params: {a: yes}}\nname: a\nradio: {bandwidth: 80}\nduration_s: -1\n")
    wish = "write true or false, or put it in quotes if it is text"
    assert first == f"my.yaml:1: policy.params.a: yes, {wish} (and 2 more)"
    aliased = error_of("""\
        name: a
        mission:
          target: {waypoints_m: &way [[0, 0], [9e9, 0]]}
        fleet: {route: {waypoints_m: *way}}
        """)
    assert aliased == "my.yaml:3: fleet.route.waypoints_m.1.0: 9e9, must be ≤ 5000 (and 1 more)"


# --- what is read ---------------------------------------------------------------------------------

PLAIN: dict[str, Any] = {"-3": -3, "0": 0, "+2": 2, "1e3": 1000.0, ".5": 0.5, "5.": 5.0, "true": True, "FALSE": False}
PLAIN |= {text: text for text in ("word", "2026-11-20", "1.2.3", "null_", "1e", "~x", "y")}
PLAIN |= {"'0.5'": "0.5", "'yes'": "yes"}
AMBIGUOUS = ["yes", "No", "ON", "off", "1_000", "0x1F", "0b1", "0o17", "017", "-007", "1:30", "190:20:30.15", "01.5"]
AMBIGUOUS += ["1__0"]
LOOK_ALIKES = ["0.5", "1e3", ".5", "5.", "true", "FALSE", "null", "~", ".inf", ".NaN", "1e999", "<<", "y", "", "9" * 40]


def test_plain_values_are_read_as_yaml_1_2_has_them() -> None:
    found = {text: loads("name: a", overrides=[f"policy.params.v={text}"]).policy.params["v"] for text in PLAIN}
    assert {text: (type(v), v) for text, v in found.items()} == {text: (type(v), v) for text, v in PLAIN.items()}
    assert loads("name: a\nduration_s: 30").duration_s == 30.0
    assert "must be a whole number" in error_of("name: a\nseed: 30.0")


def test_what_yaml_1_1_and_1_2_read_differently_is_refused_as_text_and_as_number() -> None:
    for text in AMBIGUOUS:
        assert error_of(f"name: a\npolicy: {{name: {text}}}").startswith(f"my.yaml:2: policy.name: {text}, write ")
        assert error_of(f"name: a\nduration_s: {text}").startswith(f"my.yaml:2: duration_s: {text}, must be a number")
        assert loads(f"name: a\npolicy: {{name: '{text}'}}").policy.name == text


def test_text_that_looks_like_something_else_comes_back_as_text() -> None:
    for text in [*LOOK_ALIKES, *AMBIGUOUS]:
        scenario = Scenario(name="a", description=text, policy=PolicySection(params={"v": text, "k" + text: 1}))
        assert loads(dump(scenario)) == scenario


def test_a_byte_order_mark_and_windows_line_ends_do_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xef\xbb\xbfname: a\r\nduration_s: 0\r\n")
    with pytest.raises(ScenarioError, match=r"a\.yaml:2: duration_s: 0, must be ≥ 0\.001$"):
        load(path)


# --- the tree -------------------------------------------------------------------------------------


def test_every_entry_of_a_list_is_there_and_none_beyond() -> None:
    node = as_node({"a": [5, 6, 7]})
    entries = child(node, "a")
    assert entries is not None
    assert [None if (found := child(entries, i)) is None else found.value for i in range(4)] == [5, 6, 7, None]
    assert plain(assign(node, ["a", "2"], as_node(9))) == {"a": [5, 6, 9]}
    with pytest.raises(ScenarioError, match="a has 0 … 2"):
        assign(node, ["a", "3"], as_node(9))


def test_a_name_with_another_unit_is_the_nearest() -> None:
    assert nearest("altitude_ft", ["shape", "spacing_m", "altitude_m"]) == "altitude_m"
    assert nearest("altitude", ["shape", "altitude_m"]) == "altitude_m"
    assert nearest("spacing", ["pose_spacing_x", "altitude_m"]) == "pose_spacing_x"
    assert nearest("loss_furlongs", ["cross_furlong", "loss_db"]) == "loss_db"  # and not the one that is spelt alike
    assert nearest("zzz", ["shape"]) is None


def test_an_alias_weighs_and_reaches_as_far_down_as_what_it_stands_for() -> None:
    deep = "a: &x " + "[" * (MAX_DEPTH - 2) + "1" + "]" * (MAX_DEPTH - 2) + "\n"
    tall = "a: &y {p: &x " + "[" * (MAX_DEPTH - 4) + "1" + "]" * (MAX_DEPTH - 4) + ", q: 1}\n"
    wide = "a: &x [" + ", ".join("1" * (MAX_WEIGHT // 5)) + "]\n"
    assert read_yaml(deep + "b: *x\n", "f") is not None
    assert read_yaml(wide + "b: [*x, *x, *x]\n", "f") is not None
    for text, words in (
        (deep + "b: [*x]\n", f"{MAX_DEPTH + 1} levels deep"),
        (deep + "b: {c: *x, d: 1}\n", f"{MAX_DEPTH + 1} levels deep"),
        (tall + "b: [[*y]]\n", "levels deep"),
        (wide + "b: [*x, *x, *x, *x]\n", "aliases expanded"),
        (wide + "b: &z [*x, *x]\nc: *z\n", "aliases expanded"),
    ):
        with pytest.raises(ScenarioError, match=words):
            read_yaml(text, "f")


def test_keys_of_a_broken_file_are_words_where_keys_would_stand() -> None:
    assert top_keys("name: a\nfleet: [1\nradio: {x: 1}\n") >= {"name", "fleet", "radio"}
    assert top_keys("{name: a, fleet: {drones: 2}, radio: [") >= {"name", "fleet"}
    assert "b" not in top_keys('{"a": 1, x: [, b: 2')


# --- there and back -------------------------------------------------------------------------------

names = st.from_regex(r"[a-z0-9_]{1,20}", fullmatch=True)
odd = [*LOOK_ALIKES, *AMBIGUOUS, "- a", "a: b", "# c", "=", "2026-11-20", "\x07\n"]
texts = st.text(max_size=80) | st.sampled_from(odd)
numbers = st.floats(allow_nan=False, allow_infinity=False)
params = st.dictionaries(texts, numbers | st.integers(-(10**28), 10**28) | st.booleans() | texts, max_size=4)


@settings(max_examples=100)
@given(names, texts, params, st.floats(-5000, 5000), st.floats(0, 100), st.integers(0, 2**63 - 1))
def test_a_dumped_scenario_loads_to_an_equal_one(
    name: str, text: str, params: dict[str, Any], x: float, at_s: float, seed: int
) -> None:
    expect = [{"metric": "m", "equals": text}, {"metric": "m", "equals": True}, {"metric": "m", "at_most": x}]
    scenario = Scenario.model_validate(
        {
            "name": name,
            "description": text,
            "seed": seed,
            "fleet": {"route": {"waypoints_m": [(x, 0.0), (0.0, -x)]}},
            "policy": {"params": params},
            "events": [{"kind": "jam", "at_s": at_s, "position_m": (x, x, 2.0)}],
            "expect": expect,
        }
    )
    again = loads(dump(scenario))
    assert again == scenario
    assert {k: type(v) for k, v in again.policy.params.items()} == {k: type(v) for k, v in params.items()}


# --- the library ----------------------------------------------------------------------------------


def test_the_library_s_scenarios_load_and_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A library's name means the library, also beside a file of that name."""
    assert ", ".join(sorted(library())) == LIBRARY
    for name in library():
        scenario = load(name)
        assert (scenario.name, bool(scenario.description), bool(scenario.expect)) == (name, True, True)
        assert loads(dump(scenario)) == load(library()[name]) == scenario
    monkeypatch.chdir(tmp_path)
    Path("track_target").write_text("name: mine\n")
    assert load("track_target").name == "track_target"
    assert load(Path("./track_target").absolute()).name == "mine"


# --- nothing but ScenarioError --------------------------------------------------------------------

BASE = "name: a\nevents: [{kind: drone_lost, at_s: 3, drone: 1}, {kind: drone_lost, at_s: 5, drone: 2}]\n"
FIELDS = ["name", "seed", "duration_s", "fleet.drones", "fleet.route.waypoints_m", "mission.phases", "mission.target"]
FIELDS += ["events", "events.0", "events.1.kind", "expect", "policy", "policy.params", "radio.bandwidth_mhz", "fleet"]
FIELDS += ["context.authentication", "fleet.overrides", "perception.scene", "events.0.peer"]
PIECES = [*"[]{},:-?&*!|>'\"%@`#~ \t\n", "\n  ", "\n- ", ": ", "name", "fleet", "events", "kind", "jam", "&a", "*a"]
PIECES += ["!!x", "<<: ", "--- ", "...", "1", "yes", ".nan", "1e999", "é", "\u2028", "\ufeff", "\x85", "%YAML 1.1\n"]


def outcome(read: Callable[[], Scenario]) -> str:
    """What a reader gives: a scenario's name or its error's line. Anything else is raised."""
    try:
        return read().name
    except ScenarioError as error:
        return str(error)


def only_scenario_errors(text: str, *overrides: str) -> None:
    assert outcome(lambda: loads(text, "fuzz.yaml", overrides)).isprintable()  # one line


@settings(max_examples=200)
@given(data=st.binary(max_size=200))
def test_random_bytes_raise_nothing_else(data: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.yaml"
    path.write_bytes(data)
    assert outcome(lambda: load(path)).isprintable()


@settings(max_examples=300)
@given(text=st.text(max_size=100) | st.lists(st.sampled_from(PIECES), max_size=40).map("".join))
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


scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10)
keys = st.sampled_from(["at_s", "kind", "drone", "phase", "region", "metric", "waypoints_m", "x"])
values = st.recursive(scalars, lambda x: st.lists(x, max_size=3) | st.dictionaries(keys, x, max_size=3), max_leaves=8)


@settings(max_examples=150)
@given(st.sampled_from(FIELDS), values)
def test_any_value_at_any_field_raises_nothing_else(field: str, value: Any) -> None:
    only_scenario_errors(BASE, f"{field}={yaml.safe_dump(value, default_flow_style=True)}")
