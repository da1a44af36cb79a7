"""The public API: what it loads, what it gives, and what it says of wrong arguments."""

from __future__ import annotations

import dataclasses
import gc
import json
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from places import ROOT
from scipy import stats
from threadpoolctl import threadpool_info
from typer.testing import CliRunner

import sortie
from sortie.sim.cli.app import app
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.studies import multifidelity
from sortie.sim.studies.compare import Contender, chosen_seeds

SHORT = {"duration_s": 2, "perception.detector": "none", "expect": [], "expect_decisions": []}
SURROGATE = SHORT | {"perception.detector": "surrogate"}


def quiet(view: sortie.FleetView) -> list[sortie.Directive]:
    return [sortie.Directive(view.ego, peer, reason="quiet") for peer in view.peers]


# --- what it loads -------------------------------------------------------------------------------


def test_the_import_loads_nothing() -> None:
    code = "import sys; before = set(sys.modules); import sortie; print(*sorted(set(sys.modules) - before))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "sortie" in loaded
    assert {name.partition(".")[0] for name in loaded} <= {"sortie", "importlib", "typing", "_typing"} | set(
        sys.stdlib_module_names
    )


def test_the_import_changes_nothing_in_a_process_of_somebody_else() -> None:
    code = """
import gc, os, random, signal, sys, threading
import numpy as np

def state():
    return (gc.isenabled(), gc.get_threshold(), random.getstate(), np.random.get_state()[1].tolist(), os.getcwd(),
            dict(os.environ), signal.getsignal(signal.SIGINT), threading.active_count(), np.geterr(), sys.path[:],
            sys.getrecursionlimit())

before = state()
import sortie
for name in sortie.__all__:
    getattr(sortie, name)
assert state() == before, "changed"
assert "matplotlib" not in sys.modules and "torch" not in sys.modules and "rerun" not in sys.modules
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr


def test_everything_public_is_there_documented_and_listed() -> None:
    assert sorted(sortie.__all__) == dir(sortie)
    for name in sortie.__all__:
        assert getattr(sortie, name).__doc__ or name == "__version__"
    with pytest.raises(AttributeError, match="module 'sortie' has no attribute 'fyl'"):
        sortie.fyl  # noqa: B018


# --- what it gives -------------------------------------------------------------------------------


def test_a_scenario_is_a_name_a_path_a_dict_or_a_scenario(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("name: mine\nduration_s: 5\n")
    by_path, by_dict = sortie.load(path), sortie.load({"name": "mine", "duration_s": 5})
    assert by_path == by_dict == sortie.load(by_dict) == sortie.load(str(path))
    assert sortie.load(by_dict, {"fleet.drones": 3}).fleet.drones == 3
    assert sortie.load(by_dict, ["fleet.drones=3"]) == sortie.load(by_dict, {"fleet.drones": 3})
    assert sortie.load("track_target", {"fleet": {"drones": 3}}).fleet.drones == 3


def test_a_run_is_the_engines_record() -> None:
    run = sortie.fly("track_target", SHORT, seed=7)
    record = run_sortie(sortie.load("track_target", SHORT), None, 7)
    assert run.fingerprint == record.fingerprint
    assert {k: v for k, v in run.outcome.items() if k not in WALL} == {
        k: v for k, v in outcome(record).items() if k not in WALL
    }
    assert (run.scenario.name, run.policy, run.seed, run.replication) == ("track_target", "worked", 7, 0)
    assert repr(run) == "<Run of track_target under worked, seed 7, 2 s>"


WALL = {"wall_s", "realtime_factor", "policy_eval_us"}


def test_metrics_are_the_outcomes_numbers_by_dotted_name() -> None:
    run = sortie.fly("track_target", SURROGATE)
    assert run.metrics["ap50.full_scene"] == run.outcome["ap50"]["full_scene"]
    assert run.metrics["phases.0.data_rate_mbps"] == run.outcome["phases"][0]["data_rate_mbps"]
    assert all(isinstance(v, int | float) and not isinstance(v, bool) for v in run.metrics.values())


def test_a_summary_is_text_and_shows_itself_in_a_notebook() -> None:
    run = sortie.fly("track_target", SURROGATE)
    compared = sortie.compare("track_target", ["worked", "silence"], SURROGATE)
    for summary, words in (
        (run.summary(), ("track_target · worked · seed 1", "AP@0.5", "data plane")),
        (run.decisions(), ("decisions and events", "→")),
        (compared.summary(), ("worked", "silence", "deadlines missed", "silence: sent nothing")),
    ):
        assert all(word in str(summary) for word in words)
        assert set(summary._repr_mimebundle_([], [])) == {"text/plain", "text/html"}


def test_the_command_line_prints_the_summaries_of_the_api(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    made: list[str] = []
    monkeypatch.setattr(sortie.Run, "summary", lambda self: made.append("run") or "SUMMARY")
    monkeypatch.setattr(sortie.Comparison, "summary", lambda self: made.append("comparison") or "SUMMARY")
    monkeypatch.setattr(sortie.Run, "picture", lambda self, path, at_s: made.append(f"picture at {at_s:g}"))
    settings = [arg for key, value in SHORT.items() for arg in ("--set", f"{key}={value}")]
    for command in (
        ["fly", "track_target", *settings, "--out", "a", "--no-recording"],
        ["compare", "track_target", "--policies", "worked,silence", *settings],
        ["view", "a", "--picture", "a.png", "--at", "1"],
    ):
        done = CliRunner().invoke(app, command)
        assert done.exit_code == 0, done.output
    assert made == ["run", "comparison", "picture at 1"]


@pytest.mark.parametrize("name", ["fly_and_look", "write_and_verify_a_policy", "campaign_over_link_and_battery"])
def test_a_notebook_flies_by_the_public_interface(name: str) -> None:
    text = (ROOT / "notebooks" / f"{name}.ipynb").read_text()
    assert "sortie.sim" not in text
    assert "import sortie" in text


def test_prior_methods_fly_with_their_own_fusion_when_asked() -> None:
    compared = sortie.compare("track_target", ["worked", "v2vnet-style"], SHORT, own_fusion=True)
    flown = [s.record.scenario.perception for s in compared.sorties if s.record is not None]
    assert [(p.fusion, p.weights) for p in flown] == [("disconet", None), ("v2vnet", "v2vnet.safetensors")]


@pytest.mark.parametrize(
    ("policy", "name"),
    [(None, "worked"), ("silence", "silence"), ("best-2(received_budget=0.1)", "best-2"), (quiet, "test_api.quiet")],
)
def test_a_policy_is_a_name_with_parameters_or_a_callable(policy: object, name: str) -> None:
    assert sortie.fly("track_target", SHORT, policy=policy).policy == name  # type: ignore[arg-type]


def test_a_seed_may_be_numpys() -> None:
    assert (
        sortie.fly("track_target", SHORT, seed=np.int64(7)).fingerprint
        == sortie.fly("track_target", SHORT, seed=7).fingerprint
    )  # type: ignore[arg-type]


def test_a_number_of_seeds_may_be_numpys() -> None:
    compared = sortie.compare("track_target", ["silence"], SHORT, seeds=np.int64(1))  # type: ignore[arg-type]
    assert [s.seed for s in compared.sorties] == [sortie.load("track_target").seed]


def test_a_policy_flies_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "import sortie\n\ndef decide(view):\n"
        "    return [sortie.Directive(view.ego, peer, reason='quiet') for peer in view.peers]\n"
    )
    run = sortie.fly("track_target", SHORT, policy=f"{tmp_path}/mine.py:decide")
    assert run.outcome["bytes"]["data_sent"] == 0


def test_a_run_is_saved_and_read_back(tmp_path: Path) -> None:
    run = sortie.fly("track_target", SHORT)
    read = sortie.open_run(run.save(tmp_path / "a", recording=False))
    assert read.path == tmp_path / "a"
    assert read.fingerprint == run.fingerprint
    assert json.loads((tmp_path / "a/outcome.json").read_text()) == read.outcome
    assert not (tmp_path / "a/sortie.rrd").exists()
    assert (run.save(tmp_path / "b") / "sortie.rrd").is_file()
    assert "<html" in run.report(tmp_path / "a.html").read_text()[:200].lower()


def test_a_comparison_has_a_row_a_sortie_and_says_what_its_intervals_cover() -> None:
    one = sortie.compare("track_target", ["worked", quiet], SURROGATE, seeds=[1])
    assert isinstance(one.table, pa.Table)
    assert one.table["policy"].to_pylist() == ["worked", "quiet"]
    assert [(gain.over, gain.count) for gain in one.gains] == [("blocks of one sortie", 1)]
    assert "seed 1, in this town, this flight" in _line(one)
    three = sortie.compare("track_target", ["worked", quiet], SURROGATE, seeds=range(3))
    assert three.table.select(["policy", "seed", "town_seed"]).to_pylist() == [
        {"policy": policy, "seed": seed, "town_seed": 6 + seed} for seed in range(3) for policy in ("worked", "quiet")
    ]
    (gain,) = three.gains
    assert (gain.policy, gain.metric, gain.over, gain.count) == ("quiet", "ap50.full_scene", "sorties", 3)
    assert [s.record is not None for s in three.sorties] == [True, True, False, False, False, False]
    assert "means of 3 sorties, seeds 0 to 2, each with a town and random draws of its own" in _line(three)


def _line(compared: sortie.Comparison) -> str:
    return " ".join(str(compared.summary()).split())


def test_a_gain_over_sorties_is_the_mean_of_the_sorties_own_with_students_interval() -> None:
    compared = sortie.compare("track_target", ["worked", "silence"], SURROGATE, seeds=4)
    own = [s.gain["full_scene"] for s in compared.sorties if s.policy == "silence"]
    ap = compared.table["ap50.full_scene"].to_pylist()
    assert own == pytest.approx([b - a for a, b in zip(ap[::2], ap[1::2], strict=True)])
    (gain,) = compared.gains
    assert gain.gain == pytest.approx(np.mean(own))
    student = stats.t.interval(0.95, 3, np.mean(own), stats.sem(own))
    assert (gain.low, gain.high) == pytest.approx(student, abs=1e-4)  # the ends of AP, -1 and 1, are far away


@pytest.mark.slow
def test_a_comparison_to_a_half_width_is_a_comparison(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The surrogate stands for torch; the command prints and writes the same."""
    fly = multifidelity.fly_torch

    def stand_in(contenders: Sequence[Contender], seed: int) -> multifidelity.Row:
        return fly([multifidelity.with_detector(c, "surrogate") for c in contenders], seed)._replace(processor_s=10.0)

    monkeypatch.setattr(multifidelity, "fly_torch", stand_in)
    monkeypatch.chdir(tmp_path)
    compared = sortie.compare("track_target", ["worked", "silence"], SURROGATE, half_width=0.9, pilot=4)
    plain = sortie.compare("track_target", ["worked", "silence"], SURROGATE, seeds=4)
    assert [s.outcome["fingerprint"] for s in compared.sorties] == [s.outcome["fingerprint"] for s in plain.sorties]
    assert [s.gain for s in compared.sorties] == [s.gain for s in plain.sorties]
    assert (found := compared.precision) is not None
    assert (found.paired, found.further, found.control, found.reached) == (4, 0, False, True)
    (gain,), (other,) = compared.gains, plain.gains
    assert gain.gain == pytest.approx(other.gain)
    gains = [s.gain["full_scene"] for s in compared.sorties if s.policy == "silence"]
    student = stats.t.ppf(0.975, 3) * stats.sem(gains)  # no scale with ends here, unlike that of `plain`
    assert gain.high - gain.gain == pytest.approx(student * np.sqrt(1 + 3 / 4))
    assert "half-width of ap50.full_scene" in _line(compared)
    with pytest.raises(sortie.RunError, match="a comparison to a half-width keeps no records"):
        compared.save_recording(tmp_path / "a.rrd")
    settings = [arg for key, value in SURROGATE.items() for arg in ("--set", f"{key}={value}")]
    command = [
        "compare",
        "track_target",
        "--policies",
        "worked,silence",
        *settings,
        "--half-width",
        "0.9",
        "--pilot",
        "4",
    ]
    for _ in range(2):  # the second reads what the first kept
        done = CliRunner().invoke(app, [*command, "--out", "c.json", "--replace"])
        assert done.exit_code == 0, done.output
        written = json.loads((tmp_path / "c.json").read_text())
        assert written["gains"] == [dataclasses.asdict(gain)]
        assert written["precision"]["paired"] == 4
        monkeypatch.setattr(multifidelity, "fly_torch", None)
    (kept,) = (tmp_path / "runs").iterdir()
    assert kept.match("compare-track_target-????????.sqlite")
    monkeypatch.setattr(multifidelity, "fly_torch", stand_in)
    assert CliRunner().invoke(app, [*command, "--seed", "3", "--out", "d.json"]).exit_code == 0
    sorties = json.loads((tmp_path / "d.json").read_text())["sorties"]
    assert [(s["seed"], s["town_seed"]) for s in sorties[::2]] == [(seed, seed + 6) for seed in range(3, 7)]
    assert sorties[0]["outcome"]["fingerprint"] == plain.sorties[4].outcome["fingerprint"]


def test_each_of_several_seeds_has_a_town_of_its_own_and_flies_as_when_it_is_flown_alone() -> None:
    two = sortie.compare("track_target", ["silence"], SURROGATE, seeds=[1, 5])
    own, other = (s.outcome["fingerprint"] for s in two.sorties)
    assert own == sortie.fly("track_target", SURROGATE, policy="silence", seed=1).fingerprint
    moved = SURROGATE | {"perception.scene.seed": 11}
    assert other == sortie.fly("track_target", moved, policy="silence", seed=5).fingerprint
    (alone,) = sortie.compare("track_target", ["silence"], SURROGATE, seeds=[5]).sorties
    assert alone.outcome["fingerprint"] == sortie.fly("track_target", SURROGATE, policy="silence", seed=5).fingerprint


@pytest.mark.parametrize(
    ("detector", "seed", "seeds", "flown"),
    [
        ("surrogate", None, None, range(1, 9)),
        ("torch", None, None, range(1, 2)),
        ("none", None, None, range(1, 2)),
        ("surrogate", 4, None, range(4, 5)),
        ("torch", None, 3, range(1, 4)),
        ("torch", 4, 3, range(4, 7)),
    ],
)
def test_how_many_seeds_are_flown(detector: str, seed: int | None, seeds: int | None, flown: range) -> None:
    assert chosen_seeds(sortie.load("track_target", {"perception.detector": detector}), seed, seeds) == flown


@pytest.mark.slow
def test_the_command_line_flies_the_seeds_of_the_api(tmp_path: Path) -> None:
    settings = [arg for key, value in SURROGATE.items() for arg in ("--set", f"{key}={value}")]
    command = ["compare", "track_target", "--policies", "worked,silence", *settings]
    command += ["--out", str(tmp_path / "c.json"), "--replace"]
    for more, seeds in ((["--seed", "3", "--seeds", "2"], [3, 4]), ([], None)):
        done = CliRunner().invoke(app, [*command, *more])
        assert done.exit_code == 0, done.output
        kept = json.loads((tmp_path / "c.json").read_text())
        ours = sortie.compare("track_target", ["worked", "silence"], SURROGATE, seeds=seeds)
        assert [s["outcome"]["fingerprint"] for s in kept["sorties"]] == [
            s.outcome["fingerprint"] for s in ours.sorties
        ]
        assert kept["gains"] == [dataclasses.asdict(gain) for gain in ours.gains]


CAMPAIGN = """
campaign: tiny
base: track_target
set: {duration_s: 1, perception.detector: none, mission.phases: [{at_s: 0, phase: search}]}
policies: [worked, silence]
vary:
  fleet.drones: {kind: grid, values: [2, 3]}
metrics: [bytes.data_sent]
"""


def test_a_campaign_gives_its_rows_and_goes_on(tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(CAMPAIGN)
    done = sortie.campaign(tmp_path / "tiny.yaml", out=tmp_path / "c")
    assert (done.finished, done.failed, done.flown) == (4, 0, 4)
    assert done.rows.num_rows == 4
    assert {row["policy"] for row in done.rows.to_pylist()} == {"worked", "silence"}
    assert sortie.campaign(tmp_path / "tiny.yaml", out=tmp_path / "c").flown == 0


def test_a_campaign_in_this_process_leaves_it_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(CAMPAIGN)

    def state() -> list[object]:
        return [gc.isenabled(), gc.get_threshold(), [pool["num_threads"] for pool in threadpool_info()]]

    sortie.fly("track_target", SHORT)  # libraries are loaded
    before = state()
    sortie.campaign(tmp_path / "tiny.yaml", out=tmp_path / "c")
    assert state() == before


def test_a_folder_is_checked_whole(tmp_path: Path) -> None:
    text = (
        "name: {}\nduration_s: 1\nperception: {{detector: none}}\nexpect: [{{metric: bytes.data_sent, at_least: {}}}]\n"
    )
    (tmp_path / "deep").mkdir()
    (tmp_path / "a.yaml").write_text(text.format("a", 0))
    (tmp_path / "deep/b.yml").write_text(text.format("b", "1.0e+15"))
    (tmp_path / "other.yaml").write_text("jobs: [build]\n")
    a, b = sortie.check(tmp_path)
    assert (len(a.failed), len(b.failed)) == (0, 1)


def test_a_failure_of_a_check_with_a_map_of_overrides_is_replayed_with_these_overrides(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("name: a\nexpect: [{metric: bytes.data_sent, at_least: 1.0e+15}]\n")
    (checked,) = sortie.check(str(tmp_path / "a.yaml"), {"duration_s": 1, "perception.detector": "none"})
    (failed,) = checked.failed
    overrides = "--set duration_s=1 --set 'perception.detector=\"none\"'"
    assert checked.replay(failed) == f"sortie fly {tmp_path / 'a.yaml'} {overrides} --view"


def test_the_copy_in_a_runs_folder_is_no_scenario_to_check(tmp_path: Path) -> None:
    """It would fly again, shortened or not, whenever someone runs pytest beside a folder of runs."""
    sortie.fly("track_target", {"duration_s": 1, "perception.detector": "none"}).save(tmp_path / "a", recording=False)
    assert "expect" in (tmp_path / "a/scenario.yaml").read_text()
    with pytest.raises(sortie.RunError, match="no scenario below it expects anything"):
        sortie.check(tmp_path)


def test_the_environment_steps() -> None:
    env = sortie.env("track_target", SURROGATE)
    env.reset(seed=1)
    _, rewards, *_ = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    assert set(rewards) == {f"drone_{i}" for i in range(5)}
    env.close()


# --- wrong arguments -----------------------------------------------------------------------------


HOLDS_ITSELF: dict[str, object] = {"name": "a"}
HOLDS_ITSELF["fleet"] = HOLDS_ITSELF
SHORT_TEXTS = ["duration_s=1", "perception.detector=none", "expect=[]"]
WRONG: dict[str, tuple[Callable[[], object], type[Exception], str]] = {
    "unknown scenario": (lambda: sortie.fly("nonsense"), sortie.ScenarioError, "nonsense: no such file, the library has "),
    "near miss": (lambda: sortie.load("track_targt"), sortie.ScenarioError, "did you mean track_target?"),
    "no scenario": (lambda: sortie.load(None), sortie.ScenarioError, "scenario: None, must be a name, a path, a dict or a Scenario"),  # type: ignore[arg-type]
    "a typo in a dict": (lambda: sortie.load({"name": "a", "fleet": {"dornes": 3}}), sortie.ScenarioError, "scenario: fleet.dornes: unknown key, did you mean drones?"),
    "a key that is no text": (lambda: sortie.load({3: 4}), sortie.ScenarioError, "the key 3 is no text"),  # type: ignore[dict-item]
    "not a number": (lambda: sortie.load({"name": "a", "duration_s": float("nan")}), sortie.ScenarioError, "scenario: duration_s: nan, must be a finite number"),
    "an object": (lambda: sortie.load("track_target", {"fleet.drones": object}), sortie.ScenarioError, "overrides: fleet.drones: <class 'object'>, must be a number, text, a list or a section"),
    "a wrong override": (lambda: sortie.load("track_target", {"fleet.drones": "x"}), sortie.ScenarioError, "overrides: fleet.drones: x, must be a whole number"),
    "a text for overrides": (lambda: sortie.load("track_target", "fleet.drones=3"), sortie.ScenarioError, "overrides: 'fleet.drones=3', must be a map or a list: {'fleet.drones': 3}"),
    "a number for overrides": (lambda: sortie.load("track_target", 3), sortie.ScenarioError, "overrides: 3, must be a map or a list"),  # type: ignore[arg-type]
    "an override of nothing": (lambda: sortie.load("track_target", {"": 3}), sortie.ScenarioError, "overrides: '' is no field, must be key.path"),
    "a number for a policy": (lambda: sortie.fly("track_target", policy=42), sortie.PolicyError, "policy: 42, must be a name, file.py:function or a callable of one FleetView"),  # type: ignore[arg-type]
    "a policy of no view": (lambda: sortie.fly("track_target", policy=lambda: []), sortie.PolicyError, "policy '<lambda>': too many positional arguments, must take one FleetView"),  # type: ignore[arg-type, misc]
    "an unknown policy": (lambda: sortie.fly("track_target", policy="nope"), sortie.PolicyError, "unknown policy 'nope', known: worked, "),
    "a policy that gives no directives": (lambda: sortie.fly("track_target", SHORT, policy=lambda view: 5), sortie.PolicyError, "returns int, must be a sequence of directives"),  # type: ignore[arg-type, return-value]
    "a near miss of a policy": (lambda: sortie.fly("track_target", policy="al-4"), sortie.PolicyError, "unknown policy 'al-4', did you mean all-4? known: worked, "),
    "a policy that gives one directive": (lambda: sortie.fly("track_target", SHORT, policy=lambda view: sortie.Directive(view.ego, 1)), sortie.PolicyError, "returns Directive, must be a sequence of directives"),  # type: ignore[arg-type, return-value]
    "a policy that fails": (lambda: sortie.fly("track_target", SHORT, policy=lambda view: 1 / 0), sortie.PolicyError, "raises ZeroDivisionError: division by zero"),  # type: ignore[arg-type, return-value]
    "a negative seed": (lambda: sortie.fly("track_target", seed=-1), sortie.ScenarioError, "seed: -1, must be a whole number from 0 to 2^63 - 1"),
    "a replication and a half": (lambda: sortie.fly("track_target", replication=1.5), sortie.ScenarioError, "replication: 1.5, must be a whole number"),  # type: ignore[arg-type]
    "policies as text": (lambda: sortie.compare("track_target", "worked"), sortie.PolicyError, "policies: 'worked', must be a list of policies: ['worked', 'silence']"),
    "a policy twice": (lambda: sortie.compare("track_target", ["worked", "worked"]), sortie.PolicyError, "policies: worked, worked, must be one or more, each named once"),
    "a seed twice": (lambda: sortie.compare("track_target", ["worked"], seeds=[1, 1]), sortie.ScenarioError, "seeds: [1, 1], must be one or more, each named once"),
    "a list of pairs for overrides": (lambda: sortie.load("track_target", [("fleet.drones", 3)]), sortie.ScenarioError, "overrides: [('fleet.drones', 3)], must be a map or a list"),  # type: ignore[list-item]
    "a progress that is no function": (lambda: sortie.fly("track_target", SHORT, progress=True), sortie.ScenarioError, "progress: True, must be a function, or None"),  # type: ignore[arg-type]
    "an observer that is none": (lambda: sortie.fly("track_target", SHORT, observer=print), sortie.ScenarioError, "must have the methods begin and second"),  # type: ignore[arg-type]
    "a run saved nowhere": (lambda: sortie.fly("track_target", SHORT).save(3), sortie.RunError, "path: 3, must be a path"),  # type: ignore[arg-type]
    "two policies of one name": (lambda: sortie.compare("track_target", [lambda view: [], lambda view: []]), sortie.PolicyError, "give functions of one name, such as lambdas, a __name__ of their own"),
    "seeds and a half-width": (lambda: sortie.compare("track_target", ["worked"], seeds=3, half_width=0.1), sortie.RunError, "seeds and half_width: name one of them"),
    "a half-width as text": (lambda: sortie.compare("track_target", ["worked"], half_width="1"), sortie.RunError, "half_width: '1', must be a number above 0 and below 1; 0.01 is one AP point"),  # type: ignore[arg-type]
    "a pilot alone": (lambda: sortie.compare("track_target", ["worked"], pilot=8), sortie.RunError, "pilot: goes with half_width, which is missing"),
    "a metric alone": (lambda: sortie.compare("track_target", ["worked"], metric="ap50.mission"), sortie.RunError, "metric: goes with half_width, which is missing"),
    "a replication past 32 bits": (lambda: sortie.fly("track_target", replication=2**32), sortie.ScenarioError, "replication: 4294967296, must be a whole number from 0 to 2^32 - 1"),
    "text for overrides of a check": (lambda: sortie.check("track_target", "duration_s=1"), sortie.ScenarioError, "overrides: 'duration_s=1', must be a map or a list"),
    "a metric of a half-width": (lambda: sortie.compare("track_target", ["worked"], half_width=0.1, metric="ap"), sortie.RunError, "metric: ap, must be one of ap50.full_scene, ap50.mission"),
    "no seeds": (lambda: sortie.compare("track_target", ["worked"], seeds=0), sortie.ScenarioError, "seeds: 0, must be a list of seeds or how many, 1 or more"),
    "seeds and a half": (lambda: sortie.compare("track_target", ["worked"], seeds=1.5), sortie.ScenarioError, "seeds: 1.5, must be a list of seeds or how many"),  # type: ignore[arg-type]
    "no run": (lambda: sortie.open_run("nowhere"), sortie.RunError, "nowhere: no run there (outcome.json is missing)"),
    "a number for a path": (lambda: sortie.open_run(7), sortie.RunError, "path: 7, must be a path"),  # type: ignore[arg-type]
    "unknown campaign": (lambda: sortie.campaign("nope"), sortie.ScenarioError, "nope: no such file, the library has link_battery"),
    "a near miss of a campaign": (lambda: sortie.campaign("link_batery"), sortie.ScenarioError, "did you mean link_battery?"),
    "unknown metric": (lambda: sortie.fly("track_target", SHORT).metrics["bytes.data_snt"], sortie.SortieError, "bytes.data_snt: this run has no such metric, did you mean bytes.data_sent?"),
    "a metric like no other": (lambda: sortie.fly("track_target", SHORT).metrics["§"], KeyError, "§: this run has no such metric, `sorted(run.metrics)` lists the names"),
    "negative workers": (lambda: sortie.campaign("link_battery", workers=-1), sortie.RunError, "workers: -1, must be a whole number from 0 on, or None"),
    "a dict that holds itself": (lambda: sortie.load(HOLDS_ITSELF), sortie.ScenarioError, "21 levels deep, must be at most 20"),
    "a deep override": (lambda: sortie.load("track_target", {"fleet": HOLDS_ITSELF}), sortie.ScenarioError, "21 levels deep, must be at most 20"),
    "memory as text": (lambda: sortie.campaign("link_battery", worker_memory_gb="x"), sortie.RunError, "worker_memory_gb: 'x', must be a number above 0, or None"),  # type: ignore[arg-type]
    "a number for a scheduler": (lambda: sortie.campaign("link_battery", scheduler=5), sortie.RunError, "scheduler: 5, must be an address: 'tcp://host:8786'"),  # type: ignore[arg-type]
    "a number for certificates": (lambda: sortie.campaign("link_battery", security=5), sortie.RunError, "security: 5, must be three paths: CA, certificate, key"),  # type: ignore[arg-type]
    "a progress of a check that is no function": (lambda: sortie.check("track_target", SHORT_TEXTS, progress=5), sortie.ScenarioError, "progress: 5, must be a function, or None"),  # type: ignore[arg-type]
    "a negative seed of an episode": (lambda: sortie.env("track_target", SURROGATE).reset(seed=-1), sortie.ScenarioError, "seed: -1, must be a whole number from 0 to 2^63 - 1"),
    "a negative seed of a team's episode": (lambda: sortie.env("track_target", SURROGATE, team=True).reset(seed=-1), sortie.ScenarioError, "seed: -1, must be a whole number from 0 to 2^63 - 1"),
    "an array of seeds for an episode": (lambda: sortie.env("track_target", SURROGATE).reset(seed=np.array([1, 2])), sortie.ScenarioError, "seed: array([1, 2]), must be a whole number from 0 to 2^63 - 1"),  # type: ignore[arg-type]
    "an array of seeds for a flight": (lambda: sortie.fly("track_target", seed=np.array([1, 2])), sortie.ScenarioError, "seed: array([1, 2]), must be a whole number from 0 to 2^63 - 1"),  # type: ignore[arg-type]
    "nothing to check": (lambda: sortie.check("nope"), sortie.ScenarioError, "nope: no such file"),
    "a lone drone": (lambda: sortie.env({"name": "a", "fleet": {"drones": 1}}), sortie.RunError, "fleet.drones is 1, must be at least 2 to share"),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_argument_is_one_line_that_says_what_is_allowed(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    call, kind, said = WRONG[what]
    with pytest.raises(kind, match=re.escape(said)) as error:
        call()
    assert isinstance(error.value, sortie.SortieError)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []
