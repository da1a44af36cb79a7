"""The conformance kit over every registered policy, with no exemptions."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from policies_examples import fleet_of

from sortie.policies.contract import PolicyError, Representation, check_directives
from sortie.policies.registry import BOUNDS, POLICIES, parameters, resolve
from sortie.policies.verification.conformance import conform, failing
from sortie.policies.verification.views import draw_views, to_json


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


@pytest.mark.parametrize(
    ("name", "params", "message"),
    [
        ("best-2", {"k": -1}, "best-2: k is -1, must be a whole number from 0 on"),
        ("random-2", {"k": 2.0}, "random-2: k is 2.0, must be a whole number from 0 on"),
        ("random-2", {"salt": "a"}, "random-2: salt is 'a', must be a whole number"),
        ("where2comm", {"rounds": -3}, "where2comm: rounds is -3, must be a whole number from 1 on"),
        ("where2comm", {"rounds": 0}, "where2comm: rounds is 0, must be a whole number from 1 on"),
        ("where2comm", {"rounds": True}, "where2comm: rounds is True, must be a whole number from 1 on"),
        ("worked", {"rho": 2}, "worked: rho is 2, must be a number in [0, 1]"),
        ("all-4", {"rho": "0.1"}, "all-4: rho is '0.1', must be a number in [0, 1]"),
        ("adaptive", {"rho": math.nan}, "adaptive: rho is nan, must be a number in [0, 1]"),
        ("vantage", {"rho": -0.1}, "vantage: rho is -0.1, must be a number in [0, 1]"),
        ("hydracollab", {"threshold": 1.5}, "hydracollab: threshold is 1.5, must be a number in [0, 1]"),
        ("when2com", {"sharpness": math.inf}, "when2com: sharpness is inf, must be a number in [0, 100]"),
        ("syncnet", {"trusted_for_s": 0.0}, "syncnet: trusted_for_s is 0.0, must be a number in [0.001, 3600]"),
    ],
)
def test_a_parameter_out_of_bounds_is_named_before_anything_flies(
    name: str, params: dict[str, object], message: str
) -> None:
    with pytest.raises(PolicyError, match=f"^{re.escape(message)}$"):
        resolve(name, params)


@pytest.mark.parametrize("name", POLICIES)
def test_a_policy_keeps_the_contract_at_both_ends_of_its_parameters(name: str) -> None:
    """So that a bound which lets nonsense through shows."""
    for key in parameters(POLICIES[name]).keys() & BOUNDS.keys():
        bound = BOUNDS[key]
        for end in (bound.low, bound.high):
            value = end if math.isfinite(end) else math.copysign(1e9, end)
            policy = resolve(name, {key: int(value) if bound.whole else value})
            for view in draw_views(4, 20):
                check_directives(policy(view), view)


def test_what_a_file_declares_is_its_own_to_bound(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text("def decide(view, *, rho='much', k=-1):\n    return []\n\ngreatest = max\n")
    assert not resolve(f"{path}:decide", {"rho": "more", "k": -2})(fleet_of(1))
    assert resolve("best-2", {"rho": np.float32(0.5), "k": np.int64(3)})(fleet_of(5))[0].rho == pytest.approx(2 / 3)
    with pytest.raises(PolicyError, match=r"'greatest' names no parameters, must be a Python function$"):
        resolve(f"{path}:greatest")


def test_best_and_worst_choose_by_overlap() -> None:
    assert chosen("best-2") == [1, 2]
    assert chosen("worst-2") == [3, 4]
    assert chosen("all-4") == [1, 2, 3, 4]
    assert chosen("silence") == []
    assert len(chosen("random-2")) == 2
    assert {tuple(chosen("random-2", salt=s)) for s in range(40)} == {
        (a, b) for a in range(1, 5) for b in range(a + 1, 5)
    }
