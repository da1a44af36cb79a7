"""A policy that raises, hangs, dies or breaks its contract: the fallback takes over until it answers again."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import psutil
import pytest
from live_flights import refusal_of
from policies_examples import fleet_of
from sim_examples import example

from sortie.policies.contract import PolicyError, Representation
from sortie.sim.folders import RunError
from sortie.sim.live import watchdog
from sortie.sim.live.policy_process import Begin, Decision, PolicyOrders
from sortie.sim.live.watchdog import DETECTIONS, Fallback, Watchdog, parse_fallback

pytestmark = pytest.mark.slow

POLICY = """
import os, time
from pathlib import Path
from sortie.policies.contract import Directive, Representation

MODE = Path(__file__).with_name("mode")

def decide(view):
    mode = MODE.read_text() if MODE.exists() else ""
    if mode == "raise":
        raise RuntimeError("no more ideas")
    if mode == "break":
        return [Directive(view.ego, p, rho=2.0) for p in view.peers]
    if mode == "hang":
        while True:
            pass
    if mode == "slow":
        while MODE.read_text() == "slow":
            time.sleep(0.01)
    if mode == "die":
        MODE.unlink()
        os._exit(3)
    return [Directive(view.ego, p, Representation.FEATURES, 0.1, None, 10.0, reason="fine") for p in view.peers]
"""
VIEW = fleet_of(3)


class Watched(NamedTuple):
    """A watchdog over the policy above, the file that says what it does, and what was noted."""

    watchdog: Watchdog
    mode: Path
    notes: list[str]
    answers: list[Decision]

    def until(self, holds: Callable[[], bool]) -> None:
        """Ask for decisions until something holds."""
        while not holds():
            self.watchdog(VIEW)
            time.sleep(0.02)


@contextmanager
def loaded(folder: Path, policy: str = "", deadline_s: float = 600.0, begin_s: float = 0.0) -> Iterator[Watched]:
    """The policy above as `mine.py` of a folder, in a process that has loaded it."""
    (folder / "mine.py").write_text(POLICY)
    notes: list[str] = []
    orders = PolicyOrders(example(policy or f"policy={{name: '{folder}/mine.py:decide'}}"), 0)
    dog = Watchdog(orders, fallback=DETECTIONS, deadline_s=deadline_s)
    found = Watched(dog, folder / "mode", notes, [])
    try:
        dog.wait_until_loaded()
        dog.begin(Begin(begin_s, time.monotonic()), notes.append, found.answers.append)
        yield found
    finally:
        dog.close()


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[Watched]:
    """A policy that decides."""
    with loaded(tmp_path) as found:
        yield found


def rung(dog: Watchdog) -> Representation:
    """What it decides for every peer."""
    directives = dog(VIEW)
    assert [d.destination for d in directives] == [1, 2]
    (found,) = {(d.representation, d.rate_hz) for d in directives}
    assert found in ((Representation.FEATURES, 10.0), (Representation.DETECTIONS, 2.0))
    return found[0]


def test_a_policy_that_fails_is_replaced_for_each_failed_decision(watched: Watched) -> None:
    for mode, why in (("raise", "raises RuntimeError: no more ideas"), ("break", "rho is 2.0, must be in [0, 1]")):
        watched.notes.clear()
        watched.mode.write_text(mode)
        assert [rung(watched.watchdog) for _ in range(3)] == [Representation.DETECTIONS] * 3
        assert len(watched.notes) == 1
        assert watched.notes[0].startswith("fallback to detections at 2 Hz: ")
        assert why in watched.notes[0]
        watched.mode.write_text("")
        watched.until(lambda: len(watched.notes) == 2)
        assert "the policy decides again after " in watched.notes[1]
    assert watched.watchdog.restarts == 0


def test_a_policy_that_dies_gets_a_new_process(watched: Watched) -> None:
    before = watched.watchdog.pid
    watched.mode.write_text("die")
    assert rung(watched.watchdog) == Representation.DETECTIONS
    assert watched.notes == ["fallback to detections at 2 Hz: the policy's process ended with exit code 3"]
    watched.until(lambda: len(watched.notes) == 2)
    assert watched.watchdog.restarts == 1
    assert watched.watchdog.pid not in (before, None)
    assert rung(watched.watchdog) == Representation.FEATURES


def test_a_policy_that_hangs_delays_its_drone_once_and_is_killed(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched.watchdog._hangs_s = 0.3
    watched.watchdog._deadline_s = 0.1
    before = watched.watchdog.pid
    waits: list[float] = []
    pipe = watched.watchdog._pipe
    assert pipe is not None
    poll = pipe.poll
    monkeypatch.setattr(pipe, "poll", lambda timeout_s=0.0: waits.append(timeout_s) or poll(timeout_s))
    watched.mode.write_text("hang")
    assert rung(watched.watchdog) == Representation.DETECTIONS
    assert watched.notes == ["fallback to detections at 2 Hz: the policy did not answer within 0.1 s"]
    watched.until(lambda: watched.watchdog.pid is None)
    assert [w for w in waits if w] == [0.1]
    assert watched.notes[1].startswith("the policy's process was killed: no answer for ")
    assert before is not None
    with pytest.raises(ProcessLookupError):
        os.kill(before, 0)
    watched.watchdog._hangs_s = 600.0
    watched.watchdog._deadline_s = 600.0
    watched.mode.write_text("")
    watched.until(lambda: len(watched.notes) == 3)
    assert "decides again" in watched.notes[2]


def test_a_late_answer_is_dropped_and_the_policy_is_asked_again(watched: Watched) -> None:
    watched.watchdog._hangs_s = 600.0
    watched.mode.write_text("slow")
    before = watched.watchdog.pid
    watched.watchdog._deadline_s = 0.1
    assert rung(watched.watchdog) == Representation.DETECTIONS
    watched.watchdog._deadline_s = 600.0
    watched.mode.write_text("")
    watched.until(lambda: len(watched.notes) == 2)
    assert rung(watched.watchdog) == Representation.FEATURES
    assert (watched.watchdog.pid, watched.watchdog.restarts) == (before, 0)


def test_a_policy_that_cannot_be_loaded_is_an_error_before_the_flight() -> None:
    orders = PolicyOrders(example("policy={name: none-such}"), 0)
    dog = Watchdog(orders, fallback=DETECTIONS, deadline_s=0.1)
    with pytest.raises(PolicyError, match="none-such"):
        dog.wait_until_loaded()
    dog.close()


def test_the_fallback_is_a_safe_rung() -> None:
    assert parse_fallback("detections@2") == DETECTIONS
    assert parse_fallback("tracks@5") == Fallback(Representation.TRACKS, 5.0)
    assert parse_fallback("none") == Fallback(Representation.NONE, 0.0)
    for text in ("features@2", "detections", "detections@31", "tracks@x", "none@1", ""):
        with pytest.raises(RunError, match=r"must be none, detections@RATE or tracks@RATE with at most 30 Hz$"):
            parse_fallback(text)
    assert refusal_of("--fallback", "raw@10").startswith("fallback is 'raw@10', must be ")


def test_a_policy_that_hangs_ends_with_its_drone(tmp_path: Path) -> None:
    """The drone's process is killed, and can end nothing by itself."""
    drone = multiprocessing.get_context("spawn").Process(target=ask_for_ever, args=(tmp_path,))
    drone.start()
    while not (tmp_path / "pid").exists():
        assert drone.is_alive()
        time.sleep(0.02)
    policy = psutil.Process(int((tmp_path / "pid").read_text()))
    drone.kill()
    drone.join()
    policy.wait(600)


def ask_for_ever(folder: Path) -> None:
    """A drone's process, its policy hanging."""
    with loaded(folder, deadline_s=60) as watched:
        watched.mode.write_text("hang")
        (folder / "part").write_text(str(watched.watchdog.pid))
        (folder / "part").rename(folder / "pid")
        watched.watchdog(VIEW)


def test_events_of_answers_that_are_not_used_are_kept(tmp_path: Path) -> None:
    """A change of policy was never told where the new policy failed, or answered late."""
    (tmp_path / "mode").write_text("raise")
    policy = f"policy={{name: silence, changes: [{{at_s: 0, name: '{tmp_path}/mine.py:decide'}}]}}"
    with loaded(tmp_path, policy, deadline_s=0.1, begin_s=1.0) as watched:
        watched.until(lambda: bool(watched.answers))
        assert [n.text for a in watched.answers for n in a.notices if "mine.py" in n.text]
        assert {a.elapsed_ns for a in watched.answers} == {0}


def test_a_new_process_that_does_not_load_is_killed_and_started_again(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its drone waited for it for ever."""
    (watched.mode.parent / "mine.py").write_text("import time\ntime.sleep(3600)\n")
    watched.mode.write_text("die")
    monkeypatch.setattr(watchdog, "LOAD_S", 0.5)
    rung(watched.watchdog)
    watched.until(lambda: watched.watchdog.restarts == 2)
    assert "the policy's process was killed: it did not load within 0.5 s" in watched.notes


def test_a_new_process_says_why_it_cannot_load(watched: Watched) -> None:
    (watched.mode.parent / "mine.py").write_text("decide = 3 +\n")
    watched.mode.write_text("die")
    rung(watched.watchdog)
    watched.until(lambda: any("mine.py" in d.reason for d in watched.watchdog(VIEW)))
