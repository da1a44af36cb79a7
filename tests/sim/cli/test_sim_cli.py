"""Commands in this process, as a user meets them: folders of runs, checks, comparisons, lists and exit codes."""

from __future__ import annotations

import inspect
import json
import os
import shlex
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from cli_examples import run_line
from sim_examples import BASE, example
from typer.testing import CliRunner

import sortie
from sortie.fleet.logs.flightlog import read_logs
from sortie.perception.recordings.recording import open_recording
from sortie.policies.registry import resolve
from sortie.scenarios.exit_codes import DEFECT, FAILED, INTERRUPTED, USER
from sortie.scenarios.reading.load import load
from sortie.scenarios.report_text import size
from sortie.scenarios.traces import read_columns
from sortie.sim.check.expectations import check
from sortie.sim.cli.app import app
from sortie.sim.cli.export import export
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.export.endpoint import read_key
from sortie.sim.export.telemetry import MavlinkEndpoint
from sortie.sim.folders import RunError
from sortie.sim.identity import file_digest
from sortie.sim.results import run_folder
from sortie.sim.results.outcome import outcome
from sortie.sim.results.run_files import WRITTEN
from sortie.sim.studies.beside import Beside

SHORT = "--no-recording --set duration_s=0.5"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a scenario."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")
    (tmp_path / "example.yaml").write_text(BASE)
    return tmp_path


def never_flown(*_: object, **__: object) -> None:
    raise AssertionError("flown")


# --- folders of runs -------------------------------------------------------------------------------------


def test_another_run_is_replaced_with_replace_alone_and_what_other_code_flew_is_kept_beside(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same scenario and seed can have another record, by other code. Neither run is lost then."""
    path, fly = Path("run"), f"fly example.yaml --out run {SHORT}"
    assert run_line(fly) == 0
    assert f"kept in {path}\n" in capsys.readouterr().out
    with monkeypatch.context() as patch:
        patch.setattr(sortie, "fly", never_flown)
        for more in ("--seed 7", "--set fleet.drones=3", "--policy silence"):
            assert run_line(f"{fly} {more}") == 2
            advice = "choose another folder, or replace it with --replace"
            assert capsys.readouterr().err == f"error: {path}: holds another run; {advice}\n"
        (path / "mynotes.txt").write_text("a day's work")
        assert run_line(fly) == 2
        said = "run: holds mynotes.txt, which no run wrote; choose another folder or move it"
        assert said in capsys.readouterr().err
        (path / "mynotes.txt").unlink()
    record = run_folder.load(path)
    other = replace(record, totals={**record.totals, "decisions": 0})
    run_folder.save(other, path, replace=True)
    assert run_line(fly) == 0
    own = Path(f"runs/example-s1-worked-{record.fingerprint[:8]}")
    assert f"kept in {own}, as {path} holds another run" in capsys.readouterr().out
    assert run_folder.load(own).fingerprint == record.fingerprint
    assert run_folder.load(path).fingerprint == other.fingerprint
    assert run_line(f"{fly} --seed 7 --replace") == 0
    assert json.loads((path / "outcome.json").read_text())["seed"] == 7


def test_what_was_made_of_a_run_goes_with_it(tmp_path: Path) -> None:
    """The commands' own files, under the names that they have; a page of another run is no such thing."""
    for library in ("matplotlib", "rosbags", "pymavlink"):
        pytest.importorskip(library)
    path, record = tmp_path / "run", run_sortie(example("duration_s=1"))
    run_folder.save(record, path, lambda folder: (folder / "sortie.rrd").write_text(""))
    alone = {p.name for p in path.iterdir()}
    parameters = inspect.signature(export).parameters.values()
    formats = [f"--{p.name}" for p in parameters if p.annotation.startswith("Annotated[bool")]
    assert "--pcap" in formats
    for made in (["report"], *(["export", each] for each in formats)):
        before = set(path.rglob("*"))
        done = CliRunner().invoke(app, [made[0], str(path), *made[1:]])
        assert done.exit_code == 0, done.output
        new = {p.relative_to(path).parts[0] for p in set(path.rglob("*")) - before if p.is_file()}
        assert new, made
        assert new <= WRITTEN, made
    (path / ".DS_Store").write_text("")
    run_folder.save(replace(record, seed=2), path, replace=True)
    assert {p.name for p in path.iterdir()} == alone - {"sortie.rrd"}


def test_a_users_policy_flies_from_a_file_and_profile_names_the_rooms(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "mine.py").write_text(
        "from sortie.policies.contract import Directive, Representation\n"
        "def decide(view, *, rate=5.0):\n"
        "    rung = Representation.DETECTIONS\n"
        "    return [Directive(view.ego, p, rung, rate_hz=rate, reason='mine') for p in view.peers]\n"
    )
    assert run_line(f"fly example.yaml --policy 'mine.py:decide(rate=2.0)' --profile --out run {SHORT}") == 0
    rows = pq.read_table(here / "run" / "directives.parquet").to_pylist()
    assert {(r["representation"], r["rate_hz"], r["reason"]) for r in rows} == {("detections", 2.0, "mine")}
    printed = capsys.readouterr().out
    assert all(room in printed for room in ("sim", "fleet", "radio", "policies"))


def test_another_policy_flies_to_the_end_and_says_so(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changing = BASE.replace("dwell_s: 0.3", "dwell_s: 0.3, changes: [{at_s: 0.3, name: silence}]")
    (here / "example.yaml").write_text(changing)
    told = "boxes flies to the end: the changes and commands of example are its own policy's"
    for policy, changes in (("boxes", 0), ("worked", 5)):
        assert run_line(f"fly example.yaml --replace --out run --policy {policy} {SHORT}") == 0
        assert (told in capsys.readouterr().err) == (policy == "boxes")
        assert run_folder.load(Path("run")).totals["policy_changes"] == changes


def test_over_another_policy_says_what_sharing_is_worth(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both fly the same draws. A second flight that fails leaves the first, and a scenario is not compared with itself."""
    assert run_line(f"fly example.yaml --out run --over silence {SHORT}") == 0
    sent = sortie.open_run("run").outcome["bytes"]["data_sent"]
    told = capsys.readouterr().out
    assert f"over silence: data sent {size(sent)} (0 B under silence); one sortie each; `sortie compare" in told
    assert "--seeds 8` gives an interval" in told
    assert run_line(f"fly example.yaml --out alike --over worked {SHORT}") == 0
    assert "example flies worked itself: there is nothing to compare it with" in capsys.readouterr().out
    assert run_line(f"fly example.yaml --out none --over slience {SHORT}") == USER
    assert "did you mean silence?" in capsys.readouterr().err
    assert not Path("none").exists()
    monkeypatch.setattr(Beside, "record", lambda _: (_ for _ in ()).throw(RunError("its process was killed")))
    assert run_line(f"fly example.yaml --out kept --over silence {SHORT}") == FAILED
    assert "silence did not fly to its end: its process was killed" in capsys.readouterr().err
    assert sortie.open_run("kept").outcome["bytes"]["data_sent"] == sent


# --- checks and comparisons ------------------------------------------------------------------------------

EXPECTED = """expect:
  - {metric: bytes.data_sent, at_least: 1}
  - {metric: deadline_miss_rate, at_most: -1, because: never}
  - {metric: bytes.datasent, at_least: 1}
  - {metric: scenario, equals: example}
expect_decisions:
  - {drone: 0, representation: features, roi: true, from_s: 2.9, until_s: 3.1, reason: track}
  - {drone: 0, representation: raw, from_s: 0, until_s: 6}
"""


def test_check_tells_what_failed_and_why(here: Path) -> None:
    (here / "example.yaml").write_text(BASE + EXPECTED)
    done = CliRunner().invoke(app, ["check", "example.yaml"])
    assert done.exit_code == 1
    assert done.output.count("FAILED") == 3
    record = run_sortie(load("example.yaml"))
    verdicts = check(record.scenario, record, outcome(record))
    assert [v.holds for v in verdicts] == [True, False, False, True, True, False]
    assert verdicts[2].got.startswith("bytes.datasent: bytes has no 'datasent', it has context_sent")
    assert "drone 0: features with ROI because of 'track' decided in [2.9, 3.1] s" in verdicts[4].expected
    assert verdicts[5].got.startswith("0.41 s: 0 → 1 detections at 2 Hz (goodput not measured lately); ")


def test_compare_puts_policies_side_by_side_and_says_why_they_differ_and_how_it_was_made(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "README.md").write_text("# Mine\n\n<!-- compare:begin -->old<!-- compare:end -->\n\nSee below.\n")
    policies = ["worked", "all-4(received_budget=0.1)", "silence"]
    sets = "--set duration_s=1 --set fleet.drones=2"
    made = f"compare example.yaml --policies {shlex.quote(','.join(policies))} --seed 3 {sets}"
    assert run_line(f"{made} --out c.json --readme README.md --recording new/c.rrd") == 0
    readme = (here / "README.md").read_text()
    assert readme.startswith("# Mine\n\n<!-- compare:begin -->\n")
    assert readme.endswith("<!-- compare:end -->\n\nSee below.\n")
    assert "| | worked | all-4(received_budget=0.1) | silence |" in readme
    assert "- **silence**: sent nothing" in readme
    assert f"`sortie {made}`: 1 s, 2 drones, seed 3, in this town, this flight." in readme
    assert "accuracy" not in readme  # no detector flew
    assert "old" not in readme
    assert "sent nothing; every drone saw with its own eyes only" in " ".join(capsys.readouterr().out.split())
    kept = json.loads((here / "c.json").read_text())
    assert kept["gains"] == []  # no detector flew
    sent = {each["policy"]: each["outcome"]["bytes"]["data_sent"] for each in kept["sorties"]}
    assert list(sent) == policies
    assert sent["silence"] == 0
    assert sent["all-4(received_budget=0.1)"] > 0
    assert (here / "new" / "c.rrd").is_file()


def test_a_note_is_printed_once_a_command_however_many_policies_fly(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read_twice(*_: object, **__: object) -> None:
        for _ in range(2):
            load("paper_replay_contention", {"duration_s": 5})
        raise sortie.RunError("enough")

    monkeypatch.setattr(sortie, "compare", read_twice)
    for times in (1, 2):
        assert run_line("compare track_target --policies boxes,silence") == 2
        assert sum("are left out" in text for text in caplog.messages) == times


# --- lists ---------------------------------------------------------------------------------------------

LISTS = {
    "policies": ["worked", "random-2", "silence", "when2com-style", "Missing: learned keys and queries"],
    "scenarios": ["track_target", "paper_replay", "person_crossing", "search_grid", "two_groups", "two_makes"],
    "detectors": ["torch", "none"],
    "detector": ["torch", "none"],
    "fusion": ["disconet", "element-wise maximum"],
    "path_loss": ["two_ray", "radio.ground_roughness_m"],
    "power": ["level", "momentum theory"],
    "event": ["jam(at_s=…, until_s=None, position_m=…, power_dbm=20.0)"],
    "link": ["no link is built in or installed; name one of your own: path/to/file.py:Name"],
    "invariants": ["human_in_region", "same_network", "rate_hz  rate, Hz (of each link)", "any_link", "fresh.FIELD"],
}


def test_list(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a terminal cannot show is escaped."""
    wrong = {}
    for what, words in LISTS.items():
        code, printed = run_line(f"list {what}"), "".join(capsys.readouterr())
        wrong[what] = [word for word in words if word not in printed] + [code] * (code != 0)
    assert not any(wrong.values()), wrong
    with (tmp_path / "out.txt").open("w", encoding="latin-1") as terminal:
        monkeypatch.setattr(sys, "stdout", terminal)
        assert run_line("list policies") == 0
        assert (sys.stdout.encoding, sys.stdout.errors) == ("latin-1", "backslashreplace")


# --- exit codes ----------------------------------------------------------------------------------------

NO_DETECTOR = "--set duration_s=1 --set events=[] --set perception.detector=none"
EXIT_CODES: list[tuple[str, Callable[..., object] | None, int, str]] = [
    ("list policies", None, 0, ""),
    ("list nothing", None, USER, "nothing"),
    ("fly one.yaml --sed 3", None, USER, "No such option"),
    ("fly gone.yaml", None, USER, "error: gone.yaml: no such file"),
    (f"fly one.yaml --policy mine.py:mine {NO_DETECTOR}", None, USER, "ValueError: shapes (3,) (4,) (mine.py, line 2)"),
    ("fly /dev/zero", None, USER, "error: /dev/zero: cannot be read, is a device, a pipe or a socket"),
    ("compare one.yaml --policies silence --seeds 1000000", None, USER, "10000"),
    ("fly one.yaml --mavlink udpout:127.0.0.1:1 --pace nan", None, USER, "error: pace is nan, must"),
    (f"check one.yaml {NO_DETECTOR}", None, FAILED, "1 expectation failed"),
    ("fly one.yaml", lambda *_, **__: np.zeros(3) + np.zeros(4), DEFECT, "Traceback (most recent call last)"),
    ("fly one.yaml", lambda *_, **__: {}["gone"], DEFECT, "This is a defect of Sortie"),
    ("fly one.yaml", lambda *_, **__: signal.raise_signal(signal.SIGINT), INTERRUPTED, "interrupted; what"),
]


def test_exit_codes(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "one.yaml").write_text(f"{BASE}\nexpect: [{{metric: bytes.data_sent, at_least: 1.0e12}}]\n")
    (here / "mine.py").write_text("def mine(view):\n    raise ValueError('shapes (3,) (4,)')\n")
    wrong = {}
    for line, flown, code, words in EXIT_CODES:
        with monkeypatch.context() as patch:
            if flown is not None:
                patch.setattr(sortie, "fly", flown)
            got, printed = run_line(line), capsys.readouterr()
        said = " ".join((printed.out + printed.err).split())
        if got != code or words not in said or ("Traceback" in printed.err) != (code == DEFECT):
            wrong[line, words] = (got, said)
    assert wrong == {}


# --- files without an end ------------------------------------------------------------------------------

NO_FILE = "is a device, a pipe or a socket, must be a file"


def test_a_device_is_refused_and_a_scenario_may_come_through_a_pipe() -> None:
    """/dev/null, as a reader that does not refuse devices ends there."""
    readers: dict[Callable[[Path], object], str] = dict.fromkeys(
        (load, read_logs, read_key, file_digest, open_recording, lambda path: read_columns(path, {})), NO_FILE
    )
    for read, what in {**readers, (lambda path: resolve(f"{path}:mine")): "not found"}.items():
        with pytest.raises((sortie.SortieError, OSError)) as caught:
            read(Path("/dev/null"))
        assert what in str(caught.value)
        assert "/dev/null" in str(caught.value)
    reads, writes = os.pipe()
    os.write(writes, BASE.encode())
    os.close(writes)
    assert load(f"/dev/fd/{reads}").name == "example"
    os.close(reads)


def test_a_pace_has_bounds() -> None:
    for pace in (float("nan"), float("inf"), -1.0, 1e-9, 1e9):
        with pytest.raises(
            sortie.RunError, match=r"^pace is .*, must be 0\.001 to 1000, or 0 for as fast as possible$"
        ):
            MavlinkEndpoint("udpout:127.0.0.1:1", pace)
