"""The command line and the run directory, as a user meets them."""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from cli_examples import command, refusal
from sim_examples import BASE, example
from typer.testing import CliRunner

from sortie.perception.surrogate.model import SHIPPED as CALIBRATION
from sortie.scenarios.reading.load import load
from sortie.sim.check.expectations import check
from sortie.sim.cli.app import app
from sortie.sim.cli.export import export
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError
from sortie.sim.results import run_folder
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import TABLES
from sortie.sim.results.run_files import WRITTEN

FIELDS = {  # DESIGN.md: outcome.json holds at least these
    "scenario", "policy", "seed", "version", "fingerprint", "ap50", "bytes", "context_share", "deadline_miss_rate",
    "age_s", "battery", "energy_j", "switches", "policy_eval_us", "wall_s", "realtime_factor",
}  # fmt: skip


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "example.yaml"
    path.write_text(BASE)
    return path


def sortie(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The real command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", "from sortie.sim.cli.app import main; main()", *map(str, arguments)],
        capture_output=True, text=True, cwd=cwd, check=False,
    )  # fmt: skip


# --- the run directory ---------------------------------------------------------------------------


def test_a_run_is_kept_whole_and_reads_back(tmp_path: Path) -> None:
    record = run_sortie(example())
    result = outcome(record)
    assert run_folder.save(record, tmp_path / "run") == tmp_path / "run"
    assert set(result) >= FIELDS
    assert json.loads((tmp_path / "run" / "outcome.json").read_text()) == result
    assert {p.name for p in (tmp_path / "run").iterdir()} == {
        "outcome.json", "scenario.yaml", "record.json", *(f"{t}.parquet" for t in TABLES),
    }  # fmt: skip
    assert pq.read_table(tmp_path / "run" / "states.parquet").num_rows == 300
    back = run_folder.load(tmp_path / "run")
    assert back.fingerprint == record.fingerprint
    assert outcome(back) == result


def test_energy_by_cause_is_what_left_the_batteries(tmp_path: Path) -> None:
    result = outcome(run_sortie(example()))
    by_cause = {k: v for k, v in result["energy_j"].items() if k != "total"}
    assert sum(by_cause.values()) == pytest.approx(result["energy_j"]["total"])
    assert result["energy_j"]["total"] == pytest.approx(sum(d["energy_j"] for d in result["drones"].values()))


def test_a_run_that_dies_while_saving_leaves_no_half_run(tmp_path: Path) -> None:
    record = run_sortie(example())
    path = tmp_path / "run"

    def dies(folder: Path) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(RunError, match="run: cannot be written: No space left on device"):
        run_folder.save(record, path, dies)
    assert list(tmp_path.iterdir()) == []
    run_folder.save(record, path)
    with pytest.raises(RunError):
        run_folder.save(run_sortie(example(), seed=9), path, dies, replace=True)
    assert run_folder.load(path).fingerprint == record.fingerprint, "the older run is still whole"


def test_a_folder_that_is_no_run_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("years of work")
    record = run_sortie(example("duration_s=0.1"))
    with pytest.raises(RunError, match=r"holds chapter\.tex, which no run wrote"):
        run_folder.save(record, tmp_path / "thesis", replace=True)
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="is a file, a run needs a folder"):
        run_folder.save(record, tmp_path / "file", replace=True)


@pytest.mark.parametrize(
    ("theirs", "named"),
    [
        (["mynotes.txt"], "mynotes.txt"),
        (["photos/a.jpg"], "photos"),
        (["other_run/outcome.json"], "other_run"),
        (["b.txt", "a.txt", "photos/a.jpg"], "a.txt"),
    ],
)
def test_what_no_run_wrote_is_not_replaced_with_the_run(theirs: list[str], named: str, tmp_path: Path) -> None:
    record, path = run_sortie(example("duration_s=0.1")), tmp_path / "run"
    run_folder.save(record, path)
    for name in theirs:
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text("a day's work")
    what = f"{path}: holds {named}, which no run wrote; choose another folder or move it"
    with pytest.raises(RunError, match=f"^{re.escape(what)}$"):
        run_folder.save(record, path, replace=True)
    assert [(path / name).read_text() for name in theirs] == ["a day's work"] * len(theirs)


def test_what_was_made_of_a_run_goes_with_it(tmp_path: Path) -> None:
    """The commands' own files, under the names that they have; a page of another run is no such thing."""
    pytest.importorskip("matplotlib")
    pytest.importorskip("rosbags")
    pytest.importorskip("pymavlink")
    path = tmp_path / "run"
    run_folder.save(run_sortie(example("duration_s=1")), path, lambda folder: (folder / "sortie.rrd").write_text(""))
    alone = {p.name for p in path.iterdir()}
    formats = [
        f"--{p.name}"
        for p in inspect.signature(export).parameters.values()
        if p.annotation.startswith("Annotated[bool")
    ]
    assert "--pcap" in formats
    for made in (["report"], *(["export", each] for each in formats)):
        before = set(path.rglob("*"))
        done = CliRunner().invoke(app, [made[0], str(path), *made[1:]])
        assert done.exit_code == 0, done.output
        new = {p.relative_to(path).parts[0] for p in set(path.rglob("*")) - before if p.is_file()}
        assert new, made
        assert new <= WRITTEN, made
    (path / ".DS_Store").write_text("")
    run_folder.save(run_sortie(example("duration_s=0.5")), path, replace=True)
    assert {p.name for p in path.iterdir()} == alone - {"sortie.rrd"}


def test_a_folder_that_may_not_be_replaced_is_told_before_anything_is_flown(
    scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run"
    run_folder.save(run_sortie(example("duration_s=0.1")), path)
    (path / "mynotes.txt").write_text("a day's work")

    def flown(*_: object, **__: object) -> None:
        raise AssertionError("flown")

    monkeypatch.setattr("sortie.fly", flown)
    assert command("fly", scenario, "--no-recording", "--out", path) == 2
    assert "run: holds mynotes.txt, which no run wrote; choose another folder or move it" in capsys.readouterr().err


def test_a_link_to_a_folder_stays_one(tmp_path: Path) -> None:
    record = run_sortie(example("duration_s=0.1"))
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "disk")
    for _ in range(2):
        run_folder.save(record, tmp_path / "run")
        assert (tmp_path / "run").is_symlink()
        assert run_folder.load(tmp_path / "disk").fingerprint == record.fingerprint
    assert {p.name for p in tmp_path.iterdir()} == {"disk", "run"}


def test_a_damaged_run_says_so(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"no run there \(outcome\.json is missing\)"):
        run_folder.load(tmp_path)
    run_folder.save(run_sortie(example()), tmp_path / "run")
    (tmp_path / "run" / "states.parquet").write_bytes(b"PAR1 not really")
    with pytest.raises(RunError, match="the run is damaged"):
        run_folder.load(tmp_path / "run")


def test_a_run_of_another_version_says_so(tmp_path: Path) -> None:
    path = tmp_path / "run"
    run_folder.save(run_sortie(example("duration_s=0.1")), path)
    table = pq.read_table(path / "transmissions.parquet").drop_columns(["hops"])
    pq.write_table(table, path / "transmissions.parquet")
    with pytest.raises(RunError, match=r"run: the run is damaged: transmissions\.parquet has no column hops; another"):
        run_folder.load(path)


# --- commands ------------------------------------------------------------------------------------


def test_fly_prints_the_outcome_and_keeps_the_run(scenario: Path, tmp_path: Path) -> None:
    done = sortie("fly", scenario, "--set", "fleet.battery.initial_soc=0.5", "--no-recording", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for word in ("context plane", "data plane", "energy", "fingerprint", "decisions and events"):
        assert word in done.stdout
    (folder,) = (tmp_path / "runs").glob("example-s1-worked-????????")
    kept = json.loads((folder / "outcome.json").read_text())
    assert max(kept["battery"].values()) < 0.5
    again = sortie(
        "fly",
        scenario,
        "--policy",
        "best-2(received_budget=0.1)",
        "--seed",
        "7",
        "--no-recording",
        "--out",
        "here",
        cwd=tmp_path,
    )
    assert again.returncode == 0, again.stderr
    kept = json.loads((tmp_path / "here" / "outcome.json").read_text())
    assert (kept["policy"], kept["seed"]) == ("best-2", 7)


SECOND = ("--set", "duration_s=1", "--set", "perception.detector=none", "--set", "mission.phases=[{}]")


@pytest.mark.parametrize(
    ("arguments", "folder"),
    [
        ((), "track_target-s1-worked-[0-9a-f]{8}"),  # shorter than the library's
        (("--seed", "4"), "track_target-s4-worked-[0-9a-f]{8}"),
        (("--replication", "2"), "track_target-s1-worked-r2-[0-9a-f]{8}"),
        (("--policy", "silence"), "track_target-s1-silence-[0-9a-f]{8}"),
    ],
)
def test_a_runs_folder_is_named_after_what_flew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], folder: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command("fly", "track_target", "--no-recording", *SECOND, *arguments) == 0
    (made,) = (tmp_path / "runs").iterdir()
    assert re.fullmatch(folder, made.name)


def test_two_files_of_one_name_have_two_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for file, seconds in (("a", 0.5), ("b", 0.6), ("a", 0.5)):
        (tmp_path / f"{file}.yaml").write_text(f"name: one\nduration_s: {seconds}\nperception: {{detector: none}}\n")
        assert command("fly", f"{file}.yaml", "--no-recording") == 0
    assert len(list((tmp_path / "runs").iterdir())) == 2


def test_other_settings_have_a_folder_of_their_own_and_the_same_ones_do_not(
    scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fly = ("fly", scenario, "--no-recording", "--set", "duration_s=0.5", "--set", "mission.phases=[{}]")
    for drones in (2, 3, 2):
        assert command(*fly, "--set", f"fleet.drones={drones}") == 0
    assert len(list((tmp_path / "runs").iterdir())) == 2


def test_a_scenario_that_lacks_a_field_in_its_file_flies_with_it_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "open.yaml").write_text("name: open\nduration_s: -1\nperception: {detector: none}\n")
    assert command("fly", "open.yaml", "--no-recording", "--set", "duration_s=0.5") == 0
    (made,) = (tmp_path / "runs").iterdir()
    assert re.fullmatch("open-s1-worked-[0-9a-f]{8}", made.name)


def test_another_run_is_replaced_with_replace_alone(
    scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    path = tmp_path / "run"
    fly = ("fly", scenario, "--no-recording", "--out", path, "--set", "duration_s=0.5")
    for _ in range(2):  # the same run again loses nothing
        assert command(*fly) == 0
        assert f"kept in {path}\n" in capsys.readouterr().out
    first = (path / "outcome.json").read_text()
    advice = "choose another folder, or replace it with --replace"
    for more in (("--seed", 7), ("--set", "fleet.drones=3"), ("--policy", "silence")):
        with monkeypatch.context() as patch:
            patch.setattr("sortie.fly", lambda *_, **__: pytest.fail("flown"))
            assert command(*fly, *more) == 2
        assert capsys.readouterr().err == f"error: {path}: holds another run; {advice}\n"
    assert (path / "outcome.json").read_text() == first
    assert command(*fly, "--seed", 7, "--replace") == 0
    assert json.loads((path / "outcome.json").read_text())["seed"] == 7


def test_what_other_code_flew_is_kept_beside(
    scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same scenario and seed can have another record then. Neither the older run nor the new one is lost."""
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "run"
    fly = ("fly", scenario, "--no-recording", "--out", path, "--set", "duration_s=0.5")
    record = run_sortie(load(scenario, ["duration_s=0.5"]))
    other = replace(record, totals={**record.totals, "decisions": 0})
    run_folder.save(other, path)
    assert command(*fly) == 0
    own = Path(f"runs/example-s1-worked-{record.fingerprint[:8]}")
    assert f"kept in {own}, as {path} holds another run" in capsys.readouterr().out
    assert run_folder.load(own).fingerprint == record.fingerprint
    assert run_folder.load(path).fingerprint == other.fingerprint


def test_an_edited_policy_has_a_folder_of_its_own(
    scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    policy = "def decide(view):\n    return []\n"
    other = "from sortie import Directive, Representation\n\n\ndef decide(view):\n    return [Directive(view.ego, p, representation=Representation.DETECTIONS, rate_hz=10.0) for p in view.peers]\n"
    fly = ("fly", scenario, "--no-recording", "--policy", "mine.py:decide", "--set", "duration_s=0.5")
    for text in (policy, other, policy):
        Path("mine.py").write_text(text)
        assert command(*fly) == 0
    assert len(list(Path("runs").iterdir())) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("fly", "nowhere.yaml"), "nowhere.yaml"),
        (
            ("fly", "example.yaml", "--policy", "wrst-2"),
            "unknown policy 'wrst-2', did you mean worst-2? known: worked, all-4",
        ),
        (("fly", "example.yaml", "--policy", "all-4(received_budget=0.1"), "the bracket is not closed"),
        (("fly", "example.yaml", "--policy", "silence(rho=0.1)"), "policy 'silence' has no parameter 'rho'"),
        (("fly", "example.yaml", "--policy", "no/such.py:decide"), "policy file 'no/such.py' not found"),
        (("fly", "example.yaml", "--set", "fleet.batery.initial_soc=0.5"), "did you mean battery?"),
        (("fly", "example.yaml", "--set", "fleet.battery.initial_soc=1.5"), "1.5"),
        (("fly", "example.yaml", "--set", "nonsense"), "--set nonsense: must be key.path=value"),
        (("fly", "example.yaml", "--out", "example.yaml"), "example.yaml: is a file, a run needs a folder"),
        (("compare", "example.yaml", "--policies", ","), "no policy named"),
        (("compare", "example.yaml", "--policies", "silence,silence"), "a policy is named twice"),
        (("check", "example.yaml", "nowhere"), "nowhere"),
        (("view", "."), "no run there"),
    ],
)
def test_what_a_user_can_mend_is_one_line_and_exit_code_2(
    scenario: Path, arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refusal(scenario.parent, arguments, capsys)


def test_the_real_command_gives_no_traceback(scenario: Path) -> None:
    done = sortie("fly", "nowhere.yaml", cwd=scenario.parent)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)


def test_a_users_policy_flies_from_a_file(scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(
        "from sortie.policies.contract import Directive, Representation\n"
        "def decide(view, *, rate=5.0):\n"
        "    return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=rate, reason='mine') for p in view.peers]\n"
    )
    assert command("fly", scenario, "--policy", "mine.py:decide(rate=2.0)", "--no-recording", "--out", "run") == 0
    rows = pq.read_table(tmp_path / "run" / "directives.parquet").to_pylist()
    assert {(r["representation"], r["rate_hz"], r["reason"]) for r in rows} == {("detections", 2.0, "mine")}


def test_check_tells_what_failed_and_why(scenario: Path) -> None:
    scenario.write_text(
        BASE + "expect:\n"
        "  - {metric: bytes.data_sent, at_least: 1}\n"
        "  - {metric: deadline_miss_rate, at_most: -1, because: never}\n"
        "  - {metric: bytes.datasent, at_least: 1}\n"
        "  - {metric: scenario, equals: example}\n"
        "expect_decisions:\n"
        "  - {drone: 0, representation: features, roi: true, from_s: 2.9, until_s: 3.1, reason: track}\n"
        "  - {drone: 0, representation: raw, from_s: 0, until_s: 6}\n"
    )
    done = CliRunner().invoke(app, ["check", str(scenario)])
    assert done.exit_code == 1
    assert done.output.count("FAILED") == 3
    record = run_sortie(example(text=scenario.read_text()))
    verdicts = check(record.scenario, record, outcome(record))
    assert [v.holds for v in verdicts] == [True, False, False, True, True, False]
    assert verdicts[2].got.startswith("bytes.datasent: bytes has no 'datasent', it has context_sent")
    assert "drone 0: features with ROI because of 'track' decided in [2.9, 3.1] s" in verdicts[4].expected
    assert verdicts[5].got.startswith("0.41 s: 0 → 1 detections at 2 Hz (goodput not measured lately); ")


def test_check_passes_with_code_0(scenario: Path) -> None:
    scenario.write_text(BASE + "expect:\n  - {metric: bytes.data_sent, at_least: 1}\n")
    assert CliRunner().invoke(app, ["check", str(scenario)]).exit_code == 0


@pytest.mark.parametrize("order", ["bad good", "good bad", "bad good bad", "good good"])
def test_what_fails_in_any_of_several_scenarios_fails_the_check(order: str, tmp_path: Path) -> None:
    """Two expectations fail in each bad one."""
    bounds = {"good": ("at_least: 0", "at_least: 0"), "bad": ("at_most: -1", "at_most: -2")}
    files = []
    for number, kind in enumerate(order.split()):
        expected = ", ".join(f"{{metric: bytes.data_sent, {bound}}}" for bound in bounds[kind])
        files.append(tmp_path / f"{number}.yaml")
        files[-1].write_text(BASE.replace("duration_s: 6", "duration_s: 3.5") + f"expect: [{expected}]\n")
    done = CliRunner().invoke(app, ["check", *map(str, files)])
    bad = order.split().count("bad")
    assert (done.exit_code, done.stderr) == ((1, f"{2 * bad} expectations failed\n") if bad else (0, ""))


def test_compare_puts_policies_side_by_side_and_says_why_they_differ(
    scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "README.md").write_text("# Mine\n\n<!-- compare:begin -->old<!-- compare:end -->\n\nSee below.\n")
    policies = ("--policies", "worked,all-4(received_budget=0.1),silence")
    assert command("compare", scenario, *policies, "--out", "c.json", "--readme", "README.md") == 0
    readme = (tmp_path / "README.md").read_text()
    assert readme.startswith("# Mine\n\n<!-- compare:begin -->\n")
    assert readme.endswith("<!-- compare:end -->\n\nSee below.\n")
    assert "| | worked | all-4(received_budget=0.1) | silence |" in readme
    assert "- **silence**: sent nothing" in readme
    assert "accuracy" not in readme  # no detector flew
    assert "old" not in readme
    assert "sent nothing; every drone saw with its own eyes only" in " ".join(capsys.readouterr().out.split())
    kept = json.loads((tmp_path / "c.json").read_text())
    assert kept["gains"] == []  # no detector flew
    sent = {sortie["policy"]: sortie["outcome"]["bytes"]["data_sent"] for sortie in kept["sorties"]}
    assert list(sent) == ["worked", "all-4(received_budget=0.1)", "silence"]
    assert sent["silence"] == 0
    assert sent["all-4(received_budget=0.1)"] > 0


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("policies", ["worked", "random-2", "silence", "when2com-style", "Missing: learned keys and queries"]),
        ("scenarios", ["track_target", "paper_replay", "person_crossing", "search_grid", "two_groups", "two_makes"]),
        ("detectors", ["torch", "none"]),
        ("detector", ["torch", "none"]),
        ("fusion", ["disconet", "element-wise maximum"]),
        ("path_loss", ["two_ray", "radio.ground_roughness_m"]),
        ("power", ["level", "momentum theory"]),
        ("event", ["jam(at_s=…, until_s=None, position_m=…, power_dbm=20.0)"]),
        ("link", ["no link is built in or installed; name one of your own: path/to/file.py:Name"]),
        (
            "invariants",
            [
                "human_in_region",
                "same_network",
                "rate_hz  rate, Hz (of each link)",
                "any_link",
                "detections",
                "fresh.FIELD",
            ],
        ),
    ],
)
def test_list(what: str, words: list[str]) -> None:
    done = CliRunner().invoke(app, ["list", what])
    assert done.exit_code == 0
    assert all(word in done.output for word in words)


def test_list_schema_is_json() -> None:
    done = CliRunner().invoke(app, ["list", "schema"])
    assert json.loads(done.output)["title"] == "Scenario"


def test_profile_tells_the_rooms_apart(scenario: Path, tmp_path: Path) -> None:
    done = sortie("fly", scenario, "--profile", "--no-recording", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert all(room in done.stdout for room in ("sim", "fleet", "radio", "policies"))


def test_another_policy_flies_to_the_end_and_says_so(scenario: Path, tmp_path: Path) -> None:
    scenario.write_text(BASE.replace("dwell_s: 0.3", "dwell_s: 0.3, changes: [{at_s: 0.5, name: silence}]"))
    asked = (
        "fly",
        str(scenario),
        "--replace",
        "--set",
        "duration_s=1",
        "--no-recording",
        "--out",
        str(tmp_path / "run"),
    )
    other = CliRunner().invoke(app, [*asked, "--policy", "boxes"])
    assert "boxes flies to the end: the changes and commands of example are its own policy's" in other.stderr
    assert run_folder.load(tmp_path / "run").totals["policy_changes"] == 0
    own = CliRunner().invoke(app, [*asked, "--policy", "worked"])
    assert "flies to the end" not in own.stderr
    assert run_folder.load(tmp_path / "run").totals["policy_changes"] == 5


def test_weights_that_are_not_there_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    missing = tmp_path / "none.safetensors"
    asked = ("fly", "track_target", "--set", f"perception.weights={missing}", "--set", "duration_s=1")
    assert (
        refusal(tmp_path, asked, capsys)
        == f"error: {missing}: no such weights file; `python -m research train` makes one\n"
    )


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        (
            "weights",
            "none.safetensors",
            "none.safetensors: no such calibration; `python -m research calibrate` makes one",
        ),
        (
            "fusion",
            "late",
            f"{CALIBRATION}: calibrated for fusion 'disconet', perception.fusion is 'late', must be that or 'none'",
        ),
    ],
)
def test_what_the_surrogate_cannot_do_is_one_line(
    field: str, value: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("--set", "perception.detector=surrogate", "--set", f"perception.{field}={value}", "--set", "duration_s=1")
    assert refusal(tmp_path, ("fly", "track_target", *asked), capsys) == f"error: {told}\n"
