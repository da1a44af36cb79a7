"""What a command passes on: every option arrives in its own place, and what comes back decides the exit code.

What the commands call is stood in for, so that nothing is flown.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import typer
from campaign_examples import Pretended, plan
from cli_examples import Seen, command, run_line, table_rows
from sim_examples import BASE, example

import sortie
from sortie.fleet.logs.geodesy import Origin
from sortie.policies.contract import PolicyError
from sortie.scenarios.reading.load import ScenarioError
from sortie.sim.cli import compare, console, fly
from sortie.sim.cli import verify as verify_command
from sortie.sim.cli.options import loaded, same_command, split_policies
from sortie.sim.experiment.drive import run_campaign
from sortie.sim.experiment.worst import Worst
from sortie.sim.results import run_folder

KEY = bytes(range(32))


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a scenario and a key; tables are as they are, whatever the terminal's width."""
    (tmp_path / "s.yaml").write_text(BASE)
    (tmp_path / "key").write_bytes(KEY)
    (tmp_path / "key").chmod(0o600)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(console.out, "_width", 200)
    return tmp_path


BEST = "best-2(received_budget=0.1)"
POLICIES = ["worked", BEST, "silence"]
COMPARE = f"compare s.yaml --policies 'worked,{BEST},silence' --set duration_s=2"
TOWN = example().perception.scene.seed + 3
"""Another seed is another town: --seed 4 is three further than the first."""
RESEEDED = ["duration_s=2", "seed=4", f"perception.scene.seed={TOWN}"]
HALF_WIDTH = {"half_width": 0.02, "metric": None, "pilot": None, "most_seeds": None, "kept": None, "own_fusion": False}
KEPT = {"kept": None, "workers": 1}
CHOSEN = {"metric": "ap50.mission", "pilot": 6, "most_seeds": 90, "kept": Path("k.sqlite")}
CAMPAIGN = {
    "scheduler": None,
    "security": None,
    "worker_memory_gb": None,
    "wait_for_workers_s": 300.0,
    "by_torch": None,
}
TLS = {"scheduler": "tcp://h:1", "security": tuple(map(Path, ("ca.pem", "cert.pem", "key.pem")))}
RANK = {"suite": "ranking_v1", "against": None, "again": False, "by_torch": False, "further": None, "workers": 1}
SUITE = {
    "suite": "x.yaml",
    "against": ["worked", "silence"],
    "again": True,
    "by_torch": True,
    "further": 2,
    "workers": 3,
}
LOGS = ([Path("a.bin"), Path("b.tlog")], Path("o"), 5.0, 1.5, 2.5, 3.5, [7, 2])
MORE = "--further 2 --workers 3"
SYSTEMS = "--system 7 --system 2 --together"
PASSED: list[tuple[str, str, tuple[Any, ...], dict[str, Any]]] = [
    (
        COMPARE,
        "sortie.compare",
        ("s.yaml", POLICIES, ["duration_s=2"]),
        {"seeds": range(1, 2), "own_fusion": False, **KEPT},
    ),
    (
        f"{COMPARE} --seed 4 --seeds 3 --own-fusion",
        "sortie.compare",
        ("s.yaml", POLICIES, ["duration_s=2"]),
        {"seeds": range(4, 7), "own_fusion": True, **KEPT},
    ),
    (f"{COMPARE} --half-width 0.02", "sortie.compare", ("s.yaml", POLICIES, ["duration_s=2"]), HALF_WIDTH),
    (
        f"{COMPARE} --seed 4 --half-width 0.02 --metric ap50.mission --pilot 6 --most-seeds 90 --kept k.sqlite",
        "sortie.compare",
        ("s.yaml", POLICIES, RESEEDED),
        {**HALF_WIDTH, **CHOSEN},
    ),
    (
        "campaign c.yaml --workers 5 --worker-memory 1.5 --out out --resume --retry-failed --by-torch 6 --no-report",
        "sortie.campaign",
        ("c.yaml",),
        {
            **{**CAMPAIGN, "out": Path("out"), "workers": 5, "worker_memory_gb": 1.5},
            **{"by_torch": 6, "resume": True, "retry_failed": True},
        },
    ),
    (
        "campaign run c.yaml --scheduler tcp://h:1 --security ca.pem cert.pem key.pem --wait-for-workers 7 --no-report",
        "sortie.campaign",
        ("c.yaml",),
        {
            **{**CAMPAIGN, **TLS, "out": Path("runs/campaign-named"), "workers": None},
            **{"wait_for_workers_s": 7.0, "resume": False, "retry_failed": False},
        },
    ),
    ("rank boxes", "sortie.rank", (["boxes"],), RANK),
    (
        f"rank 'boxes,{BEST}' --suite x.yaml --against worked,silence --again --by-torch {MORE} --out o",
        "sortie.rank",
        (["boxes", BEST],),
        SUITE,
    ),
    (
        f"import a.bin b.tlog --rate 5 --from 1.5 --until 2.5 --lift 3.5 {SYSTEMS} --ground 47,8 --out o",
        "sortie.sim.cli.import_log.flown_log",
        LOGS,
        {"together": True, "ground": ["47,8"]},
    ),
    (
        "import 'My Log.bin'",
        "sortie.sim.cli.import_log.flown_log",
        ([Path("My Log.bin")], Path("my_log"), 10.0, 0.0, None, None, ()),
        {"together": False, "ground": ()},
    ),
    ("view r", "sortie.open_run", (Path("r"),), {}),
]
NAMED = "campaign: named\nbase: s.yaml\nvary: {duration_s: {kind: grid, values: [1, 2]}}\npolicies: [worked]\n"


def test_every_option_arrives_in_its_place(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (here / "c.yaml").write_text(NAMED + "metrics: [frame_s]\n")
    wrong: dict[str, Any] = {}
    for line, target, args, kwargs in PASSED:
        seen = Seen()
        with monkeypatch.context() as patch:
            patch.setattr(target, seen)
            code = run_line(line)
        if code != 2 or [(args, kwargs)] != seen.calls:
            wrong[line] = (code, seen.calls)
    assert wrong == {}


def test_the_command_of_a_comparison_is_the_one_that_was_given_without_its_outputs() -> None:
    app = typer.Typer()
    app.command("compare")(compare.compare)
    given = "track_target --policies 'worked,best-2(rho=0.1)' --seed 4 --set a=1 --set b=2 --half-width 0.02 --pilot 8 --own-fusion"
    outputs = "--out a.json --report a.html --readme a.md --replace --kept b --workers 2"
    context = typer.main.get_command(app).make_context("compare", shlex.split(f"{given} {outputs}"))
    assert same_command(context, compare.OUTPUTS) == f"sortie compare {given}"


def test_fly_and_live_pass_on_the_scenario_with_its_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = Seen()
    monkeypatch.setattr(sortie, "fly", seen)
    sets = "--set duration_s=2 --set fleet.drones=3"
    assert run_line(f"fly s.yaml --no-recording --policy boxes --seed 7 --replication 3 {sets}") == 2
    (flown,) = seen.args
    assert (flown.policy.name, flown.duration_s, flown.fleet.drones) == ("boxes", 2.0, 3)
    assert (seen.kwargs["seed"], seen.kwargs["replication"], seen.kwargs["observer"]) == (7, 3, None)
    run_line("fly s.yaml --no-recording --set duration_s=2")
    assert (seen.kwargs["seed"], seen.kwargs["replication"]) == (None, 0)

    live = Seen()
    monkeypatch.setattr("sortie.sim.live.session.fly_live", live)
    monkeypatch.delenv("SORTIE_KEY", raising=False)
    monkeypatch.setenv("ROS_DOMAIN_ID", "17")
    options = "--begin 1.5 --duration 2.5 --loss 0.25 --kill 2@3.5 --start 1@3.75 --domain 9 --decide-within 0.05"
    vehicles = "--mavlink udpin:127.0.0.1:1 --mavlink udpin:127.0.0.1:2 --origin 47,8,400 --mavlink-key key"
    more = "--policy boxes --key key --fallback tracks@3 --set fleet.drones=4"
    assert run_line(f"live s.yaml {options} {vehicles} {more}") == 2
    (flown,), given = live.args, dict(live.kwargs)
    assert (flown.policy.name, flown.fleet.drones) == ("boxes", 4)
    wanted = {"begin_s": 1.5, "duration_s": 2.5, "loss": 0.25, "kill": (2, 3.5), "start": (1, 3.75), "domain": 9}
    wanted |= {"decide_within_s": 0.05, "origin": Origin(47.0, 8.0, 400.0), "key": KEY, "mavlink_key": KEY}
    assert {name: given[name] for name in wanted} == wanted
    assert list(given["mavlink"]) == ["udpin:127.0.0.1:1", "udpin:127.0.0.1:2"]
    assert (given["fallback"].representation.name.lower(), given["fallback"].rate_hz) == ("tracks", 3.0)
    command("live", "s.yaml", "--set", "fleet.origin={latitude_deg: 1, longitude_deg: 2, altitude_m: 3}")
    plain = {"begin_s": 0.0, "duration_s": None, "loss": 0.0, "kill": None, "start": None, "domain": 17}
    plain |= {"decide_within_s": None, "origin": Origin(1.0, 2.0, 3.0), "mavlink_key": None}
    assert {name: live.kwargs[name] for name in plain} == plain
    assert list(live.kwargs["mavlink"]) == []


def test_a_run_of_a_campaign_flies_with_the_campaign_s_own(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    p, seen = plan(here), Seen()
    run_campaign(p, here / "c", Pretended())
    monkeypatch.setattr(sortie, "fly", seen)
    for run in (0, 7, 41):
        at = p.at(run)
        assert run_line(f"fly --from-campaign c --run {run} --no-recording") == 2
        (flown,), given = seen.args, seen.kwargs
        fields = p.varied(at.cell)
        assert (flown.policy.name, flown.duration_s) == (("worked", "best-2")[at.policy], 0.5)
        assert flown.fleet.formation.spacing_m == fields["fleet.formation.spacing_m"]
        assert flown.fleet.battery.initial_soc == fields["fleet.battery.initial_soc"]
        assert (given["seed"], given["replication"]) == (p.seed(at.cell), at.replication)


# --- what comes back -----------------------------------------------------------------------------------


def test_failed_runs_of_a_campaign_fail_it(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "c.yaml").write_text(NAMED + "metrics: [frame_s]\n")
    for failed, now, code, said in (
        (3, 6, 1, "20 runs finished, 3 failed; 6 of them now, 4.0 a minute"),
        (0, 0, 0, "20 runs finished, none of them now"),
    ):
        monkeypatch.setattr(sortie, "campaign", Seen(sortie.CampaignResult(here / "out", 20, failed, now, 90.0)))
        assert run_line("campaign c.yaml --no-report") == code
        assert said in capsys.readouterr().out


def test_worst(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [
        {"run": 8, "policy": "a", "x": 20.123456, "m": 0.5},
        {"run": 3, "policy": "b", "x": "words", "m": 1234567.0},
    ]
    found, flown = Seen(Worst("m", True, ["x"], rows)), Seen(SimpleNamespace())
    monkeypatch.setattr("sortie.sim.experiment.worst.worst", found)
    monkeypatch.setattr("sortie.sim.cli.worst.fly_again", flown)
    assert run_line("campaign worst c m --count 4 --policy b --least --fly 1") == 0
    assert found.calls == [((Path("c"), "m", 4, "b"), {"more_is_worse": False})]
    assert [kwargs for _, kwargs in flown.calls] == [
        {"campaign": Path("c"), "run": 8, "out_dir": Path("c/worst/run-8")}
    ]
    told = capsys.readouterr().out
    for row in (["run", "policy", "x", "m"], ["8", "a", "20.12", "0.5"], ["3", "b", "words", "1.235e+06"]):
        assert row in table_rows(told)
    assert "the most first" in told
    assert "--from-campaign c --run 8 --view" in told
    run_line("campaign worst c m")
    assert found.calls[-1] == ((Path("c"), "m", 10, None), {"more_is_worse": None})
    run_line("campaign worst c m --fly 20")
    assert found.args == (Path("c"), "m", 20, None), "all that fly are shown"


def test_replay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sortie, "open_run", lambda path: ("run of", path))
    seen = Seen()
    monkeypatch.setattr(sortie, "replay", seen)
    assert run_line("replay r --policy boxes --disagreement") == 2
    assert seen.calls == [((("run of", Path("r")), "boxes"), {"disagreement": True})]
    run_line("replay r")
    assert seen.calls[-1] == ((("run of", Path("r")), None), {"disagreement": False})
    for same, strict, code in ((True, True, 0), (False, True, 1), (False, False, 0)):
        seen.answer = SimpleNamespace(same=same, differences=[1], summary=lambda: "told", save=lambda path: path)
        assert run_line("replay r" + " --expect-same" * strict) == code


def test_export(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    record = object()
    monkeypatch.setattr(run_folder, "load", lambda path: (record, path))
    bag, tlog, pcap = Seen({"/a": 3, "/b": 4}), Seen(12), Seen({"context": 5, "features": 6})
    monkeypatch.setattr("sortie.sim.export.bag.write_bag", bag)
    monkeypatch.setattr("sortie.sim.export.telemetry.save_tlog", tlog)
    monkeypatch.setattr("sortie.sim.export.pcap.write_pcap", pcap)
    us, own, place = 1_795_248_000_500_000, (record, Path("r")), Path("r/sortie.tlog")
    begin = "--begin 2026-11-21T08:00:00.5"
    for options, seen, args, said in (
        (
            f"--mcap {begin} --origin 47,8,400 --out new/b",
            bag,
            (own, Path("new/b"), us * 1000, Origin(47.0, 8.0, 400.0)),
            "7 messages on 2 topics",
        ),
        (
            f"--tlog {begin} --origin 47,8 --key key --drone 2",
            tlog,
            (own, place, us, Origin(47.0, 8.0), KEY, 2),
            "12 MAVLink frames",
        ),
        (f"--pcap {begin} --out p", pcap, (own, Path("p"), us * 1000), "11 packets (5 context, 6 features)"),
        ("--tlog", tlog, (own, place, 1_767_225_600_000_000, None, None, None), ""),
    ):
        assert run_line(f"export r {options}") == 0
        assert seen.args == args
        assert said in capsys.readouterr().out
    for wrong in ("--mcap --drone 1", "--pcap --origin 1,2", "--mcap --key key", "--mcap --tlog"):
        assert run_line(f"export r {wrong}") == 2


def test_check(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """What fails in any of several scenarios fails the check: two expectations in each that is other."""
    (here / "t.yaml").write_text(BASE.replace("name: example", "name: other"))
    calls: list[tuple[Any, ...]] = []

    def check(name: Any, overrides: Any, *, update: bool, progress: Any) -> Any:
        calls.append((Path(name).name, overrides, update))
        failed = ["a", "b"] if Path(name).name == "t.yaml" else []
        return (SimpleNamespace(failed=failed, verdicts=[], written="", replay=lambda verdict: f"see {verdict}"),)

    monkeypatch.setattr(sortie, "check", check)
    assert run_line("check s.yaml --set duration_s=2 --update") == 0
    assert calls == [("s.yaml", ["duration_s=2"], True)]
    for files, failed in (
        ("s.yaml t.yaml", 2),
        ("t.yaml s.yaml", 2),
        ("t.yaml s.yaml t.yaml", 4),
        ("s.yaml s.yaml", 0),
    ):
        calls.clear()
        assert run_line(f"check {files}") == (1 if failed else 0)
        assert calls == [(name, [], False) for name in files.split()]
        assert capsys.readouterr().err == (f"{failed} expectations failed\n" if failed else "")


def test_view_and_report(monkeypatch: pytest.MonkeyPatch) -> None:
    viewed, pictured, reported = Seen(True), Seen(True), Seen(Path("page"))
    monkeypatch.setattr(sortie, "open_run", Seen(SimpleNamespace(view=viewed, picture=pictured, report=reported)))
    assert run_line("view r --picture p.png --at 2.5") == 0
    assert (pictured.args, viewed.calls) == ((Path("p.png"), 2.5), [])
    assert run_line("view r") == 0
    assert (len(viewed.calls), len(pictured.calls)) == (1, 1)
    assert run_line("report r --out o.html") == run_line("report r") == 0
    assert [args for args, _ in reported.calls] == [(Path("o.html"),), (Path("r/report.html"),)]


def test_what_watches_a_flight_gets_its_options_and_is_closed(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A viewer and an endpoint together."""
    viewer, endpoint = Mock(), Mock()
    monkeypatch.setattr("sortie.sim.playback.viewer.LiveViewer", viewer)
    monkeypatch.setattr("sortie.sim.export.telemetry.MavlinkEndpoint", endpoint)
    for pace, wanted in ((2.5, 2.5), (0.0, None)):
        with fly._watching(True, "udpout:a:1", pace, here / "key") as watchers:
            watchers.second(1.0, {})
        endpoint.assert_called_with("udpout:a:1", wanted, key=KEY)
    for each in (viewer.return_value, endpoint.return_value):
        assert each.second.call_count == each.close.call_count == 2
    assert not fly._watching(False, None, 1.0, None)


# --- options that several commands take ------------------------------------------------------------------


def test_a_policy_that_is_named_wins_over_the_one_that_is_set(capsys: pytest.CaptureFixture[str]) -> None:
    flown = loaded("s.yaml", ["policy.name=boxes", "duration_s=4"], "silence")
    assert (flown.policy.name, flown.duration_s) == ("silence", 4.0)
    assert capsys.readouterr().err == ""
    own = loaded("s.yaml", ["policy.changes=[{at_s: 1, name: boxes}]"], "worked")
    assert [change.name for change in own.policy.changes] == ["boxes"], "the scenario's own policy keeps its changes"
    assert capsys.readouterr().err == ""


def test_what_stands_in_a_policy_s_brackets_reaches_it() -> None:
    """Commas in brackets separate parameters; quoted commas and brackets are text."""
    assert split_policies(" a(x=1, y=f(2,3)) ,b, ") == ["a(x=1, y=f(2,3))", "b"]
    assert split_policies("a(x=[1, 2], y='c, d)'),b") == ["a(x=[1, 2], y='c, d)')", "b"]
    name, params = "d (1)/own.py:decide", {"x": "a, b", "y": "(", "z": 2.5}
    text = f"""{name}( x = "a, b", y='(', z=2.5, )"""
    flown = loaded("s.yaml", [], text).policy
    assert (flown.name, flown.params) == (name, params)
    assert verify_command._called(text, "link") == (name, params)


def test_what_is_wrong_in_the_bracket_of_a_policy_is_said_of_the_policy() -> None:
    with pytest.raises(PolicyError, match=r"^policies 'a\(x=1,b': a bracket is not closed"):
        split_policies("a(x=1,b")
    for policy, error, message in (
        ("best-2(0.1)", PolicyError, r"^policy 'best-2\(0.1\)': '0.1' in the bracket, must be key=value$"),
        ("best-2(rho=[0.1)", PolicyError, r"^policy 'best-2\(rho=\[0.1\)': the bracket is not closed"),
        (
            "own.py:f(x=[1, 2.5])",
            ScenarioError,
            r"policy\.params\.x: a list of 2, must be a number, true, false or text$",
        ),
    ):
        with pytest.raises(error, match=message):
            loaded("s.yaml", [], policy)
