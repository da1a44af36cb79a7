"""The conformance kit over every registered policy, with no exemptions."""

from __future__ import annotations

import math

import pytest
from policies_examples import fleet_of

from policies.conformance import conform, failing
from policies.contract import Representation
from policies.registry import POLICIES
from policies.views import to_json


@pytest.mark.parametrize("name", POLICIES)
def test_a_policy_keeps_the_contract(name: str) -> None:
    broken = failing(conform(POLICIES[name], count=100))
    assert not broken, "\n".join(
        f"{c.name}: {c.what}\n{to_json(c.counterexample) if c.counterexample else ''}" for c in broken
    )


@pytest.mark.parametrize("name", ["all-4", "best-2", "worst-2", "random-2"])
@pytest.mark.parametrize("rho", [0.02, 0.05, 0.1, 0.25, 1.0])
def test_fixed_policies_spend_the_same_budget(name: str, rho: float) -> None:
    """Matched bytes: what a drone sends over all its links is ρ of full sharing, up to a full map a link."""
    view = fleet_of(5)
    directives = [d for d in POLICIES[name](view, rho=rho) if d.representation == Representation.FEATURES]
    spent = math.fsum(d.rho for d in directives)
    assert spent == pytest.approx(min(rho * 4, len(directives)))


def chosen(name: str, **params: object) -> list[int]:
    return [d.destination for d in POLICIES[name](fleet_of(5), **params) if d.representation != Representation.NONE]


def test_best_and_worst_choose_by_overlap() -> None:
    assert chosen("best-2") == [1, 2]
    assert chosen("worst-2") == [3, 4]
    assert chosen("all-4") == [1, 2, 3, 4]
    assert chosen("silence") == []
    assert len(chosen("random-2")) == 2
    assert {tuple(chosen("random-2", salt=s)) for s in range(40)} == {
        (a, b) for a in range(1, 5) for b in range(a + 1, 5)
    }
