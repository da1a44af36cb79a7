"""Each of a directive's six decisions acts in a sortie, in the way it should.

One flight of its own: every drone but two says something else to its two neighbours, so that each decision stands
beside the plain one of drone 0 in the same record.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from recorded import recorded
from sim_examples import PATIENT, example

from sortie.policies.contract import Directive, Disc, FleetView, Representation
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.transitions import describe

PLAIN = Directive(0, 1, Representation.FEATURES, rho=0.05, rate_hz=10.0, reason="plain")
NO_PHASES = "mission.phases=[{at_s: 0, phase: search}]"
ALL = Directive(
    0,
    1,
    Representation.FEATURES,
    rho=0.125,
    roi=Disc(1.0, 2.0, 30.0),
    rate_hz=5.0,
    deadline_s=0.25,
    fusion_weight=0.75,
    duty_percent=80,
)
SAYS: dict[str, Callable[[Directive], Directive]] = {
    "plain": lambda d: d,
    "plain too": lambda d: d,
    "half duty": lambda d: d._replace(duty_percent=50),
    "lower neighbour alone": lambda d: (
        d if d.destination < d.source else d._replace(representation=Representation.NONE)
    ),
    "few cells": lambda d: d._replace(rho=0.02),
    "near disc": lambda d: d._replace(rho=1.0, roi=Disc(0.0, 0.0, 6.0)),
    "far disc": lambda d: d._replace(rho=1.0, roi=Disc(3000.0, 0.0, 6.0)),
    "2 Hz": lambda d: d._replace(rate_hz=2.0),
    "1 ms": lambda d: d._replace(rho=0.2, deadline_s=0.001),
    "all": lambda d: ALL._replace(source=d.source, destination=d.destination),
    **{
        rung.name.lower(): functools.partial(lambda d, rung: d._replace(representation=rung, deadline_s=1.0), rung=rung)
        for rung in Representation
        if rung not in (Representation.NONE, Representation.FEATURES)
    },
}
"""By what a drone says, how its directive differs from the plain one; in the order of the drones."""
NAMES = list(SAYS)


def says(view: FleetView, /) -> Sequence[Directive]:
    change, n = SAYS[NAMES[view.ego]], len(NAMES)
    own = {p: change(PLAIN._replace(source=view.ego, destination=p)) for p in view.peers}
    nothing = {p: Directive(view.ego, p, duty_percent=d.duty_percent, reason="far") for p, d in own.items()}
    return [own[p] if (p - view.ego) % n in (1, n - 1) else nothing[p] for p in view.peers]


@functools.cache
def flown() -> SortieRecord:
    grid = "fleet.formation={shape: grid, spacing_m: 8}"
    return run_sortie(example("duration_s=4", NO_PHASES, *PATIENT, grid, f"fleet.drones={len(NAMES)}"), says)


def sent(name: str, column: str) -> list:  # type: ignore[type-arg]
    rows = flown().tables["transmissions"].to_pylist()
    return [r[column] for r in rows if r["drone"] == NAMES.index(name) and r["t_sent_s"] > 1.0]


def test_1_duty_cycle_rests_perception_and_saves_its_energy() -> None:
    half, plain = (len(set(sent(name, "captured_s"))) for name in ("half duty", "plain"))
    assert half == pytest.approx(plain / 2, abs=2)
    energy = {r["drone"]: r["energy_j"] for r in flown().tables["energy"].to_pylist() if r["cause"] == "compute"}
    assert energy[NAMES.index("half duty")] < 0.95 * energy[NAMES.index("plain")]


def test_2_topology_is_who_is_sent_to() -> None:
    drone = NAMES.index("lower neighbour alone")
    assert set(sent("lower neighbour alone", "peer")) == {drone - 1}
    assert set(sent("plain too", "peer")) == {0, 2}


def test_3_representation_is_what_is_sent_and_budget_is_how_many_cells() -> None:
    plain = np.mean(sent("plain", "payload_bytes"))
    for rung in Representation:
        if (name := rung.name.lower()) in SAYS:
            assert set(sent(name, "representation")) == {name}
            assert (np.mean(sent(name, "payload_bytes")) > plain) == (rung > Representation.FEATURES), name
    assert set(sent("plain", "representation")) == {"features"}
    assert (set(sent("plain", "cells")), set(sent("few cells", "cells"))) == ({204}, {81})


def test_4_region_is_which_cells() -> None:
    """A disc of 6 m about the origin holds at most some ten cells of 10 m²; far from it there is nothing to send."""
    near = sent("near disc", "cells")
    assert near
    assert max(near) <= 14
    assert sent("far disc", "cells") == []


def test_5_rate_is_how_often_and_deadline_is_how_long_it_may_take() -> None:
    assert len(sent("2 Hz", "cells")) == pytest.approx(len(sent("plain", "cells")) / 5, abs=4)
    missed = {name: np.mean([s == "expired" for s in sent(name, "status")]) for name in ("1 ms", "plain")}
    assert missed["1 ms"] > 0.9
    assert missed["plain"] < 0.2


def test_every_decision_stands_in_the_directives_table() -> None:
    rows = flown().tables["directives"].to_pylist()
    rows = [r for r in rows if r["drone"] == NAMES.index("all") and r["representation"] == "features"]
    assert rows
    for row in rows:
        got = (row["rho"], row["roi_radius_m"], row["rate_hz"], row["deadline_s"], row["fusion_weight"])
        assert (*got, row["duty_percent"]) == (0.125, 30.0, 5.0, 0.25, 0.75, 80)


def test_6_fusion_weights_reach_the_fusion() -> None:
    """Two short flights: the receiver fuses with the weight that came along; at 0 it sees what it sees alone."""

    def weighted(weight: float | None) -> SortieRecord:
        """Of drones 1 and 2; drone 0 sends at half weight."""
        rung = Representation.NONE if weight is None else Representation.FEATURES

        def policy(view: FleetView) -> list[Directive]:
            other = PLAIN._replace(representation=rung, fusion_weight=weight or 0.0)
            change = PLAIN._replace(fusion_weight=0.5) if view.ego == 0 else other
            return [change._replace(source=view.ego, destination=p) for p in view.peers]

        sets = ("perception.detector=surrogate", "duration_s=2", "fleet.drones=3", NO_PHASES, *PATIENT)
        return run_sortie(example(*sets), policy)

    none, alone = weighted(0.0), weighted(None)
    weights = {
        (r["drone"], peer): weight
        for r in none.tables["fusions"].to_pylist()
        for peer, weight in zip(r["peers"], r["weights"], strict=True)
    }
    assert weights == {(i, j): 0.5 if j == 0 else 0.0 for i in range(3) for j in range(3) if i != j}
    boxes = [[r for r in record.tables["detections"].to_pylist() if r["drone"] == 0] for record in (none, alone)]
    assert boxes[0] == boxes[1] != []


def test_a_link_that_hovers_about_a_threshold_steps_down_once_and_stays(tmp_path: Path) -> None:
    """Flights of their own. A policy slows down below 7 Mb/s: without the band it climbs each time the link is back."""
    links = tmp_path / "links.csv"
    traced = [f"{0.5 * k:g},0,{peer},{30 if k < 2 else 8 + k % 2 * 2}" for k in range(13) for peer in (1, 2)]
    links.write_text("t_s,sender,receiver,goodput_mbps\n" + "\n".join(traced) + "\n")

    def slows(view: FleetView, /) -> Sequence[Directive]:
        asked = [PLAIN._replace(source=view.ego, destination=p, rho=0.02) for p in view.peers]
        me = view.me
        return [d if me and me.goodput_to(d.destination) >= 7.0 else d._replace(rate_hz=5.0) for d in asked]

    def climbs(hysteresis: float) -> int:
        sets = (NO_PHASES, "fleet.drones=3", "policy.dwell_s=0.1", f"radio.trace={links}")
        record = run_sortie(example(*sets, f"policy.hysteresis={hysteresis}"), slows)
        rows = record.tables["directives"].to_pylist()
        rates_hz = [r["rate_hz"] for r in rows if (r["drone"], r["peer"]) == (0, 1)]
        return sum(b > a for a, b in itertools.pairwise(rates_hz))

    assert climbs(0.25) == 1  # after take-off
    assert climbs(0.0) > 3


def test_switches_count_links_also_where_several_change_alike() -> None:
    """Counted again from the rows. What one drone decides for several links at once is one entry of the log."""
    record = recorded("lost_drone")
    result = outcome(record)
    carried: dict[tuple[int, int], str] = {}
    changed, moments = 0, set()
    for row in record.tables["directives"].to_pylist():
        link, now = (row["drone"], row["peer"]), describe(row)
        if carried.get(link, "nothing") != now:
            changed += 1
            moments.add((row["t_s"], row["drone"], carried.get(link, "nothing"), now, row["reason"]))
        carried[link] = now
    assert len(result["transitions"]) == len(moments) < changed
    assert result["switches"] == pytest.approx(changed / 20 / (record.scenario.duration_s / 60))
