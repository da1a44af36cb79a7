"""Where the Air's processor time goes in plans that send little: each part measured with the others taken out.

python -m research.validation.ns3.wifi_parts
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from math import nan
from typing import Any
from unittest import mock

import numpy as np
import simpy

from research.validation.ns3 import wifi_air
from research.validation.ns3.wifi_compare import LOADS, QUIET
from research.validation.ns3.wifi_drawn import drawn
from research.validation.ns3.wifi_plan import FRAME_S, Case, Plan
from sortie.radio.mac import edca, medium
from sortie.radio.transmission import Status, Transmission

LIGHT = (LOADS[0], drawn(20261124, 3), drawn(20261124, 8), drawn(20261127, 6))


class Bare:
    """In place of the Air: each descriptor and payload is one event of the clock, a payload a row too, and nothing else."""

    def __init__(self, env: simpy.Environment, _: Any, positions_m: np.ndarray, **__: Any) -> None:
        self._env, self.airtime_s = env, [0.0] * positions_m.shape[1]

    def advance(self) -> None:
        pass

    def broadcast(self, _: int, __: int, on_heard: Callable[[tuple[int, ...]], None], in_s: float) -> None:
        self._env.timeout(in_s + 1e-3).callbacks.append(lambda _: on_heard(()))

    def send(self, s: int, r: int, size: int, *, kind: str, reliable: bool, deadline_s: float, on_done: Any) -> None:
        now, env = self._env.now, self._env
        row = (0, s, r, kind, size, size, now, now + deadline_s, now, nan, Status.DELIVERED, "", 1, 0, 0, 0, 0.0, 0.0)
        env.timeout(3e-3).callbacks.append(lambda _: on_done(Transmission(*row)))

    def finish(self) -> list[Transmission]:
        return []


class Stations:
    """The compiled stations; `again`: each plan is made a second time, which changes nothing."""

    def __init__(self, again: bool) -> None:
        self._again = again

    def __getattr__(self, name: str) -> Any:
        return getattr(edca, name)

    def ahead(self, table: Any, entered: int, since: int, until: int) -> tuple[int, int]:
        found: tuple[int, int] = edca.ahead(table, entered, since, until)
        if self._again and found[0] >= since <= until:
            edca.ahead(table, -1, since, until)
        return found


def parts_ms(case: Case, runs: int = 5) -> dict[str, float]:
    """Processor time of a plan and of its parts, milliseconds, the least of some runs."""

    def run(plan: Plan, mcs: int | None = case.mcs) -> float:
        return float(wifi_air.run_air(plan, case.warm_s, case.stop_s, mcs=mcs, **QUIET)["cpu_s"])

    def stations(again: bool) -> float:
        with mock.patch.object(medium, "_edca", return_value=Stations(again)):
            return run(plan)

    def bare() -> float:
        with mock.patch.object(wifi_air, "Air", Bare):
            return run(plan, None)

    plan, found = case.plan(1), {}
    nothing = Plan(plan.positions_m)
    ways = {
        "all": lambda: run(plan), "set-up and frames": lambda: run(nothing), "events and rows": bare,
        "stations once": lambda: stations(False), "stations": lambda: stations(True),
    }  # fmt: skip
    for name, way in ways.items():
        found[name] = 1e3 * min(way() for _ in range(runs))
    found["stations"] -= found.pop("stations once")
    return found


def main() -> None:
    for case in LIGHT:
        frames = round(case.stop_s / FRAME_S)
        sent = f"{case.pairs * frames} payloads, {case.drones * frames} descriptors"
        shown = ", ".join(f"{name} {ms:.1f} ms" for name, ms in parts_ms(case).items())
        sys.stdout.write(f"{case.name} ({sent}): {shown}\n")


if __name__ == "__main__":
    main()
