"""What the measurement of overhead takes from its flights."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from policies_examples import fleet_of

from research.overhead import overhead


def test_overhead_is_what_was_sent_a_second_and_the_later_half_of_the_decisions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Decisions of 9 ms while drones have not heard each other yet, then of 1, 2, …, 5 ms."""
    clock = iter(np.cumsum([k for ms in (9, 9, 9, 9, 9, 1, 2, 3, 4, 5) for k in (0, ms * 10**6)]).tolist())
    asked: list[Any] = []

    def run(scenario: Any, decide: Any, progress: Any) -> Any:
        asked.append(scenario)
        assert decide.__name__ == "all-4"
        monkeypatch.setattr(overhead.time, "thread_time_ns", lambda: next(clock))
        for _ in range(10):
            assert len(decide(fleet_of(3))) == 2
        return None

    told = {"bytes": {"context_sent": 3000, "data_sent": 9000, "data_delivered": 1, "handshakes_sent": 2}}
    monkeypatch.setattr(overhead, "run_sortie", run)
    monkeypatch.setattr(overhead, "outcome", lambda record: told)
    found = overhead.measure("all-4", 7, 2.0)
    assert (asked[0].fleet.drones, asked[0].duration_s, asked[0].perception.detector) == (7, 2.0, "none")
    assert (found.policy, found.drones, found.decisions) == ("all-4", 7, 5)
    assert (found.context_bytes_per_s, found.data_bytes_per_s, found.context_share) == (1500.0, 4500.0, 0.25)
    assert (found.p50_ms, found.p99_ms) == pytest.approx((3.0, 4.96))
