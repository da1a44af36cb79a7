"""Proofs: complete where they say so, and a counterexample in every policy with a planted fault."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from policies_examples import planted

from sortie.policies.catalogue.baselines import everyone, random_k
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.invariants.promises import PROMISES
from sortie.policies.verification.kit.views import from_json, to_json
from sortie.policies.verification.proof.proof import ProofVerdict, check_property, property_of, prove

Decide = Callable[[FleetView], Sequence[Directive]]
HUMANE = "when target_in_region and peers >= 1: any_link(representation >= detections)"


def quick(policy: Decide, line: str = "", drones: int = 2, views: int = 20, cells: int = 500_000) -> list[ProofVerdict]:
    return prove(policy, parse(line), max_drones=drones, views=views, cells=cells)


def last(policy: Decide, line: str, drones: int = 2) -> ProofVerdict:
    return quick(policy, line, drones)[-1]


def test_the_worked_policy_keeps_all_its_promises() -> None:
    verdicts = quick(worked, PROMISES["worked"])
    assert len(verdicts) == 10
    assert [v for v in verdicts if v.outcome != "proved"] == []


def test_a_promise_that_the_worked_policy_does_not_keep_is_refuted_at_its_edge() -> None:
    verdict = last(worked, "when battery <= 0.3: representation <= detections")
    assert verdict.outcome == "refuted"
    assert verdict.counterexample is not None
    assert verdict.counterexample.descriptors[verdict.counterexample.ego].battery_soc == 0.3, "the one float of all"


def test_a_policy_that_drops_below_detections_is_found_out() -> None:
    verdict = last(planted("drops_below_detections"), HUMANE)
    assert verdict.outcome == "refuted"
    assert verdict.counterexample is not None
    assert 0.4 < verdict.counterexample.descriptors[verdict.counterexample.ego].battery_soc < 0.4000001
    again = from_json(to_json(verdict.counterexample))
    assert check_property(property_of(parse(HUMANE)[0]), planted("drops_below_detections"), again) == verdict.what
    assert last(worked, HUMANE).outcome == "proved"


def test_a_policy_that_rises_with_age_is_found_out() -> None:
    verdict = quick(planted("rises_with_age"))[1]
    assert verdict.outcome == "refuted"
    assert "rate_hz rises from 1.0 to 9.0" in verdict.what
    assert last(planted("rises_with_age"), "rate_hz <= fresh.rate_hz").outcome == "refuted"


def test_a_policy_that_only_falls_with_age_is_proved() -> None:
    assert [v.outcome for v in quick(planted("falls"), "when age_periods > 3: rate_hz <= 2")] == ["proved"] * 3


def test_a_rate_out_of_bounds_in_proportion_to_charge_is_found() -> None:
    verdict = quick(planted("out_of_bounds"))[0]
    assert verdict.outcome == "refuted"
    assert "must be in [0, 30]" in verdict.what
    assert verdict.counterexample is not None


def test_a_crash_at_one_single_float_is_found() -> None:
    verdict = quick(planted("crashes"))[0]
    assert (verdict.outcome, verdict.what) == ("refuted", "raises RuntimeError: the one goodput")


@pytest.mark.parametrize(
    ("fields", "what"),
    [
        ("destination=1.0", "destination is 1.0, must be a drone's id, a whole number"),
        ("reason=5", "reason is 5, must be text"),
        ("rate_hz='10'", "rate_hz is '10', must be in [0, 30], a number"),
    ],
)
def test_a_directive_of_other_types_is_refuted_and_named_by_every_property(
    fields: str, what: str, tmp_path: Path
) -> None:
    file = tmp_path / "policy.py"
    file.write_text(
        "from sortie import Directive\ndef decide(view):\n    tired = view.me is not None and 0.12 < view.me.battery_soc < 0.12001\n"
        "    decided = [Directive(view.ego, p, reason='r') for p in view.peers]\n"
        f"    return [d._replace({fields}) if tired and d.destination == 1 else d for d in decided]\n"
    )
    contract, *_, rates = quick(resolve(f"{file}:decide"), "rate_hz <= 10")
    to = "1.0" if "destination" in fields else "1"
    assert (contract.outcome, contract.what) == ("refuted", f"directive 0→{to}: {what}")
    assert rates.outcome == ("refuted" if "rate_hz" in fields else "proved")
    assert rates.outcome == "proved" or rates.what == contract.what


@pytest.mark.slow
def test_what_cannot_be_searched_says_so() -> None:
    verdict = quick(random_k)[0]
    assert verdict.outcome == "tried"
    assert verdict.what.endswith("; not proved: it reads stamp_ns, which cannot be searched")
    assert last(random_k, "representation == none").outcome == "refuted", "by a drawn view"


def test_a_function_without_a_file_is_searched_and_not_proved() -> None:
    def decide(view: FleetView) -> list[Directive]:
        return [d._replace(rate_hz=20.0 if view.me and view.me.battery_soc == 0.4 else 2.0) for d in worked(view)]

    (*_, slow) = quick(decide, "rate_hz <= 10")
    assert slow.outcome == "refuted"
    verdict = quick(decide, "rate_hz <= 20")[-1]
    assert verdict.outcome == "tried"
    assert "it is not a policy of Sortie's nor a function in a file that was named as file.py:function" in verdict.what


def test_a_number_in_a_reason_is_no_obstacle() -> None:
    assert [v.outcome for v in quick(planted("explains"), "rho <= 1\nrepresentation >= features", 3)] == ["proved"] * 4
    assert last(planted("explains"), "rho <= 0.5").outcome == "refuted"


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("reads_overlap", "reads position_m without peers_by_overlap"),
        ("reads_grid", "reads coverage_grid, which cannot be searched"),
    ],
)
def test_a_policy_beyond_the_search_is_not_called_proved(name: str, why: str) -> None:
    verdict = quick(planted(name), "rate_hz <= 10")[-1]
    assert verdict.outcome in ("tried", "refuted")
    assert why in verdict.what or "AssertionError" in verdict.what


def test_a_spent_budget_is_not_called_proved() -> None:
    verdict = quick(worked, drones=3, cells=0)[0]
    assert verdict.outcome == "tried"
    assert "it has more cells than the budget of 0" in verdict.what


def test_a_line_that_larger_fleets_break_is_not_proved_for_them() -> None:
    """Fleets of two keep it; a drawn view of more does not."""
    verdict = quick(everyone, "count_links(representation > none) <= 2", views=100)[-1]
    assert verdict.outcome == "refuted"
    assert verdict.counterexample is not None
    assert len(verdict.counterexample.descriptors) == 4


def test_a_proof_says_how_large_the_fleets_are_and_when_a_peer_is_detached() -> None:
    verdict = quick(everyone, "count_links(representation > none) <= 2", views=0)[-1]
    covered = "all views of up to 2 drones, at a period of 0.1 s, detached after 10 periods"
    assert verdict.outcome == "proved"
    assert verdict.what.startswith(covered)


def test_a_fault_where_a_peer_is_detached_later_is_found_by_drawn_views() -> None:
    def decide(view: FleetView) -> list[Directive]:
        return [d._replace(rate_hz=10.0 if view.detached_after_periods == 20 else 2.0) for d in worked(view)]

    verdict = quick(decide, "rate_hz <= 5", views=30)[-1]
    assert verdict.outcome == "refuted"
    assert verdict.counterexample is not None
    assert verdict.counterexample.detached_after_periods == 20


def test_without_the_solver_the_verdict_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "z3", None)
    verdict = quick(planted("best_goodput"), drones=3)[0]
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
