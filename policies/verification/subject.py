"""A policy as verification needs it: the plain one, one that runs on stand-ins with checks, and its own invariants."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from sortie.policies.contract import Policy, PolicyError
from sortie.policies.verification.instrument import instrumented
from sortie.policies.verification.notes import load_with_notes
from sortie.policies.verification.shield import Shielded
from sortie.scenarios.plugins.reference import describe_error
from sortie.scenarios.plugins.user_calls import Guarded, Source, guarded

OWN_INVARIANTS = "INVARIANTS"
"""The name under which a policy's file keeps its own invariants, as text."""
NO_FILE = "is not a policy of Sortie's nor a function in a file that was named as file.py:function"


def searchable(policy: Policy) -> tuple[Policy, str]:
    """The policy that runs on stand-ins, and why a search of it cannot prove anything (empty: it can).

    Raises:
        Reached: loading its file used something that is not in a view.
        Refused: its file cannot be checked.
    """
    found: Any = policy
    if isinstance(found, functools.partial):
        inner, why = searchable(found.func)
        return functools.partial(inner, *found.args, **found.keywords), why
    if isinstance(found, Guarded):
        return (policy, NO_FILE) if found.source is None else (_with_checks(found.source), "")
    if isinstance(found, Shielded):
        inner, why = searchable(found.policy)
        return Shielded(inner, found.rules), why
    return policy, "" if _is_sorties(found) else NO_FILE


def with_notes(policy: Policy) -> Policy:
    """The policy as it is, with notes of what the code in its file computes.

    Raises:
        Exception: what its file raises.
    """

    def noted(function: Guarded) -> Policy:
        if function.source is None:
            return function
        loaded = getattr(load_with_notes(function.source.file), function.source.name)
        return Guarded(loaded, function.source)

    return with_function(policy, noted)


def apart(policy: Policy) -> Policy:
    """The policy with a limit of time of its own: where it is late, the policy itself does not count as late."""
    return Guarded(with_function(policy, lambda function: function.__wrapped__))


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


def _with_checks(source: Source) -> Policy:
    found: Policy = Guarded(instrumented(source.file, source.name), source)
    return found


def own_invariants(policy: Policy) -> object:
    """What a policy's file keeps under `INVARIANTS`, however the policy itself was made; empty text where there are none.

    Raises:
        PolicyError: the file is asked for them, and fails.
    """
    found: Any = policy
    while isinstance(found, functools.partial):
        found = found.func
    if not isinstance(found, Guarded) or found.source is None:
        return ""
    names = found.source.names
    if OWN_INVARIANTS in names or "__getattr__" not in names:
        return names.get(OWN_INVARIANTS, "")
    try:
        return guarded(names["__getattr__"])(OWN_INVARIANTS)  # type: ignore[arg-type]  # as Python asks a module for any name
    except AttributeError:
        return ""
    except Exception as error:
        raise PolicyError(
            f"{found.source.file}: __getattr__({OWN_INVARIANTS!r}) raises {describe_error(error)}"
        ) from error


def _is_sorties(function: Callable[..., Any]) -> bool:
    """Whether a function, and all that it wraps, is at home in Sortie's policies."""
    found: Any = function
    while found is not None:
        space = getattr(found, "__globals__", {})
        if not str(space.get("__name__")).startswith("sortie.policies."):
            return False
        found = getattr(found, "__wrapped__", None)
    return True
