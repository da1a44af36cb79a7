"""Calls of a user's code that end the program, never return, or change what they are given."""

from __future__ import annotations

import copy
import functools
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import late_calls
import pytest

from sortie.policies.contract import FleetView, PolicyError
from sortie.policies.registry import parameters, resolve, viewpoint_of
from sortie.policies.verification.conformance import conform, full_view
from sortie.scenarios.exit_codes import STUCK
from sortie.scenarios.plugins import user_calls
from sortie.scenarios.plugins.user_calls import (
    Guarded,
    ProgramExitError,
    TookTooLongError,
    _Interrupt,
    _Watch,
    guarded,
    text_of,
    watched,
)

POLICY = """
import os, re, sys, time
from os import _exit
from sortie.policies.contract import Directive, looks_from

def leaves(view):
    sys.exit(0)

def leaves_with_a_message(view):
    raise SystemExit("bye")

def quits(view):
    os._exit(0)

def quits_by_name(view):
    _exit(0)

def spins(view):
    while True:
        pass

def spins_again(view):
    while True:
        try:
            spins(view)
        except Exception:
            pass

class Spins:
    def __del__(self):
        spins(None)

class Text(str):
    def __str__(self):
        spins(None)

def spins_at_its_end(view):
    kept = Spins()
    return []

def spins_on_after_one_is_lost(view):
    Spins()
    spins(view)

def says_text(view):
    return Text("said")

def sleeps(view):
    time.sleep(1000)

def compiled(view):
    re.match("(a+)+$", "a" * 60 + "b")

def forks(view):
    os.fork()
    return []

def place(view):
    sys.exit(0)

@looks_from(place)
def looks(view, *, rho=0.5):
    return []
"""
ENDS = """
from sortie.scenarios.plugins import user_calls
from sortie.policies.registry import resolve
user_calls.GRACE_S = 0.3
user_calls.end_when_stuck()
policy = resolve("{path}:{name}")
with user_calls.watched(0.2, "0.2 s (limits.decision_s)"):
    policy(None)
print("went on")
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(POLICY)
    return path


@pytest.mark.parametrize(
    ("name", "code"), [("leaves", "0"), ("leaves_with_a_message", "bye"), ("quits", "0"), ("quits_by_name", "0")]
)
def test_a_policy_cannot_end_the_program(file: Path, name: str, code: str) -> None:
    with watched(600), pytest.raises(ProgramExitError, match=rf"^exit code {code}, must return$"):
        resolve(f"{file}:{name}")(full_view(2))


def test_a_viewpoint_cannot_either(file: Path) -> None:
    viewpoint = viewpoint_of(resolve(f"{file}:looks", {"rho": 0.1}))
    assert viewpoint is not None
    with pytest.raises(ProgramExitError, match=r"^exit code 0, must return$"):
        viewpoint(full_view(2))


@pytest.mark.parametrize("line", ["sys.exit(0)", "os._exit(0)"])
def test_a_file_cannot_as_it_loads(tmp_path: Path, line: str) -> None:
    (tmp_path / "mine.py").write_text(f"import os, sys\n{line}\n")
    told = r"mine\.py' does not load: ProgramExitError: exit code 0, must return \(mine\.py, line 2\)$"
    with pytest.raises(PolicyError, match=told):
        resolve(f"{tmp_path / 'mine.py'}:decide")


def test_a_process_that_a_policy_forks_ends_with_its_call(file: Path) -> None:
    """It does not go on with the command as a second one."""
    script = ENDS.format(path=file, name="forks")
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=600)
    assert done.stdout == "went on\n"


def test_what_is_not_a_users_call_may_end(file: Path) -> None:
    """In this process, and in one that a policy forks."""
    with watched(600):
        child = os.fork()
        if child == 0:
            os._exit(7)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
        with pytest.raises(SystemExit):
            sys.exit(0)


def test_the_guard_leaves_a_policy_as_it_is(file: Path) -> None:
    policy = resolve(f"{file}:looks", {"rho": 0.1})
    assert isinstance(policy, functools.partial)
    assert isinstance(policy.func, Guarded)
    assert parameters(policy.func) == {"rho": 0.5}
    assert guarded(policy.func) is policy.func
    assert policy(full_view(2)) == []


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Python drops what `__del__` raises
@pytest.mark.parametrize("name", ["spins", "spins_again", "spins_at_its_end", "spins_on_after_one_is_lost"])
def test_a_call_that_is_late_is_interrupted_and_not_made_again(file: Path, name: str) -> None:
    policy = resolve(f"{file}:{name}")
    with watched(0.15, "0.15 s"):
        for _ in range(2):
            with pytest.raises(TookTooLongError, match=r"^no answer within 0\.15 s$"):
                policy(full_view(2))
    assert resolve("worked")(full_view(2)), "nothing arrives later"


def test_an_interrupt_that_arrives_as_the_call_ends_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the next one strikes what runs afterwards, and later calls have no limit."""
    end, arrived = _Watch.end, []

    def interrupted(watch: _Watch) -> bool:
        if not arrived:
            arrived.append(watch)
            raise _Interrupt
        return end(watch)

    monkeypatch.setattr(_Watch, "end", interrupted)
    late_calls.by_hand(monkeypatch)
    with watched(0.15):
        with pytest.raises(TookTooLongError):
            guarded(int)()
        assert not arrived[0].calling
        for _ in range(round(user_calls.GRACE_S / user_calls.TICK_S)):
            late_calls.tick()
        with pytest.raises(TookTooLongError):
            guarded(late_calls.spin)()


def test_a_late_call_has_time_to_clean_up(monkeypatch: pytest.MonkeyPatch) -> None:
    late_calls.by_hand(monkeypatch)
    cleaned = []

    def spins() -> None:
        try:
            late_calls.spin()
        finally:
            for _ in range(round(user_calls.GRACE_S / 4 / user_calls.TICK_S)):
                late_calls.tick()
            cleaned.append(True)

    with watched(0.85), pytest.raises(TookTooLongError):
        guarded(spins)()
    assert cleaned


def test_a_users_object_as_text_ends_within_the_limit(file: Path) -> None:
    said = resolve(f"{file}:says_text")(full_view(2))
    with watched(0.15, "0.15 s"):
        assert text_of(said, str) == "a Text"
    with watched(600.0):
        assert text_of(said) == "'said'"
    assert type(text_of(said)) is str


def test_each_call_has_the_whole_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    late_calls.by_hand(monkeypatch)
    short = guarded(lambda: [late_calls.tick() for _ in range(5)])
    with watched(2.0):
        for _ in range(5):
            short()


@pytest.mark.parametrize("gone", [False, True])
def test_each_call_leaves_the_working_folder_as_it_was(
    gone: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one that removes the folder it moved to. Without a limit the block's end does it."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)

    def moves() -> None:
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir()
        os.chdir(elsewhere)
        if gone:
            elsewhere.rmdir()

    with watched(600.0):
        guarded(moves)()
        assert Path.cwd() == here
        os.chdir(tmp_path)  # as a call does that has no limit
    assert Path.cwd() == here


def test_calls_of_other_threads_go_on() -> None:
    done = []
    over = threading.Event()
    other = threading.Thread(target=lambda: done.append(not guarded(over.wait)()))

    def spins() -> None:
        while True:
            pass

    other.start()
    with watched(0.15), pytest.raises(TookTooLongError):
        guarded(spins)()
    over.set()
    other.join()
    assert done == [False]


@pytest.mark.parametrize(("name", "ended"), [("sleeps", STUCK), ("compiled", -signal.SIGXCPU)])
def test_a_call_that_cannot_be_interrupted_ends_the_process(file: Path, name: str, ended: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", ENDS.format(path=file, name=name)], capture_output=True, text=True, check=False
    )
    told = "error: a call of the policy does not return within 0.2 s (limits.decision_s), and cannot be interrupted\n"
    assert (done.returncode, done.stdout, done.stderr) == (ended, "", told)


def test_the_kit_goes_on(file: Path) -> None:
    with watched(0.15):
        checks = {c.name: c for c in conform(resolve(f"{file}:spins"), count=5)}
    assert not checks["returns directives"].holds
    assert re.search(r"TookTooLongError: no answer within 0\.15 s", checks["returns directives"].what)


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


@pytest.mark.parametrize("module", ["sortie.scenarios.plugins.user_calls", "sortie.not_there", None])
def test_an_exception_that_only_claims_to_be_sortie_s_own_ends_nothing(module: object) -> None:
    kind = type("_Interrupt2", (BaseException,), {"__module__": module})

    def decide(view: object) -> object:
        raise kind

    with pytest.raises(ProgramExitError, match=r"raises _Interrupt2, must return"):
        Guarded(decide)(None)
