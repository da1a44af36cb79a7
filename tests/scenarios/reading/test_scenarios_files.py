"""Files and models that a scenario names: where they stand, where they are looked for, and parameters in brackets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from installed_package import installed_package

from sortie.scenarios.reading.files import (
    found_beside,
    models_with_params,
    named_files,
    placed,
    with_files,
    without_brackets,
)
from sortie.scenarios.reading.load import ScenarioError, build, load, loads
from sortie.scenarios.shipped import located

TEXT = """
name: own
fleet: {trace: drones.csv}
radio: {trace: links/l.csv}
policy:
  name: mine.py:decide
  changes: [{at_s: 1, name: "other.py:decide"}, {at_s: 2, name: silence}]
perception: {detector: recorded, recording: seen.zarr, recorded_fusion: "fuse.py:fuse"}
"""
FILES = ["drones.csv", "links/l.csv", "seen.zarr", "fuse.py", "mine.py", "other.py"]
MAKE: dict[str, Any] = {
    "name": "m",
    "drones": [0],
    "weights": "w.st",
    "codebook": "c.st",
    "policy": "p.py:decide",
    "policy_params": {"k": 1},
    "airframe": {"power_model": "w.py:Power"},
    "battery": {"cell_model": "cell.py:Cell", "cell_params": {"v": 3}},
}
WALK = {"drones": [1], "mobility": "g.py:Way", "mobility_params": {"table": "way.csv"}}
WHOLE: dict[str, Any] = {
    "name": "a",
    "fleet": {"makes": [MAKE], "groups": [WALK], "mobility": "random_waypoint"},
    "policy": {"name": "worked", "changes": [{"at_s": 1, "name": "q.py:decide"}]},
    "events": [{"kind": "own", "at_s": 1, "model": "e.py:Rain", "params": {"mm": 2}}],
    "metrics": {"mine": {"model": "f.py:figure"}},
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scenario with its files beside it; `seen.zarr` is a folder."""
    for name in FILES:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.mkdir() if path.suffix == ".zarr" else path.touch()
    (tmp_path / "own.yaml").write_text(TEXT)
    return tmp_path


def sections_of(text: str) -> dict[str, Any]:
    return loads(text).model_dump(mode="json", exclude_none=True)


def test_every_place_of_a_scenario_that_names_a_model_is_known() -> None:
    own = [("policy", "p.py:decide", {"k": 1}), ("power", "w.py:Power", {}), ("cell", "cell.py:Cell", {"v": 3})]
    others = [("policy", "q.py:decide", {}), ("event", "e.py:Rain", {"mm": 2}), ("metric", "f.py:figure", {})]
    fleet_s = [("mobility", "random_waypoint", {}), ("policy", "worked", {})]
    walk = ("mobility", "g.py:Way", {"table": "way.csv"})
    assert list(models_with_params(WHOLE)) == [*fleet_s, *own, walk, *others]


def test_every_place_of_a_scenario_that_names_a_file_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A parameter that is the name of a file is one, too. What is renamed is a copy."""
    monkeypatch.chdir(tmp_path)
    Path("way.csv").write_text("x\n1\n")
    wanted = ["w.st", "c.st", "p.py", "w.py", "cell.py", "g.py", "way.csv", "q.py", "e.py", "f.py"]
    assert sorted(named_files(WHOLE)) == sorted(wanted)
    assert sorted(named_files(sections_of(TEXT))) == sorted(FILES)
    before = json.dumps(WHOLE)
    moved = with_files(WHOLE, lambda name: f"there/{name}")
    assert json.dumps(WHOLE) == before
    assert sorted([*named_files(moved), "there/way.csv"]) == sorted(f"there/{name}" for name in wanted)
    there = {"drones": [1], "mobility": "there/g.py:Way", "mobility_params": {"table": "there/way.csv"}}
    assert moved["fleet"]["groups"][0] == there
    assert moved["policy"]["changes"][0]["name"] == "there/q.py:decide"


def test_a_presets_name_is_no_file_and_a_model_within_a_part_is() -> None:
    for sections, files in (
        ({"fleet": {"airframe": "solo"}}, []),
        ({"fleet": {"airframe": {"power_model": "watts.py:table"}}}, ["watts.py"]),
        ({"radio": {"path_loss": "two_ray", "link_params": {"loss_db": 3.0}}}, []),
    ):
        assert named_files(sections) == files  # type: ignore[arg-type]


# --- where they are looked for --------------------------------------------------------------------


def test_files_beside_a_scenario_are_found_from_anywhere_and_what_is_here_goes_first(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    monkeypatch.chdir(elsewhere)
    own = load(folder / "own.yaml")
    assert (own.fleet.trace, own.radio.trace) == (str(folder / "drones.csv"), str(folder / "links/l.csv"))
    assert own.policy.name == f"{folder / 'mine.py'}:decide"
    assert [change.name for change in own.policy.changes] == [f"{folder / 'other.py'}:decide", "silence"]
    assert own.perception.recording == str(folder / "seen.zarr")
    assert own.perception.recorded_fusion == f"{folder / 'fuse.py'}:fuse"
    assert load(folder / "own.yaml", ["fleet.trace=none.csv"]).fleet.trace == "none.csv"
    (elsewhere / "drones.csv").touch()
    assert load(folder / "own.yaml").fleet.trace == "drones.csv"
    monkeypatch.chdir(folder)
    assert load(folder / "own.yaml") == loads(TEXT)
    without = loads("name: plain")
    assert found_beside(without, folder) is without


@pytest.mark.parametrize("name", ["paper_120s/links.csv", "disconet.safetensors"])
def test_a_file_beside_the_scenario_goes_before_a_shipped_one_of_its_name(tmp_path: Path, name: str) -> None:
    assert placed(name, tmp_path) == name
    assert located(Path(name)).is_file(), "it is shipped"
    own = tmp_path / name
    own.parent.mkdir(exist_ok=True)
    own.touch()
    assert placed(name, tmp_path) == str(own)


def test_a_parameter_that_names_a_file_is_found_beside_the_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "heights.csv").write_text("1\n")
    (tmp_path / "own.py").write_text("")
    (tmp_path / "s.yaml").write_text("name: s\nfleet: {sensor: 'own.py:f(heights=heights.csv, kind=wide.v2)'}\n")
    fleet = load(tmp_path / "s.yaml").fleet
    assert fleet.sensor == f"{tmp_path}/own.py:f"
    assert fleet.sensor_params == {"heights": str(tmp_path / "heights.csv"), "kind": "wide.v2"}
    monkeypatch.chdir(tmp_path)
    sections = load("s.yaml").model_dump(mode="json", exclude_none=True)
    assert sections["fleet"]["sensor_params"] == {"heights": "heights.csv", "kind": "wide.v2"}
    assert named_files(sections) == ["own.py", "heights.csv"]


def test_a_parameter_may_name_a_file_or_a_folder_by_a_suffix_or_a_slash(tmp_path: Path) -> None:
    """Also of an installed model. A word is no file or folder that has its name by chance."""
    for name in ("maps", "train"):
        (tmp_path / name).mkdir()
    for name in ("heights", "val"):
        (tmp_path / name).write_text("1\n")
    params = {"a": "./heights", "b": "maps/", "c": "train", "d": "missing/", "e": "", "f": "val"}
    source = "def f(pose):\n    return 0\n"
    with installed_package(tmp_path, "sensors", source, {"sensor": {"wobbly": "sensors:f"}}):
        for model in ("own.py:f", "wobbly"):
            sensor = {"name": "a", "fleet": {"sensor": model, "sensor_params": params}}
            fleet = found_beside(build(sensor), tmp_path).fleet
            here = {"a": str(tmp_path / "heights"), "b": str(tmp_path / "maps")}
            assert fleet.sensor_params == {**params, **here}
            assert set(here.values()) <= set(named_files({"fleet": fleet.model_dump(mode="json", exclude_none=True)}))


def test_the_working_folder_and_those_above_it_are_no_files_of_a_parameter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "above" / "here"
    (here / "maps").mkdir(parents=True)
    monkeypatch.chdir(here)
    texts = ["/", "./", "../", "maps/..", f"{here.parent}/", f"{here}"]
    params = {f"p{i}": text for i, text in enumerate([*texts, "./maps"])}
    assert named_files({"policy": {"name": "own.py:decide", "params": params}}) == ["own.py", "./maps"]


# --- parameters in brackets -----------------------------------------------------------------------


def test_parameters_in_brackets_stand_where_they_belong() -> None:
    """In YAML and as an override, where they replace those of the file."""
    walk = "fleet: {groups: [{drones: [1], mobility: random_waypoint(pause_s=2.5)}]}"
    text = f"name: a\nradio: {{link: 'own.py:L(loss_db=3, name=far, on=true)'}}\n{walk}\n"
    scenario = loads(text)
    assert (scenario.radio.link, scenario.radio.link_params) == ("own.py:L", {"loss_db": 3, "name": "far", "on": True})
    assert scenario.fleet.groups[0].mobility_params == {"pause_s": 2.5}
    again = loads(text, overrides=["radio.link=other.py:M(x=-1e-3)", "fleet.airframe.power_model=own.py:P()"])
    assert (again.radio.link, again.radio.link_params) == ("other.py:M", {"x": -0.001})
    assert (again.fleet.airframe.power_model, again.fleet.airframe.power_params) == ("own.py:P", {})
    built = build({"name": "a", "metrics": {"m": {"model": "own.py:f(a=1)"}}})
    assert built.metrics["m"].params == {"a": 1}


def link(text: str, params: dict[str, Any] | None = None) -> dict[str, Any]:
    return {"radio": {"link": text} | ({} if params is None else {"link_params": params})}


IN_BRACKETS = """own.py:L(speeds=[1, 2.5], name="a, b)", to={x: 1, y: 'c,d'}, said='it''s, so', who=it's)"""
READ = {"speeds": [1, 2.5], "name": "a, b)", "to": {"x": 1, "y": "c,d"}, "said": "it's, so", "who": "it's"}
SMALL = {"name": "small(b=2)", "policy": "best-2(rho=0.2)"}
BRACKETS: list[tuple[dict[str, Any], dict[str, Any]]] = [
    (link(IN_BRACKETS), link("own.py:L", READ)),  # YAML with lists and quoted commas
    (link("moved to (another) place/own.py:Name"), link("moved to (another) place/own.py:Name")),
    (link("d (x=1)/own.py:Name(y=2)"), link("d (x=1)/own.py:Name", {"y": 2})),  # those of a folder's name
    (link("own.py:Name", {"model": "Other(k=1)"}), link("own.py:Name", {"model": "Other(k=1)"})),  # no section
    ({"events": [{"model": "e.py:E(k=1)"}]}, {"events": [{"model": "e.py:E", "params": {"k": 1}}]}),
    ({"policy": {"name": "all-4(rho=0.1)"}}, {"policy": {"name": "all-4", "params": {"rho": 0.1}}}),
    (
        {"policy": {"changes": [{"at_s": 1, "name": "p.py:decide(k=2)"}]}},
        {"policy": {"changes": [{"at_s": 1, "name": "p.py:decide", "params": {"k": 2}}]}},
    ),
    (
        {"name": "mine(a=1)", "fleet": {"makes": [SMALL]}},  # of names a policy's alone
        {
            "name": "mine(a=1)",
            "fleet": {"makes": [{"name": "small(b=2)", "policy": "best-2", "policy_params": {"rho": 0.2}}]},
        },
    ),
]


def test_brackets_are_read_where_a_model_or_a_policy_is_named() -> None:
    assert [without_brackets(written) for written, _ in BRACKETS] == [wanted for _, wanted in BRACKETS]
    assert named_files(link(IN_BRACKETS)) == ["own.py"]
    assert with_files(link(IN_BRACKETS), lambda name: f"/there/{name}") == link(f"/there/{IN_BRACKETS}")


def test_brackets_that_are_none_are_refused() -> None:
    for name in ("own.py:L(3)", "own.py:L(a=1", "own.py:L(a=(1)", "own.py:L(a=)", "(a=1)"):
        assert without_brackets(link(name)) == link(name)
        with pytest.raises(ScenarioError, match=r"^--set radio.link=.*, must be path/to/file.py:Name$"):
            loads("name: a", overrides=[f"radio.link={name}"])


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("yes", r"^own\.py:L\(a=yes\): yes, write true or false, or put it in quotes if it is text$"),
        ("[1, .inf]", r"^own\.py:L\(a=\[1, \.inf\]\): 1: \.inf, must be a finite number$"),
        ("'open", r"^own\.py:L\(a='open\): not YAML, "),
    ],
)
def test_a_value_in_brackets_that_is_no_clear_yaml_is_named(value: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        without_brackets(link(f"own.py:L(a={value})"))
    with pytest.raises(ScenarioError, match=f"^s.yaml: {message[1:]}"):
        loads(f'name: a\nradio: {{link: "own.py:L(a={value})"}}', "s.yaml")
