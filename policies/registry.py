"""The registered policies, and `resolve`: from a policy's name in a scenario to its function."""

from __future__ import annotations

import functools
import math
import numbers
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from sortie.policies.catalogue import adaptive, baselines, other_representations
from sortie.policies.catalogue.deputies import deputies
from sortie.policies.catalogue.prior import METHODS, STAND_IN
from sortie.policies.catalogue.vantage import vantage
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Directive, Policy, PolicyError, Viewpoint
from sortie.scenarios.plugins import reference
from sortie.scenarios.plugins.reference import describe_error, parameters
from sortie.scenarios.plugins.user_calls import Guarded, guarded

__all__ = ["POLICIES", "describe_error", "parameters", "resolve"]

POLICIES: Mapping[str, Callable[..., Sequence[Directive]]] = MappingProxyType(
    {
        "worked": worked,
        "all-4": baselines.everyone,
        "best-2": baselines.best_k,
        "worst-2": baselines.worst_k,
        "random-2": baselines.random_k,
        "best-2-receivers": baselines.best_k_receivers,
        "worst-2-receivers": baselines.worst_k_receivers,
        "random-2-receivers": baselines.random_k_receivers,
        "silence": baselines.silence,
        "boxes": adaptive.boxes,
        "uncertain-boxes": other_representations.uncertain_boxes,
        "codes": other_representations.codes,
        "deputies": deputies,
        "adaptive": adaptive.adaptive,
        "learned": adaptive.learned,
        "vantage": vantage,
        **{name: method.policy for name, method in METHODS.items()},
    }
)
"""One line for each policy. Its keyword-only arguments are its parameters."""


class Bound(NamedTuple):
    """The allowed values of a parameter, and the text for its error message."""

    text: str
    low: float = -math.inf
    high: float = math.inf
    whole: bool = False

    def holds(self, value: object) -> bool:
        kind: Any = numbers.Integral if self.whole else numbers.Real
        return isinstance(value, kind) and not isinstance(value, bool) and self.low <= value <= self.high  # NaN is not


BOUNDS: dict[str, Bound] = {
    "rho": Bound("a number in [0, 1]", 0, 1),
    "received_budget": Bound("a number in [0, 1]", 0, 1),
    "sent_budget": Bound("a number in [0, 1]", 0, 1),
    "k": Bound("a whole number from 0 on", 0, whole=True),
    "salt": Bound("a whole number", whole=True),
    "rounds": Bound("a whole number from 1 on", 1, whole=True),
    "threshold": Bound("a number in [0, 1]", 0, 1),
    "sharpness": Bound("a number in [0, 100]", 0, 100),  # e to the power of some 700 is no float any more
    "trusted_for_s": Bound("a number in [0.001, 3600]", 0.001, 3600),
}
"""The bounds of the registered policies' parameters, by name. A policy checks all other parameters itself, and so does a
user's file."""


def resolve(name: str, params: Mapping[str, object] | None = None) -> Policy:
    """A registered policy, an installed one, or `path/to/file.py:function`, with its parameters bound.

    Raises:
        PolicyError: unknown name or parameter, a parameter out of its bounds, missing file or function.
    """
    if name not in POLICIES and (stand_in := METHODS.get(name + STAND_IN)) is not None:
        raise PolicyError(
            f"policy {name!r} is here as a stand-in alone, name it {stand_in.name}; it lacks {stand_in.missing}"
        )
    found = reference.resolve("policy", name, params, POLICIES, PolicyError)
    for key, value in (params or {}).items():
        limit = BOUNDS.get(key) if name in POLICIES else None
        if limit is not None and not limit.holds(value):
            raise PolicyError(f"{name}: {key} is {value!r}, must be {limit.text}")
    return found


def handshake_bytes(name: str, params: Mapping[str, object] | None = None) -> int:
    """Bytes that a drone under this policy sends to each peer in each frame before any payload; 0 without a handshake."""
    method = METHODS.get(name)
    return 0 if method is None else method.handshake_bytes(params or {})


def missing_parts(name: str) -> str:
    """What a published method has and its stand-in under this name lacks; empty for every other policy."""
    method = METHODS.get(name)
    return "" if method is None else method.missing


def own_fusion(name: str) -> str | None:
    """The fusion with which a prior method was published (a value of `perception.fusion`), or None."""
    method = METHODS.get(name)
    return None if method is None else method.fusion


def viewpoint_of(policy: Policy) -> Viewpoint | None:
    """The function by which a policy chooses where to look from, with its parameters bound; None if it has none."""
    bound = policy.keywords if isinstance(policy, functools.partial) else {}
    function = policy.func if isinstance(policy, functools.partial) else policy
    found = getattr(function, "viewpoint", None)
    if found is not None and isinstance(function, Guarded):
        found = guarded(found)
    shared = {k: v for k, v in bound.items() if k in parameters(found)} if found is not None else {}
    return functools.partial(found, **shared) if found is not None and shared else found


def within_budget(policy: Callable[..., object], budget: float) -> dict[str, float]:
    """The parameter that keeps a policy within a budget, whichever of the three it has; none if it has none of them.

    Args:
        policy: a policy, or a partial of one.
        budget: feature cells of the fleet, as a share of full sharing. It is what each ego receives, or each drone sends;
            with `rho` it is an upper limit, since every link carries that share of a map.
    """
    known = parameters(policy)
    return {name: budget for name in ("received_budget", "sent_budget", "rho") if name in known}
