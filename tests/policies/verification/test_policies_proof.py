"""Proofs: complete where they say so, and a counterexample in every policy with a planted fault."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import pytest

from sortie.policies.catalogue.baselines import everyone, random_k
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Descriptor, Directive, FleetView, Representation, TaskPhase
from sortie.policies.geometry import footprint_overlap
from sortie.policies.verification.invariants import parse
from sortie.policies.verification.proof import ProofVerdict, check_property, property_of, prove
from sortie.policies.verification.properties import PROMISES
from sortie.policies.verification.views import from_json, to_json

Decide = Callable[[FleetView], Sequence[Directive]]
HUMANE = "when target_in_region and peers >= 1: any_link(representation >= detections)"


def last(policy: Decide, line: str, drones: int = 3) -> ProofVerdict:
    return prove(policy, parse(line), max_drones=drones)[-1]


def test_the_worked_policy_keeps_all_its_promises() -> None:
    verdicts = prove(worked, parse(PROMISES["worked"]), max_drones=3)
    assert len(verdicts) == 11
    assert [v for v in verdicts if v.outcome != "proved"] == []


def test_a_promise_that_the_worked_policy_does_not_keep_is_refuted_at_its_edge() -> None:
    verdict = last(worked, "when battery <= 0.3: representation <= detections")
    assert verdict.outcome == "refuted"
    assert verdict.counterexample is not None
    assert verdict.counterexample.descriptors[verdict.counterexample.ego].battery_soc == 0.3, "the one float of all"


def drops_below_detections(view: FleetView) -> list[Directive]:
    """Falls silent in a sliver of charge in which no drawn view lies."""
    me = view.me
    tired = me is not None and 0.4 < me.battery_soc < 0.4000001 and me.task_phase == TaskPhase.RETURN
    return [d._replace(representation=Representation.NONE) if tired else d for d in worked(view)]


def rises_with_age(view: FleetView) -> list[Directive]:
    """Sends faster to a peer whose descriptor is between 0.2 and 0.2001 s old."""
    return [d._replace(rate_hz=9.0 if 0.2 < view.age_s[d.destination] < 0.2001 else 1.0) for d in everyone(view)]


def out_of_bounds(view: FleetView) -> list[Directive]:
    return [d._replace(rate_hz=40 * view.descriptors[d.destination].battery_soc) for d in everyone(view)]


def crashes(view: FleetView) -> list[Directive]:
    me = view.me
    if me is not None and me.peer_goodput_mbps[:1] and me.peer_goodput_mbps[0] == 77.25:
        raise RuntimeError("the one goodput")
    return everyone(view)


def test_a_policy_that_drops_below_detections_is_found_out() -> None:
    verdict = last(drops_below_detections, HUMANE)
    assert verdict.outcome == "refuted"
    assert verdict.counterexample is not None
    assert 0.4 < verdict.counterexample.descriptors[verdict.counterexample.ego].battery_soc < 0.4000001
    again = from_json(to_json(verdict.counterexample))
    assert check_property(property_of(parse(HUMANE)[0]), drops_below_detections, again) == verdict.what
    assert last(worked, HUMANE).outcome == "proved"


def test_a_policy_that_rises_with_age_is_found_out() -> None:
    verdict = prove(rises_with_age, max_drones=2)[1]
    assert verdict.outcome == "refuted"
    assert "rate_hz rises from 1.0 to 9.0" in verdict.what
    assert last(rises_with_age, "rate_hz <= fresh.rate_hz").outcome == "refuted"


def test_a_policy_that_only_falls_with_age_is_proved() -> None:
    def falls(view: FleetView) -> list[Directive]:
        return [
            d._replace(rate_hz=10.0 if view.age_s[d.destination] / view.period_s <= 3 else 2.0) for d in everyone(view)
        ]

    assert [v.outcome for v in prove(falls, parse("when age_periods > 3: rate_hz <= 2"), max_drones=3)] == [
        "proved"
    ] * 3


def test_a_rate_out_of_bounds_in_proportion_to_charge_is_found() -> None:
    verdict = prove(out_of_bounds, max_drones=2)[0]
    assert verdict.outcome == "refuted"
    assert "must be in [0, 30]" in verdict.what
    assert verdict.counterexample is not None


def test_a_crash_at_one_single_float_is_found() -> None:
    verdict = prove(crashes, max_drones=2)[0]
    assert (verdict.outcome, verdict.what) == ("refuted", "raises RuntimeError: the one goodput")


@pytest.mark.parametrize(
    ("fields", "what"),
    [
        ({"destination": 1.0}, "destination is 1.0, must be a drone's id, a whole number"),
        ({"reason": 5}, "reason is 5, must be text"),
        ({"rate_hz": "10"}, "rate_hz is '10', must be in [0, 30], a number"),
    ],
)
def test_a_directive_of_other_types_is_refuted_and_named_by_every_property(
    fields: dict[str, object], what: str
) -> None:
    def decide(view: FleetView) -> list[Directive]:
        me = view.me
        tired = me is not None and 0.12 < me.battery_soc < 0.12001
        return [d._replace(**fields) if tired and d.destination == 1 else d for d in everyone(view)]

    contract, *_, rates = prove(decide, parse("rate_hz <= 10"), max_drones=2)
    assert (contract.outcome, contract.what) == ("refuted", f"directive 0→{fields.get('destination', 1)}: {what}")
    assert rates.outcome == ("refuted" if "rate_hz" in fields else "proved")
    assert rates.outcome == "proved" or rates.what == contract.what


def test_what_cannot_be_searched_says_so() -> None:
    verdict = prove(random_k, max_drones=3)[0]
    assert verdict.outcome == "not proved"
    assert verdict.what == "reads stamp_ns, which cannot be searched; 1000 drawn views keep it"
    assert last(random_k, "representation == none").outcome == "refuted", "by a drawn view"


def reads_overlap(view: FleetView) -> list[Directive]:
    me = view.me
    assert me is not None
    return [d for d in everyone(view) if footprint_overlap(me, view.descriptors[d.destination]) >= 0]


def reads_grid(view: FleetView) -> list[Directive]:
    me = view.me
    return everyone(view) if me is None or me.coverage_grid[0] >= 0 else []


def best_goodput(view: FleetView) -> list[Directive]:
    me = view.me
    assert me is not None
    best = max(view.peers, key=me.goodput_to, default=None)
    return [d if d.destination == best else d._replace(rate_hz=1.0) for d in everyone(view)]


def rises(view: FleetView, tired: object) -> list[Directive]:
    return [d._replace(rho=2.0) if tired else d for d in everyone(view)]


def charge(view: FleetView) -> float:
    return 1.0 if view.me is None else view.me.battery_soc


def reads_text(view: FleetView) -> list[Directive]:
    return rises(view, f"{charge(view):.7f}" == "0.1234567")


def reads_the_start_of_text(view: FleetView) -> list[Directive]:
    return rises(view, str(charge(view)).startswith("0.1234567"))


def asks_for_the_type(view: FleetView) -> list[Directive]:
    return rises(view, type(charge(view)) is float and 0.1234567 < charge(view) < 0.12345671)


def asks_for_the_type_in_a_helper(view: FleetView) -> list[Directive]:
    return rises(view, Kind.of(charge(view)) and 0.1234567 < charge(view) < 0.12345671)


class Kind:
    @staticmethod
    def of(x: object) -> bool:
        return KINDS["one"](x) is float


KINDS = {"one": lambda x: type(x)}


class Asks:
    def __call__(self, view: FleetView) -> list[Directive]:
        return asks_for_the_type(view)


def guards(view: FleetView) -> list[Directive]:
    me = view.me
    sound = isinstance(me, Descriptor) and isinstance(me.battery_soc, float)
    return rises(view, sound and isinstance(charge(view), int | float) and 0.1234567 < charge(view) < 0.12345671)


def reads_the_highest_flag(view: FleetView) -> list[Directive]:
    return rises(view, view.me is not None and view.me.novelty_flags & 128)


@pytest.mark.parametrize(
    ("policy", "why"),
    [
        (reads_text, "uses the text of battery_soc of drone 0 for more than a reason"),
        (reads_the_start_of_text, "uses the text of battery_soc of drone 0 for more than a reason"),
        (asks_for_the_type, "uses type(…), which gives another type in the search"),
        (partial(asks_for_the_type), "uses type(…), which gives another type in the search"),
        (Asks(), "uses type(…), which gives another type in the search"),
        (asks_for_the_type_in_a_helper, "uses type(…), which gives another type in the search"),
    ],
)
def test_a_policy_that_sees_through_its_numbers_is_not_proved(policy: Decide, why: str) -> None:
    verdict = prove(policy, max_drones=2)[0]
    assert (verdict.outcome, verdict.what) == ("not proved", f"{why}; 1000 drawn views keep it")


@pytest.mark.parametrize("policy", [guards, reads_the_highest_flag])
def test_what_is_answered_as_in_flight_is_searched(policy: Decide) -> None:
    verdict = prove(policy, max_drones=2)[0]
    assert (verdict.outcome, verdict.what) == ("refuted", "directive 0→1: rho is 2.0, must be in [0, 1]")


def test_a_number_in_a_reason_is_no_obstacle() -> None:
    def explains(view: FleetView) -> list[Directive]:
        return [
            full_sharing(view.ego, p, 1.0, f"{charge(view):.0%}" if p == 1 else f"{charge(view):.0%} left")
            for p in view.peers
        ]

    assert [v.outcome for v in prove(explains, parse("rho <= 1\nrepresentation >= features"), max_drones=3)] == [
        "proved"
    ] * 4
    assert last(explains, "rho <= 0.5").outcome == "refuted"


@pytest.mark.parametrize(
    ("policy", "why"),
    [
        (reads_overlap, "reads position_m without peers_by_overlap"),
        (reads_grid, "reads coverage_grid, which cannot be searched"),
        (best_goodput, "compares or combines two inputs, goodput of drone 0 to slot"),
    ],
)
def test_a_policy_beyond_the_search_is_not_called_proved(policy: Decide, why: str) -> None:
    verdict = last(policy, "rate_hz <= 10")
    assert verdict.outcome == "not proved" or "AssertionError" in verdict.what
    if verdict.outcome == "not proved":
        assert why in verdict.what


def test_too_many_cells_are_given_up() -> None:
    verdict = prove(worked, max_drones=3, max_cells=10)[0]
    assert verdict.outcome == "not proved"
    assert "more than 10 cells" in verdict.what
