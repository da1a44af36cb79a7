"""The public API: what it loads, and what it gives. Most tests read one flight and one comparison, each flown once."""

from __future__ import annotations

import dataclasses
import functools
import gc
import json
import subprocess
import sys
from collections.abc import Sequence
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
from sortie.sim.experiment import half_width, pools
from sortie.sim.experiment.compare import Contender, chosen_seeds
from sortie.sim.results.outcome import outcome

SHORT = {"duration_s": 1, "perception.detector": "none", "expect": [], "expect_decisions": []}
SURROGATE = SHORT | {"duration_s": 2, "perception.detector": "surrogate"}
WALL = {"wall_s", "realtime_factor", "policy_eval_us"}


def quiet(view: sortie.FleetView) -> list[sortie.Directive]:
    return [sortie.Directive(view.ego, peer, reason="quiet") for peer in view.peers]


@functools.cache
def flown() -> sortie.Run:
    """The scenario's own policy and seed, 1."""
    return sortie.fly("track_target", SURROGATE)


@functools.cache
def compared() -> sortie.Comparison:
    """Two policies, seeds 1 to 4."""
    return sortie.compare("track_target", ["worked", "silence"], SURROGATE, seeds=4)


def words_of(comparison: sortie.Comparison) -> str:
    """Its summary on one line."""
    return " ".join(str(comparison.summary()).split())


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
    run, record = flown(), run_sortie(sortie.load("track_target", SURROGATE), None, 1)
    assert run.fingerprint == record.fingerprint
    theirs = outcome(record)
    assert {k: v for k, v in run.outcome.items() if k not in WALL} == {k: theirs[k] for k in theirs if k not in WALL}
    assert (run.scenario.name, run.policy, run.seed, run.replication) == ("track_target", "worked", 1, 0)
    assert repr(run) == "<Run of track_target under worked, seed 1, 2 s>"


def test_metrics_are_the_outcomes_numbers_by_dotted_name() -> None:
    run = flown()
    assert run.metrics["ap50.full_scene"] == run.outcome["ap50"]["full_scene"]
    assert run.metrics["phases.0.data_rate_mbps"] == run.outcome["phases"][0]["data_rate_mbps"]
    assert all(isinstance(v, int | float) and not isinstance(v, bool) for v in run.metrics.values())


def test_a_summary_is_text_and_shows_itself_in_a_notebook() -> None:
    for summary, words in (
        (flown().summary(), ("track_target · worked · seed 1", "AP@0.5", "data plane")),
        (flown().decisions(), ("decisions and events", "→")),
        (compared().summary(), ("worked", "silence", "deadlines missed", "silence: sent nothing")),
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


def test_notebooks_fly_by_the_public_interface() -> None:
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        text = path.read_text("utf-8")
        assert "sortie.sim" not in text, path
        assert "import sortie" in text, path


def test_prior_methods_fly_with_their_own_fusion_when_asked() -> None:
    two = sortie.compare("track_target", ["worked", "v2vnet-style"], SHORT, own_fusion=True)
    perception = [s.record.scenario.perception for s in two.sorties if s.record is not None]
    assert [(p.fusion, p.weights) for p in perception] == [("disconet", None), ("v2vnet", "v2vnet.safetensors")]


def test_a_policy_is_a_name_with_parameters_a_callable_or_a_file(tmp_path: Path) -> None:
    assert sortie.fly("track_target", SHORT, policy="best-2(received_budget=0.1)").policy == "best-2"
    assert sortie.fly("track_target", SHORT, policy=quiet).policy == "test_api.quiet"
    (tmp_path / "mine.py").write_text(
        "import sortie\n\ndef decide(view):\n"
        "    return [sortie.Directive(view.ego, peer, reason='quiet') for peer in view.peers]\n"
    )
    run = sortie.fly("track_target", SHORT, policy=f"{tmp_path}/mine.py:decide")
    assert run.outcome["bytes"]["data_sent"] == 0


def test_numbers_may_be_numpys() -> None:
    again = sortie.fly("track_target", SURROGATE, seed=np.int64(1))  # type: ignore[arg-type]
    assert again.fingerprint == flown().fingerprint
    one = sortie.compare("track_target", ["silence"], SHORT, seeds=np.int64(1))  # type: ignore[arg-type]
    assert [s.seed for s in one.sorties] == [1]


def test_a_run_is_saved_and_read_back(tmp_path: Path) -> None:
    run = flown()
    read = sortie.open_run(run.save(tmp_path / "a", recording=False))
    assert read.path == tmp_path / "a"
    assert read.fingerprint == run.fingerprint
    assert json.loads((tmp_path / "a/outcome.json").read_text()) == read.outcome
    assert not (tmp_path / "a/sortie.rrd").exists()
    assert (run.save(tmp_path / "b") / "sortie.rrd").is_file()
    assert "<html" in run.report(tmp_path / "a.html").read_text()[:200].lower()


def test_a_comparison_of_one_seed_has_intervals_over_blocks_of_the_sortie() -> None:
    one = sortie.compare("track_target", ["worked", quiet], SURROGATE, seeds=[1])
    assert isinstance(one.table, pa.Table)
    assert one.table["policy"].to_pylist() == ["worked", "quiet"]
    assert [(gain.over, gain.count) for gain in one.gains] == [("blocks of one sortie", 1)]
    assert "seed 1, in this town, this flight" in words_of(one)


def test_a_comparison_of_several_has_a_row_a_sortie_and_intervals_over_sorties() -> None:
    """A gain is the mean of the sorties' own, with Student's interval."""
    found = compared()
    assert found.table.select(["policy", "seed", "town_seed"]).to_pylist() == [
        {"policy": policy, "seed": seed, "town_seed": 6 + seed}
        for seed in range(1, 5)
        for policy in ("worked", "silence")
    ]
    own = [s.gain["full_scene"] for s in found.sorties if s.policy == "silence"]
    ap = found.table["ap50.full_scene"].to_pylist()
    assert own == pytest.approx([b - a for a, b in zip(ap[::2], ap[1::2], strict=True)])
    (gain,) = found.gains
    assert (gain.policy, gain.metric, gain.over, gain.count) == ("silence", "ap50.full_scene", "sorties", 4)
    assert gain.gain == pytest.approx(np.mean(own))
    student = stats.t.interval(0.95, 3, np.mean(own), stats.sem(own))
    assert (gain.low, gain.high) == pytest.approx(student, abs=1e-4)  # the ends of AP, -1 and 1, are far away
    assert [s.record is not None for s in found.sorties] == [True, True, *[False] * 6]
    assert "means of 4 sorties, seeds 1 to 4, each with a town and random draws of its own" in words_of(found)


@pytest.mark.slow
def test_a_comparison_to_a_half_width_is_a_comparison(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The surrogate stands for torch; the command prints and writes the same."""
    fly = half_width.fly_torch

    def stand_in(contenders: Sequence[Contender], seed: int, kept: Path | None) -> half_width.Row:
        cheap = [half_width.with_detector(c, "surrogate") for c in contenders]
        return fly(cheap, seed, kept)._replace(processor_s=10.0)

    monkeypatch.setattr(half_width, "fly_torch", stand_in)
    monkeypatch.chdir(tmp_path)
    found = sortie.compare("track_target", ["worked", "silence"], SURROGATE, half_width=0.9, pilot=4)
    plain = compared()
    assert [s.outcome["fingerprint"] for s in found.sorties] == [s.outcome["fingerprint"] for s in plain.sorties]
    assert [s.gain for s in found.sorties] == [s.gain for s in plain.sorties]
    assert (precision := found.precision) is not None
    assert (precision.paired, precision.further, precision.control, precision.reached) == (4, 0, False, True)
    (gain,), (other,) = found.gains, plain.gains
    assert gain.gain == pytest.approx(other.gain)
    gains = [s.gain["full_scene"] for s in found.sorties if s.policy == "silence"]
    student = stats.t.ppf(0.975, 3) * stats.sem(gains)  # no scale with ends here, unlike that of `plain`
    assert gain.high - gain.gain == pytest.approx(student * np.sqrt(1 + 3 / 4))
    assert "half-width of ap50.full_scene" in words_of(found)
    with pytest.raises(sortie.RunError, match="a comparison to a half-width keeps no records"):
        found.save_recording(tmp_path / "a.rrd")
    monkeypatch.setenv("SORTIE_FLIGHTS", str(tmp_path / "flights.sqlite"))
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
        monkeypatch.setattr(pools, "fly", None)
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(half_width, "fly_torch", stand_in)
    assert CliRunner().invoke(app, [*command, "--seed", "3", "--out", "d.json"]).exit_code == 0
    sorties = json.loads((tmp_path / "d.json").read_text())["sorties"]
    assert [(s["seed"], s["town_seed"]) for s in sorties[::2]] == [(seed, seed + 6) for seed in range(3, 7)]
    assert sorties[0]["outcome"]["fingerprint"] == plain.sorties[4].outcome["fingerprint"]


def test_each_of_several_seeds_has_a_town_of_its_own_and_flies_as_when_it_is_flown_alone() -> None:
    prints = {s.seed: s.outcome["fingerprint"] for s in compared().sorties if s.policy == "silence"}
    assert prints[1] == sortie.fly("track_target", SURROGATE, policy="silence", seed=1).fingerprint
    moved = SURROGATE | {"perception.scene.seed": 10}
    assert prints[4] == sortie.fly("track_target", moved, policy="silence", seed=4).fingerprint
    (alone,) = sortie.compare("track_target", ["silence"], SURROGATE, seeds=[4]).sorties
    assert alone.outcome["fingerprint"] == sortie.fly("track_target", SURROGATE, policy="silence", seed=4).fingerprint


def test_how_many_seeds_are_flown() -> None:
    for detector, seed, seeds, flies in (
        ("surrogate", None, None, range(1, 9)),
        ("torch", None, None, range(1, 2)),
        ("none", None, None, range(1, 2)),
        ("surrogate", 4, None, range(4, 5)),
        ("torch", None, 3, range(1, 4)),
        ("torch", 4, 3, range(4, 7)),
    ):
        scenario = sortie.load("track_target", {"perception.detector": detector})
        assert chosen_seeds(scenario, seed, seeds) == flies, (detector, seed, seeds)


@pytest.mark.slow
def test_the_command_line_flies_the_seeds_of_the_api(tmp_path: Path) -> None:
    settings = [arg for key, value in SURROGATE.items() for arg in ("--set", f"{key}={value}")]
    command = ["compare", "track_target", "--policies", "worked,silence", *settings]
    done = CliRunner().invoke(app, [*command, "--seed", "1", "--seeds", "4", "--out", str(tmp_path / "c.json")])
    assert done.exit_code == 0, done.output
    kept, ours = json.loads((tmp_path / "c.json").read_text()), compared()
    prints = [s["outcome"]["fingerprint"] for s in kept["sorties"]]
    assert prints == [s.outcome["fingerprint"] for s in ours.sorties]
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


def test_a_campaign_gives_its_rows_goes_on_and_leaves_this_process_as_it_was(tmp_path: Path) -> None:
    def state() -> list[object]:
        return [gc.isenabled(), gc.get_threshold(), [pool["num_threads"] for pool in threadpool_info()]]

    (tmp_path / "tiny.yaml").write_text(CAMPAIGN)
    flown()  # libraries are loaded
    before = state()
    done = sortie.campaign(tmp_path / "tiny.yaml", out=tmp_path / "c")
    assert state() == before
    assert (done.finished, done.failed, done.flown) == (4, 0, 4)
    assert done.rows.num_rows == 4
    assert {row["policy"] for row in done.rows.to_pylist()} == {"worked", "silence"}
    assert sortie.campaign(tmp_path / "tiny.yaml", out=tmp_path / "c").flown == 0


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
    expecting = {"expect": [{"metric": "bytes.data_sent", "at_least": 0}]}
    sortie.fly("track_target", SHORT | expecting).save(tmp_path / "a", recording=False)
    assert "expect" in (tmp_path / "a/scenario.yaml").read_text()
    with pytest.raises(sortie.RunError, match="no scenario below it expects anything"):
        sortie.check(tmp_path)


def test_the_environment_steps() -> None:
    env = sortie.env("track_target", SURROGATE)
    env.reset(seed=1)
    _, rewards, *_ = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
    assert set(rewards) == {f"drone_{i}" for i in range(5)}
    env.close()
