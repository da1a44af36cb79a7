"""Live flights that end when something holds. A busy machine takes longer for them, and nothing else changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple
from unittest import mock

from sim_examples import example
from typer.testing import CliRunner

from sortie.policies.staleness import LinkHealth
from sortie.scenarios.schema import Scenario
from sortie.sim.cli.app import app
from sortie.sim.folders import RunError
from sortie.sim.live import session
from sortie.sim.live.bench import FleetReports
from sortie.sim.live.context import Trace, traces
from sortie.sim.live.reports import Report
from sortie.sim.live.result import LiveResult
from sortie.sim.live.session import fly_live

LONGEST_S = 600.0
stop = session._request_stop
PATIENT = "context={degraded_after_periods: 100, detached_after_periods: 300}"
"""Peers stay fresh on a machine that stalls for 10 s."""


class Seen(NamedTuple):
    """What the processes of a flight have reported so far."""

    fleet: FleetReports

    def last(self, drone: int, late: bool = False) -> Report | None:
        """The latest report of a process."""
        return self.fleet.last.get((drone, late))

    def healths(self, drone: int, peer: int) -> list[LinkHealth]:
        """What became of a drone's context about a peer, without what a busy host skips."""
        found = sorted(c for new in self.fleet.news for c in new.health if (c.drone, c.peer) == (drone, peer))
        return [c.health for c in found if c.health != LinkHealth.DEGRADED]

    def carried(self, drone: int, peer: int) -> list[str]:
        """What a link carried, change by change."""
        found = sorted(o for new in self.fleet.news for o in new.orders if (o.drone, o.peer) == (drone, peer))
        return [o.representation for o in found]

    def notices(self, drone: int) -> list[str]:
        """A drone's events."""
        return [n.text for n in sorted(n for new in self.fleet.news for n in new.notices) if n.drone == drone]


def fly_until(holds: Callable[[Seen], bool], *sets: str, **options: Any) -> LiveResult:
    """Fly the example, with these fields set, until something holds of the reports.

    Raises:
        AssertionError: it did not hold before the end of a flight of `LONGEST_S`.
    """
    with ending_when(holds):
        return fly_live(example(*sets, f"duration_s={LONGEST_S:g}"), **options)


class ending_when:  # noqa: N801 - used as a function
    """Within the block, live flights end when something holds of their reports."""

    def __init__(self, holds: Callable[[Seen], bool]) -> None:
        self._holds, self._held = holds, False

    def __enter__(self) -> None:
        collect = session._collect

        def collect_and_look(flown: Any, fleet: FleetReports, *more: Any) -> None:
            collect(flown, fleet, *more)
            if not self._held and self._holds(Seen(fleet)):
                self._held = True
                stop(flown)

        self._patch = mock.patch.object(session, "_collect", collect_and_look)
        self._patch.start()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._patch.stop()
        assert kind is not None or self._held, f"it did not hold within {LONGEST_S:g} s"


def refusal_of(*arguments: str) -> str:
    """The error of `sortie live` with these arguments."""
    error = CliRunner().invoke(app, ["live", *arguments]).exception
    assert isinstance(error, RunError)
    return str(error)


def short_traces(scenario: Scenario) -> list[Trace]:
    """Of the first two minutes, in place of `traces`: the scenario is long so that no busy host flies to its end."""
    return list(traces(scenario.model_copy(update={"duration_s": 120.0})))
