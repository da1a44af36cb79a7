"""An installation without extras: the surrogate flies, and what needs a missing library says which extra brings it."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import pytest

BLOCKED = """
import sys


class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in LIBRARIES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, Missing())
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
SURROGATE = ("--set", "perception.detector=surrogate", "--set", "duration_s=2")
VIEW = "error: rerun is missing: pip install 'sortie-sim[view]'\n"
MAVLINK = "error: pymavlink is missing: pip install 'sortie-sim[mavlink]'\n"


def _sortie(
    folder: Path, *commands: tuple[str, ...], without: tuple[str, ...] = ("torch", "rerun", "pymavlink")
) -> tuple[str, str]:
    """Output and errors of commands one after another in one process; each ends with a line `exit CODE`."""
    code = f"LIBRARIES = {without!r}\nCOMMANDS = {commands!r}\n{BLOCKED}"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout, done.stderr


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with the run `a`, flown by the surrogate without any extra, and what was printed."""
    folder = tmp_path_factory.mktemp("slim")
    printed, errors = _sortie(folder, ("fly", "track_target", *SURROGATE, "--out", "a"), ("report", "a"))
    assert errors == "exit 0\nexit 0\n"
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
    ("live", "track_target", "--mavlink", "udpin:127.0.0.1:14550"): MAVLINK,
    ("paper",): "error: torch is missing: pip install 'sortie-sim[torch]'\n",
    ("fly", "track_target", "--out", "b"): "error: perception.detector is torch, which is not installed: "
    "pip install 'sortie-sim[torch]', or take surrogate\n",
}


def test_what_needs_an_extra_says_so_before_it_flies(flown: tuple[Path, str]) -> None:
    folder, _ = flown
    (folder / "flown.tlog").write_bytes(struct.pack(">Q", 1_700_000_000_000_000) + b"\xfd" + bytes(40))
    _, errors = _sortie(folder, *NEEDY)
    assert errors == "".join(f"{told}exit 2\n" for told in NEEDY.values())
    assert not (folder / "b").exists()


def test_a_log_that_is_no_telemetry_needs_no_mavlink(tmp_path: Path) -> None:
    (tmp_path / "a.ulg").write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8))
    _, errors = _sortie(tmp_path, ("import", "a.ulg"), without=("pymavlink",))
    assert "a.ulg" in errors
    assert "pymavlink" not in errors
