"""The table of policies, and the way from a name in a scenario to a callable."""

from __future__ import annotations

import functools
import importlib.util
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from policies import adaptive, baselines
from policies.contract import Directive, FleetView, Policy, PolicyError, Viewpoint
from policies.deputies import deputies
from policies.prior import METHODS
from policies.vantage import vantage
from policies.worked import worked

POLICIES: dict[str, Callable[..., Sequence[Directive]]] = {
    "worked": worked,
    "all-4": baselines.everyone,
    "best-2": baselines.best_k,
    "worst-2": baselines.worst_k,
    "random-2": baselines.random_k,
    "silence": baselines.silence,
    "boxes": adaptive.boxes,
    "deputies": deputies,
    "adaptive": adaptive.adaptive,
    "learned": adaptive.learned,
    "vantage": vantage,
    **{name: method.policy for name, method in METHODS.items()},
}
"""One line a policy. Keyword-only arguments are its parameters."""


def resolve(name: str, params: Mapping[str, object] | None = None) -> Policy:
    """A registered policy, or `path/to/file.py:function`, with its parameters bound.

    Raises:
        PolicyError: unknown name or parameter, missing file or function.
    """
    function = _from_file(name) if ":" in name else POLICIES.get(name)
    if function is None:
        raise PolicyError(f"unknown policy {name!r}, known: {', '.join(POLICIES)}, or path/to/file.py:function")
    known = parameters(function)
    for key in params or {}:
        if key not in known:
            raise PolicyError(f"policy {name!r} has no parameter {key!r}, it has: {', '.join(known) or 'none'}")
    return functools.partial(function, **params) if params else function


def handshake_bytes(name: str, params: Mapping[str, object] | None = None) -> int:
    """What a drone under this policy sends to each peer and frame before any payload; 0 where it asks for nothing."""
    method = METHODS.get(name)
    return 0 if method is None else method.handshake_bytes(params or {})


def own_fusion(name: str) -> str | None:
    """The fusion that a prior method was published with, a value of `perception.fusion`; None where it has none."""
    method = METHODS.get(name)
    return None if method is None else method.fusion


def viewpoint_of(policy: Policy) -> Viewpoint | None:
    """The function by which a policy chooses where to look from, its parameters bound; None where it has none."""
    bound = policy.keywords if isinstance(policy, functools.partial) else {}
    found = getattr(policy.func if isinstance(policy, functools.partial) else policy, "viewpoint", None)
    shared = {k: v for k, v in bound.items() if k in parameters(found)} if found is not None else {}
    return functools.partial(found, **shared) if found is not None and shared else found


def parameters(function: Callable[..., object]) -> dict[str, object]:
    """The policy's keyword-only parameters and their defaults."""
    signature = inspect.signature(function)
    return {p.name: p.default for p in signature.parameters.values() if p.kind is p.KEYWORD_ONLY}


def _from_file(reference: str) -> Callable[[FleetView], Sequence[Directive]]:
    file, _, attribute = reference.rpartition(":")
    path = Path(file)
    if not path.is_file():
        raise PolicyError(f"policy file {file!r} not found")
    spec = importlib.util.spec_from_file_location(f"sortie_policy_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise PolicyError(f"policy file {file!r} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise PolicyError(f"policy file {file!r} does not load: {type(error).__name__}: {error}") from error
    function = getattr(module, attribute, None)
    if not callable(function):
        raise PolicyError(f"policy file {file!r} has no function {attribute!r}")
    return function  # type: ignore[no-any-return]
