"""What a file says against what stands above, beside and below it: overrides, presets, bases, aliases and named files.

1. An override shortens a flight that it shortens alone, and changes one value of a preset.
2. Of several mistakes the file's first is told first, and those of overrides last.
3. A campaign's base, its files and its columns; each end of what is varied is held against the schema.
4. Files and models are found wherever a scenario names them: in makes, groups, parameters.
5. The tree: the last entry of a list, names with another unit, aliases with all that they hold.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sortie.scenarios.reading.campaign import Study, extremes, load_campaign
from sortie.scenarios.reading.files import (
    found_beside,
    models_with_params,
    named_files,
    with_files,
    without_brackets,
)
from sortie.scenarios.reading.load import ScenarioError, build, load, loads
from sortie.scenarios.reading.nodes import MAX_DEPTH, as_node, assign, child, nearest, plain
from sortie.scenarios.reading.strict_yaml import MAX_WEIGHT, read_yaml
from sortie.scenarios.reading.top_keys import top_keys
from sortie.scenarios.schema.campaign import Linspace, Normal

LOST = "events: [{kind: drone_lost, drone: 0, at_s: 3}]"


def test_only_what_an_override_shortens_is_left_out() -> None:
    """What the file itself, or another override, does after the end is a mistake."""
    text = f"name: a\nduration_s: 9\n{LOST}\n"
    assert loads(text, overrides=["duration_s=3"]).events == ()
    assert len(loads(text, overrides=["duration_s=3.1"]).events) == 1
    late = 'events=[{"kind": "drone_lost", "drone": 0, "at_s": 4}]'
    with pytest.raises(ScenarioError, match="must be below duration_s = 4"):
        loads(text, overrides=["duration_s=4", late])
    with pytest.raises(ScenarioError, match="must be below duration_s = 3"):
        loads(f"name: a\nduration_s: 3\n{LOST}\n", overrides=["seed=2"])


@pytest.mark.parametrize(
    ("field", "preset", "override", "kept"),
    [("fleet.airframe", "solo", "payload_kg=1", ("mass_kg", 1.88)), ("context.form", "small", "grid_cells=4", ("number_bits", 16))],
)  # fmt: skip
def test_an_override_below_a_preset_keeps_the_preset_s_other_values(
    field: str, preset: str, override: str, kept: tuple[str, Any]
) -> None:
    section, name = field.split(".")
    made = loads(f"name: a\n{section}: {{{name}: {preset}}}\n", overrides=[f"{field}.{override}"])
    found = getattr(getattr(made, section), name)
    key, _, value = override.partition("=")
    assert (getattr(found, key), getattr(found, kept[0])) == (float(value), kept[1])


def test_mistakes_are_told_in_the_file_s_order_and_those_of_overrides_last() -> None:
    with pytest.raises(ScenarioError) as caught:
        loads("name: a\nseed: -1\nduration_s: 0\n", "f.yaml", ["fleet.drones=0"])
    assert [issue.split(":")[1] for issue in caught.value.issues][:2] == ["2", "3"]
    assert "fleet.drones" in caught.value.issues[-1]
    assert str(caught.value).endswith("(and 2 more)")


def test_a_library_s_name_means_the_library_also_beside_a_file_of_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("track_target").write_text("name: mine\n")
    assert load("track_target").name == "track_target"
    assert load(Path("./track_target").absolute()).name == "mine"


# --- campaigns -------------------------------------------------------------------------------------------


def study(folder: Path, **changes: Any) -> Study:
    (folder / "base.yaml").write_text(json.dumps({"name": "base", "duration_s": 5.0}))
    (folder / "c.yaml").write_text(json.dumps({"campaign": "c", "base": "base.yaml", "metrics": ["wall_s"], **changes}))
    return load_campaign(folder / "c.yaml")


def test_both_ends_of_what_is_varied_are_held_against_the_schema(tmp_path: Path) -> None:
    field = "fleet.battery.initial_soc"
    for low, high, wrong in ((0.5, 1.0, None), (0.0, 1.0, "0, must be"), (0.5, 1.1, "1.1, must be")):
        for spread in (
            {"kind": "uniform", "low": low, "high": high}, {"kind": "normal", "mean": 0.7, "sd": 0.1, "low": low, "high": high},
            {"kind": "linspace", "low": low, "high": high, "count": 3}, {"kind": "triangular", "low": low, "mode": 0.7, "high": high},
        ):  # fmt: skip
            if wrong is None:
                assert study(tmp_path, vary={field: spread}).drones == 5
            else:
                with pytest.raises(ScenarioError, match=wrong):
                    study(tmp_path, vary={field: spread})
    assert list(extremes(Normal(kind="normal", mean=1.0, sd=1.0, high=3.0), ())) == [3.0]
    assert list(extremes(Normal(kind="normal", mean=1.0, sd=1.0), ())) == [1.0]
    assert [type(v) for v in extremes(Linspace(kind="linspace", low=1.0, high=2.5, count=4), ())] == [int, float]


def test_a_line_of_whole_numbers_may_be_counted(tmp_path: Path) -> None:
    spread = {"kind": "linspace", "low": 2, "high": 6, "count": 3}
    assert study(tmp_path, vary={"fleet.drones": spread}).drones == 6


def test_a_column_keeps_its_empty_cells_and_its_words(tmp_path: Path) -> None:
    """A row is a row, so that columns of one file stay side by side; true is a word there, and 1.5 a number."""
    (tmp_path / "v.csv").write_text("a,b\nworked,1.5\n,2\ntrue,-3\n")
    found = study(
        tmp_path, vary={
            "description": {"kind": "column", "file": "v.csv", "column": "a"},
            "policy.params.x": {"kind": "column", "file": "v.csv", "column": "b"},
        },
    )  # fmt: skip
    assert found.columns == {"description": ("worked", "", "true"), "policy.params.x": (1.5, 2, -3)}
    assert [type(v) for v in found.columns["policy.params.x"]] == [float, int, int]


def test_files_that_a_base_names_lie_beside_the_base_or_beside_the_campaign(tmp_path: Path) -> None:
    """Those of `set` beside the campaign, and those of a base in another folder beside that."""
    (tmp_path / "own").mkdir()
    for name in ("own/a.csv", "b.csv"):
        (tmp_path / name).write_text("t_s,sender,receiver,snr_db\n0,0,1,20\n")
    (tmp_path / "own" / "base.yaml").write_text(json.dumps({"name": "base", "radio": {"trace": "a.csv"}}))
    of = {"campaign": "c", "base": "own/base.yaml", "metrics": ["wall_s"]}
    (tmp_path / "c.yaml").write_text(json.dumps(of))
    assert load_campaign(tmp_path / "c.yaml").base.radio.trace == str(tmp_path / "own" / "a.csv")
    (tmp_path / "c.yaml").write_text(json.dumps(of | {"set": {"radio.trace": "b.csv"}}))
    assert load_campaign(tmp_path / "c.yaml").base.radio.trace == str(tmp_path / "b.csv")


# --- named files and models ------------------------------------------------------------------------------


WHOLE: dict[str, Any] = {
    "name": "a",
    "fleet": {
        "makes": [
            {"name": "m", "drones": [0], "weights": "w.st", "codebook": "c.st", "policy": "p.py:decide", "policy_params": {"k": 1},
             "airframe": {"power_model": "w.py:Power"}, "battery": {"cell_model": "cell.py:Cell", "cell_params": {"v": 3}}},
        ],
        "groups": [{"drones": [1], "mobility": "g.py:Way", "mobility_params": {"table": "way.csv"}}],
        "mobility": "random_waypoint",
    },
    "policy": {"name": "worked", "changes": [{"at_s": 1, "name": "q.py:decide"}]},
    "events": [{"kind": "own", "at_s": 1, "model": "e.py:Rain", "params": {"mm": 2}}],
    "metrics": {"mine": {"model": "f.py:figure"}},
}  # fmt: skip


def test_every_place_of_a_scenario_that_names_a_model_is_known() -> None:
    assert list(models_with_params(WHOLE)) == [
        ("mobility", "random_waypoint", {}), ("policy", "worked", {}), ("policy", "p.py:decide", {"k": 1}),
        ("power", "w.py:Power", {}), ("cell", "cell.py:Cell", {"v": 3}), ("mobility", "g.py:Way", {"table": "way.csv"}),
        ("policy", "q.py:decide", {}), ("event", "e.py:Rain", {"mm": 2}), ("metric", "f.py:figure", {}),
    ]  # fmt: skip


def test_every_place_of_a_scenario_that_names_a_file_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A parameter that is the name of a file is one, too."""
    monkeypatch.chdir(tmp_path)
    Path("way.csv").write_text("x\n1\n")
    wanted = ["w.st", "c.st", "p.py", "w.py", "cell.py", "g.py", "way.csv", "q.py", "e.py", "f.py"]
    assert sorted(named_files(WHOLE)) == sorted(wanted)
    moved = with_files(WHOLE, lambda name: f"there/{name}")
    assert sorted([*named_files(moved), "there/way.csv"]) == sorted(f"there/{name}" for name in wanted)
    assert moved["fleet"]["groups"][0] == {
        "drones": [1], "mobility": "there/g.py:Way", "mobility_params": {"table": "there/way.csv"},
    }  # fmt: skip
    assert WHOLE["fleet"]["groups"][0]["mobility"] == "g.py:Way"


def test_a_parameter_s_file_is_found_beside_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("class Link: ...\n")
    (tmp_path / "table.csv").write_text("x\n")
    made = build(
        {"name": "a", "radio": {"link": "own.py:Link", "link_params": {"table": "table.csv", "word": "table", "k": 2}}}
    )
    found = found_beside(made, tmp_path).radio
    assert found.link == f"{tmp_path}/own.py:Link"
    assert found.link_params == {"table": f"{tmp_path}/table.csv", "word": "table", "k": 2}


def test_parameters_are_no_sections() -> None:
    """What stands in a model's parameters is the model's, whatever it looks like."""
    sections = {"radio": {"link": "own.py:Name", "link_params": {"model": "Other(k=1)"}}}
    assert without_brackets(sections) == sections
    assert without_brackets({"events": [{"model": "e.py:E(k=1)"}]}) == {
        "events": [{"model": "e.py:E", "params": {"k": 1}}]
    }


# --- the tree ----------------------------------------------------------------------------------------------


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
    assert read_yaml(deep + "b: *x\n", "f") is not None
    with pytest.raises(ScenarioError, match=f"{MAX_DEPTH + 1} levels deep"):
        read_yaml(deep + "b: [*x]\n", "f")
    with pytest.raises(ScenarioError, match=f"{MAX_DEPTH + 1} levels deep"):
        read_yaml(deep + "b: {c: *x, d: 1}\n", "f")
    tall = "a: &y {p: &x " + "[" * (MAX_DEPTH - 4) + "1" + "]" * (MAX_DEPTH - 4) + ", q: 1}\n"
    with pytest.raises(ScenarioError, match="levels deep"):
        read_yaml(tall + "b: [[*y]]\n", "f")
    wide = "a: &x [" + ", ".join("1" * (MAX_WEIGHT // 5)) + "]\n"
    assert read_yaml(wide + "b: [*x, *x, *x]\n", "f") is not None
    with pytest.raises(ScenarioError, match="aliases expanded"):
        read_yaml(wide + "b: [*x, *x, *x, *x]\n", "f")
    with pytest.raises(ScenarioError, match="aliases expanded"):
        read_yaml(wide + "b: &z [*x, *x]\nc: *z\n", "f")


def test_keys_of_a_broken_file_are_words_where_keys_would_stand() -> None:
    assert top_keys("name: a\nfleet: [1\nradio: {x: 1}\n") >= {"name", "fleet", "radio"}
    assert top_keys("{name: a, fleet: {drones: 2}, radio: [") >= {"name", "fleet"}
    assert "b" not in top_keys('{"a": 1, x: [, b: 2')
