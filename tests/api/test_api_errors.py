"""A wrong argument of the public API is one line that says what is allowed, and it leaves nothing behind."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sortie

SHORT = {"duration_s": 1, "perception.detector": "none", "expect": [], "expect_decisions": []}
SURROGATE = SHORT | {"perception.detector": "surrogate"}
HOLDS_ITSELF: dict[str, object] = {"name": "a"}
HOLDS_ITSELF["fleet"] = HOLDS_ITSELF
SHORT_TEXTS = ["duration_s=1", "perception.detector=none", "expect=[]"]
Rows = list[tuple[Callable[[], object], str]]


@functools.cache
def flown() -> Any:
    return sortie.fly("track_target", SHORT)


SCENARIO: Rows = [
    (lambda: sortie.fly("nonsense"), "nonsense: no such file, the library has "),
    (lambda: sortie.load("track_targt"), "did you mean track_target?"),
    (lambda: sortie.load(None), "scenario: None, must be a name, a path, a dict or a Scenario"),
    (
        lambda: sortie.load({"name": "a", "fleet": {"dornes": 3}}),
        "scenario: fleet.dornes: unknown key, did you mean drones?",
    ),
    (lambda: sortie.load({3: 4}), "the key 3 is no text"),
    (lambda: sortie.load({"name": "a", "duration_s": float("nan")}), "scenario: duration_s: nan, must"),
    (lambda: sortie.load("track_target", {"fleet.drones": object}), "overrides: fleet.drones: <class 'object'>, must"),
    (lambda: sortie.load("track_target", {"fleet.drones": "x"}), "overrides: fleet.drones: x, must"),
    (lambda: sortie.load("track_target", "fleet.drones=3"), "overrides: 'fleet.drones=3', must"),
    (lambda: sortie.load("track_target", 3), "overrides: 3, must be a map or a list"),
    (lambda: sortie.load("track_target", {"": 3}), "overrides: '' is no field, must be key.path"),
    (lambda: sortie.fly("track_target", seed=-1), "seed: -1, must be a whole number from 0 to 2^63 - 1"),
    (lambda: sortie.fly("track_target", replication=1.5), "replication: 1.5, must be a whole number"),
    (lambda: sortie.compare("track_target", ["worked"], seeds=[1, 1]), "seeds: [1, 1], must"),
    (lambda: sortie.load("track_target", [("fleet.drones", 3)]), "overrides: [('fleet.drones', 3)], must"),
    (lambda: sortie.fly("track_target", SHORT, progress=5), "progress: 5, must be a function, or None"),
    (lambda: sortie.fly("track_target", SHORT, observer=print), "must have the methods begin and second"),
    (lambda: sortie.fly("track_target", replication=2**32), "replication: 4294967296, must"),
    (lambda: sortie.check("track_target", "duration_s=1"), "overrides: 'duration_s=1', must be a map or a list"),
    (lambda: sortie.compare("track_target", ["worked"], seeds=0), "seeds: 0, must"),
    (lambda: sortie.compare("track_target", ["worked"], seeds=1.5), "seeds: 1.5, must"),
    (lambda: sortie.campaign("nope"), "nope: no such file, the library has link_battery"),
    (lambda: sortie.campaign("link_batery"), "did you mean link_battery?"),
    (lambda: sortie.load(HOLDS_ITSELF), "21 levels deep, must be at most 20"),
    (lambda: sortie.load("track_target", {"fleet": HOLDS_ITSELF}), "21 levels deep, must be at most 20"),
    (lambda: sortie.check("track_target", SHORT_TEXTS, progress=5), "progress: 5, must be a function, or None"),
    (lambda: sortie.env("track_target", SURROGATE).reset(seed=-1), "seed: -1, must"),
    (lambda: sortie.env("track_target", SURROGATE, team=True).reset(seed=-1), "seed: -1, must"),
    (lambda: sortie.env("track_target", SURROGATE).reset(seed=np.array([1, 2])), "seed: array([1, 2]), must"),
    (lambda: sortie.fly("track_target", seed=np.array([1, 2])), "seed: array([1, 2]), must"),
    (lambda: sortie.check("nope"), "nope: no such file"),
]
POLICY: Rows = [
    (lambda: sortie.fly("track_target", policy=42), "policy: 42, must"),
    (lambda: sortie.fly("track_target", policy=lambda: []), "policy '<lambda>': too many positional arguments, must"),
    (lambda: sortie.fly("track_target", policy="nope"), "unknown policy 'nope', known: worked, "),
    (lambda: sortie.fly("track_target", SHORT, policy=lambda view: 5), "returns int, must"),
    (lambda: sortie.fly("track_target", policy="al-4"), "unknown policy 'al-4', did you mean all-4? known: worked, "),
    (
        lambda: sortie.fly("track_target", SHORT, policy=lambda view: sortie.Directive(view.ego, 1)),
        "returns Directive, must",
    ),
    (
        lambda: sortie.fly("track_target", SHORT, policy=lambda view: 1 / 0),
        "raises ZeroDivisionError: division by zero",
    ),
    (lambda: sortie.compare("track_target", "worked"), "policies: 'worked', must"),
    (lambda: sortie.compare("track_target", ["worked", "worked"]), "policies: worked, worked, must"),
    (
        lambda: sortie.compare("track_target", [lambda view: [], lambda view: []]),
        "give functions of one name, such as lambdas, a __name__ of their own",
    ),
]
RUN: Rows = [
    (lambda: flown().save(3), "path: 3, must be a path"),
    (
        lambda: sortie.compare("track_target", ["worked"], seeds=3, half_width=0.1),
        "seeds and half_width: name one of them",
    ),
    (lambda: sortie.compare("track_target", ["worked"], half_width="1"), "half_width: '1', must"),
    (lambda: sortie.compare("track_target", ["worked"], pilot=8), "pilot: goes with half_width, which is missing"),
    (
        lambda: sortie.compare("track_target", ["worked"], metric="ap50.mission"),
        "metric: goes with half_width, which is missing",
    ),
    (lambda: sortie.compare("track_target", ["worked"], half_width=0.1, metric="ap"), "metric: ap, must"),
    (lambda: sortie.open_run("nowhere"), "nowhere: no run there (outcome.json is missing)"),
    (lambda: sortie.open_run(7), "path: 7, must be a path"),
    (lambda: sortie.campaign("link_battery", workers=-1), "workers: -1, must be a whole number from 0 on, or None"),
    (lambda: sortie.campaign("link_battery", worker_memory_gb="x"), "worker_memory_gb: 'x', must"),
    (lambda: sortie.campaign("link_battery", scheduler=5), "scheduler: 5, must be an address: 'tcp://host:8786'"),
    (lambda: sortie.campaign("link_battery", security=5), "security: 5, must be three paths: CA, certificate, key"),
    (lambda: sortie.env({"name": "a", "fleet": {"drones": 1}}), "fleet.drones is 1, must be at least 2 to share"),
]
METRIC: Rows = [
    (
        lambda: flown().metrics["bytes.data_snt"],
        "bytes.data_snt: this run has no such metric, did you mean bytes.data_sent?",
    ),
    (lambda: flown().metrics["§"], "§: this run has no such metric, `sorted(run.metrics)` lists the names"),
]


@pytest.mark.parametrize(
    ("kind", "rows"),
    [
        (sortie.ScenarioError, SCENARIO),
        (sortie.PolicyError, POLICY),
        (sortie.RunError, RUN),
        (sortie.SortieError, METRIC),
    ],
    ids=["scenario", "policy", "run", "metric"],
)
def test_a_wrong_argument_is_one_line_that_says_what_is_allowed(
    kind: type[sortie.SortieError], rows: Rows, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    wrong = []
    for call, words in rows:
        try:
            call()
        except kind as error:
            if words not in str(error) or "\n" in str(error):
                wrong.append((words, str(error)))
        else:
            wrong.append((words, "no error"))
    assert wrong == []
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_metric_is_a_key_error_too() -> None:
    with pytest.raises(KeyError):
        flown().metrics["§"]
