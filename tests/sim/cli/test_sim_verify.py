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
from sortie.policies.verification.subject import own_invariants
from sortie.sim.check import over_time
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


def test_a_parameter_is_part_of_what_is_verified(faulty: Path, tmp_path: Path) -> None:
    assert command("verify", f"{faulty}:decide(quiet_below=0.1)", *QUICK, "--out", tmp_path / "out") == 0


def test_invariants_may_come_from_a_file(faulty: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rules = tmp_path / "rules.txt"
    rules.write_text("rate_hz <= 4  # slower than it is\n")
    assert command("verify", f"{faulty}:decide", *QUICK, "--invariants", rules, "--out", tmp_path / "out") == 1
    assert "rate_hz <= 4" in capsys.readouterr().out
    rules.write_text("rate_hz <=\n")
    assert command("verify", "worked", *QUICK, "--invariants", rules) == 2
    assert "line 1, 'rate_hz <=': 'rate_hz <=' is not an expression" in capsys.readouterr().err


def test_a_file_of_invariants_is_utf8_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rules = tmp_path / "rules.txt"
    rules.write_bytes(b"rate_hz <= 5 # \xff\n")
    assert command("verify", "worked", *QUICK, "--invariants", rules, "--out", tmp_path / "out") == 2
    assert capsys.readouterr().err == f"error: {rules}: byte 0xff is not UTF-8 text\n"
    rules.write_text("rate_hz <= 5\nrate_hz <=\n", "utf-8-sig")
    assert command("verify", "worked", *QUICK, "--invariants", rules, "--out", tmp_path / "out") == 2
    assert "line 2, 'rate_hz <='" in capsys.readouterr().err, "a byte order mark is no part of line 1"


@pytest.mark.parametrize(
    "line", ["climbs_in(dwell) <= 1", "within 1 s: count_links(representation >= detections) <= 1"]
)
def test_a_line_that_no_shield_keeps_is_refused_before_anything_is_tried(
    line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rules, scenario = tmp_path / "rules.txt", tmp_path / "shielded.yaml"
    rules.write_text(line)
    scenario.write_text("name: shielded\npolicy: {shield: true, invariants: 'rate_hz <= 10'}\n")
    assert command("verify", "worked", "--invariants", rules, "--scenario", scenario, "--out", tmp_path / "out") == 2
    told = f"policy.shield of shielded is true, must be false for {line!r}: no shield can keep such a line"
    assert capsys.readouterr() == ("", f"error: {told}\n")


@pytest.mark.parametrize("name", ["too_fast", "eager", "forgetful"])
def test_what_breaks_the_plane_shows_in_flight(name: str, faulty: Path) -> None:
    reference = f"{faulty}:{name}"
    policy = resolve(reference)
    rule = {"too_fast": "bounds kept", "eager": "age-monotone", "forgetful": "one directive per link"}[name]
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

def tired(view):
    return view.me is not None and view.me.battery_soc < 0.5

def raises(view):
    if tired(view):
        raise RuntimeError("[/red] tired")
    return share(view)

def raises_when_old(view):
    if any(view.age_s[p] > 2.0 for p in view.peers):
        raise RuntimeError("too old")
    return share(view)

def nothing(view):
    return None

def lacks(view, *, must):
    return share(view)

def text(view):
    return "hello" if tired(view) else share(view)

def texts(view):
    return share(view, rate_hz="10" if tired(view) else 5.0)

def texts_when_old(view):
    return [d._replace(rate_hz="10" if view.age_s[d.destination] > 2.0 else 5.0) for d in share(view)]

def rung(view):
    return share(view, representation="features")

def leaves(view):
    raise SystemExit(0)
"""


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("raises", "raises RuntimeError: [/red] tired"),
        ("raises_when_old", "raises RuntimeError: too old"),
        ("nothing", "returns NoneType, must be a list or a tuple of directives"),
        ("lacks", "missing 1 required keyword-only argument: 'must'"),
        ("text", "a policy returns a list or a tuple of directives, got str"),
        ("texts", "rate_hz is '10', must be in [0, 30], a number"),
        ("texts_when_old", "rate_hz is '10', must be in [0, 30], a number"),
        ("rung", "representation is 'features', must be a Representation, such as sortie.Representation.DETECTIONS"),
        ("leaves", "raises ProgramExitError: exit code 0, must return"),
    ],
)
def test_a_policy_that_gives_no_directives_is_a_broken_one(
    name: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console.out, "_width", 1000)
    path = tmp_path / "broken.py"
    path.write_text(BROKEN)
    assert command("verify", f"{path}:{name}", "--views", 20, "--drones", 2, "--out", tmp_path / "out") == 1
    printed = capsys.readouterr()
    assert told in printed.out + printed.err


def test_the_ages_at_which_a_policy_raises_are_shown_in_flight(tmp_path: Path) -> None:
    path = tmp_path / "broken.py"
    path.write_text(BROKEN)
    policy = resolve(f"{path}:raises_when_old")
    view = next(v for v in draw_views(2, 200) if len(v.peers) == 3 and max(v.age_s.values()) < 1.0)
    raised = raised_ages(policy, view)
    assert raised is not None
    with pytest.raises(RuntimeError, match="too old"):
        policy(view._replace(age_s=raised))
    assert raised_ages(policy, view._replace(age_s=raised)) is None, "it raises on the view itself"
    assert shows_in_flight(replay_scenario("ages", "", f"{path}:raises_when_old", {}, view, raised_age_s=raised))


def test_an_unknown_policy_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert command("verify", "loud") == 2
    assert "unknown policy 'loud'" in capsys.readouterr().err


@pytest.mark.parametrize("phase", TaskPhase)
def test_any_view_becomes_a_scenario(phase: TaskPhase) -> None:
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


ALIASES = {
    "alias": "from sortie.policies.catalogue.baselines import everyone\ndecide = everyone\n",
    "wrapper": "import functools\nfrom sortie.policies.catalogue.baselines import everyone\ndecide = functools.wraps(everyone)(lambda view: everyone(view))\n",
    "object": "from sortie.policies.catalogue.baselines import everyone\nclass Policy:\n    def __call__(self, view):\n        return everyone(view)\ndecide = Policy()\n",
}


@pytest.mark.parametrize("kind", ALIASES)
def test_the_files_invariants_hold_however_the_policy_is_made(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "policy.py"
    path.write_text(f"INVARIANTS = 'rate_hz <= 5'\n{ALIASES[kind]}")
    assert command("verify", f"{path}:decide", *QUICK, "--out", tmp_path / "out") == 1
    assert "rate_hz <= 5" in capsys.readouterr().out


def test_invariants_that_are_no_text_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "policy.py"
    path.write_text(f"INVARIANTS = ['rate_hz <= 5']\n{ALIASES['alias']}")
    assert command("verify", f"{path}:decide", *QUICK, "--out", tmp_path / "out") == 2
    assert capsys.readouterr().err == f"error: {path}:decide: INVARIANTS is of type list, must be text\n"


def test_invariants_that_are_none_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "policy.py"
    path.write_text(f"INVARIANTS = None\n{ALIASES['alias']}")
    assert command("verify", f"{path}:decide", *QUICK, "--out", tmp_path / "out") == 2
    assert capsys.readouterr().err == f"error: {path}:decide: INVARIANTS is of type NoneType, must be text\n"


@pytest.mark.parametrize("kind", ["guarded", "resolved"])
def test_the_named_files_invariants_are_read_where_its_policy_is_already_guarded(kind: str, tmp_path: Path) -> None:
    other, path = tmp_path / "other.py", tmp_path / "policy.py"
    other.write_text("def decide(view):\n    return []\n")
    made = {
        "guarded": "from sortie.scenarios.plugins.user_calls import guarded\n@guarded\ndef decide(view):\n    return []\n",
        "resolved": f"from sortie.policies.registry import resolve\ndecide = resolve({f'{other}:decide'!r})\n",
    }
    path.write_text(f"INVARIANTS = 'rate_hz <= 5'\n{made[kind]}")
    assert own_invariants(resolve(f"{path}:decide")) == "rate_hz <= 5"


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


FLOWN = """
name: dropping
duration_s: 3
fleet: {drones: 2, formation: {shape: line, spacing_m: 25}}
perception: {detector: none}
policy: {name: silence, dwell_s: 0.2}
events: [{kind: link_drop, at_s: 1, until_s: 2.5, drone: 1, loss_db: 120}]
"""


def test_a_scenario_is_flown_for_a_line_about_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Courses are left out, which find the break as well."""
    monkeypatch.setattr(over_time, "_search", lambda *what: None)
    monkeypatch.setattr(console.out, "_width", 1000)
    (tmp_path / "dropping.yaml").write_text(FLOWN)
    rules, out = tmp_path / "rules.txt", tmp_path / "out"
    rules.write_text("within 0.3 s: age_s < 0.9\n")
    told = ("--invariants", rules, "--courses", 1, "--scenario", tmp_path / "dropping.yaml", "--flights", 1)
    assert command("verify", "silence", *QUICK, *told, "--out", out) == 1
    assert "s of a flight of dropping: " in capsys.readouterr().out
    (scenario,) = out.rglob("*.yaml")
    assert command("check", scenario) == 1
