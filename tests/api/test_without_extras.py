"""An installation without extras: the surrogate flies, and what needs a missing library says which extra brings it."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from missing_libraries import path_without

from sortie.sim.export.foxglove import LAYOUT

pytestmark = pytest.mark.slow

RUN = """
import sys

from sortie.__main__ import main

for words in COMMANDS:
    sys.argv[1:] = words
    try:
        main()
        code = 0
    except SystemExit as end:
        code = end.code or 0
    print(f"exit {code}", file=sys.stderr, flush=True)
"""
SURROGATE = ("--set", "perception.detector=surrogate", "--set", "duration_s=2", "--set", "mission.phases=[{}]")
VIEW = "error: rerun is missing: pip install 'sortie-sim[view]'\n"
ROS = "error: rosbags is missing: pip install 'sortie-sim[ros2]'\n"
MAVLINK = "error: pymavlink is missing: pip install 'sortie-sim[mavlink]'\n"


def _sortie(
    folder: Path, *commands: tuple[str, ...], without: tuple[str, ...] = ("torch", "rerun", "pymavlink")
) -> tuple[str, str]:
    """Output and errors of commands one after another in one process; each ends with a line `exit CODE`."""
    code, env = f"COMMANDS = {commands!r}\n{RUN}", {**os.environ, "PYTHONPATH": path_without(folder, *without)}
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, env=env, capture_output=True, text=True, check=True)
    return done.stdout, done.stderr


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with the run `a` and its bag, flown by the surrogate without extras, and what was printed."""
    folder = tmp_path_factory.mktemp("slim")
    commands = ("fly", "track_target", *SURROGATE, "--out", "a"), ("report", "a"), ("export", "a", "--mcap")
    printed, errors = _sortie(folder, *commands)
    assert errors == "exit 0\n" * 3
    return folder, printed


def test_the_surrogate_flies_and_its_run_is_reported(flown: tuple[Path, str]) -> None:
    folder, printed = flown
    assert "AP@0.5" in printed
    assert "kept in a\nwithout a recording, as Rerun is missing: pip install 'sortie-sim[view]'\n" in printed
    assert not (folder / "a/sortie.rrd").exists()


def test_a_sortie_without_a_recording_says_nothing_of_rerun(tmp_path: Path) -> None:
    printed, _ = _sortie(tmp_path, ("fly", "track_target", *SURROGATE, "--no-recording", "--out", "a"))
    assert printed.endswith("kept in a\n")


NEEDY = {
    ("view", "a"): VIEW,
    ("fly", "track_target", *SURROGATE, "--view", "--out", "b"): VIEW,
    ("fly", "track_target", *SURROGATE, "--live", "--out", "b"): VIEW,
    ("fly", "track_target", *SURROGATE, "--recording", "--out", "b"): VIEW,
    ("fly", "track_target", *SURROGATE, "--mavlink", "udpout:127.0.0.1:14550", "--out", "b"): MAVLINK,
    ("export", "a", "--tlog"): MAVLINK,
    ("import", "flown.tlog"): MAVLINK,
    ("export", "a", "--mcap", "--replace"): ROS,
    ("live", "track_target", "--mavlink", "udpin:127.0.0.1:14550"): MAVLINK,
    ("fly", "track_target", "--out", "b"): "error: perception.detector is torch, which is not installed: "
    "pip install 'sortie-sim[torch]', or take surrogate\n",
}


def test_what_needs_an_extra_says_so_before_it_flies(flown: tuple[Path, str]) -> None:
    folder, _ = flown
    (folder / "flown.tlog").write_bytes(struct.pack(">Q", 1_700_000_000_000_000) + b"\xfd" + bytes(40))
    _, errors = _sortie(folder, *NEEDY, without=("torch", "rerun", "pymavlink", "rosbags"))
    assert errors == "".join(f"{told}exit 2\n" for told in NEEDY.values())
    assert not (folder / "b").exists()


def test_a_run_becomes_a_bag(flown: tuple[Path, str]) -> None:
    folder, _ = flown
    assert {file.name for file in (folder / "a/bag").iterdir()} == {"metadata.yaml", "bag.mcap", LAYOUT}


def test_what_needs_no_mavlink_runs_without_it(tmp_path: Path) -> None:
    (tmp_path / "a.ulg").write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8))
    _, errors = _sortie(tmp_path, ("import", "a.ulg"), ("live", "track_target", "--set", "fleet.drones=21"))
    assert "a.ulg" in errors
    assert "live flights have at most 20" in errors
    assert "pymavlink" not in errors
