"""How fast sorties fly: by the number of drones, for an hour of a small fleet, and in a campaign on two cores.

    python -m research.validation.pace                 measure and print everything (`make figures FIGURE=pace` for the page)
    python -m research.validation.pace fleet 100 0.2 worked    one fleet: 100 drones on a square of 0.2 km, policy `worked`
    python -m research.validation.pace hour            one of the other parts: hour, parts, campaign RUNS

Each fleet flies `track_target` without a detector in a process of its own. Its first simulated second is left out, because
drones meet in it. Times are processor times, but for the campaign's.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import simpy

import sortie
from research.validation.stored import Column, Table
from sortie.scenarios.reading.load import load
from sortie.sim.engine.garbage import cycles_searched_rarely
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import build, fly, run_sortie
from sortie.sim.results.outcome import outcome

POLICIES = ("worked", "silence")
FLEETS = ((0.02, (5, 10, 25, 50, 100)), (None, (100, 200, 400, 1000)))
"""Metres between neighbours in a square grid of all sizes; None spreads each fleet over `WIDE_KM`. With the sizes."""
WIDE_KM = 5.0
SEARCH = "mission.phases=[{at_s: 0, phase: search}]"
LASTING_WH = 1000
"""Of a pack that lasts for an hour."""
FIRST_S, FLOWN_S = 1.0, 4.0
FEW_MANY = (10, 50)
"""Runs of two campaigns; the difference of their times leaves out what a campaign costs before its first run."""
CAMPAIGN = """
campaign: pace
base: track_target
set: {{perception.detector: surrogate}}
seed: 1
replications: {runs}
policies: [worked]
metrics: [ap50.mission]
"""


@dataclass(frozen=True, slots=True)
class Pace:
    """What a fleet's flight took."""

    drones: int
    side_km: float
    policy: str
    cost_s: float
    """Processor time of a simulated second."""
    heard: float
    """Peers that a drone heard, in the mean."""
    peak_b: float
    """Largest resident memory of the process."""


def measure(drones: int, side_km: float, policy: str) -> Pace:
    """Fly a square grid of drones, in this process."""
    gap_m = 1e3 * side_km / math.ceil(math.sqrt(drones))
    scenario = load(
        "track_target",
        ["perception.detector=none", SEARCH, f"fleet.drones={drones}", f"duration_s={FIRST_S + FLOWN_S}",
         f"fleet.formation={{shape: grid, spacing_m: {gap_m}, altitude_m: 60}}", f"policy={{name: {policy}}}"],
    )  # fmt: skip
    parts = build(scenario, plan_for(scenario), 1)
    begun_s = [0.0]

    def begin() -> Iterator[simpy.Event]:
        yield parts.env.timeout(FIRST_S - 1e-4)
        begun_s[0] = time.process_time()

    parts.env.process(begin())  # type: ignore[arg-type]
    with cycles_searched_rarely():  # as a flight does
        fly(parts)
    cost_s = (time.process_time() - begun_s[0]) / FLOWN_S
    heard = float(np.mean([len(agent.memory.peers) for agent in parts.agents]))
    return Pace(drones, side_km, policy, cost_s, heard, peak_b())


def peak_b() -> float:
    """Largest resident memory of this process so far, B; not `ru_maxrss`, which begins with that of the process that started it."""
    return 1024.0 * int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0])


def hour() -> dict[str, float]:
    """An hour of five drones without a detector, with packs that last so long."""
    begin_s = time.process_time()
    packs = f"fleet.battery.capacity_wh={LASTING_WH}"
    record = run_sortie(load("track_target", ["perception.detector=none", "duration_s=3600", packs]))
    if not all(record.tables["states"]["airborne"].to_pylist()):
        raise ValueError(f"packs of {LASTING_WH} Wh do not last for an hour")
    flown_s = time.process_time() - begin_s
    outcome(record)
    return {"flight": flown_s, "outcome": time.process_time() - begin_s - flown_s, "peak_b": peak_b()}


SCORED = "`worked`, scored by the surrogate"
PARTS = {
    "silence, without a detector": ["perception.detector=none", "policy={name: silence}"],
    "`worked`, without a detector": ["perception.detector=none"],
    SCORED: ["perception.detector=surrogate"],
}


def parts() -> dict[str, float]:
    """Processor time of a whole `track_target` of 120 s: of its parts, and with the outcome; the least of three."""
    took: dict[str, float] = {}
    for _ in range(4):  # the first one also compiles
        for name, sets in PARTS.items():
            begin_s = time.process_time()
            record = run_sortie(load("track_target", sets))
            took[name] = min(took.get(name, math.inf), time.process_time() - begin_s)
        begin_s = time.process_time()
        outcome(record)
        took["outcome"] = min(took.get("outcome", math.inf), time.process_time() - begin_s)
    return took


def campaign(runs: int) -> dict[str, float]:
    """Wall time of a campaign of full sorties on two workers."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "pace.yaml"
        file.write_text(CAMPAIGN.format(runs=runs))
        begin_s = time.monotonic()
        sortie.campaign(file, out=Path(folder) / "out", workers=2)
        return {"wall_s": time.monotonic() - begin_s}


def elsewhere(*words: object) -> dict[str, float]:
    """What this script finds in a process of its own."""
    command = [sys.executable, "-m", "research.validation.pace", "--json", *map(str, words)]
    found: dict[str, float] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    sys.stderr.write(f"{' '.join(map(str, words))}: {found}\n")
    return found


def paces() -> list[Pace]:
    """All fleets."""
    found = []
    for gap_km, sizes in FLEETS:
        for policy in POLICIES:
            for n in sizes:
                side_km = WIDE_KM if gap_km is None else gap_km * math.ceil(math.sqrt(n))
                found.append(Pace(**elsewhere("fleet", n, f"{side_km:g}", policy)))  # type: ignore[arg-type]
    return found


def exponent(these: Sequence[Pace]) -> float:
    """The power of the number of drones with which the cost grows, fitted from 25 drones on: smaller fleets cost little."""
    large = [p for p in these if p.drones >= 25]
    slope, _ = np.polyfit(np.log([p.drones for p in large]), np.log([p.cost_s for p in large]), 1)
    return float(slope)


def grouped(found: Sequence[Pace]) -> dict[tuple[bool, str], list[Pace]]:
    """By whether the fleet is spread widely, and by policy."""
    groups: dict[tuple[bool, str], list[Pace]] = {}
    for p in found:
        groups.setdefault((p.side_km == WIDE_KM, p.policy), []).append(p)
    return groups


def fleet_table(found: Sequence[Pace]) -> Table:
    """A row for each fleet, and the exponents below."""
    wide = {True: f"{WIDE_KM:g} by {WIDE_KM:g} km", False: "20 m apart"}
    rows = [
        [wide[p.side_km == WIDE_KM], p.policy, p.drones, p.heard, p.cost_s, 1.0 / p.cost_s, p.peak_b] for p in found
    ]
    columns = [
        Column("fleet"), Column("policy"), Column("drones"), Column("peers heard", ".0f"),
        Column("processor time of a simulated second", ".3f", " s"), Column("times real time", ".2f"),
        Column("peak memory", ",.0f", " MB", 1e-6),
    ]  # fmt: skip
    grows = [f"{wide[is_wide]}, `{name}`: {exponent(each):.2f}" for (is_wide, name), each in grouped(found).items()]
    about = (
        f"No detector. {FLOWN_S:g} simulated seconds after the first, one core. "
        f"Cost grows with the number of drones, from 25 on, to the power of: {'; '.join(grows)}."
    )
    return Table(columns, [list(row) for row in rows], about)


def sortie_table(hour_: Mapping[str, float], parts_: Mapping[str, float], a_minute: float) -> Table:
    """An hour, a full sortie with its parts, and sorties a minute."""
    rows: list[list[str]] = [
        [
            f"an hour of five drones with packs of {LASTING_WH:,} Wh, without a detector",
            f"{hour_['flight']:.0f} s of processor time",
        ],
        ["its outcome", f"{hour_['outcome']:.1f} s of processor time"],
        ["peak memory of both", f"{hour_['peak_b'] / 1e6:,.0f} MB"],
        *(
            [
                f"120 s of five drones: {name.replace('outcome', 'the outcome of the last')}",
                f"{s:.2f} s of processor time",
            ]
            for name, s in parts_.items()
        ),
        ["a campaign of such sorties by the surrogate, two workers", f"{a_minute:.0f} sorties a minute"],
    ]
    return Table([Column("what"), Column("measured")], [list(row) for row in rows])


def short_table(
    found: Sequence[Pace], hour_: Mapping[str, float], parts_: Mapping[str, float], a_minute: float
) -> Table:
    """What the README shows."""
    rows = []
    for p in found:
        if (p.drones, p.side_km == WIDE_KM) in ((100, False), (1000, True)):
            where = f"over {WIDE_KM:g} by {WIDE_KM:g} km" if p.side_km == WIDE_KM else "20 m apart"
            pace = f"{1.0 / p.cost_s:.2g} times real time, {p.peak_b / 1e6:,.0f} MB"
            rows.append([f"{p.drones:,} drones {where}, policy `{p.policy}`, without a detector", pace])
    full_s = parts_[SCORED] + parts_["outcome"]
    rows += [
        [
            "five drones, policy `worked`, scored by the surrogate, with the outcome",
            f"{120.0 / full_s:.0f} times real time",
        ],
        ["such sorties of 120 s in a campaign, two workers", f"{a_minute:.0f} a minute"],
        [
            f"an hour of five drones with packs of {LASTING_WH:,} Wh, without a detector",
            f"{hour_['flight']:.0f} s, {hour_['peak_b'] / 1e6:,.0f} MB",
        ],
    ]
    return Table([Column("what"), Column("measured")], [list(row) for row in rows])


def draw(found: Sequence[Pace], path: Path) -> None:
    """Processor time of a simulated second over the number of drones, both axes logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.subplots()
    for (is_wide, policy), each in grouped(found).items():
        where = f"over {WIDE_KM:g} by {WIDE_KM:g} km" if is_wide else "20 m apart"
        label = f"{policy}, {where}: power {exponent(each):.2f}"
        style = {"color": "#1d6f80" if is_wide else "#b5542b", "ls": "-" if policy == POLICIES[0] else "--"}
        axes.plot([p.drones for p in each], [p.cost_s for p in each], marker="o", label=label, **style)
    axes.axhline(1.0, color="#7a7d85", lw=1, ls=":", label="real time")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("drones")
    axes.set_ylabel("processor time of a simulated second, s")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def tables() -> tuple[dict[str, Table], list[Pace]]:
    """All tables, and the fleets that were flown."""
    elsewhere("fleet", 2, 0.04, "worked")  # what is compiled once is no fleet's cost
    found = paces()
    few, many = (elsewhere("campaign", runs)["wall_s"] for runs in FEW_MANY)
    rest = elsewhere("hour"), elsewhere("parts"), 60.0 * (FEW_MANY[1] - FEW_MANY[0]) / (many - few)
    made = {
        "fleet_pace": fleet_table(found),
        "sortie_pace": sortie_table(*rest),
        "short_pace": short_table(found, *rest),
    }
    return made, found


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", help="fleet DRONES KM POLICY, hour, parts, or campaign RUNS; nothing: all")
    parser.add_argument("--json", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    match options.what:
        case []:
            for made in tables()[0].values():
                sys.stdout.write(f"{made.markdown()}\n")
            return
        case ["fleet", drones, side_km, policy]:
            found: dict[str, Any] = asdict(measure(int(drones), float(side_km), policy))
        case ["hour"]:
            found = hour()
        case ["parts"]:
            found = parts()
        case ["campaign", runs]:
            found = campaign(int(runs))
        case other:
            parser.error(f"what is {' '.join(other)}")
    sys.stdout.write(json.dumps(found) if options.json else f"{found}\n")


if __name__ == "__main__":
    main()
