"""A flight with limits flies in a process of its own: the same record, heard as it flies, ended at its limits."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from sim_examples import example

from sortie.policies.contract import FleetView, PolicyError
from sortie.scenarios.errors import SortieError
from sortie.scenarios.schema import Limits
from sortie.sim import apart
from sortie.sim.apart import DiedError, LimitError, Said, call_within
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError

POLICY = """
import hashlib, os
from sortie import Directive

def silent(view):
    return [Directive(view.ego, p, reason="silent") for p in view.peers]

def deaf(view):
    while True:
        try:
            hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)
        except BaseException:
            pass

def dies(view):
    os._exit(3)

def raises(view):
    return 1 / 0
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(POLICY)
    return path


class Heard:
    """An observer that keeps what it got."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.rows: dict[float, int] = {}

    def begin(self, scenario: Any, scene: Any) -> None:
        self.begun.append(f"{scenario.name} {type(scene).__name__}")

    def second(self, t_s: float, new: dict[str, pa.Table]) -> None:
        self.rows[t_s] = sum(map(len, new.values()))


def test_a_flight_with_limits_is_the_same_flight(file: Path) -> None:
    records, seen, times = [], [Heard(), Heard()], list[float]()
    for observer, limits in zip(seen, ([], ["limits={run_s: 600, decision_s: 60}"]), strict=True):
        scenario = example("duration_s=2", *limits)
        records.append(run_sortie(scenario, f"{file}:silent", progress=times.append, observer=observer))
    assert records[0].fingerprint == records[1].fingerprint
    assert records[0].own_files == records[1].own_files
    assert times == [0.0, 1.0, 2.0] * 2
    assert seen[0].begun == seen[1].begun == ["example SceneModel"]
    assert seen[0].rows == seen[1].rows


ENDS: list[tuple[str, str, type[SortieError], str]] = [
    ("deaf", "decision_s=0.5", LimitError, r": no answer within 0\.5 s \(limits\.decision_s\) \(mine\.py, line 11\)$"),
    ("deaf", "run_s=0.5", LimitError, r": the flight takes longer than 0\.5 s \(limits\.run_s\)$"),
    ("dies", "run_s=600", DiedError, r": the flight's process ended with exit code 3$"),
]
"""Policy, limit, and the error after `example, seed 1`."""


def test_what_ends_a_flight_with_limits_is_one_line(file: Path) -> None:
    for policy, limit, error, words in ENDS:
        with pytest.raises(error, match=f"^example, seed 1{words}"):
            run_sortie(example(f"limits.{limit}"), f"{file}:{policy}", seed=1)
    words = r":raises' on drone \d raises ZeroDivisionError: division by zero \(mine\.py, line 19\)$"
    with pytest.raises(PolicyError, match=words):
        run_sortie(example("limits.run_s=600"), f"{file}:raises", seed=1)


def test_a_function_that_no_other_process_can_get_is_refused() -> None:
    def mine(view: FleetView) -> list[Any]:
        return []

    words = (
        r"^limits are set, so the flight has a process of its own, .*; name a policy by its file, as mine\.py:decide"
    )
    with pytest.raises(RunError, match=words):
        run_sortie(example("limits.run_s=600"), mine)


def _tell_and_wait(tell: Callable[[str], None]) -> None:
    tell("here")
    time.sleep(600)


def test_who_stops_waiting_ends_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """As Ctrl-C does."""
    started: list[subprocess.Popen[bytes]] = []

    class Noted(apart.Apart):
        def __init__(self) -> None:
            super().__init__()
            started.append(self._process)

    def interrupted(word: str) -> None:
        raise KeyboardInterrupt(word)

    monkeypatch.setattr(apart, "Apart", Noted)
    with pytest.raises(KeyboardInterrupt, match="here"):
        call_within(Limits(run_s=600), "it", partial(_tell_and_wait, Said("told")), {"told": interrupted})
    assert started[0].returncode == -9
