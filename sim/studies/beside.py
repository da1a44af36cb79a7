"""What sharing is worth in one sortie: the same draws flown by another policy, in a process of its own beside the first."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import cast

from sortie.scenarios.report_text import size
from sortie.scenarios.schema import Scenario
from sortie.sim.apart import Said, call_within
from sortie.sim.engine.sortie import fly_here
from sortie.sim.experiment.compare import AREAS, gains_over
from sortie.sim.results.accuracy import both_matched
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord


class Beside:
    """A sortie in flight in another process. It ends with this one."""

    def __init__(
        self, scenario: Scenario, seed: int | None, replication: int, progress: Callable[[float], None]
    ) -> None:
        self._work = partial(fly_here, scenario, None, seed, replication=replication, progress=Said("progress"))
        self._scenario, self._progress = scenario, progress
        self._record: SortieRecord | None = None
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._fly, daemon=True)  # Ctrl-C does not wait for it
        self._thread.start()

    def _fly(self) -> None:
        try:
            hear = {"progress": self._progress}
            self._record = call_within(self._scenario.limits, self._scenario.name, self._work, hear)
        except Exception as error:
            self._error = error

    def record(self) -> SortieRecord:
        """What was flown, once it has landed.

        Raises:
            Exception: what the flight raised.
        """
        self._thread.join()
        if self._error is not None:
            raise self._error
        return cast("SortieRecord", self._record)


def worth(policy: str, own: SortieRecord, other: SortieRecord, scenario: str) -> str:
    """How much more was seen and sent than in the same sortie by another policy, in words.

    Args:
        policy: the other one.
        own, other: the sorties.
        scenario: as the command names it.
    """
    ours, theirs = (outcome(record) for record in (own, other))
    parts = [
        f"AP@0.5 {name.replace('_', ' ')} {100 * gain:+.1f} points ({ours['ap50'][name]:.3f}, {theirs['ap50'][name]:.3f})"
        for name, gain in gains_over(both_matched(other), both_matched(own)).items()
        if name in AREAS and gain is not None
    ]
    parts.append(f"data sent {size(ours['bytes']['data_sent'])} ({size(theirs['bytes']['data_sent'])} under {policy})")
    again = f"sortie compare {scenario} --policies {policy},{own.scenario.policy.name} --seeds 8"
    return f"over {policy}: {', '.join(parts)}; one sortie each; `{again}` gives an interval"
