"""Policies that change in flight, a shield over them, and the audit that says who decided what."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sim_examples import example

from sortie.policies.contract import PolicyError
from sortie.scenarios.reading.load import ScenarioError
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.policy_text import policy_overrides
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

SLOW = "rate_hz <= 5"


@pytest.fixture(scope="module")
def base() -> SortieRecord:
    return run_sortie(example())


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The worked policy of the example under another name."""
    path = tmp_path_factory.mktemp("policies") / "twin.py"
    path.write_text(
        "from sortie.policies.catalogue.worked import worked\n\ndef decide(view):\n    return worked(view, rho=0.25)\n"
    )
    return f"{path}:decide"


def rows(record: SortieRecord, table: str, **where: object) -> list[dict[str, object]]:
    return [r for r in record.tables[table].to_pylist() if all(r[k] == v for k, v in where.items())]


def links(record: SortieRecord) -> dict[tuple[int, int], np.ndarray]:
    """Which captures each link sent, in order of sending."""
    found: dict[tuple[int, int], list[float]] = {}
    for r in record.tables["transmissions"].to_pylist():
        if r["representation"] != "handshake":
            found.setdefault((r["drone"], r["peer"]), []).append(r["captured_s"])
    return {link: np.array(captured_s) for link, captured_s in found.items()}


# --- the change ----------------------------------------------------------------------------------


@pytest.mark.parametrize("at_s", [2.0, 2.004, 2.033])
def test_a_change_to_the_same_decisions_changes_no_payload(base: SortieRecord, twin: str, at_s: float) -> None:
    """On a frame's edge, between two drones' decisions, and between a decision and its payload: nothing moves."""
    changed = run_sortie(example(f"policy.changes=[{{at_s: {at_s}, name: '{twin}'}}]"))
    assert (
        changed.tables["transmissions"]
        .drop_columns(["snr_db"])
        .equals(base.tables["transmissions"].drop_columns(["snr_db"]))
    )
    assert outcome(changed)["policies"]["changes"] == 5


def test_no_frame_is_lost_or_sent_twice_at_a_change() -> None:
    to_two = "policy.changes=[{at_s: 3.05, name: best-2, params: {received_budget: 0.02}}]"
    searching = "mission.phases=[{at_s: 0, phase: search}]"
    record = run_sortie(example("policy.name=all-4", "policy.params={received_budget: 0.02}", to_two, searching))
    after = {(r["drone"], r["peer"]) for r in rows(record, "transmissions") if r["captured_s"] > 4.0}
    assert 0 < len(after) < 20
    for link, captured_s in links(record).items():
        frames = np.round(captured_s * 10).astype(int)
        assert len(set(frames)) == len(frames), "a frame sent twice"
        last = 59 if link in after else 30
        assert list(frames) == list(range(frames[0], last + 1)), f"a frame of {link} was lost"


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("phase: track, name: boxes", "at_s: 3, name: silence"),
        ("at_s: 3, name: boxes", "phase: track, name: silence"),
        ("command: go, name: boxes", "at_s: 3, name: silence"),
        ("at_s: 3, name: boxes", "command: go, name: silence"),
        ("phase: track, name: boxes", "command: go, name: silence"),
    ],
)
def test_of_two_changes_at_once_the_later_in_the_list_stays(first: str, second: str) -> None:
    """The example's phase changes at 3 s, too."""
    both = f"policy.changes=[{{{first}}}, {{{second}}}]"
    go = ["policy.commands=[{at_s: 3, command: go}]"] if "go" in both else []
    record = run_sortie(example(both, *go))
    decided = {row["policy"] for row in rows(record, "directives") if row["t_s"] > 3.5}
    assert decided <= {"silence"}
    assert "silence" in outcome(record)["policies"]["decisions"]
    by_hand = run_sortie(example("policy.changes=[{at_s: 3, name: silence}]"))
    assert outcome(record)["policies"]["decisions"]["silence"] == outcome(by_hand)["policies"]["decisions"]["silence"]


def test_a_change_by_phase_is_each_drones_own_and_in_the_audit() -> None:
    record = run_sortie(example("policy.changes=[{phase: track, name: best-2, params: {received_budget: 0.1}}]"))
    told = rows(record, "events", kind="policy")
    assert [r["drone"] for r in sorted(told, key=lambda r: r["drone"])] == [0, 1, 2, 3, 4]
    assert {r["text"] for r in told} == {"worked(rho=0.25) → best-2(received_budget=0.1): phase track"}
    at_s = {r["drone"]: r["t_s"] for r in told}
    assert all(3.0 <= t_s < 3.02 for t_s in at_s.values()), "at the drone's own first decision of the phase"
    for r in record.tables["directives"].to_pylist():
        assert r["policy"] == ("best-2(received_budget=0.1)" if r["t_s"] >= at_s[r["drone"]] else "worked(rho=0.25)")
    decisions = outcome(record)["policies"]["decisions"]
    assert decisions == {"worked(rho=0.25)": 5 * 30, "best-2(received_budget=0.1)": 5 * 30}


def test_a_command_reaches_whom_it_names() -> None:
    record = run_sortie(
        example(
            "policy.changes=[{command: quiet, name: silence}]",
            "policy.commands=[{at_s: 2, command: quiet, drones: [1, 2]}]",
        )
    )
    assert [(r["t_s"], r["drone"]) for r in rows(record, "events", kind="policy")] == [(2.0, 1), (2.0, 2)]
    late = {r["drone"] for r in rows(record, "transmissions") if r["captured_s"] > 2.5}
    assert late == {0, 3, 4}


def test_a_method_takes_its_handshakes_along() -> None:
    record = run_sortie(
        example("policy.name=when2com-style", "policy.params={}", "policy.changes=[{at_s: 3, name: silence}]")
    )
    asked = [r["t_sent_s"] for r in rows(record, "transmissions", representation="handshake")]
    assert min(asked) < 1
    assert 2.8 < max(asked) < 3.0


def test_a_policy_named_at_take_off_flies_to_the_end() -> None:
    changing = example("policy.changes=[{at_s: 1, name: silence}]")
    assert outcome(run_sortie(changing, "best-2"))["policies"]["changes"] == 0
    assert (
        example("policy.changes=[{at_s: 1, name: silence}]", *policy_overrides("best-2", "worked")).policy.changes == ()
    )


def test_the_worse_for_wear_is_refused_before_the_flight() -> None:
    with pytest.raises(PolicyError, match="unknown policy 'loud'"):
        run_sortie(example("policy.changes=[{at_s: 5, name: loud}]"))
    with pytest.raises(ScenarioError, match=r"policy\.commands\.0\.command: 'x', must be one that a change waits for"):
        example("policy.commands=[{at_s: 5, command: x}]")
    with pytest.raises(ScenarioError, match="at_s and phase, must be one of at_s, phase and command"):
        example("policy.changes=[{at_s: 5, phase: track, name: silence}]")


# --- the shield ----------------------------------------------------------------------------------


def test_a_shielded_sortie_keeps_its_invariants_and_counts_each_intervention() -> None:
    bare = run_sortie(example(f"policy.invariants={SLOW}"))
    shielded = run_sortie(example(f"policy.invariants={SLOW}", "policy.shield=true"))
    counted = outcome(bare)["policies"]
    assert counted["invariant_violations"] == bare.tables["violations"].num_rows >= 5
    assert counted["violated_ticks"] > 100
    assert counted["shield_interventions"] == 0
    kept = outcome(shielded)["policies"]
    assert kept["invariant_violations"] == 0
    assert kept["shield_interventions"] == shielded.tables["interventions"].num_rows > 100
    assert max(r["rate_hz"] for r in rows(bare, "directives")) == 10
    assert max(r["rate_hz"] for r in rows(shielded, "directives")) == 5
    first = rows(shielded, "interventions")[0]
    assert first["policy"] == "worked(rho=0.25)"
    assert str(first["text"]).startswith("rate_hz <= 5 (decided ")
    at_the_gate = [r["reason"] for r in rows(shielded, "directives") if str(r["reason"]).startswith("shield: ")]
    assert at_the_gate, "the gate's row says that the shield decided it"


def test_counting_changes_nothing_but_the_count(base: SortieRecord) -> None:
    counted = run_sortie(example(f"policy.invariants={SLOW}"))
    assert (
        counted.tables["transmissions"]
        .drop_columns(["snr_db"])
        .equals(base.tables["transmissions"].drop_columns(["snr_db"]))
    )


@pytest.mark.parametrize(
    ("invariant", "message"),
    [
        ("rate_hz <=", r"policy\.invariants: line 1, 'rate_hz <=': 'rate_hz <=' is not an expression"),
        ("sum_links(rate_hz) <= 5", r"policy\.invariants: .* a shield cannot keep sum_links"),
    ],
)
def test_a_shield_that_cannot_be_is_refused_before_the_flight(invariant: str, message: str) -> None:
    with pytest.raises(PolicyError, match=message):
        run_sortie(example(f"policy.invariants='{invariant}'", "policy.shield=true"))


# --- a user's policy -----------------------------------------------------------------------------

BROKEN = {
    "greedy": ("[Directive(view.ego, p, rho=7.0) for p in view.peers]", r"^policy '.*greedy' on drone \d: directive 0→\d: rho is 7\.0, must be in \[0, 1\]"),
    "stray": ("[Directive(view.ego, 77)]", r"^policy '.*stray' on drone \d: directive 0→77: destination 77 is not a peer in the view"),
    "empty": ("None", r"policy '.*empty' on drone \d returns NoneType, must be a sequence of directives"),
    "crash": ("[1 / 0]", r"policy '.*crash' on drone \d raises ZeroDivisionError: division by zero \(mine\.py, line 4\)"),
    "wrong": ("['features']", r"^policy '.*wrong' on drone \d: a policy returns Directive, got str"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_a_users_policy_that_breaks_the_contract_is_told_how(name: str, tmp_path: Path) -> None:
    code, message = BROKEN[name]
    path = tmp_path / "mine.py"
    path.write_text(f"from sortie.policies.contract import Directive\n\ndef {name}(view):\n    return {code}\n")
    with pytest.raises(PolicyError, match=message.replace("directive 0", r"directive \d")):
        run_sortie(example("duration_s=1", "mission.phases=[{at_s: 0, phase: search}]"), f"{path}:{name}")


def test_what_the_audit_cannot_read_is_told_as_without_it(tmp_path: Path) -> None:
    path = tmp_path / "texts.py"
    path.write_text(
        "from sortie.policies.contract import Directive, Representation\n\ndef decide(view):\n"
        "    return [Directive(view.ego, p, Representation.FEATURES, 0.1, rate_hz='10') for p in view.peers]\n"
    )
    for rules in ("policy.invariants=''", f"policy.invariants={SLOW}"):
        with pytest.raises(PolicyError, match=r"rate_hz is '10', must be in \[0, 30\], a number"):
            run_sortie(example(f"policy.name={path}:decide", "policy.params={}", rules))
