"""Outcomes as regression tests: expectations over replications, golden outcomes, and the pytest plugin in a new project."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy import stats
from sim_examples import BASE, example
from typer.testing import CliRunner

from sortie.scenarios.intervals import mean_interval
from sortie.scenarios.reading.load import load
from sortie.sim.check.checking import check_scenario
from sortie.sim.check.discovery import is_scenario
from sortie.sim.check.expectations import Verdict, check
from sortie.sim.check.golden import differences, golden_path, write_golden
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


def test_the_limit_is_students() -> None:
    values = np.random.default_rng(1).normal(3, 2, 12)
    low = stats.ttest_1samp(values, 0, alternative="greater").confidence_interval(0.95).low
    record = run_sortie(example("duration_s=0.2", "mission.phases=[{at_s: 0, phase: search}]"))
    for bound, holds in ((low - 1e-6, True), (low + 1e-6, False)):
        expect = f"expect=[{{metric: m, at_least: {bound}, replications: 12, confidence: 0.95}}]"
        (verdict,) = check(example(expect), record, {}, [{"m": v} for v in values.tolist()])
        assert verdict.holds is holds
        assert verdict.got.startswith(f"{values.mean():.6g} [{low:.6g}, ")


@pytest.mark.slow
def test_a_mean_at_its_bound_is_called_shown_as_seldom_as_asked() -> None:
    """With a true mean of 0 the expectation `≥ 0 with 90 %` is wrongly called held in 10 % of cases, within 3 σ."""
    rng, cases = np.random.default_rng(2), 4000
    held = sum(mean_interval(rng.normal(0, 1, 8), level=0.8).low >= 0 for _ in range(cases))
    assert abs(held / cases - 0.1) < 3 * math.sqrt(0.09 / cases)


@pytest.mark.parametrize(
    ("values", "holds"),
    [((5.0, 5.0, 5.0), True), ((5.1, 5.3, 5.5), True), ((4.6, 5.2, 5.8), False), ((4.9, 5.0, 5.1), False)],
)
def test_an_expectation_over_replications(values: tuple[float, ...], holds: bool) -> None:
    scenario = example("duration_s=4", "expect=[{metric: m, at_least: 5, replications: 3, confidence: 0.9}]")
    record = run_sortie(example("duration_s=0.2", "mission.phases=[{at_s: 0, phase: search}]"))
    (verdict,) = check(scenario, record, {}, [{"m": v} for v in values])
    assert verdict.expected == "m ≥ 5 with 90 % over 3"
    assert verdict.holds is holds


@pytest.mark.parametrize(("metric", "got"), [("m", "replication 1: None, no number"), ("n", "replication 0: n: ")])
def test_a_replication_without_the_metric_fails_it(metric: str, got: str) -> None:
    scenario = example(f"expect=[{{metric: {metric}, at_least: 5, replications: 2, confidence: 0.9}}]")
    record = run_sortie(example("duration_s=0.2", "mission.phases=[{at_s: 0, phase: search}]"))
    (verdict,) = check(scenario, record, {}, [{"m": 6.0}, {"m": None}])
    assert not verdict.holds
    assert verdict.got.startswith(got)


@pytest.mark.parametrize(
    ("expectation", "holds"),
    [
        ("at_least: 5.2, tolerance: 0.3", True),
        ("at_least: 5.4, tolerance: 0.3", False),
        ("at_most: 4.8, tolerance: 0.3", True),
        ("at_most: 4.8, tolerance: 0.1", False),
        ("equals: 4.9, tolerance: 0.2", True),
        ("equals: 4.9, tolerance: 0.05", False),
    ],
)
def test_tolerances(expectation: str, holds: bool) -> None:
    scenario = example(f"expect=[{{metric: m, {expectation}}}]")
    record = run_sortie(example("duration_s=0.2", "mission.phases=[{at_s: 0, phase: search}]"))
    assert [v.holds for v in check(scenario, record, {"m": 5.0})] == [holds]


def test_of_a_time_that_was_not_flown_nothing_is_held_to_be_so() -> None:
    """Missions may be flown shortened: the phase at 3 s is not in the outcome, and no bound on it holds for want of it."""
    late = "{metric: phases.1.data_rate_mbps, at_most: 1.0e9}"
    decided = "expect_decisions=[{drone: 0, from_s: 3, until_s: 4}]"
    scenario = example("duration_s=2", f"expect=[{late}]", decided)
    record = run_sortie(scenario)
    result = outcome(record)
    assert [p["phase"] for p in result["phases"]] == ["search"]
    assert [(v.holds, v.got) for v in check(scenario, record, result)] == [
        (False, "phases.1.data_rate_mbps: phases has no '1', it has 0 … 0"),
        (False, "no decision"),
    ]


def test_a_failure_tells_why_and_how_to_see_it(tmp_path: Path) -> None:
    path = tmp_path / "short one.yaml"
    path.write_text(SHORT + EXPECT)
    checked = check_scenario(str(path))
    assert [v.holds for v in checked.verdicts] == [True, False]
    (failed,) = checked.failed
    assert "payloads: " in failed.explanation
    assert "decided because of " in failed.explanation
    assert checked.replay(checked.verdicts[0]) == f"sortie fly '{path}' --view"


def test_replications_are_flown_once_each(tmp_path: Path) -> None:
    path = tmp_path / "short.yaml"
    path.write_text(SHORT + "expect:\n  - {metric: energy_j.total, at_least: 1, replications: 2, confidence: 0.9}\n")
    (verdict,) = check_scenario(str(path)).verdicts
    each = [outcome(run_sortie(load(path), replication=r))["energy_j"]["total"] for r in (0, 1)]
    assert each[0] != each[1]
    assert verdict.got.startswith(f"{sum(each) / 2:.6g} [")


def test_a_failure_over_replications_shows_the_worst_of_them(tmp_path: Path) -> None:
    path = tmp_path / "short.yaml"
    asked = "{metric: bytes.data_delivered, at_most: 1, replications: 4, confidence: 0.9}"
    path.write_text(SHORT + f"expect: [{asked}]\n")
    checked = check_scenario(str(path))
    (failed,) = checked.failed
    flown = [outcome(run_sortie(checked.scenario, replication=k))["bytes"]["data_delivered"] for k in range(4)]
    worst = int(np.argmax(flown))
    assert worst > 0, "else nothing is shown"
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
    assert "transitions." in verdict.got
    assert golden.read_text() == before
    check_scenario(str(path), update=True)
    assert golden.read_text() != before


@pytest.mark.parametrize("folder", ["project", "moved to (another) place"])
def test_a_golden_outcome_holds_wherever_the_project_lies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    """Policy files are named by how they are found, which is another path in pytest, in the shell and on another machine."""
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
    path = tmp_path / "x.golden.json"
    result = {"a": 1.0, "b": {"c": [1, "x", None]}, "wall_s": 3.0}
    write_golden(path, result)
    assert differences(path, {**result, "wall_s": 4.0}) == {}
    assert differences(path, {**result, "a": 1.0000001}) == {}
    assert differences(path, {**result, "a": 1.00001}) == {"a": (1.0, 1.00001)}
    assert differences(path, {"a": 1.0, "b": {"c": [1, "y"]}, "d": 2}) == {
        "b.c.1": ("x", "y"),
        "b.c.2": (None, "nothing"),
        "d": ("nothing", 2),
    }
    text = json.loads(path.read_text())
    text["tolerance"]["relative"] = 0.01
    path.write_text(json.dumps(text))
    assert differences(path, {**result, "a": 1.001}) == {}
    write_golden(path, {**result, "a": 2.0})
    assert json.loads(path.read_text())["tolerance"]["relative"] == 0.01


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("{}", "tolerance must be an object"),
        ("[]", "tolerance must be an object"),
        ('{"tolerance": {"relative": 0, "absolute": 0}, "outcome": []}', "outcome must be an object"),
        ('{"tolerance": {"relative": 0}, "outcome": {}}', "tolerance.absolute: None, must be a number ≥ 0"),
        ('{"tolerance": {"relative": "1", "absolute": 0}, "outcome": {}}', "tolerance.relative: '1', must be a number ≥ 0"),
        ('{"tolerance": {"relative": NaN, "absolute": 0}, "outcome": {}}', "tolerance.relative: nan, must be a number ≥ 0"),
        ('{"tolerance": {"relative": -1, "absolute": 0}, "outcome": {}}', "tolerance.relative: -1, must be a number ≥ 0"),
        ("{", "Expecting property name enclosed in double quotes: line 1 column 2 (char 1)"),
    ],
)  # fmt: skip
def test_a_broken_golden_outcome_is_named_and_replaced(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "x.golden.json"
    path.write_text(text)
    with pytest.raises(RunError) as error:
        differences(path, {"a": 1})
    assert str(error.value) == f"{path}: no golden outcome: {what}"
    said = write_golden(path, {"a": 1})
    assert said == f"golden outcome written: {path}, in place of a broken file (no golden outcome: {what})"
    assert differences(path, {"a": 1}) == {}


@pytest.mark.slow
def test_another_sortie_than_the_files_own_is_never_its_golden_outcome(tmp_path: Path) -> None:
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    assert check_scenario(str(path), update=True).written == f"golden outcome written: {golden_path(path)}"
    before = golden_path(path).read_bytes()
    line = "fleet.drones=2: a golden outcome is written of the scenario as its file has it, set nothing"
    with pytest.raises(RunError, match=line):
        check_scenario(str(path), ["fleet.drones=2"], update=True)
    done = CliRunner().invoke(app, ["check", str(path), "--update", "--set", "fleet.drones=2"])
    assert isinstance(done.exception, RunError)
    code, lines = _pytest(tmp_path, "--sortie-update", "--sortie-set", "fleet.drones=2")
    assert (code, lines) == (4, [f"ERROR: {line}", ""])
    assert golden_path(path).read_bytes() == before
    done = CliRunner().invoke(app, ["check", str(path), "--update"])
    assert f"golden outcome written: {golden_path(path)}\n" in done.output
    code, lines = _pytest(tmp_path, "--sortie-update")
    assert (code, lines[-2:]) == (0, [f"golden outcome written: {golden_path(path)}", "1 passed"])


@pytest.mark.slow
def test_a_golden_outcome_that_is_not_compared_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    check_scenario(str(path), update=True)
    assert _pytest(tmp_path) == (0, ["1 passed"])
    code, lines = _pytest(tmp_path, "-rs", "--sortie-set", "fleet.drones=2")
    assert (code, lines[-1]) == (0, "1 skipped")
    assert any("not compared under --sortie-set" in line for line in lines)


@pytest.mark.parametrize(
    ("text", "is_one"),
    [
        ("{name: x, fleet: {drones: 2}, expect: [{metric: switches, at_most: 9}]}", True),
        ('\ufeff# a note\n---\n{ "expect_decisions" : [],\n  "name" : x}', True),
        ('"name": x\n"expect": []', True),
        ("{name: x, expect: [}", True),  # broken: reported when it is collected
        ("{name: x, fleet: {drones: ], expect: []}", True),
        ("fleet: [\nname: x\nexpect: []", True),
        ("services: {{ all }}\n  - {name: x, expect: 1}", False),  # a template
        ("{services: [{name: x, expect: 1}}", False),
        ("{name: x}", False),
        ("{services: {name: x, expect: []}}", False),
        ("{expect: 1, services: [{name: x}]}", False),
        ("{{ name: x, expect: 1 }}", False),  # a template
        ("[{name: x, expect: []}]", False),
        ("a: {name: x, expect: []}", False),
        ("- name: x\n  expect: []", False),
        ("#" * 60 + "\n" * 60 + "x: {", False),  # in no time
    ],
)
def test_a_scenario_is_told_from_other_yaml(tmp_path: Path, text: str, is_one: bool) -> None:
    path = tmp_path / "some.yaml"
    path.write_text(text, "utf-8")
    assert is_scenario(path) is is_one
    golden_path(path).write_text("{}")
    assert is_scenario(path) is (is_one or text == "{name: x}")


def test_yaml_of_other_projects_loads_nothing_heavy(tmp_path: Path) -> None:
    """The plugin runs in every project of whoever installed Sortie."""
    (tmp_path / "some.yaml").write_text("services: [{name: x, expect: 1}]")
    look = (
        "import sys, pathlib; from sortie.sim.check.discovery import is_scenario\n"
        "assert not is_scenario(pathlib.Path(sys.argv[1]))\n"
        "print(*{name.partition('.')[0] for name in sys.modules})"
    )
    command = [sys.executable, "-c", look, str(tmp_path / "some.yaml")]
    loaded = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert "yaml" in loaded
    assert not {"torch", "numpy", "pyarrow", "pydantic", "simpy"} & set(loaded)


@pytest.mark.slow
def test_a_new_project_with_one_yaml_passes_and_fails_as_it_should(tmp_path: Path) -> None:
    """A user's project: pytest, the installed package, scenario files, one of them broken, and YAML of others."""
    (tmp_path / "good.yaml").write_text(SHORT + EXPECT.splitlines()[1] + "\n" + EXPECT.splitlines()[2] + "\n")
    (tmp_path / "compose.yaml").write_text("services: {web: {image: x}}\nexpect: 3\n")
    assert _pytest(tmp_path) == (0, ["1 passed"])
    (tmp_path / "flow.yaml").write_text("{name: x, duration_s: 0.2, perception: {detector: none},\n"
                                        " expect: [{metric: switches, at_least: 0}]}\n")  # fmt: skip
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
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "--color=no", "-p", "no:cacheprovider", "--rootdir", str(folder), *options,
         str(folder)],
        capture_output=True, text=True, cwd=folder,
    )  # fmt: skip
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
    assert len(calls) == 4


@pytest.mark.slow
def test_the_ini_option_says_which_files_are_scenarios(tmp_path: Path) -> None:
    inside = tmp_path / "scenarios" / "more"
    inside.mkdir(parents=True)
    good = SHORT + "\n".join(EXPECT.splitlines()[:3]) + "\n"
    for file in (tmp_path / "elsewhere.yaml", tmp_path / "scenarios" / "one.yaml", inside / "two.yaml"):
        file.write_text(good)
    (tmp_path / "pytest.ini").write_text("[pytest]\nsortie_scenarios = scenarios/*.yaml\n")
    code, lines = _pytest(tmp_path, "--collect-only")
    assert (code, lines[0]) == (0, "scenarios/one.yaml::deadline_miss_rate ≤ 0.5")
    assert lines[-1] == "1 test collected"
    (tmp_path / "pytest.ini").write_text("[pytest]\nsortie_scenarios = scenarios/**/*.yaml elsewhere.yaml\n")
    (tmp_path / "scenarios" / "one.yaml").write_text("name: [1]\n")  # said to be one, so it must be one
    code, lines = _pytest(tmp_path, "--collect-only")
    assert (code, lines[-1]) == (2, "2 tests collected, 1 error")
    assert any("one.yaml:1: name: " in line for line in lines)


def test_verdicts_as_junit_xml(tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_text(SHORT + EXPECT)
    file = tmp_path / "reports" / "sortie.xml"
    done = CliRunner().invoke(app, ["check", str(tmp_path / "bad.yaml"), "--junit", str(file)])
    assert done.exit_code == 1
    (suite,) = ElementTree.parse(file).getroot()  # noqa: S314 - our own file
    assert {k: suite.get(k) for k in ("tests", "failures", "errors")} == {"tests": "2", "failures": "1", "errors": "0"}
    first, second = suite
    assert (first.get("name"), len(first)) == ("deadline_miss_rate ≤ 0.5", 0)
    (failure,) = second
    assert failure.get("message").startswith("bytes.data_sent ≥ 1e+12, got ")
    lines = failure.text.splitlines()
    assert lines[0] == "because: it cannot"
    assert lines[1].startswith("the record: payloads: ")
    assert lines[2].startswith("see it: sortie fly ")


def test_a_flight_that_fails_is_an_error_in_the_xml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.yaml").write_text(SHORT + EXPECT)
    (tmp_path / "bad.yaml").write_text(SHORT + "metrics: {m: {model: 'none.py:x'}}" + EXPECT)
    done = CliRunner().invoke(app, ["check", "good.yaml", "bad.yaml", "--junit", "r.xml"])
    assert done.exit_code == 1
    good, bad = ElementTree.parse("r.xml").getroot()  # noqa: S314 - our own file
    assert (good.get("tests"), good.get("errors"), bad.get("tests"), bad.get("errors")) == ("2", "0", "1", "1")
    assert bad[0][0].get("message") == "metric file 'none.py' not found"


def test_text_that_xml_cannot_hold_is_replaced() -> None:
    text = junit([Suite("a\x00<b>", None, "half \ud800 & \x1b[31m")])
    (suite,) = ElementTree.fromstring(text)  # noqa: S314 - our own text
    assert (suite.get("name"), suite[0][0].get("message")) == ("a�<b>", "half � & �[31m")
