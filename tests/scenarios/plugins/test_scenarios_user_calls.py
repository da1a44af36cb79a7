"""Calls of a user's code that end the program, never return, or change what they are given."""

from __future__ import annotations

import copy
import functools
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sortie.policies.contract import FleetView, PolicyError
from sortie.policies.registry import parameters, resolve, viewpoint_of
from sortie.policies.verification.kit.conformance import conform, full_view
from sortie.scenarios.plugins import user_calls
from sortie.scenarios.plugins.user_calls import (
    Guarded,
    ProgramExitError,
    TookTooLongError,
    guarded,
    text_of,
    watched,
)

POLICY = """
import hashlib, sys, time
from sortie.policies.contract import Directive, looks_from

def leaves(view):
    sys.exit(0)

def leaves_with_a_message(view):
    raise SystemExit("bye")

def spins(view):
    while True:
        pass

def spins_again(view):
    while True:
        try:
            spins(view)
        except Exception:
            pass

def sleeps(view):
    time.sleep(1000)

class Text(str):
    def __str__(self):
        spins(None)

def says_text(view):
    return Text("said")

def compiled(view):
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)

def place(view):
    sys.exit(0)

@looks_from(place)
def looks(view, *, rho=0.5):
    return []
"""
ENDS = """
from sortie.policies.registry import resolve
from sortie.scenarios.plugins import user_calls
user_calls.GRACE_S = 0.1
user_calls.limit_calls()
policy = resolve("{path}:compiled")
with user_calls.watched(0.2):
    policy(None)
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(POLICY)
    return path


@pytest.mark.parametrize(("name", "code"), [("leaves", "0"), ("leaves_with_a_message", "bye")])
def test_a_policy_that_leaves_is_an_error_of_its_call(file: Path, name: str, code: str) -> None:
    with pytest.raises(ProgramExitError, match=rf"^exit code {code}, must return$"):
        resolve(f"{file}:{name}")(full_view(2))


def test_so_is_a_viewpoint(file: Path) -> None:
    viewpoint = viewpoint_of(resolve(f"{file}:looks", {"rho": 0.1}))
    assert viewpoint is not None
    with pytest.raises(ProgramExitError, match=r"^exit code 0, must return$"):
        viewpoint(full_view(2))


def test_so_is_a_file_as_it_loads(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("import sys\nsys.exit(0)\n")
    told = r"mine\.py' does not load: ProgramExitError: exit code 0, must return \(mine\.py, line 2\)$"
    with pytest.raises(PolicyError, match=told):
        resolve(f"{tmp_path / 'mine.py'}:decide")


def test_the_guard_leaves_a_policy_as_it_is(file: Path) -> None:
    policy = resolve(f"{file}:looks", {"rho": 0.1})
    assert isinstance(policy, functools.partial)
    assert isinstance(policy.func, Guarded)
    assert parameters(policy.func) == {"rho": 0.5}
    assert guarded(policy.func) is policy.func
    assert policy(full_view(2)) == []


# --- limits --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["spins", "spins_again", "sleeps"])
def test_a_call_that_is_late_is_interrupted_and_not_made_again(file: Path, name: str) -> None:
    policy = resolve(f"{file}:{name}")
    with watched(0.15, "0.15 s", always=True):
        for _ in range(2):
            with pytest.raises(TookTooLongError, match=r"^no answer within 0\.15 s$"):
                policy(full_view(2))
    assert resolve("worked")(full_view(2)), "nothing arrives later"


def test_a_call_has_the_limit_that_its_block_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each call the whole of it, a call within a call none of its own, and after a call there is none."""
    asked: list[float] = []
    monkeypatch.setattr(user_calls, "_own_process", False)
    monkeypatch.setattr(user_calls.signal, "setitimer", lambda which, seconds: asked.append(seconds))
    inner = guarded(lambda: 1)
    outer = guarded(lambda: inner())
    with watched(2.0, always=True):
        outer()
        with watched(3.0, always=True):
            outer()
        outer()
    outer()
    assert asked == [2.0, 0.0, 3.0, 0.0, 2.0, 0.0]


@pytest.fixture
def somebodys_alarm() -> Iterator[None]:
    before = signal.signal(signal.SIGALRM, lambda number, frame: None)
    yield
    signal.signal(signal.SIGALRM, before)


def test_an_alarm_of_somebody_else_is_left_alone(somebodys_alarm: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(user_calls.signal, "setitimer", lambda which, seconds: pytest.fail("the alarm is taken"))
    with watched(2.0, always=True):
        assert guarded(lambda: 1)() == 1


def test_without_a_wish_only_a_process_of_sorties_own_has_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, float]] = []
    monkeypatch.setattr(user_calls, "_own_process", False)
    monkeypatch.setattr(user_calls.signal, "setitimer", lambda which, seconds: asked.append((which, seconds)))
    with watched(2.0):
        guarded(lambda: 1)()
    assert asked == []
    monkeypatch.setattr(user_calls, "_own_process", True)
    monkeypatch.setattr(user_calls.os, "cpu_count", lambda: 4)
    with watched(2.0):
        guarded(lambda: 1)()
    killed_s = 4 * (2.0 + user_calls.GRACE_S)
    real, virtual = signal.ITIMER_REAL, signal.ITIMER_VIRTUAL
    assert asked == [(real, 2.0), (virtual, killed_s), (real, 0.0), (virtual, 0.0)]


def test_calls_of_other_threads_go_on() -> None:
    done = []
    over = threading.Event()
    other = threading.Thread(target=lambda: done.append(not guarded(over.wait)()))

    def spins() -> None:
        while True:
            pass

    other.start()
    with watched(0.15, always=True), pytest.raises(TookTooLongError):
        guarded(spins)()
    over.set()
    other.join()
    assert done == [False]


def test_compiled_code_that_does_not_return_is_killed_with_its_place(file: Path) -> None:
    done = subprocess.run([sys.executable, "-c", ENDS.format(path=file)], capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGVTALRM
    assert f'File "{file}", line 33 in compiled' in done.stderr


def test_a_block_leaves_the_working_folder_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = Path.cwd()
    with watched(600.0, always=True):
        guarded(monkeypatch.chdir)(tmp_path)
    assert Path.cwd() == here


def test_a_users_object_as_text_ends_within_the_limit(file: Path) -> None:
    said = resolve(f"{file}:says_text")(full_view(2))
    with watched(0.15, "0.15 s", always=True):
        assert text_of(said, str) == "a Text"
    assert text_of(said) == "'said'"
    assert type(text_of(said)) is str


def test_the_kit_goes_on(file: Path) -> None:
    with watched(0.15, always=True):
        checks = {c.name: c for c in conform(resolve(f"{file}:spins"), count=5)}
    assert not checks["returns directives"].holds
    assert "TookTooLongError: no answer within 0.15 s" in checks["returns directives"].what


def test_an_error_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("raise ValueError('\\ud800')\n")
    with pytest.raises(PolicyError, match=r"does not load: ValueError: \\ud800 \(mine\.py, line 1\)$") as caught:
        resolve(f"{tmp_path / 'mine.py'}:decide")
    assert str(caught.value).encode()


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
