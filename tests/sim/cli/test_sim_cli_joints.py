"""What a command passes on: every option arrives in its own place, and what comes back decides the exit code.

Joints, each with a test below: options of `fly`, `compare`, `campaign`, `rank`, `replay`, `check`, `live`, `export` and
`campaign worst` to the function that does the work.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from campaign_examples import Pretended, plan
from cli_examples import command
from sim_examples import BASE

import sortie
from sortie.fleet.logs.geodesy import Origin
from sortie.sim.campaign.drive import run_campaign
from sortie.sim.campaign.worst import Worst
from sortie.sim.cli import fly
from sortie.sim.results import run_folder


class Seen:
    """A function that keeps what it was called with, and gives `answer` or stops the command."""

    def __init__(self, answer: Any = None) -> None:
        self.args: tuple[Any, ...] = ()
        self.kwargs: dict[str, Any] = {}
        self.calls, self._answer = 0, answer

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.args, self.kwargs, self.calls = args, kwargs, self.calls + 1
        if self._answer is None:
            raise sortie.RunError("seen")
        return self._answer


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scenario and a key."""
    (tmp_path / "s.yaml").write_text(BASE)
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    key.chmod(0o600)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_fly(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = Seen()
    monkeypatch.setattr(sortie, "fly", seen)
    options = (
        "--policy",
        "boxes",
        "--seed",
        "7",
        "--replication",
        "3",
        "--set",
        "duration_s=2",
        "--set",
        "fleet.drones=3",
    )
    assert command("fly", "s.yaml", "--no-recording", *options) == 2
    (flown,), given = seen.args, seen.kwargs
    assert (flown.policy.name, flown.duration_s, flown.fleet.drones) == ("boxes", 2.0, 3)
    assert (given["seed"], given["replication"], given["observer"]) == (7, 3, None)
    command("fly", "s.yaml", "--no-recording", "--set", "duration_s=2")
    assert (seen.kwargs["seed"], seen.kwargs["replication"]) == (None, 0)


def test_a_run_of_a_campaign_flies_with_the_campaign_s_own(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    p = plan(here)
    run_campaign(p, here / "c", Pretended())
    seen = Seen()
    monkeypatch.setattr(sortie, "fly", seen)
    for run in (0, 7, 41):
        at = p.at(run)
        assert command("fly", "--from-campaign", "c", "--run", run, "--no-recording") == 2
        (flown,), given = seen.args, seen.kwargs
        fields = p.varied(at.cell)
        assert (flown.policy.name, flown.duration_s) == (("worked", "best-2")[at.policy], 0.5)
        assert flown.fleet.formation.spacing_m == fields["fleet.formation.spacing_m"]
        assert flown.fleet.battery.initial_soc == fields["fleet.battery.initial_soc"]
        assert (given["seed"], given["replication"]) == (p.seed(at.cell), at.replication)


def test_compare(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = Seen()
    monkeypatch.setattr(sortie, "compare", seen)
    named = ("compare", "s.yaml", "--policies", "worked,best-2(received_budget=0.1),silence", "--set", "duration_s=2")
    labels = ["worked", "best-2(received_budget=0.1)", "silence"]
    assert command(*named, "--seed", "4", "--seeds", "3", "--own-fusion") == 2
    assert seen.args == ("s.yaml", labels, ["duration_s=2"])
    assert (seen.kwargs["seeds"], seen.kwargs["own_fusion"]) == (range(4, 7), True)
    command(*named)
    assert (seen.kwargs["seeds"], seen.kwargs["own_fusion"]) == (range(1, 2), False)
    command(
        *named, "--seed", "4", "--half-width", "0.02", "--metric", "ap50.mission", "--pilot", "6", "--most-seeds", "90", "--kept", "k.sqlite"
    )  # fmt: skip
    town = sortie.load("s.yaml").perception.scene.seed + 3
    assert seen.args == ("s.yaml", labels, ["duration_s=2", "seed=4", f"perception.scene.seed={town}"])
    names = ("half_width", "metric", "pilot", "most_seeds", "kept", "own_fusion")
    assert [seen.kwargs[k] for k in names] == [0.02, "ap50.mission", 6, 90, Path("k.sqlite"), False]
    command(*named, "--half-width", "0.02")
    assert [seen.kwargs[k] for k in names] == [0.02, None, None, None, True, False]


CAMPAIGN = "campaign: named\nbase: s.yaml\nvary: {duration_s: {kind: grid, values: [1, 2]}}\npolicies: [worked]\nmetrics: [frame_s]\n"


def test_campaign(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "c.yaml").write_text(CAMPAIGN)
    done = sortie.CampaignResult(here / "out", 20, 3, 6, 90.0)
    seen = Seen(done)
    monkeypatch.setattr(sortie, "campaign", seen)
    options = (
        "--workers",
        "5",
        "--worker-memory",
        "1.5",
        "--out",
        "out",
        "--resume",
        "--retry-failed",
        "--by-torch",
        "6",
    )
    assert command("campaign", "c.yaml", *options, "--no-report") == 1, "some failed"
    assert "20 runs finished, 3 failed; 6 of them now, 4.0 a minute" in capsys.readouterr().out
    assert seen.args == ("c.yaml",)
    given = {k: v for k, v in seen.kwargs.items() if k not in ("progress", "notice")}
    assert given == {
        "out": Path("out"), "workers": 5, "scheduler": None, "security": None, "worker_memory_gb": 1.5, "wait_for_workers_s": 300.0,
        "by_torch": 6, "resume": True, "retry_failed": True,
    }  # fmt: skip
    seen._answer = sortie.CampaignResult(here / "out", 20, 0, 0, 90.0)
    tls = ("--scheduler", "tcp://h:1", "--security", "ca.pem", "cert.pem", "key.pem", "--wait-for-workers", "7")
    assert command("campaign", "run", "c.yaml", *tls, "--retry-failed", "--no-report") == 0
    assert "20 runs finished, none of them now" in capsys.readouterr().out
    given = {k: v for k, v in seen.kwargs.items() if k not in ("progress", "notice")}
    assert given == {
        "out": Path("runs/campaign-named"), "workers": None, "scheduler": "tcp://h:1",
        "security": (Path("ca.pem"), Path("cert.pem"), Path("key.pem")), "worker_memory_gb": None, "wait_for_workers_s": 7.0,
        "by_torch": None, "resume": False, "retry_failed": True,
    }  # fmt: skip


def test_worst(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [
        {"run": 8, "policy": "a", "x": 20.123456, "m": 0.5},
        {"run": 3, "policy": "b", "x": "words", "m": 1234567.0},
    ]
    found, flown = Seen(Worst("m", True, ["x"], rows)), Seen(SimpleNamespace())
    monkeypatch.setattr("sortie.sim.campaign.worst.worst", found)
    monkeypatch.setattr("sortie.sim.cli.worst.fly_again", flown)
    assert command("campaign", "worst", "c", "m", "--count", "4", "--policy", "b", "--least", "--fly", "1") == 0
    assert (found.args, found.kwargs) == ((Path("c"), "m", 4, "b"), {"more_is_worse": False})
    assert flown.calls == 1
    assert flown.kwargs == {"campaign": Path("c"), "run": 8, "out_dir": Path("c/worst/run-8")}
    told = capsys.readouterr().out
    cells = [[cell.strip() for cell in line.strip("│┃").replace("┃", "│").split("│")] for line in told.splitlines()]
    assert ["run", "policy", "x", "m"] in cells
    assert ["8", "a", "20.12", "0.5"] in cells
    assert ["3", "b", "words", "1.235e+06"] in cells
    assert "the most first" in told
    assert "--from-campaign c --run 8 --view" in told
    command("campaign", "worst", "c", "m")
    assert (found.args, found.kwargs) == ((Path("c"), "m", 10, None), {"more_is_worse": None})
    command("campaign", "worst", "c", "m", "--fly", "20")
    assert found.args == (Path("c"), "m", 20, None), "all that fly are shown"


def test_rank(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = Seen()
    monkeypatch.setattr(sortie, "rank", seen)
    options = (
        "--suite",
        "x.yaml",
        "--against",
        "worked,silence",
        "--again",
        "--by-torch",
        "--further",
        "2",
        "--workers",
        "3",
        "--out",
        "o",
    )
    assert command("rank", "boxes,best-2(received_budget=0.1)", *options) == 2
    assert seen.args == (["boxes", "best-2(received_budget=0.1)"],)
    given = {k: v for k, v in seen.kwargs.items() if k != "progress"}
    assert given == {
        "suite": "x.yaml", "against": ["worked", "silence"], "again": True, "by_torch": True, "further": 2, "workers": 3, "folder": Path("o"),
    }  # fmt: skip
    command("rank", "boxes")
    given = {k: v for k, v in seen.kwargs.items() if k != "progress"}
    assert given == {
        "suite": "ranking_v1", "against": None, "again": False, "by_torch": False, "further": None, "workers": 1, "folder": Path("runs/rank"),
    }  # fmt: skip


def test_replay(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sortie, "open_run", lambda path: ("run of", path))
    seen = Seen()
    monkeypatch.setattr(sortie, "replay", seen)
    assert command("replay", "r", "--policy", "boxes", "--disagreement") == 2
    assert (seen.args, seen.kwargs) == ((("run of", Path("r")), "boxes"), {"disagreement": True})
    command("replay", "r")
    assert (seen.args, seen.kwargs) == ((("run of", Path("r")), None), {"disagreement": False})
    for same, strict, code in ((True, True, 0), (False, True, 1), (False, False, 0)):
        seen._answer = SimpleNamespace(same=same, differences=[1], summary=lambda: "told", save=lambda path: path)
        assert command("replay", "r", *(["--expect-same"] if strict else [])) == code


def test_live(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = Seen()
    monkeypatch.setattr("sortie.sim.live.session.fly_live", seen)
    monkeypatch.delenv("SORTIE_KEY", raising=False)
    monkeypatch.setenv("ROS_DOMAIN_ID", "17")
    options = (
        "--policy", "boxes", "--begin", "1.5", "--duration", "2.5", "--loss", "0.25", "--kill", "2@3.5", "--start", "1@3.75", "--domain", "9",
        "--key", "key", "--fallback", "tracks@3", "--decide-within", "0.05", "--mavlink", "udpin:127.0.0.1:1", "--mavlink", "udpin:127.0.0.1:2",
        "--origin", "47,8,400", "--mavlink-key", "key", "--set", "fleet.drones=4",
    )  # fmt: skip
    assert command("live", "s.yaml", *options) == 2
    (flown,), given = seen.args, seen.kwargs
    assert (flown.policy.name, flown.fleet.drones) == ("boxes", 4)
    names = (
        "begin_s",
        "duration_s",
        "loss",
        "kill",
        "start",
        "domain",
        "key",
        "decide_within_s",
        "origin",
        "mavlink_key",
    )
    assert [given[k] for k in names] == [
        1.5, 2.5, 0.25, (2, 3.5), (1, 3.75), 9, bytes(range(32)), 0.05, Origin(47.0, 8.0, 400.0), bytes(range(32)),
    ]  # fmt: skip
    assert list(given["mavlink"]) == ["udpin:127.0.0.1:1", "udpin:127.0.0.1:2"]
    assert (given["fallback"].representation.name.lower(), given["fallback"].rate_hz) == ("tracks", 3.0)
    command("live", "s.yaml", "--set", "fleet.origin={latitude_deg: 1, longitude_deg: 2, altitude_m: 3}")
    assert [seen.kwargs[k] for k in names if k != "key"] == [
        0.0, None, 0.0, None, None, 17, None, Origin(1.0, 2.0, 3.0), None,
    ]  # fmt: skip
    assert list(seen.kwargs["mavlink"]) == []


def test_export(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    record = object()
    monkeypatch.setattr(run_folder, "load", lambda path: (record, path))
    bag, tlog, pcap = Seen({"/a": 3, "/b": 4}), Seen(12), Seen({"context": 5, "features": 6})
    monkeypatch.setattr("sortie.sim.export.bag.write_bag", bag)
    monkeypatch.setattr("sortie.sim.export.telemetry.save_tlog", tlog)
    monkeypatch.setattr("sortie.sim.export.pcap.write_pcap", pcap)
    us, own = 1_795_248_000_500_000, (record, Path("r"))
    begin = ("--begin", "2026-11-21T08:00:00.5")
    assert command("export", "r", "--mcap", *begin, "--origin", "47,8,400", "--out", "new/b") == 0
    assert bag.args == (own, Path("new/b"), us * 1000, Origin(47.0, 8.0, 400.0))
    assert "7 messages on 2 topics" in capsys.readouterr().out
    assert command("export", "r", "--tlog", *begin, "--origin", "47,8", "--key", "key", "--drone", "2") == 0
    assert tlog.args == (own, Path("r/sortie.tlog"), us, Origin(47.0, 8.0), bytes(range(32)), 2)
    assert "12 MAVLink frames" in capsys.readouterr().out
    assert command("export", "r", "--pcap", *begin, "--out", "p") == 0
    assert pcap.args == (own, Path("p"), us * 1000)
    assert "11 packets (5 context, 6 features)" in capsys.readouterr().out
    assert command("export", "r", "--tlog") == 0
    assert tlog.args == (own, Path("r/sortie.tlog"), 1_767_225_600_000_000, None, None, None)
    for wrong in (
        ("--mcap", "--drone", "1"),
        ("--pcap", "--origin", "1,2"),
        ("--mcap", "--key", "key"),
        ("--mcap", "--tlog"),
    ):
        assert command("export", "r", *wrong) == 2


def test_check(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (here / "t.yaml").write_text(BASE.replace("name: example", "name: other"))
    calls: list[tuple[Any, ...]] = []

    def check(name: Any, overrides: Any, *, update: bool, progress: Any) -> Any:
        calls.append((Path(name).name, overrides, update))
        failed = ["a", "b"] if Path(name).name == "t.yaml" else []
        return (SimpleNamespace(failed=failed, verdicts=[], written="", replay=lambda verdict: f"see {verdict}"),)

    monkeypatch.setattr(sortie, "check", check)
    assert command("check", "s.yaml", "--set", "duration_s=2", "--update") == 0
    assert calls == [("s.yaml", ["duration_s=2"], True)]
    assert command("check", "s.yaml", "t.yaml") == 1
    assert calls[1:] == [("s.yaml", [], False), ("t.yaml", [], False)]


def test_what_watches_a_flight_gets_its_options_and_every_second(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A viewer and an endpoint together: both hear all of it, and both are closed, also after an error."""
    heard: list[tuple[Any, ...]] = []

    class Watcher:
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            self.name = args[0] if args else "viewer"
            heard.append(("made", self.name, args, kwargs))

        def begin(self, *told: Any) -> None:
            heard.append(("begin", self.name, *told))

        def second(self, *told: Any) -> None:
            heard.append(("second", self.name, *told))

        def close(self) -> None:
            heard.append(("close", self.name))

    monkeypatch.setattr("sortie.sim.playback.viewer.LiveViewer", Watcher)
    monkeypatch.setattr("sortie.sim.export.telemetry.MavlinkEndpoint", Watcher)
    for pace, wanted in ((2.5, 2.5), (0.0, None)):
        heard.clear()
        with fly._watching(True, "udpout:a:1", pace, here / "key") as watchers:
            assert watchers
            watchers.begin("scenario", "scene")  # type: ignore[arg-type]
            watchers.second(1.0, {})
        both = ("viewer", "udpout:a:1")
        assert heard == [
            ("made", "viewer", (), {}), ("made", "udpout:a:1", ("udpout:a:1", wanted), {"key": bytes(range(32))}),
            *(("begin", name, "scenario", "scene") for name in both), *(("second", name, 1.0, {}) for name in both),
            *(("close", name) for name in both),
        ]  # fmt: skip
    assert not fly._watching(False, None, 1.0, None)
