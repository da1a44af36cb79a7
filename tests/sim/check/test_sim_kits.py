"""Conformance kits of models from outside: sound models pass, and each rule fails for a model that breaks it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from cli_examples import command
from places import ROOT

from sortie.scenarios.plugins.reference import PluginError
from sortie.sim.check.kits import KITS, verify
from sortie.sim.check.model_rules import plain

BROKEN = """
import numpy as np

def loss(d):
    d += 0.0  # it may change what it is given, which is a copy
    return 80 + 20 * np.log10(np.maximum(d, 1.0))

def random(d, a, b, ghz):
    return loss(d) + np.random.random(np.shape(d))

calls = []

def counts(d, a, b, ghz):
    calls.append(1)
    return loss(d) + len(calls)

def tallest(d, a, b, ghz):
    return loss(d) + np.max(a, initial=0.0) + np.max(b, initial=0.0)

def downhill(d, a, b, ghz):
    return loss(d) + 0.1 * a

def near(d, a, b, ghz):
    return 80 + 20 * np.log10(d + 1e-9)

class Shared:
    offset = [0.0]
    def __init__(self, drones, frame_s, rng):
        pass
    def snr_db(self, t_s, positions_m, snr_db):
        self.offset[0] = 0.0 if t_s == 0.0 else self.offset[0] + 1.0
        return snr_db - self.offset[0]

def squad(air, acceleration, climb, mass):
    return np.full_like(climb, 100.0 * len(mass))

def free_fall(air, acceleration, climb, mass):
    return 100.0 * mass + 50.0 * climb

def two_frames(times_s, positions_m, rng):
    return np.zeros((len(times_s), 4)) + times_s[1]

class Wanders:
    def __init__(self, drone, start_m, rng):
        pass
    def command(self, view):
        from sortie.fleet.flight.steering import Velocity
        return Velocity(np.random.normal(), 1.0)

def mean_of_all(agents, takes_part, weight):
    return agents.mean(1)

def last_peer(agents, takes_part, weight):
    return agents[:, 0] + 0.1 * takes_part[:, -1, None] * agents[:, -1]

def all_egos(agents, takes_part, weight):
    return agents[:, 0] + 0.1 * (takes_part[:, 1:, None] * agents[:, 1:]).sum(1).mean(0)

class Late:
    def __init__(self, rng):
        pass
    def step(self, fleet):
        fleet.jam((0.0, 0.0, np.random.random()), 30.0)

def many(record):
    return [1.0]

def tables(record, *, names):
    return sum(record.tables[name].num_rows for name in names)

def any_number(record):
    return np.random.random()

class Blind:
    def __init__(self, scene, perception, seed, replication, *, size=2):
        from sortie.perception.types import Boxes
        self.boxes, self.size = Boxes, size
    def detect(self, jobs):
        import numpy as np
        n = len(jobs)
        one = self.boxes(np.zeros((n, 2)), np.ones((n, self.size)), np.zeros(n), np.ones(n))
        return [one] * n
    def truth(self, t_s, ego):
        return self.boxes.empty()
    def count_boxes(self, capture, roi):
        return 0
    def camera_views(self, capture):
        raise ValueError("none")
"""


@pytest.fixture(autouse=True)
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("broken.py").write_text(BROKEN)
    for page in (ROOT / "docs" / "guide").glob("*.md"):
        for name, text in re.findall(r"^```python\n# file: (\S+)\n(.*?)^```$", page.read_text("utf-8"), re.M | re.S):
            Path(name).write_text(text)


SOUND = [
    ("path_loss", "foliage.py:weissberger", {"depth_m": 40}),
    ("link", "houses.py:Blocked", {}),
    ("detector", "nearby.py:Nearby", {}),
    ("detector", "surrogate", {}),
    ("fusion", "mean.py:Mean", {}),
    ("power", "measured.py:wind_tunnel", {}),
    ("cell", "phosphate.py:tremblay", {}),
    ("sensor", "receiver.py:biased", {}),
    ("mobility", "spiral.py:spiral", {"apart_m": 30}),
    ("mobility", "gauss_markov", {}),
    ("mobility", "orbit.py:Orbit", {}),
    ("event", "rain.py:RainFront", {}),
    ("metric", "first.py:detection_s", {}),
]


def test_the_guides_models_keep_every_rule() -> None:
    """They are of every kind."""
    assert {kind for kind, _, _ in SOUND} == set(KITS)
    broken = {}
    for kind, reference, params in SOUND:
        checks = verify(kind, reference, params)
        if len(checks) < 3 or not all(c.holds for c in checks):
            broken[kind, reference] = [(c.name, c.what) for c in checks if not c.holds]
    assert broken == {}


AGAIN, MEMORY, ANSWERS = "same answer again", "no memory", "answers"
OTHER_ANSWER = "another answer than the first time"
BREAKS: list[tuple[str, str, str, str]] = [
    ("path_loss", "random", AGAIN, f"one link: {OTHER_ANSWER}; take random numbers from what is given"),
    ("path_loss", "counts", MEMORY, "frames by links: another answer"),
    ("path_loss", "tallest", "links apart", "the loss of a link depends on the other links of the same call"),
    ("path_loss", "downhill", "both directions alike", "another loss from the second end to the first"),
    ("path_loss", "near", ANSWERS, "distance 0: path_loss near: -100.0 dB at 0 m, must be at least 40.7 dB"),
    ("link", "Shared", "sorties apart", "two objects made alike and used in turn disturb each other"),
    ("power", "squad", "drones apart", "a drone's power depends on the other drones"),
    ("power", "free_fall", ANSWERS, "descent: power free_fall: returns -50 W, must be ≥ 0"),
    ("sensor", "two_frames", ANSWERS, "one frame: sensor two_frames: IndexError: index 1 is out of bounds"),
    ("fusion", "mean_of_all", "absent peers", "a peer that takes part in no cell"),
    ("fusion", "mean_of_all", "ego alone", "another map than the ego's"),
    ("fusion", "last_peer", "order of peers", "the map depends on the order of the peers"),
    ("fusion", "all_egos", "egos apart", "an ego's map depends on the other egos of the same call"),
    ("mobility", "Wanders", AGAIN, "no region: another answer"),
    ("mobility", "squad", ANSWERS, "one drone: mobility squad: TypeError"),
    ("event", "Late", AGAIN, "from 0.5 s to the end: another answer"),
    ("metric", "many", ANSWERS, "traffic alone: metric broken.py:many: returns [1.0], must be a finite number or None"),
    ("metric", "any_number", AGAIN, "traffic alone"),
    ("metric", "any_number", MEMORY, f"a drone is lost: {OTHER_ANSWER}; keep nothing"),
    ("detector", "Blind", "egos apart", "an ego's boxes depend on the other egos of the same call"),
]


def test_each_rule_fails_for_a_model_that_breaks_it() -> None:
    wrong = {}
    for kind, name in dict.fromkeys((kind, name) for kind, name, *_ in BREAKS):
        found = {c.name: c.what for c in verify(kind, f"broken.py:{name}") if not c.holds}
        wanted = {rule: what for k, n, rule, what in BREAKS if (k, n) == (kind, name)}
        if not all(found.get(rule, "").startswith(what) for rule, what in wanted.items()):
            wrong[kind, name] = found
    assert wrong == {}


def test_a_metric_is_asked_with_the_tables_of_a_scenario_and_boxes_of_a_wrong_shape_are_told() -> None:
    assert all(c.holds for c in verify("metric", "broken.py:tables", {"names": ["beliefs", "views"]}))
    (check,) = verify("detector", "broken.py:Blind", {"size": 3})
    assert check.what == "alone: detector broken.py:Blind: detect returns size_m of shape (1, 3), must be (1, 2)"


def test_a_kind_or_a_model_that_is_not_there_is_an_error() -> None:
    with pytest.raises(ValueError, match="no kind of model is called 'radar', must be policy, path_loss, link, "):
        verify("radar", "x")
    with pytest.raises(PluginError, match=r"path_loss file 'broken\.py' has no function or class 'none'"):
        verify("path_loss", "broken.py:none")


def test_the_command_prints_the_rules_and_says_by_its_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    assert command("verify", "path_loss", "foliage.py:weissberger(depth_m=40)") == 0
    assert "links apart" in capsys.readouterr().out
    assert command("verify", "path_loss", "broken.py:downhill") == 1
    assert "1 does not hold" in capsys.readouterr().err
    for wrong, message in (
        (("power", "measured.py:wind_tunnel(kg=2)"), "has no parameter 'kg', it has: measured_kg"),
        (("path_loss", "foliage.py:weissberger(depth_m=40"), "the bracket is not closed"),
        (("policy", "broken.py:nobody"), "policy file 'broken.py' has no function 'nobody'"),
        (("broken.py:nobody",), "policy file 'broken.py' has no function 'nobody'"),
    ):
        assert command("verify", *wrong) == 2
        assert message in capsys.readouterr().err


def test_values_are_compared_by_what_they_hold() -> None:
    assert plain({"a": np.array([1.0, np.nan])}) == plain({"a": np.array([1.0, np.nan])})
    assert plain(np.zeros(2)) != plain(np.zeros(2, np.float32))
    assert plain([1, None, "x"]) != plain([1, None, "y"])
