"""What scoring a large fleet costs, how precise its accuracy is where drones take turns, and how well its time is estimated.

make figures FIGURE=large_fleets     # 25 minutes; `docs/results/speed.md` has the tables
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from research.validation.stored import Column, Table
from sortie.perception.metrics.ap import Matched, average_precision
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.needs import Forecast
from sortie.sim.engine.scoring import Scorer, taking_turns
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.accuracy import CAR, Pool, score

SCORED = (100, 300, 1000)
SCORED_S = 6.0
FORECAST = {30: 90.0, 100: 40.0, 200: 25.0, 300: 20.0, 1000: 14.0}
"""Seconds that each fleet flies."""
DRAWN, DRAWN_S, DRAWS = 100, 30.0, 400
EGOS = (10, 25, 50)


def fleet(drones: int, duration_s: float, *sets: str) -> Scenario:
    """A square of drones, 40 m apart, that follows a car from the beginning."""
    about = (
        f"fleet.drones={drones}", f"duration_s={duration_s}", "fleet.formation={shape: grid, spacing_m: 40}",
        "perception.detector=surrogate", "mission.phases=[{at_s: 0, phase: track, region: {radius_m: 32}}]",
    )  # fmt: skip
    return load("track_target", [*about, *sets])


@contextmanager
def scoring_measured() -> Iterator[list[float]]:
    """Adds up the processor time of scoring: fusing, detecting, and what the drones' trackers compute for it."""
    spent, within = [0.0], [False]
    plain = {name: getattr(Scorer, name) for name in ("_score", "flush")}

    def measured(method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> None:
            if within[0]:
                return method(*args)
            within[0], begin_s = True, time.process_time()
            method(*args)
            within[0] = False
            spent[0] += time.process_time() - begin_s

        return call

    for name, method in plain.items():
        setattr(Scorer, name, measured(method))
    try:
        yield spent
    finally:
        for name, method in plain.items():
            setattr(Scorer, name, method)


def scoring() -> Table:
    """Processor time for each simulated second, with every drone scored and by turns."""
    rows = []
    for drones in SCORED:
        spent = []
        for egos in (drones, 50):
            with scoring_measured() as seconds:
                begin_s = time.process_time()
                run_sortie(fleet(drones, SCORED_S, f"perception.egos={egos}"))
                whole_s = time.process_time() - begin_s
            spent += [seconds[0] / SCORED_S, (whole_s - seconds[0]) / SCORED_S]
        rows.append([drones, spent[0], spent[2], spent[3]])
    columns = [
        Column("drones", ",.0f"), Column("scoring all", ".2f", " s"), Column("scoring 50 by turns", ".2f", " s"),
        Column("all else", ".2f", " s"),
    ]  # fmt: skip
    about = f"Processor time for each simulated second, over {SCORED_S:g} s at two scored moments a second; drones in a square, 40 m apart."
    return Table(columns, rows, about)


Chosen = NDArray[np.bool_]
"""[moments, drones]: who is scored when."""


def kept(rng: np.random.Generator, moments: int, drones: int, egos: int) -> Chosen:
    """Drones that are drawn once."""
    return np.tile(rng.permutation(drones) < egos, (moments, 1))


def anew(rng: np.random.Generator, moments: int, drones: int, egos: int) -> Chosen:
    """Drones that are drawn anew at each moment."""
    return np.stack([rng.permutation(drones) < egos for _ in range(moments)])


def by_turns(rng: np.random.Generator, moments: int, drones: int, egos: int) -> Chosen:
    """Drones that take turns."""
    scenario = fleet(drones, DRAWN_S, f"perception.egos={egos}")
    chosen = np.zeros((moments, drones), bool)
    for k, those in enumerate(taking_turns(scenario, int(rng.integers(2**31)), 0)):
        chosen[k, those] = True
    return chosen


def ap_of(pool: Pool, chosen: Chosen, moments: NDArray[np.float64]) -> float:
    """AP over the fusions of the chosen drones."""
    fusions = np.flatnonzero(chosen[np.searchsorted(moments, pool.t_s), pool.drone])
    boxes = np.concatenate([np.arange(pool.first[k], pool.first[k + 1]) for k in fusions])
    return average_precision([Matched(pool.score[boxes], pool.hit[boxes], int(pool.truths[fusions].sum()))])


def draws() -> Table:
    """How far the AP of drawn drones is off that of all."""
    pools = score(run_sortie(fleet(DRAWN, DRAWN_S, f"perception.egos={DRAWN}")), [CAR]).pools
    moments, rng, rows = np.unique(pools[CAR, "full_scene"].t_s), np.random.Generator(np.random.PCG64(1)), []
    for egos in EGOS:
        for how, draw in (("once", kept), ("anew", anew), ("by turns", by_turns)):
            chosen = [draw(rng, len(moments), DRAWN, egos) for _ in range(DRAWS)]
            row: list[Any] = [egos, how]
            for scope in ("full_scene", "mission"):
                pool = pools[CAR, scope]
                whole = ap_of(pool, np.ones((len(moments), DRAWN), bool), moments)
                off = np.array([ap_of(pool, c, moments) - whole for c in chosen])
                off = off[~np.isnan(off)]
                row += [off.mean(), off.std()]
            rows.append(row)
    columns = [
        Column("drones scored at a time"), Column("drawn"),
        *(Column(f"{scope}: {what}", form, "", 100) for scope in ("full scene", "mission") for what, form in (("mean error", "+.2f"), ("standard deviation", ".2f"))),
    ]  # fmt: skip
    about = f"AP points off the AP of all {DRAWN} drones of one flight of {DRAWN_S:g} s; {DRAWS} draws for each row."
    return Table(columns, rows, about)


def forecasts() -> Table:
    """What `sortie fly` says in the first seconds of a flight, and what the flight took."""
    rows = []
    for drones, duration_s in FORECAST.items():
        begin_s, said = time.process_time(), []
        forecast = Forecast(fleet(drones, duration_s), said.append, lambda _: None, clock=time.process_time)
        run_sortie(fleet(drones, duration_s), progress=forecast)
        took_s = time.process_time() - begin_s
        assert forecast.takes_s is not None
        rows.append(
            [drones, duration_s, forecast.measured_s, forecast.takes_s, took_s, forecast.takes_s / took_s - 1.0]
        )
    columns = [
        Column("drones", ",.0f"), Column("flight", "g", " s"), Column("estimated after", "g", " s"), Column("estimate", ".0f", " s"),
        Column("flown in", ".0f", " s"), Column("error", "+.0f", " %", 100),
    ]  # fmt: skip
    return Table(columns, rows, "Processor time, so that other programs on the machine do not count.")


def tables() -> dict[str, Table]:
    """All three."""
    return {"large_fleets_scoring": scoring(), "large_fleets_draws": draws(), "large_fleets_time": forecasts()}
