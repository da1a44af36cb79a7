"""Policies that choose among attached peers alone."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import TypeVar

from sortie.policies.contract import Directive, FleetView, nothing_to_all

Decide = TypeVar("Decide", bound=Callable[..., Sequence[Directive]])
DETACHED = "detached: not heard any more"


def among_attached(policy: Decide) -> Decide:
    """Show a policy the attached part of its view; peers that are detached get nothing, and nobody waits for them.

    A drone that is gone so gives its place, among the two best peers for example, to the next one. The policy may be
    stacked on others that do the same: a view without detached peers is handed on as it is.
    """

    @functools.wraps(policy)
    def decide(view: FleetView, **params: object) -> Sequence[Directive]:
        attached = view.attached
        directives = policy(attached, **params)
        if attached is view or attached.me is None:
            return directives
        duty = directives[0].duty_percent if directives else 100
        away = [p for p in view.peers if p not in attached.descriptors]
        gone = nothing_to_all(view.ego, tuple(away), DETACHED)
        return [*directives, *(gone if duty == 100 else [d._replace(duty_percent=duty) for d in gone])]

    decide.__signature__ = inspect.signature(policy)  # type: ignore[attr-defined]
    return decide  # type: ignore[return-value]
