"""Files that a scenario names: where they are looked for."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from installed_package import installed_package

from sortie.scenarios.reading.files import (
    found_beside,
    named_files,
    placed,
    with_files,
    without_brackets,
)
from sortie.scenarios.reading.load import ScenarioError, build, load, loads
from sortie.scenarios.shipped import TRACES, located

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


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scenario with its files beside it; `seen.zarr` is a folder."""
    for name in FILES:
        path = tmp_path / name
        if path.suffix == ".zarr":
            path.mkdir()
        else:
            path.parent.mkdir(exist_ok=True)
            path.touch()
    (tmp_path / "own.yaml").write_text(TEXT)
    return tmp_path


def test_every_field_that_names_a_file_is_known() -> None:
    assert sorted(named_files(loads(TEXT).model_dump(mode="json", exclude_none=True))) == sorted(FILES)
    told = json.dumps(with_files(loads(TEXT).model_dump(mode="json", exclude_none=True), lambda name: f"here/{name}"))
    assert all(f'"here/{name}' in told for name in FILES)
    assert '"here/mine.py:decide"' in told
    assert '"silence"' in told


def test_files_that_a_part_of_the_fleet_an_event_or_a_metric_names_are_known() -> None:
    text = """
name: own
perception: {detector: torch}
fleet:
  makes:
  - name: other
    drones: [0]
    policy: decide.py:decide
    weights: net.safetensors
    codebook: codes.safetensors
    airframe: {power_model: "power.py:Power"}
    battery: {cell_model: "cell.py:Cell"}
  groups: [{drones: [1], mobility: "walk.py:Walk"}]
events: [{at_s: 1, kind: own, model: "rain.py:Rain"}]
metrics: {mine: {model: "figure.py:Figure"}}
"""
    found = named_files(loads(text).model_dump(mode="json", exclude_none=True))
    models = ["cell.py", "decide.py", "figure.py", "power.py", "rain.py", "walk.py"]
    assert sorted(found) == sorted([*models, "net.safetensors", "codes.safetensors"])


def test_files_beside_a_scenario_are_found_from_anywhere(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    own = load(folder / "own.yaml")
    assert own.fleet.trace == str(folder / "drones.csv")
    assert own.radio.trace == str(folder / "links/l.csv")
    assert own.policy.name == f"{folder / 'mine.py'}:decide"
    assert [change.name for change in own.policy.changes] == [f"{folder / 'other.py'}:decide", "silence"]
    assert own.perception.recording == str(folder / "seen.zarr")
    assert own.perception.recorded_fusion == f"{folder / 'fuse.py'}:fuse"
    assert load(folder / "own.yaml", ["fleet.trace=none.csv"]).fleet.trace == "none.csv"


def test_what_is_here_goes_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert load(folder / "own.yaml") == loads(TEXT)
    monkeypatch.chdir(folder.parent)
    (folder.parent / "drones.csv").touch()
    assert load(folder / "own.yaml").fleet.trace == "drones.csv"
    (folder.parent / "drones.csv").unlink()


@pytest.mark.parametrize("name", ["paper_120s/links.csv", "disconet.safetensors"])
def test_a_file_beside_the_scenario_goes_before_a_shipped_one_of_its_name(tmp_path: Path, name: str) -> None:
    assert placed(name, tmp_path) == name
    assert located(Path(name)).is_file(), "it is shipped"
    own = tmp_path / name
    own.parent.mkdir(exist_ok=True)
    own.touch()
    assert placed(name, tmp_path) == str(own)
    assert load("paper_context").radio.trace is not None


def test_a_file_of_one_s_own_goes_before_a_shipped_one_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = Path("paper_120s/links.csv")
    monkeypatch.chdir(tmp_path)
    assert located(name) == TRACES / name
    name.parent.mkdir()
    assert located(name) == TRACES / name  # a folder is no trace
    name.touch()
    assert located(name) == name


def test_a_scenario_whose_files_are_looked_for_is_left_as_it_was() -> None:
    """Sections within sections and lists too: what is renamed is a copy."""
    sections = loads(TEXT).model_dump(mode="json", exclude_none=True)
    before = json.dumps(sections)
    changed = with_files(sections, lambda name: f"there/{name}")
    assert json.dumps(sections) == before
    assert changed["policy"]["changes"][0]["name"] == "there/other.py:decide"


def test_a_scenario_without_files_is_left_alone(tmp_path: Path) -> None:
    plain = loads("name: plain")
    assert found_beside(plain, tmp_path) is plain


def test_a_presets_name_is_no_file_and_a_model_within_a_part_is() -> None:
    for sections, files in (
        ({"fleet": {"airframe": "solo"}}, []),
        ({"fleet": {"airframe": {"power_model": "watts.py:table"}}}, ["watts.py"]),
        ({"fleet": {"makes": [{"airframe": {"power_model": "watts.py:table"}}]}}, ["watts.py"]),
        ({"radio": {"path_loss": "two_ray", "link_params": {"loss_db": 3.0}}}, []),
        ({"events": [{"kind": "own", "model": "rain.py:Front"}]}, ["rain.py"]),
    ):
        assert named_files(sections) == files  # type: ignore[arg-type]


def test_parameters_in_brackets_stand_where_they_belong() -> None:
    """In YAML and as an override, where they replace those of the file."""
    text = "name: a\nradio: {link: 'own.py:L(loss_db=3, name=far, on=true)'}\nfleet: {groups: [{drones: [1], mobility: random_waypoint(pause_s=2.5)}]}\n"
    scenario = loads(text)
    assert (scenario.radio.link, scenario.radio.link_params) == ("own.py:L", {"loss_db": 3, "name": "far", "on": True})
    assert scenario.fleet.groups[0].mobility_params == {"pause_s": 2.5}
    again = loads(text, overrides=["radio.link=other.py:M(x=-1e-3)", "fleet.airframe.power_model=own.py:P()"])
    assert (again.radio.link, again.radio.link_params) == ("other.py:M", {"x": -0.001})
    assert (again.fleet.airframe.power_model, again.fleet.airframe.power_params) == ("own.py:P", {})
    built = build({"name": "a", "metrics": {"m": {"model": "own.py:f(a=1)"}}})
    assert built.metrics["m"].params == {"a": 1}
    assert named_files({"radio": {"link": "own.py:L(loss_db=3)"}}) == ["own.py"]


@pytest.mark.parametrize("name", ["own.py:L(3)", "own.py:L(a=1", "own.py:L(a=(1)", "own.py:L(a=)", "(a=1)"])
def test_brackets_that_are_none_are_refused(name: str) -> None:
    assert without_brackets({"radio": {"link": name}}) == {"radio": {"link": name}}
    with pytest.raises(ScenarioError, match=r"^--set radio.link=.*, must be path/to/file.py:Name$"):
        loads("name: a", overrides=[f"radio.link={name}"])


def test_a_policy_s_name_takes_parameters_in_brackets_and_no_other_name_does() -> None:
    flown = {"name": "all-4(rho=0.1)", "changes": [{"at_s": 1, "name": "p.py:decide(k=2)"}]}
    plain = {
        "name": "all-4",
        "params": {"rho": 0.1},
        "changes": [{"at_s": 1, "name": "p.py:decide", "params": {"k": 2}}],
    }
    given = {"name": "mine(a=1)", "fleet": {"makes": [{"name": "small(b=2)", "policy": "best-2(rho=0.2)"}]}}
    make = {"name": "small(b=2)", "policy": "best-2", "policy_params": {"rho": 0.2}}
    wanted = {"name": "mine(a=1)", "fleet": {"makes": [make]}, "policy": plain}
    assert without_brackets({**given, "policy": flown}) == wanted


def test_values_in_brackets_are_yaml_with_lists_and_quoted_commas() -> None:
    text = """own.py:L(speeds=[1, 2.5], name="a, b)", to={x: 1, y: 'c,d'}, said='it''s, so', who=it's)"""
    params = {"speeds": [1, 2.5], "name": "a, b)", "to": {"x": 1, "y": "c,d"}, "said": "it's, so", "who": "it's"}
    assert without_brackets({"radio": {"link": text}}) == {"radio": {"link": "own.py:L", "link_params": params}}
    assert named_files({"radio": {"link": text}}) == ["own.py"]
    moved = with_files({"radio": {"link": text}}, lambda name: f"/there/{name}")
    assert moved == {"radio": {"link": f"/there/{text}"}}


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
        without_brackets({"radio": {"link": f"own.py:L(a={value})"}})
    with pytest.raises(ScenarioError, match=f"^s.yaml: {message[1:]}"):
        loads(f'name: a\nradio: {{link: "own.py:L(a={value})"}}', "s.yaml")


def test_a_parameter_that_names_a_file_is_found_beside_the_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "heights.csv").write_text("1\n")
    (tmp_path / "own.py").write_text("")
    (tmp_path / "s.yaml").write_text("name: s\nfleet: {sensor: 'own.py:f(heights=heights.csv, kind=wide.v2)'}\n")
    fleet = load(tmp_path / "s.yaml").fleet
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


@pytest.mark.parametrize(
    ("given", "model", "params"),
    [
        ("moved to (another) place/own.py:Name", "moved to (another) place/own.py:Name", None),
        ("d (x=1)/own.py:Name(y=2)", "d (x=1)/own.py:Name", {"y": 2}),
    ],
)
def test_brackets_in_a_folders_name_are_the_folders(given: str, model: str, params: dict[str, int] | None) -> None:
    plain = {"link": given}
    assert without_brackets(plain) == {"link": model} | ({} if params is None else {"link_params": params})
