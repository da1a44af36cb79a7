"""Proofs: complete where they say so, a counterexample where there is a fault, and what a verdict says was covered."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from policies_examples import written

from sortie.policies.catalogue.baselines import everyone
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.registry import POLICIES
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.invariants.promises import PROMISES
from sortie.policies.verification.kit.single_view import PLANE
from sortie.policies.verification.kit.views import from_json, to_json
from sortie.policies.verification.proof.proof import ProofVerdict, check_property, property_of, prove

Decide = Callable[[FleetView], Sequence[Directive]]
HUMANE = "when target_in_region and peers >= 1: any_link(representation >= detections)"
AT_MOST_TWO = "count_links(representation > none) <= 2"
TRIED = {"deputies", "adaptive", "learned", "random-2", "random-2-receivers", "where2comm-style", "when2com-style"}
TRIED |= {"who2com-style", "syncnet-style", "hydracollab-style"}
"""Policies that read grids, places or stamps, which are not searched."""

HEAD = """
from sortie import Directive, Representation, TaskPhase
from sortie.policies.catalogue.worked import worked
from sortie.policies.catalogue.baselines import everyone
def decide(view):
    me = view.me
    if me is None:
        return []
"""


def quick(policy: Decide, line: str = "", drones: int = 2, views: int = 20, cells: int = 500_000) -> list[ProofVerdict]:
    return prove(policy, parse(line), max_drones=drones, views=views, cells=cells)


def decides(folder: Path, body: str) -> Decide:
    return written(folder, HEAD + "".join(f"    {line}\n" for line in body.splitlines()))


def test_the_verdicts_on_the_built_in_policies() -> None:
    """Of the plane's properties and of what each promises: proved, but for policies that read what is not searched."""
    found = {name: quick(policy, PROMISES.get(name, ""), views=0) for name, policy in POLICIES.items()}
    assert {name: {v.outcome for v in verdicts} for name, verdicts in found.items()} == {
        name: {"tried" if name in TRIED else "proved"} for name in POLICIES
    }
    assert len(found["worked"]) == 10
    assert found["random-2"][0].what.endswith("; not proved: it reads stamp_ns, which cannot be searched")


def test_a_promise_that_the_worked_policy_does_not_keep_is_refuted_at_its_edge() -> None:
    line = "when battery <= 0.3: representation <= detections"
    verdict = quick(worked, line)[-1]
    assert verdict.outcome == "refuted"
    assert verdict.counterexample is not None
    assert verdict.counterexample.descriptors[verdict.counterexample.ego].battery_soc == 0.3, "the one float of all"
    again = from_json(to_json(verdict.counterexample))
    assert check_property(property_of(parse(line)[0]), worked, again) == verdict.what


TIRED = "tired = 0.12 < me.battery_soc < 0.12001\n"
LATE = "late = {p: view.age_s[p] / view.period_s > 3 for p in view.peers}\n"
TEXT_RATE = "directive 0→1: rate_hz is '10', must be in [0, 30], a number"
FAULTS: list[tuple[str, str, str, list[str], str]] = [
    ("", "rate_hz=40 * view.descriptors[d.destination].battery_soc", "", ["refuted", "proved"], "must be in [0, 30]"),
    (
        "assert me.peer_goodput_mbps[:1] != (77.25,), 'once'\n",
        "rho=0.0",
        "",
        ["refuted", "refuted"],
        "AssertionError: once",
    ),
    (
        "",
        "rate_hz=9.0 if 0.2 < view.age_s[d.destination] < 0.2001 else 1.0",
        "rate_hz <= fresh.rate_hz",
        ["proved", "refuted", "refuted"],
        "rate_hz rises from 1.0 to 9.0",
    ),
    (LATE, "rate_hz=2.0 if late[d.destination] else 10.0", "when age_periods > 3: rate_hz <= 2", ["proved"] * 3, ""),
    (TIRED, "rate_hz='10' if tired else 2.0", "rate_hz <= 10", ["refuted", "proved", "refuted"], TEXT_RATE),
    (
        TIRED,
        "reason=5 if tired else 'r'",
        "rate_hz <= 10",
        ["refuted", "proved", "proved"],
        "reason is 5, must be text",
    ),
]
"""What a policy computes and changes, a line, the verdicts on contract, age and line, and words of the first fault."""


def test_faults_of_the_contract_of_age_and_of_a_line_are_told_apart(tmp_path: Path) -> None:
    wrong = {}
    for head, fields, line, outcomes, words in FAULTS:
        body = f"{head}return [d._replace({fields}) for d in everyone(view)]"
        found = quick(decides(tmp_path, body), line, views=0)
        first = next((v.what for v in found if v.outcome == "refuted"), "")
        if [v.outcome for v in found] != outcomes or words not in first:
            wrong[body] = [(v.outcome, v.what) for v in found]
    assert wrong == {}


def test_a_refuted_verdict_about_ages_has_the_ages_that_show_it(tmp_path: Path) -> None:
    late = "rates = {p: 9.0 if 0.61 < view.age_s[p] < 0.62 else 2.0 for p in view.peers}\n"
    policy = decides(tmp_path, f"{late}return [d._replace(rate_hz=rates[d.destination]) for d in everyone(view)]")
    contract, monotone = quick(policy, views=0)
    assert (contract.outcome, monotone.outcome) == ("proved", "refuted")
    assert monotone.counterexample is not None
    assert monotone.raised_age_s is not None
    (peer,) = monotone.counterexample.peers
    assert 0.61 < monotone.raised_age_s[peer] < 0.62
    assert check_property(PLANE[1], policy, monotone.counterexample, monotone.raised_age_s) == monotone.what
    assert "rate_hz rises from 2.0 to 9.0" in monotone.what


def test_a_function_without_a_file_is_searched_and_not_proved() -> None:
    def decide(view: FleetView) -> list[Directive]:
        return [d._replace(rate_hz=20.0 if view.me and view.me.battery_soc == 0.4 else 2.0) for d in worked(view)]

    assert quick(decide, "rate_hz <= 10")[-1].outcome == "refuted"
    verdict = quick(decide, "rate_hz <= 20")[-1]
    assert verdict.outcome == "tried"
    assert "it is not a policy of Sortie's nor a function in a file that was named as file.py:function" in verdict.what


def test_a_spent_budget_is_not_called_proved() -> None:
    verdict = quick(worked, drones=3, cells=0)[0]
    assert verdict.outcome == "tried"
    assert "it has more cells than the budget of 0" in verdict.what


def test_a_proof_says_what_it_covers_and_drawn_views_try_the_rest() -> None:
    """Fleets of two keep the line; a drawn view of more does not. The proof is for one limit of detached peers."""
    proved = quick(everyone, AT_MOST_TWO, views=0)[-1]
    covered = "all views of up to 2 drones, at a period of 0.1 s, detached after 10 periods"
    assert (proved.outcome, proved.what.startswith(covered)) == ("proved", True)
    refuted = quick(everyone, AT_MOST_TWO, views=100)[-1]
    assert refuted.outcome == "refuted"
    assert refuted.counterexample is not None
    assert len(refuted.counterexample.descriptors) == 4

    def decide(view: FleetView) -> list[Directive]:
        return [d._replace(rate_hz=10.0 if view.detached_after_periods == 20 else 2.0) for d in worked(view)]

    later = quick(decide, "rate_hz <= 5", views=30)[-1]
    assert later.outcome == "refuted"
    assert later.counterexample is not None
    assert later.counterexample.detached_after_periods == 20


def test_without_the_solver_the_verdict_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    best = "best = max(view.peers, key=me.goodput_to, default=None)\n"
    policy = decides(
        tmp_path, f"{best}return [d._replace(rate_hz=5.0 * (d.destination == best)) for d in everyone(view)]"
    )
    monkeypatch.setitem(sys.modules, "z3", None)
    verdict = quick(policy, drones=3)[0]
    assert verdict.outcome == "tried"
    assert verdict.what.endswith(
        "; not proved: it combines goodput of drone 0 to drone 2 and goodput of drone 0 to drone 1, and z3 is not "
        "installed (pip install sortie-sim[verify])"
    )


def test_a_refutation_of_a_policy_that_fails_only_sometimes_says_so() -> None:
    calls = []

    def decide(view: FleetView) -> list[Directive]:
        calls.append(view)
        rate_hz = 20.0 if len(calls) % 7 == 0 else 2.0
        return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=rate_hz) for p in view.peers]

    verdicts = prove(decide, parse("rate_hz <= 2"), max_drones=1, views=20, cells=0)
    assert all(v.what for v in verdicts)
    assert any(v.what.startswith("not the same for the same view") for v in verdicts), verdicts
