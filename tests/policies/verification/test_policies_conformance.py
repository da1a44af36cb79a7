"""The conformance kit over every registered policy, with no exemptions."""

from __future__ import annotations

import math
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from policies_examples import fleet_of

from sortie.perception.budget import cells_in
from sortie.policies.checks import check_directives
from sortie.policies.contract import PolicyError, Representation
from sortie.policies.registry import BOUNDS, POLICIES, parameters, resolve
from sortie.policies.verification.kit.conformance import conform, failing
from sortie.policies.verification.kit.views import draw_views, to_json


@pytest.mark.parametrize("name", POLICIES)
def test_a_policy_keeps_the_contract(name: str) -> None:
    broken = failing(conform(POLICIES[name], count=100))
    assert not broken, "\n".join(
        f"{c.name}: {c.what}\n{to_json(c.counterexample) if c.counterexample else ''}" for c in broken
    )


@pytest.mark.parametrize("budget", [0.02, 0.05, 0.1, 0.25, 1.0])
@pytest.mark.parametrize("name", ["all-4", "best-2", "worst-2", "random-2"])
def test_every_receiver_gets_its_whole_budget(name: str, budget: float) -> None:
    """Matched bytes: what all drones together send to an ego is the budget's share of full sharing, to the cell."""
    view, cells = fleet_of(5), Counter[int]()
    links = Counter[int]()
    for ego in view.descriptors:
        for d in POLICIES[name](view._replace(ego=ego), received_budget=budget):
            if d.representation == Representation.FEATURES:
                cells[d.destination] += cells_in(d.rho)
                links[d.destination] += 1
    most = 4 if name == "all-4" else 2
    assert set(links.values()) == {most}
    assert set(cells.values()) == {min(int(budget * 4 * 4096), most * 4096)}


@pytest.mark.parametrize("budget", [0.02, 0.05, 0.1, 0.25, 1.0])
@pytest.mark.parametrize("name", ["best-2-receivers", "worst-2-receivers", "random-2-receivers"])
def test_every_sender_spends_its_whole_budget(name: str, budget: float) -> None:
    """Matched bytes: what a drone sends over all its links is the budget's share of full sharing, up to a full map a link."""
    directives = POLICIES[name](fleet_of(5), sent_budget=budget)
    spent = math.fsum(d.rho for d in directives if d.representation == Representation.FEATURES)
    assert spent == pytest.approx(min(budget * 4, 2))


def receivers(name: str, sender: int = 0, **params: object) -> list[int]:
    """To whom a drone of a line sends; drone 0 is at one end."""
    view = fleet_of(5)._replace(ego=sender)
    return [d.destination for d in POLICIES[name](view, **params) if d.representation != Representation.NONE]


def senders(name: str, receiver: int, **params: object) -> set[int]:
    return {i for i in range(5) if i != receiver and receiver in receivers(name, i, **params)}


@pytest.mark.parametrize(
    ("name", "params", "message"),
    [
        ("best-2", {"k": -1}, "best-2: k is -1, must be a whole number from 0 on"),
        ("random-2", {"k": 2.0}, "random-2: k is 2.0, must be a whole number from 0 on"),
        ("random-2", {"salt": "a"}, "random-2: salt is 'a', must be a whole number"),
        ("where2comm-style", {"rounds": -3}, "where2comm-style: rounds is -3, must be a whole number from 1 on"),
        ("where2comm-style", {"rounds": 0}, "where2comm-style: rounds is 0, must be a whole number from 1 on"),
        ("where2comm-style", {"rounds": True}, "where2comm-style: rounds is True, must be a whole number from 1 on"),
        ("worked", {"rho": 2}, "worked: rho is 2, must be a number in [0, 1]"),
        ("all-4", {"received_budget": "0.1"}, "all-4: received_budget is '0.1', must be a number in [0, 1]"),
        ("adaptive", {"sent_budget": math.nan}, "adaptive: sent_budget is nan, must be a number in [0, 1]"),
        ("vantage", {"received_budget": -0.1}, "vantage: received_budget is -0.1, must be a number in [0, 1]"),
        ("hydracollab-style", {"threshold": 1.5}, "hydracollab-style: threshold is 1.5, must be a number in [0, 1]"),
        ("when2com-style", {"sharpness": math.inf}, "when2com-style: sharpness is inf, must be a number in [0, 100]"),
        (
            "syncnet-style",
            {"trusted_for_s": 0.0},
            "syncnet-style: trusted_for_s is 0.0, must be a number in [0.001, 3600]",
        ),
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
    assert resolve("best-2", {"received_budget": np.float32(0.5), "k": np.int64(3)})(fleet_of(5))[
        0
    ].rho == pytest.approx(2 / 3, abs=1e-3)
    with pytest.raises(PolicyError, match=r"'greatest' names no parameters, must be a Python function$"):
        resolve(f"{path}:greatest")


def test_the_receiver_chooses_its_senders() -> None:
    """Each receiver of a line has the two nearest, or the two farthest, senders."""
    assert [senders("best-2", r) for r in range(5)] == [{1, 2}, {0, 2}, {1, 3}, {2, 4}, {2, 3}]
    assert [senders("worst-2", r) for r in (0, 4)] == [{3, 4}, {0, 1}]
    assert [senders("all-4", r) for r in range(5)] == [set(range(5)) - {r} for r in range(5)]
    assert {frozenset(senders("random-2", 0, salt=s)) for s in range(40)} == {
        frozenset((a, b)) for a in range(1, 5) for b in range(a + 1, 5)
    }


def test_the_sender_chooses_its_receivers() -> None:
    assert receivers("best-2-receivers") == [1, 2]
    assert receivers("worst-2-receivers") == [3, 4]
    assert receivers("silence") == []
    assert {tuple(receivers("random-2-receivers", salt=s)) for s in range(40)} == {
        (a, b) for a in range(1, 5) for b in range(a + 1, 5)
    }


def test_a_link_carries_the_same_share_however_many_drones_were_heard() -> None:
    """Senders who hear different drones would otherwise divide the same budget by different fleets."""
    whole = fleet_of(5)._replace(ego=1)
    few = whole._replace(descriptors={i: whole.descriptors[i] for i in (0, 1)}, age_s={0: 0.1, 1: 0.1})
    for name in ("all-4", "best-2"):
        rho = [
            next(d.rho for d in POLICIES[name](v, received_budget=0.125) if d.destination == 0) for v in (whole, few)
        ]
        assert rho == [0.125 * 4 / (4 if name == "all-4" else 2)] * 2
