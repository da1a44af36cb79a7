"""A policy as verification needs it: its function loaded anew, its own invariants, and the numbers in its code."""

from __future__ import annotations

import ast
import contextlib
import functools
import inspect
import linecache
import math
from collections.abc import Callable, Sequence
from typing import Any

from sortie.policies.contract import Policy
from sortie.policies.verification.invariants.language import Invariant, Number
from sortie.policies.verification.shield import Shielded
from sortie.scenarios.plugins.user_calls import Guarded

OWN_INVARIANTS = "INVARIANTS"
"""The name under which a policy's file keeps its own invariants, as text."""


def with_function(policy: Policy, change: Callable[[Guarded], Policy]) -> Policy:
    """The policy with another function in place of a user's, within its bound parameters and its shield.

    Args:
        policy: the policy; one of Sortie's own stays as it is.
        change: from the user's function to the other one.
    """
    found: Any = policy
    if isinstance(found, functools.partial):
        return functools.partial(with_function(found.func, change), *found.args, **found.keywords)
    if isinstance(found, Shielded):
        return Shielded(with_function(found.policy, change), found.rules)
    return change(found) if isinstance(found, Guarded) else policy


def function_of(policy: Policy) -> Any:
    """The policy without its bound parameters and its shield."""
    found: Any = policy
    while isinstance(found, functools.partial | Shielded):
        found = found.func if isinstance(found, functools.partial) else found.policy
    return found


def own_invariants(policy: Policy) -> object:
    """What a policy's file keeps under `INVARIANTS`, however the policy itself was made; empty text where there are none."""
    found = function_of(policy)
    return "" if not isinstance(found, Guarded) or found.source is None else found.source.names.get(OWN_INVARIANTS, "")


def constants_of(policy: Policy, rules: Sequence[Invariant] = ()) -> set[float]:
    """The numbers in a policy's file, among its parameters and in invariants, at which decisions may change."""
    found: list[object] = [n.value for rule in rules for n in rule.nodes if isinstance(n, Number)]
    bound: Any = policy
    while isinstance(bound, functools.partial | Shielded):
        found += bound.keywords.values() if isinstance(bound, functools.partial) else ()
        bound = bound.func if isinstance(bound, functools.partial) else bound.policy
    if isinstance(bound, Guarded) and bound.source is not None:
        found += [value for value in bound.source.names.values() if type(value) in (int, float)]
        path: Any = bound.source.file
    else:
        try:
            path = inspect.getsourcefile(inspect.unwrap(bound))
        except TypeError:  # an object that is called
            path = inspect.getsourcefile(type(bound))
    linecache.checkcache(str(path))  # it may have changed since
    with contextlib.suppress(SyntaxError):  # a policy that stands in a page, not in a Python file
        tree = ast.parse("".join(linecache.getlines(str(path))))  # of a notebook's cell too
        found += [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)]
    limits = [float(x) for x in found if type(x) in (int, float) and abs(x) < 1e300]  # type: ignore[arg-type]
    return {x for x in limits if math.isfinite(x)}
