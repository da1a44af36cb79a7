"""Each drone's own part where a fleet has several: its network counts, shows and detects; mains; headrooms; violations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import simpy
from sim_examples import example

from sortie.fleet.energy.battery import FleetBatteries
from sortie.perception.types import Boxes, Capture, Share
from sortie.policies.verification.enforced import Violation
from sortie.scenarios.schema import Battery
from sortie.sim.engine.audit import Audit
from sortie.sim.engine.mixed import Mixed
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.record import VIOLATIONS_OF, Recorder


class Network:
    """A detector that names itself in everything that it is asked for."""

    def __init__(self, number: int) -> None:
        self.number = number

    def detect(self, jobs: Sequence[tuple[Capture, Sequence[Share]]]) -> list[Boxes]:
        return [self._box() for _ in jobs]

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        return Boxes.empty()

    def count_boxes(self, capture: Capture, roi: Any) -> int:
        return self.number

    def camera_views(self, capture: Capture) -> Any:
        return np.array([self.number])

    def _box(self) -> Boxes:
        at = np.array([[float(self.number), 0.0]])
        return Boxes(at, np.array([[4.5, 1.9]]), np.zeros(1), np.ones(1))


@pytest.mark.parametrize("of_drone", [(0, 1, 0, 2), (2, 2, 1, 0)])
def test_every_drone_is_counted_shown_and_detected_by_its_own_network(of_drone: tuple[int, ...]) -> None:
    fleet = Mixed([Network(k) for k in range(3)], of_drone, [None] * 3)
    captures = [Capture(i, 0.0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 60.0), 0.0) for i in range(4)]
    assert tuple(fleet.count_boxes(c, None) for c in captures) == of_drone
    assert tuple(int(fleet.camera_views(c)[0]) for c in captures) == of_drone
    for order in (captures, captures[::-1]):
        found = fleet.detect([(c, []) for c in order])
        assert [b.xy_m[0, 0] for b in found] == [of_drone[c.drone] for c in order]
    share = Share(captures[1], "detections", 0.0, None, 1.0)
    ((_, (given,)),) = fleet._with_foreign_boxes([[(captures[0], [share])]])[0]
    if of_drone[0] == of_drone[1]:
        assert given.boxes is None  # its own network finds them
    else:
        assert given.boxes is not None
        assert given.boxes.xy_m[0, 0] == of_drone[1]


def test_the_mains_lose_nothing_to_a_fault() -> None:
    packs = FleetBatteries(Battery(), (), 2, mains={0})
    for drone in (0, 1):
        packs.fault(drone, 0.5)
    assert packs.energy_j["fault"][0] == 0.0
    assert packs.soc[0] == 1.0
    assert packs.energy_j["fault"][1] > 0.0
    packs.step(1.0, [100.0, 100.0], [1.0, 1.0], [0.1, 0.1])
    assert packs.spent_j[0] == 0.0
    packs.fault(0, 1.0)
    assert not packs.landed[0]


def test_a_headroom_is_of_the_time_that_was_flown() -> None:
    """A drone that has flown for less than a second has worked for less: its share is over that time, not over a second."""
    record = run_sortie(
        example("duration_s=2", "policy.name=silence", "policy.params={}", "fleet.computer.driving_cores=6")
    )
    rows = [r for r in record.tables["descriptors"].to_pylist() if r["drone"] == 0]
    busy = [1.0 - r["gpu_headroom"] for r in rows]
    assert busy[0] == 0.0
    assert busy[1:] == pytest.approx([0.03 / 0.1] * (len(busy) - 1), rel=0.02)  # a look of 30 ms in every frame


def test_a_decision_that_breaks_several_lines_is_one_violated_decision() -> None:
    """Violations are counted by line and link, decisions once; a violation that goes on is the same one."""
    env, recorder = simpy.Environment(), Recorder(classes=False)
    audit = Audit(env, recorder)
    one, other = (Violation(line, 1, "policy", "features") for line in ("rho <= 0.1", "rate_hz <= 5"))
    for broken in ([one, other], [one], [], [one]):
        audit.judged(0, "mine", broken)
        env.run(until=env.now + 0.1)
    audit.finish()
    counts = audit.totals()
    assert counts["violated_ticks"] == 3
    assert counts["invariant_violations"] == 3
    assert counts[f"{VIOLATIONS_OF}policy"] == 3
