"""A policy that raises, hangs, dies or breaks its contract in flight: the fallback takes over until it answers again."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from dds_domains import domain
from live_flights import PATIENT, Seen, fly_until
from policies_examples import fleet_of
from sim_examples import example
from typer.testing import CliRunner

from sortie.policies.contract import PolicyError, Representation
from sortie.sim.apart import LimitError
from sortie.sim.cli.app import app
from sortie.sim.folders import RunError
from sortie.sim.live import watchdog
from sortie.sim.live.context import traces
from sortie.sim.live.policy_process import Begin, PolicyOrders
from sortie.sim.live.sentences import describe_changes
from sortie.sim.live.session import fly_live
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
        time.sleep(0.3)
        time.sleep(600.0)
    if mode == "die":
        MODE.unlink()
        os._exit(3)
    return [Directive(view.ego, p, Representation.FEATURES, 0.1, None, 10.0, reason="fine") for p in view.peers]
"""
VIEW = fleet_of(3)
DIED = "drone 0: fallback to detections at 2 Hz: the policy's process ended with exit code -6"


class Watched(NamedTuple):
    """A watchdog over the policy above, the file that says what it does, and what was noted."""

    watchdog: Watchdog
    mode: Path
    notes: list[str]

    def until(self, holds: Callable[[], bool]) -> None:
        """Ask for decisions until something holds."""
        end_s = time.monotonic() + 600
        while not holds():
            assert time.monotonic() < end_s
            self.watchdog(VIEW)
            time.sleep(0.02)


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[Watched]:
    """A policy that decides."""
    (tmp_path / "mine.py").write_text(POLICY)
    notes: list[str] = []
    orders = PolicyOrders(example(f"policy={{name: '{tmp_path}/mine.py:decide'}}"), 0)
    dog = Watchdog(orders, fallback=DETECTIONS, deadline_s=600.0)
    try:
        dog.wait_until_loaded()
        dog.begin(Begin(0.0, time.monotonic()), notes.append, lambda _: None)
        yield Watched(dog, tmp_path / "mode", notes)
    finally:
        dog.close()


def rung(dog: Watchdog) -> Representation:
    """What it decides for every peer."""
    directives = dog(VIEW)
    assert [d.destination for d in directives] == [1, 2]
    (found,) = {(d.representation, d.rate_hz) for d in directives}
    assert found in ((Representation.FEATURES, 10.0), (Representation.DETECTIONS, 2.0))
    return found[0]


@pytest.mark.parametrize(
    ("mode", "why"), [("raise", "raises RuntimeError: no more ideas"), ("break", "rho is 2.0, must be in [0, 1]")]
)
def test_a_policy_that_fails_is_replaced_for_each_failed_decision(watched: Watched, mode: str, why: str) -> None:
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


def test_a_policy_that_hangs_in_the_simulated_flight_ends_it_by_the_scenario_s_limit(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(POLICY)
    (tmp_path / "mode").write_text("hang")
    sets = (f"policy={{name: '{tmp_path}/mine.py:decide'}}", "limits.decision_s=0.2", "duration_s=1")
    with pytest.raises(LimitError, match=r"no answer within 0\.2 s \(limits\.decision_s\)"):
        traces(example(*sets))


def test_a_policy_that_dies_between_loading_and_the_flight_gets_a_new_process(tmp_path: Path) -> None:
    """A drone that starts late may wait for minutes between the two."""
    notes: list[str] = []
    (tmp_path / "mine.py").write_text(POLICY)
    dog = Watchdog(
        PolicyOrders(example(f"policy={{name: '{tmp_path}/mine.py:decide'}}"), 0), fallback=DETECTIONS, deadline_s=600.0
    )
    try:
        dog.wait_until_loaded()
        assert dog._process is not None
        dog._process.kill()
        dog._process.join()
        dog.begin(Begin(0.0, time.monotonic()), notes.append, lambda _: None)
        assert rung(dog) == Representation.DETECTIONS
        assert notes == ["fallback to detections at 2 Hz: the policy's process is starting"]
        Watched(dog, tmp_path / "mode", notes).until(lambda: len(notes) == 2)
        assert (dog.restarts, rung(dog)) == (1, Representation.FEATURES)
    finally:
        dog.close()


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
    done = CliRunner().invoke(app, ["live", "--fallback", "raw@10"])
    assert str(done.exception).startswith("fallback is 'raw@10', must be ")
    with pytest.raises(RunError, match=r"^decide_within_s is 2, must be in \(0, 1\]$"):
        fly_live(example(), decide_within_s=2.0)


def test_a_drone_flies_on_as_its_policy_dies(tmp_path: Path) -> None:
    """Drone 0's policy dies at its eleventh decision of the live flight; the flight in simulation has another process."""
    (tmp_path / "mine.py").write_text(
        "import multiprocessing, os\nfrom pathlib import Path\n"
        "from sortie.policies.contract import Directive, Representation\n"
        "DEAD, made = Path(__file__).with_name('dead'), []\n"
        "def decide(view):\n"
        "    made.append(view.ego)\n"
        "    if multiprocessing.current_process().name == 'policy of drone 0' and len(made) > 10 and not DEAD.exists():\n"
        "        DEAD.touch()\n        os.abort()\n"
        "    return [Directive(view.ego, p, Representation.FEATURES, 0.05, None, 10.0) for p in view.peers]\n"
    )
    policy = f"policy={{name: '{tmp_path}/mine.py:decide', dwell_s: 0.3}}"

    def died_and_decides_again(seen: Seen) -> bool:
        notices = seen.notices(0)
        died = [i for i, text in enumerate(notices) if DIED.endswith(text)]
        carried = seen.carried(0, 1)
        again = [i for i in range(len(carried)) if carried[i : i + 3] == ["features", "detections", "features"]]
        return bool(died and again) and any("decides again" in text for text in notices[died[0] :])

    result = fly_until(
        died_and_decides_again, "fleet.drones=2", PATIENT, policy, domain=domain(__name__), decide_within_s=1.0
    )
    broken = result.each[0]
    assert broken.policy_restarts >= 1
    assert broken.published >= broken.fallbacks > 0  # it published as its policy was dead
    text = "\n".join(describe_changes(result))
    assert DIED in text
    assert "drone 0: the policy decides again after " in text


def test_a_policy_that_hangs_ends_with_its_drone(tmp_path: Path) -> None:
    """The drone's process is killed, and can end nothing by itself."""
    (tmp_path / "mine.py").write_text(POLICY)
    drone = multiprocessing.get_context("spawn").Process(target=ask_for_ever, args=(tmp_path,))
    drone.start()
    end_s = time.monotonic() + 600
    while not (tmp_path / "pid").exists():
        assert time.monotonic() < end_s
        time.sleep(0.02)
    pid = int((tmp_path / "pid").read_text())
    drone.kill()
    drone.join()
    while Path(f"/proc/{pid}").exists() and "Z" not in Path(f"/proc/{pid}/stat").read_text().split()[2]:
        assert time.monotonic() < end_s
        time.sleep(0.02)


def ask_for_ever(folder: Path) -> None:
    """A drone's process, its policy hanging."""
    dog = Watchdog(
        PolicyOrders(example(f"policy={{name: '{folder}/mine.py:decide'}}"), 0), fallback=DETECTIONS, deadline_s=60
    )
    dog.wait_until_loaded()
    dog.begin(Begin(0.0, time.monotonic()), str, lambda _: None)
    (folder / "mode").write_text("hang")
    (folder / "part").write_text(str(dog.pid))
    (folder / "part").rename(folder / "pid")
    dog(VIEW)


def test_events_of_answers_that_are_not_used_are_kept(tmp_path: Path) -> None:
    """A change of policy was never told where the new policy failed, or answered late."""
    (tmp_path / "mine.py").write_text(POLICY)
    (tmp_path / "mode").write_text("raise")
    mine = f"{tmp_path}/mine.py:decide"
    scenario = example(f"policy={{name: silence, changes: [{{at_s: 0, name: '{mine}'}}]}}")
    dog, answers = Watchdog(PolicyOrders(scenario, 0), fallback=DETECTIONS, deadline_s=0.1), []
    try:
        dog.wait_until_loaded()
        dog.begin(Begin(1.0, time.monotonic()), str, answers.append)
        end_s = time.monotonic() + 600
        while not answers:
            assert time.monotonic() < end_s
            dog(VIEW)
        assert [n.text for a in answers for n in a.notices if "mine.py" in n.text]
        assert {a.elapsed_ns for a in answers} == {0}
    finally:
        dog.close()


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
    reasons: list[str] = []
    end_s = time.monotonic() + 600
    while not any("mine.py" in reason for reason in reasons):
        assert time.monotonic() < end_s
        reasons += [d.reason for d in watched.watchdog(VIEW)]
        time.sleep(0.02)
