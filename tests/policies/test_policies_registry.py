"""From a policy's name to its function: parameters and bounds, budgets, viewpoints, and what a wrong name says."""

from __future__ import annotations

import math
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from policies_examples import fleet_of, written

from sortie.policies.catalogue.other_representations import codes, uncertain_boxes
from sortie.policies.catalogue.vantage import vantage
from sortie.policies.catalogue.worked import worked
from sortie.policies.checks import check_directives
from sortie.policies.contract import Directive, PolicyError, Representation
from sortie.policies.registry import BOUNDS, POLICIES, parameters, resolve, viewpoint_of, within_budget
from sortie.policies.verification.kit.views import draw_views
from sortie.scenarios.plugins.user_calls import Guarded

OUT_OF_BOUNDS: list[tuple[str, str, object, str]] = [
    ("best-2", "k", -1, "a whole number from 0 on"),
    ("random-2", "k", 2.0, "a whole number from 0 on"),
    ("random-2", "salt", "a", "a whole number"),
    ("where2comm-style", "rounds", -3, "a whole number from 1 on"),
    ("where2comm-style", "rounds", 0, "a whole number from 1 on"),
    ("where2comm-style", "rounds", True, "a whole number from 1 on"),
    ("worked", "rho", 2, "a number in [0, 1]"),
    ("all-4", "received_budget", "0.1", "a number in [0, 1]"),
    ("adaptive", "sent_budget", math.nan, "a number in [0, 1]"),
    ("vantage", "received_budget", -0.1, "a number in [0, 1]"),
    ("hydracollab-style", "threshold", 1.5, "a number in [0, 1]"),
    ("when2com-style", "sharpness", math.inf, "a number in [0, 100]"),
    ("syncnet-style", "trusted_for_s", 0.0, "a number in [0.001, 3600]"),
]


def refusal(name: str, params: dict[str, object] | None = None) -> str:
    with pytest.raises(PolicyError) as caught:
        resolve(name, params)
    return str(caught.value)


def test_a_parameter_out_of_bounds_is_named_before_anything_flies() -> None:
    found = {(name, key): refusal(name, {key: value}) for name, key, value, _ in OUT_OF_BOUNDS}
    wanted = {
        (name, key): f"{name}: {key} is {value!r}, must be {allowed}" for name, key, value, allowed in OUT_OF_BOUNDS
    }
    assert found == wanted
    assert resolve("best-2", {"received_budget": np.float32(0.5), "k": np.int64(3)})(fleet_of(5))


def test_a_policy_keeps_the_contract_at_both_ends_of_its_parameters() -> None:
    """So that a bound which lets nonsense through shows."""
    views = list(draw_views(4, 20))
    for name in POLICIES:
        for key in parameters(POLICIES[name]).keys() & BOUNDS.keys():
            for end in (BOUNDS[key].low, BOUNDS[key].high):
                value = end if math.isfinite(end) else math.copysign(1e9, end)
                policy = resolve(name, {key: int(value) if BOUNDS[key].whole else value})
                for view in views:
                    check_directives(policy(view), view)


def test_errors_name_what_there_is(tmp_path: Path) -> None:
    assert re.match(r"unknown policy 'best', did you mean best-2\? known: worked, all-4", refusal("best"))
    assert refusal("worked", {"k": 3}) == "policy 'worked' has no parameter 'k', it has: rho"
    (tmp_path / "mine.py").write_text("def decide(view): return []\n\ngreatest = max\n")
    (tmp_path / "bad.py").write_text("def decide(view) return []\n")
    (tmp_path / "late.py").write_text("import math\n\nLEAST = math.sqrt(-1)\n")
    (tmp_path / "exits.py").write_text("import sys\nsys.exit(0)\n")
    for name, words in (
        ("none.py:decide", r"not found"),
        ("mine.py:decode", r"has no function 'decode'"),
        ("mine.py", r"mine.py' without its function, must be .*mine.py:function"),
        ("mine.py:greatest", r"'greatest' names no parameters, must be a Python function$"),
        ("bad.py:decide", r"does not load: SyntaxError"),
        ("late.py:decide", r"late.py' does not load: ValueError: .* \(late\.py, line 3\)$"),
        ("exits.py:decide", r"exits\.py' does not load: SystemExit: 0 \(exits\.py, line 2\)$"),
    ):
        assert re.search(words, refusal(f"{tmp_path}/{name}")), name


def test_parameters_are_the_keyword_only_arguments() -> None:
    assert parameters(worked) == {"rho": 1.0}
    assert [next(iter(policy(fleet_of(5)))).rho for policy in (worked, resolve("worked", {"rho": 0.25}))] == [1.0, 0.25]


def test_a_users_file_bounds_its_parameters_itself_and_its_viewpoint_gets_those_that_it_has(tmp_path: Path) -> None:
    text = (
        "import sortie\n"
        "def away(view, *, far_m=1.0, why='default'):\n"
        "    return sortie.Reposition(view.me.position_m[0] + far_m, 0.0, why)\n"
        "@sortie.looks_from(away)\n"
        "def decide(view, *, far_m=1.0, rho=0.1):\n"
        "    return [sortie.Directive(view.ego, p, reason=f'{far_m:g} {rho:g}') for p in view.peers]\n"
    )
    policy, view = written(tmp_path, text, {"far_m": -7.0, "rho": 5.0}), fleet_of(2)
    assert isinstance(policy, partial)
    assert policy(view)[0].reason == "-7 5"
    look, plain = viewpoint_of(policy), viewpoint_of(written(tmp_path, text))
    assert isinstance(look, partial)
    assert look.keywords == {"far_m": -7.0}
    assert isinstance(look.func, Guarded)
    assert look(view) == (-7.0, 0.0, "default")
    assert plain is not None
    assert plain(view) == (1.0, 0.0, "default")
    assert [name for name in POLICIES if viewpoint_of(resolve(name))] == ["vantage"]


def test_a_budget_goes_to_the_parameter_that_a_policy_has() -> None:
    wanted = {"all-4": "received_budget", "best-2-receivers": "sent_budget", "worked": "rho"}
    for name, parameter in wanted.items():
        assert within_budget(resolve(name), 0.1) == {parameter: 0.1}
    assert within_budget(resolve("silence"), 0.1) == {}


def test_what_a_policy_takes_from_another_one_it_takes_with_its_own_parameters() -> None:
    view = fleet_of(4)
    for budget in (0.0, 0.1, 1.0):
        shares = [d.rho for d in POLICIES["all-4"](view, received_budget=budget)]
        assert [d.rho for d in codes(view, received_budget=budget)] == shares
        assert [d.rho for d in vantage(view, received_budget=budget)] == shares
        assert {d.representation for d in codes(view, received_budget=budget)} == {Representation.CODES}
    wanted = [Directive(0, p, Representation.UNCERTAIN_BOXES, rate_hz=10.0) for p in view.peers]
    assert uncertain_boxes(view) == wanted
