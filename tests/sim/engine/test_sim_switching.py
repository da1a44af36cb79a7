"""Policies that change in flight, a shield over them, and the audit of who decided what."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recorded import recorded
from sim_examples import example

from sortie.policies.contract import DIRECTIVE_BOUNDS, PolicyError
from sortie.scenarios.reading.load import ScenarioError
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.policy_text import policy_overrides
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

SLOW = "rate_hz <= 5"
KEPT = "any_link(representation >= detections and rate_hz >= 2)"
CUT_OFF = "events=[{kind: link_drop, at_s: 2, until_s: 4, drone: 0, loss_db: 120}]"
FEW = ("duration_s=2", "fleet.drones=3")
AT_1 = "mission.phases=[{at_s: 0, phase: search}, {at_s: 1, phase: track, region: {radius_m: 32}}]"
"""Flights of their own: no recorded one changes its policy, or has invariants that break."""


def rows(record: SortieRecord, table: str, **where: object) -> list[dict[str, object]]:
    return [r for r in record.tables[table].to_pylist() if all(r[k] == v for k, v in where.items())]


def payloads(record: SortieRecord) -> str:
    """Without what else was on the air at the time."""
    return str(record.tables["transmissions"].drop_columns(["snr_db"]).to_pydict())


# --- the change ----------------------------------------------------------------------------------


def test_a_change_to_the_same_decisions_changes_no_payload(tmp_path: Path) -> None:
    """On a frame's edge, between two drones' decisions, and between a decision and its payload: nothing moves."""
    path = tmp_path / "twin.py"
    path.write_text(
        "from sortie.policies.catalogue.worked import worked\n\ndef decide(view):\n    return worked(view, rho=0.25)\n"
    )
    base = run_sortie(example(*FEW, AT_1))
    for at_s in (1.0, 1.004, 1.033):
        changed = run_sortie(example(*FEW, AT_1, f"policy.changes=[{{at_s: {at_s}, name: '{path}:decide'}}]"))
        assert payloads(changed) == payloads(base) != ""
        assert outcome(changed)["policies"]["changes"] == 3


def test_no_frame_is_lost_or_sent_twice_at_a_change() -> None:
    to_two = "policy.changes=[{at_s: 2.05, name: best-2, params: {received_budget: 0.02}}]"
    all_four = "policy={name: all-4, params: {received_budget: 0.02}}"
    record = run_sortie(example("duration_s=4", all_four, to_two, "mission.phases=[{at_s: 0, phase: search}]"))
    links: dict[tuple[int, int], list[int]] = {}
    for row in record.tables["transmissions"].to_pylist():
        links.setdefault((row["drone"], row["peer"]), []).append(round(row["captured_s"] * 10))
    after = {link for link, frames in links.items() if frames[-1] > 30}
    assert 0 < len(after) < len(links) == 20
    for link, frames in links.items():
        last = 39 if link in after else 20
        assert frames == list(range(frames[0], last + 1)), f"a frame of {link} was lost or sent twice"


def test_of_two_changes_at_once_the_later_in_the_list_stays() -> None:
    """The phase changes at 1 s, too."""
    decided = {}
    for first, second in (
        ("at_s: 1, name: boxes", "at_s: 1, name: silence"),
        ("phase: track, name: boxes", "at_s: 1, name: silence"),
        ("at_s: 1, name: boxes", "phase: track, name: silence"),
        ("command: go, name: boxes", "at_s: 1, name: silence"),
        ("at_s: 1, name: boxes", "command: go, name: silence"),
        ("phase: track, name: boxes", "command: go, name: silence"),
    ):
        both = f"policy.changes=[{{{first}}}, {{{second}}}]"
        go = ["policy.commands=[{at_s: 1, command: go}]"] if "go" in both else []
        record = run_sortie(example(*FEW, AT_1, both, *go))
        late = [row for row in record.tables["directives"].to_pylist() if row["t_s"] > 1.1]
        assert {row["policy"] for row in late} <= {"silence"}
        decided[first, second] = outcome(record)["policies"]["decisions"]["silence"]
    assert set(decided.values()) == {30}


def test_a_change_by_phase_is_each_drone_s_own_and_in_the_audit() -> None:
    to_best = "policy.changes=[{phase: track, name: best-2, params: {received_budget: 0.1}}]"
    record = run_sortie(example(*FEW, AT_1, to_best))
    changes = rows(record, "events", kind="policy")
    assert {r["text"] for r in changes} == {"worked(rho=0.25) → best-2(received_budget=0.1): phase track"}
    at_s = {r["drone"]: r["t_s"] for r in changes}
    assert sorted(at_s) == [0, 1, 2]
    own_first = all(1.0 <= float(str(t_s)) < 1.02 for t_s in at_s.values())
    assert own_first, "at the drone's own first decision of the phase"
    for r in record.tables["directives"].to_pylist():
        assert r["policy"] == ("best-2(received_budget=0.1)" if r["t_s"] >= at_s[r["drone"]] else "worked(rho=0.25)")
    decisions = outcome(record)["policies"]["decisions"]
    assert decisions == {"worked(rho=0.25)": 3 * 10, "best-2(received_budget=0.1)": 3 * 10}


def test_a_command_reaches_whom_it_names_and_takes_handshakes_along() -> None:
    named = ("policy={name: when2com-style}", "policy.changes=[{command: quiet, name: silence}]")
    record = run_sortie(example(*FEW, AT_1, *named, "policy.commands=[{at_s: 1, command: quiet, drones: [1, 2]}]"))
    assert [(r["t_s"], r["drone"]) for r in rows(record, "events", kind="policy")] == [(1.0, 1), (1.0, 2)]
    asked = rows(record, "transmissions", representation="handshake")
    late = {r["drone"] for r in asked if r["t_sent_s"] > 1.0}  # type: ignore[operator]
    assert ({r["drone"] for r in asked}, late) == ({0, 1, 2}, {0})


def test_a_policy_named_at_take_off_flies_to_the_end() -> None:
    changing = example("policy.changes=[{at_s: 0.1, name: silence}]", "duration_s=0.3", "mission.phases=[{}]")
    assert outcome(run_sortie(changing, "best-2"))["policies"]["changes"] == 0
    named = example("policy.changes=[{at_s: 1, name: silence}]", *policy_overrides("best-2", "worked"))
    assert named.policy.changes == ()


# --- the shield ----------------------------------------------------------------------------------


def test_a_shielded_sortie_keeps_its_invariants_and_counts_each_intervention() -> None:
    base, bare, shielded = (
        run_sortie(example(*FEW, AT_1, *more))
        for more in ((), (f"policy.invariants={SLOW}",), (f"policy.invariants={SLOW}", "policy.shield=true"))
    )
    assert payloads(bare) == payloads(base), "counting changes nothing"
    counted, kept = outcome(bare)["policies"], outcome(shielded)["policies"]
    assert counted["invariant_violations"] == bare.tables["violations"].num_rows >= 3
    assert counted["violated_ticks"] > 30
    assert counted["shield_interventions"] == 0
    assert kept["invariant_violations"] == 0
    assert kept["shield_interventions"] == shielded.tables["interventions"].num_rows > 30
    rates_hz = [max(record.tables["directives"]["rate_hz"].to_pylist()) for record in (bare, shielded)]
    assert rates_hz == [10, 5]
    first = rows(shielded, "interventions")[0]
    assert first["policy"] == "worked(rho=0.25)"
    assert str(first["text"]).startswith("rate_hz <= 5 (decided ")
    assert any(str(r["reason"]).startswith("shield: ") for r in rows(shielded, "directives")), "at the gate"


def gates_that_share_nothing(record: SortieRecord) -> list[tuple[float, int]]:
    """Decisions after which a drone sends no peer its detections, from the gates' own rows."""
    directives = record.tables["directives"].to_pylist()
    found, sending, k = [], {}, 0
    decisions = {(r["t_s"], r["drone"]) for r in record.tables["descriptors"].to_pylist()}  # at the same moment
    for t_s, drone in sorted(decisions):
        while k < len(directives) and directives[k]["t_s"] <= t_s:
            d = directives[k]
            rung = d["representation"] in ("detections", "features", "raw")
            sending[d["drone"], d["peer"]] = rung and d["rate_hz"] >= 2
            k += 1
        if not any(on for (sender, _), on in sending.items() if sender == drone):
            found.append((t_s, drone))
    return found


def test_the_outcome_counts_what_the_gates_did() -> None:
    """Judged on the policy's output, a shielded silence kept its line from the first decision; its gates did not."""
    sets = (CUT_OFF, "fleet.drones=3", f"policy.invariants='{KEPT}'", "policy.shield=true")
    record = run_sortie(example("policy={name: silence}", *sets))
    found = gates_that_share_nothing(record)
    counted = outcome(record)["policies"]
    assert counted["violated_ticks"] == len(found) > 5
    broken = rows(record, "violations")
    assert {(r["cause"], r["line"], r["peer"]) for r in broken} == {("no peer", KEPT, -1)}
    first = {r["drone"]: r for r in broken if r["t_s"] < 0.1}  # type: ignore[operator]
    assert set(first) == {0, 1, 2}, "nobody is heard before the first decision"
    assert all(r["until_s"] == r["t_s"] for r in first.values())
    (row,) = [r for r in broken if r["t_s"] > 0.1]  # type: ignore[operator]
    cut_off_s = [t_s for t_s, drone in found if t_s > 0.1 and drone == 0]
    assert (row["t_s"], row["until_s"]) == (min(cut_off_s), max(cut_off_s))
    assert 2.9 < min(cut_off_s) < max(cut_off_s) < 4.2, "from detached, 10 periods after 2 s, until it is heard again"
    events = [e["text"] for e in outcome(record)["events"] if e["kind"] == "violation"]
    assert events == [f"{KEPT}: broken by no peer"] * 4
    assert counted["violations_by_cause"] == {"policy": 0, "staleness": 0, "damping": 0, "no_peer": 4}
    assert {r["drone"] for r in rows(record, "transmissions")} == {0, 1, 2}, "a link that is raised sends"


def test_a_violation_names_the_step_that_broke_the_line() -> None:
    sets = (CUT_OFF.replace("until_s: 4, ", ""), "fleet.drones=3", "duration_s=4")
    for policy, line, cause in (
        ("silence", KEPT, "policy"),
        ("boxes", KEPT, "damping"),
        ("boxes", "every_link(representation >= detections)", "staleness"),
    ):
        record = run_sortie(example(f"policy={{name: {policy}, dwell_s: 0.3}}", *sets, f"policy.invariants='{line}'"))
        broken = rows(record, "violations", cause=cause)
        assert {r["drone"] for r in broken} >= {1, 2}
        counted = outcome(record)["policies"]
        assert counted["violations_by_cause"][cause] == len(broken)
        assert counted["invariant_violations"] == sum(counted["violations_by_cause"].values())
        if cause == "damping":  # for the dwell time of 0.3 s
            assert all(0.15 < r["until_s"] - r["t_s"] < 0.25 for r in broken if r["t_s"] < 1)  # type: ignore[operator]


def test_the_shield_never_gives_a_link_more_than_its_age_allows() -> None:
    """A line that asks for features on every link: degraded peers get detections at 2 Hz, detached ones nothing."""
    line = "representation >= features and rate_hz >= 10 and rho >= 0.1"
    record = run_sortie(example(CUT_OFF, "fleet.drones=3", f"policy.invariants='{line}'", "policy.shield=true"))
    directives = record.tables["directives"].to_pylist()
    assert {r["link"] for r in directives} == {"fresh", "degraded", "detached"}
    for r in directives:
        if r["link"] == "degraded":
            assert r["representation"] in ("none", "detections")
            assert r["rate_hz"] <= 2
        elif r["link"] == "detached":
            assert r["representation"] == "none"
    fresh = [r for r in directives if r["link"] == "fresh" and r["t_s"] > 0.5]
    assert all(r["representation"] == "features" and r["rate_hz"] <= DIRECTIVE_BOUNDS["rate_hz"].high for r in fresh)
    assert {r["cause"] for r in rows(record, "violations")} == {"staleness"}


# --- what is refused -----------------------------------------------------------------------------

REFUSED: dict[str, tuple[type[Exception], str]] = {
    "policy.changes=[{at_s: 5, name: loud}]": (PolicyError, "unknown policy 'loud'"),
    "policy.commands=[{at_s: 5, command: x}]": (
        ScenarioError,
        r"policy\.commands\.0\.command: 'x', must be one that a change waits for",
    ),
    "policy.changes=[{at_s: 5, phase: track, name: silence}]": (
        ScenarioError,
        "at_s and phase, must be one of at_s, phase and command",
    ),
    "policy={name: worked, invariants: 'rate_hz <=', shield: true}": (
        PolicyError,
        r"policy\.invariants: line 1, 'rate_hz <=': 'rate_hz <=' is not an expression",
    ),
    "policy={name: worked, invariants: 'sum_links(rate_hz) <= 5', shield: true}": (
        PolicyError,
        r"policy\.invariants: .* a shield cannot keep sum_links",
    ),
}
BROKEN = {
    "greedy": (
        "[Directive(view.ego, p, rho=7.0) for p in view.peers]",
        r"^policy '.*greedy' on drone \d: directive \d→\d: rho is 7\.0, must be in \[0, 1\]",
    ),
    "stray": (
        "[Directive(view.ego, 77)]",
        r"^policy '.*stray' on drone \d: directive \d→77: destination 77 is not a peer in the view",
    ),
    "empty": ("None", r"policy '.*empty' on drone \d returns NoneType, must be a sequence of directives"),
    "crash": ("[1 / 0]", r"policy '.*crash' on drone \d raises ZeroDivisionError: .* \(mine\.py, line 4\)"),
    "wrong": ("['features']", r"^policy '.*wrong' on drone \d: a policy returns Directive, got str"),
    "texts": (
        "[Directive(view.ego, p, Representation.FEATURES, 0.1, rate_hz='10') for p in view.peers]",
        r"rate_hz is '10', must be in \[0, 30\], a number",
    ),
}
"""By name: what a user's policy returns, and the error."""


def test_what_cannot_be_is_refused_before_the_flight() -> None:
    for override, (error, words) in REFUSED.items():
        with pytest.raises(error, match=words):
            run_sortie(example(override))


def test_a_user_s_policy_that_breaks_the_contract_is_refused_with_its_name(tmp_path: Path) -> None:
    for name, (code, words) in BROKEN.items():
        path = tmp_path / name / "mine.py"
        path.parent.mkdir()
        contract = "from sortie.policies.contract import Directive, Representation"
        path.write_text(f"{contract}\n\ndef {name}(view):\n    return {code}\n")
        for rules in ("", SLOW):  # what the audit cannot read is refused as without it
            with pytest.raises(PolicyError, match=words):
                run_sortie(example(*FEW, AT_1, f"policy={{name: '{path}:{name}', invariants: '{rules}'}}"))


def test_without_changes_nobody_decides_but_the_scenario_s_policy() -> None:
    counted = outcome(recorded("base"))["policies"]
    assert (counted["changes"], counted["decisions"]) == (0, {"worked(rho=0.25)": 300})
    assert np.unique(recorded("base").tables["directives"]["policy"].to_pylist()).tolist() == ["worked(rho=0.25)"]
