"""Outcomes as regression tests: replications, golden outcomes, and the pytest plugin in a new project."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from sim_examples import BASE
from typer.testing import CliRunner

from sortie.sim.check.checking import check_scenario
from sortie.sim.check.discovery import is_scenario
from sortie.sim.check.expectations import Verdict
from sortie.sim.check.golden import differences, golden_path, told, write_golden
from sortie.sim.check.junit import Suite, junit
from sortie.sim.check.once import Flown, flown_once
from sortie.sim.cli.app import app
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError
from sortie.sim.results.outcome import outcome

SHORT = BASE.replace("duration_s: 6", "duration_s: 1").replace("at_s: 3", "at_s: 0.5")
EXPECT = """
expect:
  - {metric: deadline_miss_rate, at_most: 0.5, because: little is sent}
  - {metric: bytes.data_sent, at_least: 1.0e12, because: it cannot}
"""


def test_a_failure_tells_why_and_how_to_see_it(tmp_path: Path) -> None:
    path = tmp_path / "short one.yaml"
    path.write_text(SHORT + EXPECT)
    checked = check_scenario(str(path))
    assert [v.holds for v in checked.verdicts] == [True, False]
    (failed,) = checked.failed
    assert "payloads: " in failed.explanation
    assert "decided because of " in failed.explanation
    assert checked.replay(checked.verdicts[0]) == f"sortie fly '{path}' --view"


def test_replications_are_flown_once_each_and_a_failure_shows_the_worst_of_them(tmp_path: Path) -> None:
    path = tmp_path / "short.yaml"
    asked = "{metric: bytes.data_delivered, at_most: 1, replications: 4, confidence: 0.9}"
    path.write_text(SHORT + f"expect: [{asked}]\n")
    checked = check_scenario(str(path))
    (failed,) = checked.failed
    flown = [outcome(run_sortie(checked.scenario, replication=k))["bytes"]["data_delivered"] for k in range(4)]
    worst = int(np.argmax(flown))
    assert len(set(flown)) > 1
    assert worst > 0, "else nothing is shown"
    assert failed.got.startswith(f"{sum(flown) / 4:.6g} [")
    assert failed.got.endswith(f" over 4, {flown[worst]:.6g} in replication {worst}")
    assert "payloads: " in failed.explanation
    assert checked.replay(failed) == f"sortie fly {path} --replication {worst} --view"


def test_a_golden_outcome_is_compared_and_only_renewed_when_asked(tmp_path: Path) -> None:
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    golden = golden_path(path)
    assert check_scenario(str(path)).verdicts == ()
    assert not golden.exists()
    check_scenario(str(path), update=True)
    assert [v.holds for v in check_scenario(str(path)).verdicts] == [True]
    path.write_text(SHORT.replace("rho: 0.25", "rho: 0.2"))
    before = golden.read_text()
    (verdict,) = check_scenario(str(path)).verdicts
    assert not verdict.holds
    assert "transitions (" in verdict.got
    assert "transitions." in verdict.whole
    assert golden.read_text() == before
    check_scenario(str(path), update=True)
    assert golden.read_text() != before


def test_a_golden_outcome_holds_wherever_the_project_lies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Policy files are named by how they are found, which is another path in pytest, in a shell or elsewhere."""
    folder = "moved to (another) place"
    first, second = tmp_path / "first", tmp_path / folder
    first.mkdir()
    (first / "mine.py").write_text("def decide(view):\n    return []\n")
    own = "policy: {name: 'mine.py:decide', changes: [{at_s: 0.5, name: silence}]}"
    (first / "own.yaml").write_text(SHORT.replace("policy: {name: worked, params: {rho: 0.25}, dwell_s: 0.3}", own))
    assert check_scenario(str(first / "own.yaml"), update=True).written
    shutil.copytree(first, second)
    for here, path in ((second, "own.yaml"), (tmp_path, f"{folder}/own.yaml"), (tmp_path, str(second / "own.yaml"))):
        monkeypatch.chdir(here)
        (golden,) = check_scenario(path).verdicts
        assert golden.got == "the same"
    assert str(tmp_path) not in golden_path(first / "own.yaml").read_text()


def test_golden_tolerances_are_the_files_own_and_stay(tmp_path: Path) -> None:
    """What is gone, what is new and what moved is told; wall clock is not compared."""
    path = tmp_path / "x.golden.json"
    result = {"a": 1.0, "b": {"c": [1, "x", None]}, "near_zero": 0.0, "wall_s": 3.0}
    write_golden(path, result)
    assert differences(path, {**result, "wall_s": 4.0, "a": 1.0000001, "near_zero": 1e-10}) == {}
    assert differences(path, {**result, "a": 1.00001}) == {"a": (1.0, 1.00001)}
    moved = {"b.c.1": ("x", "y"), "b.c.2": (None, "nothing"), "d.x.0": ("nothing", 4)}
    assert differences(path, {**result, "b": {"c": [1, "y"]}, "d": {"x": [4]}}) == moved
    text = json.loads(path.read_text())
    text["tolerance"]["relative"] = 0.01
    path.write_text(json.dumps(text))
    assert differences(path, {**result, "a": 1.001}) == {}
    write_golden(path, {**result, "a": 2.0})
    assert json.loads(path.read_text())["tolerance"]["relative"] == 0.01


def test_what_moved_is_told_by_sections_the_largest_change_first() -> None:
    """A charge that stands in two places is told once; what is gone or no number counts as changed altogether."""
    moved = {
        "battery.0": (0.8, 0.75),
        "bytes.data_sent": (1000, 1100),
        "bytes.data_lost": (10, 5),
        "drones.0.soc": (0.8, 0.75),
        "drones.0.airborne": (True, False),
        "phases.1.phase": ("track", "nothing"),
    }
    line, whole = told(moved)
    assert line == (
        "6 moved; of each section the most: drones (1): 0.airborne True → False; phases (1): 1.phase track → nothing; "
        "bytes (2): data_lost 10 → 5; battery (1): 0 0.8 → 0.75"
    )
    assert whole.splitlines() == [
        "drones.0.airborne: True → False",
        "phases.1.phase: track → nothing",
        "bytes.data_lost: 10 → 5",
        "bytes.data_sent: 1000 → 1100",
        "battery.0: 0.8 → 0.75",
    ]


NUMBER = "must be a number ≥ 0"
BROKEN_GOLDEN = {
    "{}": "tolerance must be an object",
    "[]": "tolerance must be an object",
    '{"tolerance": {"relative": 0, "absolute": 0}, "outcome": []}': "outcome must be an object",
    '{"tolerance": {"relative": 0}, "outcome": {}}': f"tolerance.absolute: None, {NUMBER}",
    '{"tolerance": {"relative": "1", "absolute": 0}, "outcome": {}}': f"tolerance.relative: '1', {NUMBER}",
    '{"tolerance": {"relative": NaN, "absolute": 0}, "outcome": {}}': f"tolerance.relative: nan, {NUMBER}",
    '{"tolerance": {"relative": -1, "absolute": 0}, "outcome": {}}': f"tolerance.relative: -1, {NUMBER}",
    "{": "Expecting property name enclosed in double quotes: line 1 column 2 (char 1)",
}


def test_a_broken_golden_outcome_is_named_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "x.golden.json"
    for text, what in BROKEN_GOLDEN.items():
        path.write_text(text)
        with pytest.raises(RunError) as error:
            differences(path, {"a": 1})
        assert str(error.value) == f"{path}: no golden outcome: {what}"
        said = write_golden(path, {"a": 1})
        assert said == f"golden outcome written: {path}, in place of a broken file (no golden outcome: {what})"
        assert differences(path, {"a": 1}) == {}


def test_another_sortie_than_the_files_own_is_never_its_golden_outcome(tmp_path: Path) -> None:
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    line = "fleet.drones=2: a golden outcome is written of the scenario as its file has it, set nothing"
    with pytest.raises(RunError, match=line):
        check_scenario(str(path), ["fleet.drones=2"], update=True)
    assert not golden_path(path).exists()
    done = CliRunner().invoke(app, ["check", str(path), "--update"])
    assert f"golden outcome written: {golden_path(path)}\n" in done.output


SCENARIOS = [
    "{name: x, fleet: {drones: 2}, expect: [{metric: switches, at_most: 9}]}",
    '\ufeff# a note\n---\n{ "expect_decisions" : [],\n  "name" : x}',
    '"name": x\n"expect": []',
    "{name: x, expect: [}",  # broken: reported when it is collected
    "{name: x, fleet: {drones: ], expect: []}",
    "fleet: [\nname: x\nexpect: []",
]
OTHERS = [
    "services: {{ all }}\n  - {name: x, expect: 1}",  # a template
    "{services: [{name: x, expect: 1}}",
    "{name: x}",
    "{services: {name: x, expect: []}}",
    "{expect: 1, services: [{name: x}]}",
    "{{ name: x, expect: 1 }}",  # a template
    "[{name: x, expect: []}]",
    "a: {name: x, expect: []}",
    "- name: x\n  expect: []",
    "#" * 60 + "\n" * 60 + "x: {",  # in no time
]


def test_a_scenario_is_told_from_other_yaml(tmp_path: Path) -> None:
    """With a golden outcome beside it, it needs no expectations; with its outcome beside it, it is a run's."""
    path = tmp_path / "some.yaml"
    for text in (*SCENARIOS, *OTHERS):
        path.write_text(text, "utf-8")
        assert is_scenario(path) is (text in SCENARIOS), text
        golden_path(path).write_text("{}")
        assert is_scenario(path) is (text in SCENARIOS or text == "{name: x}"), text
        golden_path(path).unlink()
    run = tmp_path / "scenario.yaml"
    run.write_text("name: x\nexpect: []\n")
    (tmp_path / "record.json").touch()
    assert is_scenario(run)
    (tmp_path / "outcome.json").touch()
    assert not is_scenario(run)


@pytest.mark.slow
def test_a_new_project_with_one_yaml_passes_and_fails_as_it_should(tmp_path: Path) -> None:
    """A user's project: pytest, the installed package, scenario files, one of them broken, and YAML of others."""
    (tmp_path / "good.yaml").write_text(SHORT + EXPECT.splitlines()[1] + "\n" + EXPECT.splitlines()[2] + "\n")
    (tmp_path / "compose.yaml").write_text("services: {web: {image: x}}\nexpect: 3\n")
    assert _pytest(tmp_path) == (0, ["1 passed"])
    flow = "{name: x, duration_s: 0.2, perception: {detector: none},\n expect: [{metric: switches, at_least: 0}]}\n"
    (tmp_path / "flow.yaml").write_text(flow)
    assert _pytest(tmp_path) == (0, ["2 passed"])
    (tmp_path / "flow.yaml").unlink()
    (tmp_path / "bad.yaml").write_text(SHORT + EXPECT)
    code, lines = _pytest(tmp_path)
    assert code == 1
    assert lines[-1] == "1 failed, 2 passed"
    text = "\n".join(lines)
    assert "  expected  bytes.data_sent ≥ 1e+12\n" in text
    assert "       got  " in text
    assert "   because  it cannot\n" in text
    assert "the record  payloads: " in text
    assert "    see it  sortie fly " in text
    (tmp_path / "bad.yaml").write_text(SHORT.replace("duration_s", "duration") + EXPECT)
    code, lines = _pytest(tmp_path)
    assert code == 2
    assert any("bad.yaml:3: duration: unknown key, did you mean duration_s?" in line for line in lines)


def _pytest(folder: Path, *options: str) -> tuple[int, list[str]]:
    quiet = ["-q", "--color=no", "-p", "no:cacheprovider", "--rootdir", str(folder)]
    command = [sys.executable, "-m", "pytest", *quiet, *options, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    lines = (done.stdout or done.stderr).splitlines()
    last = [line.partition(" in ")[0].strip("= ") for line in lines[-1:]]
    return done.returncode, last if done.returncode == 0 and not options else lines[:-1] + last


COUNT = """
from pathlib import Path

def count(record):
    with Path(__file__).with_suffix(".txt").open("a") as file:
        file.write("one\\n")
    return 1.0
"""


def project(folder: Path) -> None:
    """A project with a scenario that expects six things, and another whose metric fails; both count their flights."""
    (folder / "good.py").write_text(COUNT)
    (folder / "bad.py").write_text(COUNT.replace("return 1.0", "raise KeyError('no such thing')"))
    expect = "".join(f"  - {{metric: switches, at_least: -{i}}}\n" for i in range(6))
    for name in ("good", "bad"):
        (folder / f"{name}.yaml").write_text(
            f"{SHORT}metrics: {{flights: {{model: '{name}.py:count'}}}}\nexpect:\n{expect}"
        )


@pytest.mark.slow
def test_a_scenario_is_flown_once_whatever_the_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tmp").mkdir()
    (tmp_path / "project").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    project(tmp_path / "project")
    _, lines = _pytest(tmp_path / "project", "-n", "2")
    assert lines[-1] == "6 failed, 6 passed"
    assert "PluginError: metric count: KeyError: 'no such thing' (bad.py, line 7)" in "\n".join(lines)
    assert [(tmp_path / "project" / f"{name}.txt").read_text() for name in ("good", "bad")] == ["one\n"] * 2
    assert not list((tmp_path / "tmp").glob("sortie-check-*")), "what the workers shared is gone"


def test_verdicts_come_to_the_other_workers_as_they_were(tmp_path: Path) -> None:
    verdicts = (Verdict("a ≥ 1", "0", False, "it must", "a", "facts", 3), Verdict("b", "2", True, ""))
    flown, calls = Flown(verdicts, ("sortie fly x", ""), "wrote it"), list[int]()

    def fly() -> Flown:
        calls.append(1)
        return flown

    assert [flown_once(tmp_path, tmp_path / "x.yaml", fly) for _ in range(3)] == [flown] * 3
    assert len(calls) == 1
    for folder in (None, tmp_path / "gone"):
        flown_once(folder, tmp_path / "x.yaml", fly)
    flown_once(tmp_path, tmp_path / "y.yaml", fly)
    flown_once(tmp_path, tmp_path / "elsewhere" / "x.yaml", fly)
    assert len(calls) == 5


def test_verdicts_as_junit_xml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A flight that fails is an error in it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.yaml").write_text(SHORT + EXPECT)
    (tmp_path / "gone.yaml").write_text(SHORT + "metrics: {m: {model: 'none.py:x'}}" + EXPECT)
    done = CliRunner().invoke(app, ["check", "bad.yaml", "gone.yaml", "--junit", "reports/sortie.xml"])
    assert done.exit_code == 1
    bad, gone = ElementTree.parse("reports/sortie.xml").getroot()  # noqa: S314 - our own file
    assert {k: bad.get(k) for k in ("tests", "failures", "errors")} == {"tests": "2", "failures": "1", "errors": "0"}
    assert (gone.get("tests"), gone.get("errors")) == ("1", "1")
    assert gone[0][0].get("message") == "metric file 'none.py' not found"
    first, second = bad
    assert (first.get("name"), len(first)) == ("deadline_miss_rate ≤ 0.5", 0)
    (failure,) = second
    assert failure.get("message").startswith("bytes.data_sent ≥ 1e+12, got ")
    lines = failure.text.splitlines()
    assert lines[0] == "because: it cannot"
    assert lines[1].startswith("the record: payloads: ")
    assert lines[2].startswith("see it: sortie fly ")


def test_text_that_xml_cannot_hold_is_replaced() -> None:
    text = junit([Suite("a\x00<b>", None, "half \ud800 & \x1b[31m")])
    (suite,) = ElementTree.fromstring(text)  # noqa: S314 - our own text
    assert (suite.get("name"), suite[0][0].get("message")) == ("a�<b>", "half � & �[31m")
