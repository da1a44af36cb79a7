"""Options of commands: honoured or refused, and refused before anything flies."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from cli_examples import command, refusal
from sim_examples import BASE


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "example.yaml"
    path.write_text(BASE)
    return path


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("view", ".", "--at", "3"), "--at goes with --picture"),
        (("check", "example.yaml", "--syntax", "--update"), "--update goes with flights, not with --syntax"),
        (("check", "example.yaml", "--syntax", "--junit", "o.xml"), "--junit goes with flights, not with --syntax"),
        (
            ("compare", "example.yaml", "--policies", "silence", "--by-torch"),
            "--by-torch goes with a set of conditions",
        ),
        (
            ("compare", "conditions", "--policies", "silence", "--seed", "0"),
            "--seed goes with a scenario, not with a set",
        ),
        (("compare", "conditions", "--policies", "silence", "--own-fusion"), "--own-fusion goes with a scenario"),
        (
            ("compare", "conditions", "--policies", "silence", "--half-width", "0.1"),
            "--half-width goes with a scenario",
        ),
        (("compare", "example.yaml", "--policies", "silence", "--pilot", "8"), "--pilot goes with --half-width"),
        (("compare", "example.yaml", "--policies", "silence", "--kept", "c.sqlite"), "--kept goes with --half-width"),
        (
            ("compare", "example.yaml", "--policies", "silence,worked", "--half-width", "0.1", "--seeds", "3"),
            "--seeds does not go with --half-width",
        ),
        (
            ("compare", "example.yaml", "--policies", "silence,worked", "--half-width", "0.1", "--recording", "c.rrd"),
            "--recording does not go with --half-width",
        ),
        (
            ("compare", "example.yaml", "--policies", "silence,worked", "--half-width", "0"),
            "half-width: 0, must be above 0 and below 1; 0.01 is one AP point",
        ),
        (
            ("compare", "example.yaml", "--policies", "silence,worked", "--half-width", "0.1", "--metric", "ap70"),
            "metric: ap70, must be one of ap50.full_scene, ap50.mission",
        ),
        (
            (
                "compare",
                "example.yaml",
                "--policies",
                "silence,worked",
                "--half-width",
                "0.1",
                "--most-seeds",
                "6",
                "--pilot",
                "9",
            ),
            "pilot: 9, must be 4 or more and at most the seeds to fly (6)",
        ),
        (
            (
                "compare",
                "example.yaml",
                "--policies",
                "silence",
                "--half-width",
                "0.1",
                "--set",
                "perception.detector=torch",
            ),
            "policies: one, must be two or more to compare to a half-width",
        ),
        (
            (
                "compare",
                "example.yaml",
                "--policies",
                "silence,worked",
                "--half-width",
                "0.1",
                "--set",
                "perception.detector=none",
            ),
            "perception.detector is none, must be torch or one of your own",
        ),
        (
            ("compare", "conditions", "--policies", "silence", "--recording", "c.rrd"),
            "--recording goes with a scenario",
        ),
        (("compare", "conditions", "--policies", "silence", "--readme", "c.md"), "--readme goes with a scenario"),
        (("compare", "conditions", "--policies", "silence", "--out", "."), ".: is a folder, must be a file"),
        (("compare", "example.yaml", "--policies", "silence", "--out", "."), ".: is a folder, must be a file"),
        (
            ("compare", "example.yaml", "--policies", "silence", "--recording", "example.yaml/c.rrd"),
            "example.yaml/c.rrd: its folder cannot be made",
        ),
        (("compare", "example.yaml", "--policies", "silence", "--readme", "c.md"), "c.md: No such file or directory"),
        (("compare", "example.yaml", "--policies", "silence", "--readme", "example.yaml"), "must hold <!-- compare"),
        (("live", "example.yaml", "--out", "."), ".: is a folder, must be a file"),
        (("fly", "--from-campaign", ".", "--run", "0", "--seed", "0"), "name nothing else"),
        (("fly", "--from-campaign", ".", "--run", "0", "--replication", "0"), "name nothing else"),
        (("fly", "link_battery"), "link_battery.yaml: is a campaign, not a scenario; its command is: sortie campaign"),
        (
            ("check", "conditions"),
            "conditions.yaml: is a set of conditions, not a scenario; its command is: sortie compare",
        ),
        (("fly", "example.yaml", "--pace", "1.0"), "--pace goes with --mavlink"),
        (("fly", "example.yaml", "--mavlink-key", "key"), "--mavlink-key goes with --mavlink"),
        (("live", "example.yaml", "--origin", "47,8"), "--origin goes with --mavlink"),
        (("campaign", "link_battery", "--wait-for-workers", "7"), "--wait-for-workers goes with --scheduler"),
        (("campaign", "run", "link_battery", "--security", "a", "b", "c"), "--security goes with --scheduler"),
        (("verify", "link", "own.py:L", "--views", "20"), "--views goes with policies"),
        (("verify", "link", "own.py:L", "--out", "o"), "--out goes with policies"),
        (("verify", "link", "own.py:L", "--scenario", "example.yaml"), "--scenario goes with policies"),
    ],
)
def test_what_cannot_be_honoured_is_refused_before_anything_flies(
    scenario: Path, arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refusal(scenario.parent, arguments, capsys)


def test_a_seed_is_one_that_a_scenario_takes(scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command("fly", scenario, "--seed", 2**63) == 2
    assert "Invalid value for '--seed'" in capsys.readouterr().err


def test_a_domain_out_of_range_is_one_line(
    scenario: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for domain in ("231", "-1"):
        monkeypatch.setenv("ROS_DOMAIN_ID", domain)
        assert command("live", scenario) == 2
        assert capsys.readouterr().err == f"error: ROS_DOMAIN_ID is {domain}, must be 0 to 230\n"


def test_a_comparison_in_a_readme_says_how_it_was_made(scenario: Path, tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    readme.write_text("<!-- compare:begin --><!-- compare:end -->")
    made = (
        "--policies",
        "silence,all-4(received_budget=0.1)",
        "--seed",
        3,
        "--set",
        "duration_s=1",
        "--set",
        "fleet.drones=2",
    )
    assert command("compare", scenario, *made, "--readme", readme, "--recording", tmp_path / "new" / "c.rrd") == 0
    said = f"sortie compare {shlex.quote(str(scenario))} --policies 'silence,all-4(received_budget=0.1)' --seed 3 --set duration_s=1 --set fleet.drones=2"
    assert f"`{said}`: 1 s, 2 drones, seed 3, in this town, this flight." in readme.read_text()
    assert (tmp_path / "new" / "c.rrd").is_file()


def test_a_name_between_colons_is_printed_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Rich would print an emoji for `:link:`."""
    assert command("fly", "track_target", "--set", "radio.link=oops:Link") == 2
    assert "radio.link=oops:Link: radio.link" in capsys.readouterr().err
