"""`sortie verify`, as a user meets it: verdicts, exit codes, and counterexamples that can be flown again."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest
from cli_examples import command

from sortie.policies.contract import TaskPhase
from sortie.policies.registry import resolve
from sortie.policies.verification.kit.conformance import RULES
from sortie.policies.verification.kit.views import draw_views, from_json, to_json
from sortie.policies.verification.proof.proof import prove
from sortie.sim.check.counterexample import raised_ages, replay_scenario, shows_in_flight, slug
from sortie.sim.cli import console

FAULTY = '''
from sortie.policies.contract import Directive, Representation

INVARIANTS = """
when target_in_region and peers >= 1: any_link(representation >= detections)
"""

def decide(view, *, quiet_below=0.4000001):
    me = view.me
    tired = me is not None and 0.4 < me.battery_soc < quiet_below
    rung = Representation.NONE if tired else Representation.DETECTIONS
    return [Directive(view.ego, p, rung, 0.0, None, 5.0, reason="planted") for p in view.peers]

def too_fast(view):
    return [Directive(view.ego, p, Representation.DETECTIONS, 0.0, None, 31.0, reason="planted") for p in view.peers]

def eager(view):
    rate_hz = {p: 9.0 if view.age_s[p] > 0.55 else 5.0 for p in view.peers}
    return [Directive(view.ego, p, Representation.DETECTIONS, 0.0, None, rate_hz[p], reason="x") for p in view.peers]

def forgetful(view):
    return decide(view)[:1]
'''
QUICK = ("--views", 10, "--drones", 2)


@pytest.fixture(autouse=True)
def _few_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command tries a policy on a thousand drawn views; most of these tests ask what it makes of the verdicts."""
    monkeypatch.setattr("sortie.sim.cli.verify.prove", functools.partial(prove, views=50))


@pytest.fixture
def faulty(tmp_path: Path) -> Path:
    path = tmp_path / "faulty.py"
    path.write_text(FAULTY)
    return path


def test_counterexamples_replace_counterexamples_and_nothing_else(
    faulty: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    for _ in range(2):
        assert command("verify", f"{faulty}:decide", *QUICK, "--out", out) == 1
    (folder,) = out.iterdir()
    before = sorted(p.name for p in folder.iterdir())
    assert {p.suffix for p in folder.iterdir()} == {".json", ".yaml"}
    (folder / "notes.txt").write_text("keep")
    capsys.readouterr()
    assert command("verify", f"{faulty}:decide", *QUICK, "--out", out) == 2
    said = f"error: {folder}: holds notes.txt, which is no counterexample; name another --out or move it\n"
    assert capsys.readouterr().err == said
    assert sorted(p.name for p in folder.iterdir()) == sorted([*before, "notes.txt"])
    mine = tmp_path / "worked" / "mine.json"
    mine.parent.mkdir()
    mine.write_text("[]")
    assert command("verify", "worked", *QUICK, "--out", tmp_path) == 2  # its folder would be tmp_path/worked
    assert mine.read_text() == "[]"


def test_the_worked_policy_passes_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()  # on all views
    assert command("verify", "worked(rho=0.25)", *QUICK, "--out", tmp_path) == 0
    printed = capsys.readouterr().out
    assert "when battery < 0.6: rate_hz <= 5" in printed
    assert printed.count("proved") == 10
    assert list(tmp_path.iterdir()) == []


def test_a_planted_fault_gives_a_counterexample_that_fails_until_it_is_mended(
    faulty: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert command("verify", f"{faulty}:decide", *QUICK, "--out", out) == 1
    assert "refuted" in capsys.readouterr().out
    (kept,) = out.rglob("*.json")
    view = from_json(kept.read_text())
    me = view.descriptors[view.ego]
    assert 0.4 < me.battery_soc < 0.4000001, "a sliver of charge in which no drawn view lies"
    assert me.region is not None
    scenario = kept.with_suffix(".yaml")
    assert command("check", scenario) == 1
    assert "invariant_violations" in capsys.readouterr().out
    faulty.write_text(FAULTY.replace("quiet_below=0.4000001", "quiet_below=0.0"))
    assert command("check", scenario) == 0


def test_invariants_may_come_from_a_file(faulty: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is UTF-8 text; a byte order mark is no part of line 1."""
    rules, out = tmp_path / "rules.txt", tmp_path / "out"
    for policy, content, code, words in (
        (f"{faulty}:decide", b"rate_hz <= 4  # slower than it is\n", 1, "rate_hz <= 4"),
        ("worked", b"rate_hz <=\n", 2, "line 1, 'rate_hz <=': 'rate_hz <=' is not an expression"),
        ("worked", b"rate_hz <= 5 # \xff\n", 2, f"error: {rules}: byte 0xff is not UTF-8 text\n"),
        ("worked", b"\xef\xbb\xbfrate_hz <= 5\nrate_hz <=\n", 2, "line 2, 'rate_hz <='"),
    ):
        rules.write_bytes(content)
        assert command("verify", policy, *QUICK, "--invariants", rules, "--out", out) == code
        printed = capsys.readouterr()
        assert words in printed.out + printed.err


def test_a_line_that_no_shield_keeps_is_refused_before_anything_is_tried(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rules, scenario = tmp_path / "rules.txt", tmp_path / "shielded.yaml"
    scenario.write_text("name: shielded\npolicy: {shield: true, invariants: 'rate_hz <= 10'}\n")
    for line in ("climbs_in(dwell) <= 1", "within 1 s: count_links(representation >= detections) <= 1"):
        rules.write_text(line)
        files = ("--invariants", rules, "--scenario", scenario, "--out", tmp_path / "out")
        assert command("verify", "worked", *files) == 2
        told = f"policy.shield of shielded is true, must be false for {line!r}: no shield can keep such a line"
        assert capsys.readouterr() == ("", f"error: {told}\n")


def test_what_breaks_the_plane_shows_in_flight(faulty: Path) -> None:
    for name, rule in (("too_fast", "bounds kept"), ("eager", "age-monotone"), ("forgetful", "one directive per link")):
        reference = f"{faulty}:{name}"
        policy = resolve(reference)
        view = next(v for v in draw_views(2, 200) if len(v.peers) == 3 and RULES[rule].complaint(policy, v) is not None)
        raised = raised_ages(policy, view) if name == "eager" else None
        assert shows_in_flight(replay_scenario(rule, "", reference, {}, view, raised_age_s=raised))
        assert not shows_in_flight(replay_scenario(rule, "", "worked", {}, view, raised_age_s=raised))


BROKEN = """
from sortie.policies.contract import Directive, Representation

INVARIANTS = "rate_hz <= 20"

def share(view, **fields):
    rung = Representation.DETECTIONS
    return [Directive(view.ego, p, rung, rate_hz=5.0, reason="shares")._replace(**fields) for p in view.peers]

def raises(view):
    if view.me is not None and view.me.battery_soc < 0.5:
        raise RuntimeError("[/red] tired")
    return share(view)

def lacks(view, *, must):
    return share(view)

def text(view):
    return "hello"

def texts_when_old(view):
    return [d._replace(rate_hz="10" if view.age_s[d.destination] > 2.0 else 5.0) for d in share(view)]

def leaves(view):
    raise SystemExit(0)
"""


NO_DIRECTIVES = {
    "raises": "raises RuntimeError: [/red] tired",
    "lacks": "missing 1 required keyword-only argument: 'must'",
    "text": "a policy returns a list or a tuple of directives, got str",
    "texts_when_old": "rate_hz is '10', must be in [0, 30], a number",
    "leaves": "raises ProgramExitError: exit code 0, must return",
}


def test_a_policy_that_gives_no_directives_is_a_broken_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console.out, "_width", 1000)
    path, wrong = tmp_path / "broken.py", {}
    path.write_text(BROKEN)
    for name, told in NO_DIRECTIVES.items():
        out = ("--out", tmp_path / "out" / name)
        code, printed = command("verify", f"{path}:{name}", "--views", 20, "--drones", 2, *out), capsys.readouterr()
        if code != 1 or told not in printed.out + printed.err:
            wrong[name] = printed.out + printed.err
    assert wrong == {}


def test_any_view_becomes_a_scenario() -> None:
    for phase in TaskPhase:
        view = next(v for v in draw_views(9, 400) if v.me is not None and v.me.task_phase == phase)
        scenario = replay_scenario("a rule: with signs ≤", "how " * 900, "worked", {"rho": 0.1}, view)
        assert scenario.name == "a_rule_with_signs"
        assert scenario.policy.replays[0].view == to_json(view)


def test_slugs_are_names() -> None:
    assert slug("mine/x.py:decide(rho=0.1)") == "mine_x_py_decide_rho_0_1"
    assert slug("≤") == "rule"
    long = "a/folder/with/quite/a/long/name/of/a/project/that/has/policies.py"
    assert slug(f"{long}:first") != slug(f"{long}:second")
    assert max(len(slug(f"{long}:{name}")) for name in ("first", "second")) <= 60


EVERYONE = "from sortie.policies.catalogue.baselines import everyone\n"
WRAPPED = "decide = functools.wraps(everyone)(lambda view: everyone(view))\n"
CALLED = "class Policy:\n    def __call__(self, view):\n        return everyone(view)\ndecide = Policy()\n"
ALIASES = {
    "alias": f"{EVERYONE}decide = everyone\n",
    "wrapper": f"import functools\n{EVERYONE}{WRAPPED}",
    "object": f"{EVERYONE}{CALLED}",
}


def test_the_files_invariants_hold_however_the_policy_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those that are no text are refused."""
    for invariants, kind, code, words in (
        ("'rate_hz <= 5'", "alias", 1, "rate_hz <= 5"),
        ("'rate_hz <= 5'", "wrapper", 1, "rate_hz <= 5"),
        ("'rate_hz <= 5'", "object", 1, "rate_hz <= 5"),
        ("['rate_hz <= 5']", "alias", 2, ":decide: INVARIANTS is of type list, must be text\n"),
        ("None", "alias", 2, ":decide: INVARIANTS is of type NoneType, must be text\n"),
    ):
        path = tmp_path / f"{kind}{code}.py"
        path.write_text(f"INVARIANTS = {invariants}\n{ALIASES[kind]}")
        assert command("verify", f"{path}:decide", *QUICK, "--out", tmp_path / "out") == code
        printed = capsys.readouterr()
        assert words in printed.out + printed.err


def test_a_line_about_time_gets_a_scenario_that_flies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rules, out = tmp_path / "rules.txt", tmp_path / "out"
    rules.write_text("when peers >= 1: within 0.5 s: any_link(representation >= detections)\nclimbs_in(dwell) <= 1\n")
    told = ("verify", "silence", *QUICK, "--invariants", rules, "--courses", 20, "--out", out)
    assert command(*told) == 1
    printed = capsys.readouterr().out
    assert "over time, as the gates enforce it" in printed
    assert printed.count("proved") == 3, "the plane's two properties and the count of climbs"
    (scenario,) = out.rglob("*.yaml")
    assert "read_by: drone" in scenario.read_text()
    assert command("check", scenario) == 1
    assert "violation" in capsys.readouterr().out
    assert command(*told) == 1, "its own counterexamples are replaced"
