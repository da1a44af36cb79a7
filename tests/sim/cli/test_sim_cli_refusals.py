"""What a user can put right is one line and exit code 2, before anything flies, is proved or is written."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_examples import command, refused, run_line
from sim_examples import BASE, example

from sortie.perception.surrogate.model import SHIPPED as CALIBRATION
from sortie.scenarios.reading.nodes import ScenarioError
from sortie.sim.identity import own_files

LONG = "n" * 300
SCHEMA = "sortie.schema.json"
TWO = "compare a.yaml --policies silence,worked --half-width 0.1"
SET = "compare conditions --policies silence"
ONE = "compare a.yaml --policies silence"
SURROGATE = "fly track_target --set perception.detector=surrogate --set duration_s=1"
AGAIN = "fly --from-campaign . --run 0"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "a.yaml").write_text(BASE)
    (tmp_path / "inside").mkdir()
    return tmp_path


REFUSED = [
    # names, values and brackets
    ("fly nowhere.yaml", "nowhere.yaml"),
    ("fly a.yaml --policy wrst-2", "unknown policy 'wrst-2', did you mean worst-2? known: worked, all-4"),
    ("fly a.yaml --policy 'all-4(received_budget=0.1'", "the bracket is not closed"),
    ("fly a.yaml --policy 'silence(rho=0.1)'", "policy 'silence' has no parameter 'rho'"),
    ("fly a.yaml --policy no/such.py:decide", "policy file 'no/such.py' not found"),
    ("fly a.yaml --set fleet.batery.initial_soc=0.5", "did you mean battery?"),
    ("fly a.yaml --set fleet.battery.initial_soc=1.5", "1.5"),
    ("fly a.yaml --set nonsense", "--set nonsense: must be key.path=value"),
    ("fly track_target --set radio.link=oops:Link", "radio.link=oops:Link: radio.link"),  # no emoji for :Link:
    ("compare a.yaml --policies ,", "no policy named"),
    ("compare a.yaml --policies silence,silence", "a policy is named twice"),
    ("check a.yaml nowhere", "nowhere"),
    ("view .", "no run there"),
    ("verify loud", "unknown policy 'loud'"),
    ("fly link_battery", "link_battery.yaml: is a campaign, not a scenario; its command is: sortie campaign"),
    ("check conditions", "conditions.yaml: is a set of conditions, not a scenario; its command is: sortie compare"),
    # options that do not go together
    ("view . --at 3", "--at goes with --picture"),
    ("check a.yaml --syntax --update", "--update goes with flights, not with --syntax"),
    ("check a.yaml --syntax --junit o.xml", "--junit goes with flights, not with --syntax"),
    (f"{ONE} --by-torch", "--by-torch goes with a set of conditions"),
    (f"{SET} --seed 0", "--seed goes with a scenario, not with a set"),
    (f"{SET} --own-fusion", "--own-fusion goes with a scenario"),
    (f"{SET} --half-width 0.1", "--half-width goes with a scenario"),
    (f"{SET} --recording c.rrd", "--recording goes with a scenario"),
    (f"{SET} --readme c.md", "--readme goes with a scenario"),
    (f"{ONE} --pilot 8", "--pilot goes with --half-width"),
    (f"{TWO} --seeds 3", "--seeds does not go with --half-width"),
    (f"{TWO} --recording c.rrd", "--recording does not go with --half-width"),
    (f"{AGAIN} --seed 0", "name nothing else"),
    (f"{AGAIN} --replication 0", "name nothing else"),
    ("fly a.yaml --pace 1.0", "--pace goes with --mavlink"),
    ("fly a.yaml --mavlink-key key", "--mavlink-key goes with --mavlink"),
    ("live a.yaml --origin 47,8", "--origin goes with --mavlink"),
    ("campaign link_battery --wait-for-workers 7", "--wait-for-workers goes with --scheduler"),
    ("campaign run link_battery --security a b c", "--security goes with --scheduler"),
    ("verify link own.py:L --views 20", "--views goes with policies"),
    ("verify link own.py:L --out o", "--out goes with policies"),
    ("verify link own.py:L --scenario a.yaml", "--scenario goes with policies"),
    # comparisons that cannot be made
    (f"{TWO[:-3]}0", "half-width: 0, must be above 0 and below 1; 0.01 is one AP point"),
    (f"{TWO} --metric ap70", "metric: ap70, must be one of ap50.full_scene, ap50.mission"),
    (f"{TWO} --most-seeds 6 --pilot 9", "pilot: 9, must be 4 or more and at most the seeds to fly (6)"),
    (f"{ONE} --half-width 0.1 --set perception.detector=torch", "policies: one, must be two or more to compare"),
    (f"{TWO} --set perception.detector=none", "perception.detector is none, must be torch or one of your own"),
    (
        "fly track_target --set perception.weights=no.st",
        "no.st: no such weights file; `python -m research train` makes",
    ),
    (f"{SURROGATE} --set perception.weights=no.st", "no.st: no such calibration; `python -m research calibrate` makes"),
    (
        f"{SURROGATE} --set perception.fusion=late",
        f"{CALIBRATION}: calibrated for fusion 'disconet', perception.fusion is",
    ),
    # files and folders
    (f"{SET} --out .", ".: is a folder, must be a file"),
    (f"{ONE} --out .", ".: is a folder, must be a file"),
    ("live a.yaml --out .", ".: is a folder, must be a file"),
    (f"{ONE} --recording a.yaml/c.rrd", "a.yaml/c.rrd: its folder cannot be made"),
    (f"{ONE} --readme c.md", "c.md: No such file or directory"),
    (f"{ONE} --readme a.yaml", "must hold <!-- compare"),
    ("verify silence --out a.yaml", "its folder cannot be made or written to"),
    ("fly a.yaml --out a.yaml", "a.yaml: is a file, a run needs a folder"),
    *(
        (f"fly a.yaml --out {place}", f"error: {place}: is the working folder")
        for place in (".", "..", "/", "inside/..")
    ),
    # names that are too long
    (f"fly a.yaml --out {LONG}", LONG),
    (f"fly a.yaml --policy {LONG}.py:f", LONG),
    (f"fly a.yaml --set radio.link={LONG}.py:f", LONG),
    (f"fly a.yaml --set perception.weights={LONG}", LONG),
    (f"check {LONG}", LONG),
    (f"report {LONG}", LONG),
    (f"export {LONG} --pcap", LONG),
    (f"replay {LONG}", LONG),
    (f"{ONE} --out {LONG}", LONG),
    (f"verify {LONG}.py:f", LONG),
]


def test_what_cannot_be_done_is_refused_in_one_line_before_anything_flies(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert refused(folder, REFUSED, capsys) == {}


def test_a_domain_out_of_range_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for domain in ("231", "-1"):
        monkeypatch.setenv("ROS_DOMAIN_ID", domain)
        words = f"error: ROS_DOMAIN_ID is {domain}, must be 0 to 230\n"
        assert refused(folder, [("live a.yaml", words)], capsys) == {}


def test_a_working_folder_that_was_deleted_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert run_line("fly track_target --set duration_s=1") == 2
    assert capsys.readouterr().err == "error: the working folder was deleted; change to another folder\n"


def test_a_schema_of_somebody_else_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for theirs in ("{}", "[]", "not JSON", '{"title": "Scenario", "properties": {}}'):
        (tmp_path / SCHEMA).write_text(theirs)
        assert refused(tmp_path, [("new mine", f"error: {SCHEMA}: is there already")], capsys) == {}
        assert (tmp_path / SCHEMA).read_text() == theirs


def test_a_file_that_is_missing_is_named_with_its_field() -> None:
    makes = "fleet.makes=[{name: other, drones: [1], weights: nope.safetensors}]"
    for field, *sets in (
        ("perception.weights", "perception.weights=nope.safetensors"),
        ("perception.codebook", "perception.codebook=nope.safetensors"),
        (r"fleet\.makes\.0\.weights", "perception.detector=torch", makes),
    ):
        with pytest.raises(ScenarioError, match=f"^{field}: nope.safetensors: no such file$"):
            own_files(example(*sets))


IMPORTED = [f"import a.bin {option}={value}" for option in ("--lift", "--until", "--from") for value in ("nan", "-1e5")]


def test_a_value_that_no_option_takes_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`--lift nan` left the trace without heights, and the scenario flew its own route."""
    for line in (f"fly {folder}/a.yaml --seed {2**63}", *IMPORTED):
        option = line.rpartition("--")[2].partition("=")[0].split()[0]
        assert command(*line.split()) == 2
        assert f"Invalid value for '--{option}'" in capsys.readouterr().err
