"""`sortie new` writes a scenario to begin with; `sortie check --syntax` says everything that is wrong with files."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest
from typer.testing import CliRunner

import sortie
from sortie.scenarios.errors import SortieError
from sortie.scenarios.reading.load import ScenarioError, load, loads
from sortie.sim.cli.app import app
from sortie.sim.cli.listing import SCHEMAS

BROKEN = """name: broken
duration_s: -1
fleet: {drones: many, formatoin: {}}
events:
  - {at_s: 3}
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def say(*arguments: str) -> tuple[int, str]:
    said = CliRunner().invoke(app, arguments)
    return said.exit_code, str(said.exception) if isinstance(said.exception, SortieError) else said.output


def test_a_new_scenario_keeps_its_own_expectations_and_has_its_schema_beside_it(here: Path) -> None:
    """A schema of an older version is replaced."""
    assert say("new", "mine")[0] == 0
    assert load("mine.yaml").name == "mine"
    (checked,) = sortie.check("mine.yaml")
    assert (len(checked.verdicts), checked.failed) == (2, [])
    assert (here / "mine.yaml").read_text().splitlines()[0].endswith("$schema=sortie.schema.json")
    schema = here / "sortie.schema.json"
    newest = json.loads(schema.read_text("utf-8"))
    assert newest["title"] == "Scenario"
    schema.write_text(json.dumps({**newest, "properties": {"fleet": newest["properties"]["fleet"]}}))
    assert say("new", "another")[0] == 0
    assert json.loads(schema.read_text("utf-8")) == newest


def test_a_file_that_is_there_stays_and_a_name_that_no_scenario_may_have_is_refused(here: Path) -> None:
    (here / "mine.yaml").write_text("name: older\n")
    assert say("new", "mine")[1] == "mine.yaml: is there already, choose another name or delete it"
    assert (here / "mine.yaml").read_text() == "name: older\n"
    must = "no name of a scenario, must be 1 to 64 small letters, digits and _"
    assert say("new", "My Flight")[1] == f"'My Flight': {must}"
    assert [p.name for p in here.iterdir()] == ["mine.yaml"]


def test_everything_that_is_wrong_is_said_at_once(here: Path) -> None:
    (here / "broken.yaml").write_text(BROKEN)
    code, text = say("check", "--syntax", "broken.yaml", "track_target", "gone.yaml")
    lines = text.splitlines()
    assert code == 1
    assert lines[:3] == [
        "broken.yaml:2: duration_s: -1, must be ≥ 0.001",
        'broken.yaml:3: fleet.drones: "many", must be a whole number',
        "broken.yaml:3: fleet.formatoin: unknown key, did you mean formation?",
    ]
    assert lines[3].startswith("broken.yaml:5: events.0.kind: missing, must be battery_fault, camera_blocked, ")
    assert lines[4].startswith("gone.yaml: no such file")
    assert lines[5] == "5 things are wrong"


def test_what_a_file_names_and_is_not_there_is_said(here: Path) -> None:
    (here / "own.py").write_text("def loss(d, a, b, ghz, *, db=1.0):\n    return d\n")
    (here / "s.yaml").write_text(
        "name: s\nradio: {path_loss: own.py:loss, path_loss_params: {decibel: 3}, link: own.py:Link, trace: links.csv}"
        "\n"
        "perception: {detector: gone.py:D}\nfleet: {airframe: {power_model: momentum}}\n"
        "policy: {name: own.py:loss, params: {db: 2}}\nmetrics: {m: {model: own.py:loss, params: {x: 1}}}\n"
    )
    code, text = say("check", "--syntax", "s.yaml")
    assert code == 1
    assert text.splitlines() == [
        "s.yaml: no file links.csv",
        "s.yaml: path_loss 'own.py:loss' has no parameter 'decibel', it has: db",
        "s.yaml: link file 'own.py' has no function or class 'Link'",
        "s.yaml: detector file 'gone.py' not found",
        "s.yaml: metric 'own.py:loss' has no parameter 'x', it has: db",
        "5 things are wrong",
    ]


def test_every_file_of_the_library_is_read() -> None:
    code, text = say("check", "--syntax", "all")
    assert code == 0
    assert text.endswith("files read, nothing is wrong\n")


def test_a_campaign_and_a_set_of_conditions_are_read_as_what_they_are(here: Path) -> None:
    vary = "vary: {radio.tx_power: {kind: uniform, low: 0, high: 1}}"
    (here / "c.yaml").write_text(f"campaign: c\nbase: track_target\nmetrics: [bytes.data_sent]\n{vary}\n")
    (here / "s.yaml").write_text("conditions: []\n")
    code, text = say("check", "--syntax", "c.yaml", "s.yaml")
    assert code == 1
    assert "c.yaml:4: radio.tx_power: unknown key, did you mean tx_power_dbm?" in text
    assert "s.yaml:1:" in text


def test_the_first_issue_alone_is_the_error_of_a_flight() -> None:
    with pytest.raises(ScenarioError, match=r"duration_s: -1, must be ≥ 0.001 \(and 3 more\)$") as caught:
        loads(BROKEN)
    assert len(caught.value.issues) == 4


def test_what_happens_after_the_end_is_left_out_with_a_line_or_is_an_error_where_it_was_meant(
    here: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = load("paper_replay_contention")
    with caplog.at_level(logging.WARNING, "sortie"):
        short = load("paper_replay_contention", {"duration_s": 5})
    assert len(whole.events) > len(short.events) == sum(event.at_s < 5 for event in whole.events)
    left = f"{len(whole.events) - len(short.events)} of {len(whole.events)}"
    assert f"events: {left} begin at duration_s = 5 or later, and are left out" in caplog.messages
    late = "events=[{kind: jam, at_s: 9, position_m: [0, 0, 0]}]"
    (here / "a.yaml").write_text("name: a\nduration_s: 5\nevents: [{kind: drone_lost, at_s: 9, drone: 1}]\n")
    for name, sets in (("paper_replay_contention", ["duration_s=5", late]), ("a.yaml", [])):
        with pytest.raises(ScenarioError, match=r"events.0.at_s: 9, must be below duration_s = 5"):
            load(name, sets)


def test_there_is_a_schema_for_each_kind_of_file() -> None:
    for what, model in SCHEMAS.items():
        code, text = say("list", what)
        assert (code, json.loads(text)["title"]) == (0, model.__name__)
