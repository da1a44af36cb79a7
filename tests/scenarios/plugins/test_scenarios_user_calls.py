"""Calls of a user's code: they are what they were, and in a process of Sortie's own each has a limit of time."""

from __future__ import annotations

import copy
import functools
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sortie.policies.contract import FleetView, PolicyError
from sortie.policies.registry import parameters, resolve, viewpoint_of
from sortie.policies.verification.kit.conformance import full_view
from sortie.scenarios.plugins import user_calls
from sortie.scenarios.plugins.user_calls import Guarded, guarded, is_guarded

POLICY = """
from sortie.policies.contract import looks_from

def place(view):
    return None

@looks_from(place)
def looks(view, *, rho=0.5):
    return []
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(POLICY)
    return path


def test_a_file_that_leaves_as_it_loads_is_one_that_does_not_load(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("import sys\nsys.exit(0)\n")
    with pytest.raises(PolicyError, match=r"mine\.py' does not load: SystemExit: 0 \(mine\.py, line 2\)$"):
        resolve(f"{tmp_path / 'mine.py'}:decide")


def test_the_guard_leaves_a_policy_as_it_is(file: Path) -> None:
    policy = resolve(f"{file}:looks", {"rho": 0.1})
    assert isinstance(policy, functools.partial)
    assert isinstance(policy.func, Guarded)
    assert parameters(policy.func) == {"rho": 0.5}
    assert guarded(policy.func) is policy.func
    assert policy(full_view(2)) == []
    viewpoint = viewpoint_of(policy)
    assert viewpoint is not None
    assert is_guarded(viewpoint)


def test_only_where_calls_are_limited_each_has_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole of it, a call within a call none of its own, and after a call there is none."""
    asked: list[float] = []
    monkeypatch.setattr(user_calls.signal, "setitimer", lambda which, seconds: asked.append(seconds))
    inner = guarded(lambda: 1)
    outer = guarded(lambda: inner())

    def fails() -> None:
        raise KeyError

    outer()
    assert asked == []
    monkeypatch.setattr(user_calls, "_limit_s", 2.0)
    outer()
    with pytest.raises(KeyError):
        guarded(fails)()
    outer()
    assert asked == [2.0, 0.0, 2.0, 0.0, 2.0, 0.0]


# --- the view ------------------------------------------------------------------------------------


@pytest.mark.parametrize("copied", [copy.deepcopy, copy.copy, lambda view: pickle.loads(pickle.dumps(view))])  # noqa: S301
def test_a_frozen_view_is_copied_as_a_plain_one(copied: Callable[[FleetView], FleetView]) -> None:
    view = full_view(3).frozen
    other = copied(view)
    assert other == view == full_view(3)
    assert isinstance(other.age_s, dict)


def test_a_frozen_view_can_be_read_only() -> None:
    view: Any = full_view(3).frozen
    with pytest.raises(TypeError, match="does not support item assignment"):
        view.age_s[1] = 0.0
    with pytest.raises(TypeError, match="doesn't support item deletion"):
        del view.descriptors[1]
