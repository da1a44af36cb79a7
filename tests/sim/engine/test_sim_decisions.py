"""Each of a directive's six decisions acts in a sortie: another decision, another record, in the way it should be.

Policies of one line fly the same six seconds; nothing else differs between the two sorties of a test.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import pyarrow as pa
import pytest
from sim_examples import PATIENT, example

from sortie.policies.contract import Directive, Disc, FleetView, Policy, Representation
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import describe, outcome
from sortie.sim.results.record import SortieRecord

PLAIN = Directive(0, 1, Representation.FEATURES, rho=0.05, rate_hz=10.0, reason="plain")
NO_PHASES = "mission.phases=[{at_s: 0, phase: search}]"


def says(change: Callable[[Directive], Directive] = lambda d: d) -> Policy:
    """A policy that says the same to every link, but for `change`."""

    def policy(view: FleetView, /) -> Sequence[Directive]:
        return [change(PLAIN._replace(source=view.ego, destination=p)) for p in view.peers]

    return policy


def flown(change: Callable[[Directive], Directive] = lambda d: d, *overrides: str) -> SortieRecord:
    return run_sortie(example(NO_PHASES, *PATIENT, *overrides), says(change))


@pytest.fixture(scope="module")
def plain() -> SortieRecord:
    return flown()


def sent(record: SortieRecord) -> pa.Table:
    return record.tables["transmissions"]


def captures(record: SortieRecord) -> set[tuple[int, float]]:
    """Every (drone, time) of which something was sent."""
    return set(zip(sent(record)["drone"].to_pylist(), sent(record)["captured_s"].to_pylist(), strict=True))


def test_1_duty_cycle_rests_perception_and_saves_its_energy(plain: SortieRecord) -> None:
    half = flown(lambda d: d._replace(duty_percent=50))
    assert len(captures(half)) == pytest.approx(len(captures(plain)) / 2, abs=5)
    assert outcome(half)["energy_j"]["compute"] < 0.95 * outcome(plain)["energy_j"]["compute"]


def test_2_topology_is_who_is_sent_to(plain: SortieRecord) -> None:
    def next_only(d: Directive) -> Directive:
        near = d.destination == (d.source + 1) % 5
        return d if near else d._replace(representation=Representation.NONE)

    def links(record: SortieRecord) -> set[tuple[int, int]]:
        return set(zip(sent(record)["drone"].to_pylist(), sent(record)["peer"].to_pylist(), strict=True))

    assert links(plain) == {(i, j) for i in range(5) for j in range(5) if i != j}
    assert links(flown(next_only)) == {(i, (i + 1) % 5) for i in range(5)}


@pytest.mark.parametrize("rung", [r for r in Representation if r not in (Representation.NONE, Representation.FEATURES)])
def test_3_representation_is_what_is_sent(plain: SortieRecord, rung: Representation) -> None:
    record = flown(lambda d: d._replace(representation=rung, deadline_s=1.0))
    assert set(sent(record)["representation"].to_pylist()) == {rung.name.lower()}
    assert set(sent(plain)["representation"].to_pylist()) == {"features"}
    mean = [sum(s := sent(r)["payload_bytes"].to_pylist()) / len(s) for r in (record, plain)]
    assert (mean[0] > mean[1]) == (rung > Representation.FEATURES)


def test_3_budget_is_how_many_cells(plain: SortieRecord) -> None:
    assert set(sent(plain)["cells"].to_pylist()) == {204}
    assert set(sent(flown(lambda d: d._replace(rho=0.02)))["cells"].to_pylist()) == {81}


def test_4_region_is_which_cells(plain: SortieRecord) -> None:
    """A disc of 6 m about the origin holds at most some ten cells of 10 m²; far from it there is nothing to send."""
    near = flown(lambda d: d._replace(rho=1.0, roi=Disc(0.0, 0.0, 6.0)))
    cells = sent(near)["cells"].to_pylist()
    assert cells
    assert max(cells) <= 14 < min(sent(plain)["cells"].to_pylist())
    away = flown(lambda d: d._replace(rho=1.0, roi=Disc(3000.0, 0.0, 6.0)))
    assert sent(away).num_rows == 0


def test_5_rate_is_how_often(plain: SortieRecord) -> None:
    assert sent(flown(lambda d: d._replace(rate_hz=2.0))).num_rows == pytest.approx(sent(plain).num_rows / 5, abs=20)


def test_5_deadline_is_how_long_it_may_take() -> None:
    """In 1 ms hardly one of twenty payloads a frame gets through, as each takes most of it; within a frame all do."""
    hurried, plain = (
        outcome(flown(lambda d, s=s: d._replace(rho=0.1, deadline_s=s))) for s in (0.001, PLAIN.deadline_s)
    )
    assert hurried["deadline_miss_rate"] > 0.9
    assert (plain["deadline_miss_rate"] or 0.0) < 0.1


SURROGATE = ("perception.detector=surrogate", "duration_s=4")


def test_6_fusion_weights_reach_the_fusion() -> None:
    """The receiver fuses with the weight that came along; at weight 0 it sees what it sees alone."""

    def weights(record: SortieRecord) -> set[float]:
        return {w for ws in record.tables["fusions"]["weights"].to_pylist() for w in ws}

    full, half, none, alone = (
        flown(change, *SURROGATE)
        for change in (
            lambda d: d,
            lambda d: d._replace(fusion_weight=0.5),
            lambda d: d._replace(fusion_weight=0.0),
            lambda d: d._replace(representation=Representation.NONE),
        )
    )
    assert (weights(full), weights(half), weights(none)) == ({1.0}, {0.5}, {0.0})
    seen = [r.tables["detections"] for r in (full, half, none, alone)]
    assert not seen[0].equals(seen[2])
    assert not seen[0].equals(seen[1])
    assert seen[2].equals(seen[3])


def test_every_decision_stands_in_the_directives_table() -> None:
    asked = PLAIN._replace(
        roi=Disc(1.0, 2.0, 30.0), rate_hz=5.0, deadline_s=0.25, fusion_weight=0.75, duty_percent=80, rho=0.125
    )
    record = flown(lambda d: asked._replace(source=d.source, destination=d.destination))
    rows = [r for r in record.tables["directives"].to_pylist() if r["representation"] == "features"]
    assert rows
    for row in rows:
        got = (row["rho"], row["roi_radius_m"], row["rate_hz"], row["deadline_s"], row["fusion_weight"])
        assert (*got, row["duty_percent"]) == (0.125, 30.0, 5.0, 0.25, 0.75, 80)


def test_a_link_that_hovers_about_a_threshold_steps_down_once_and_stays(tmp_path: Path) -> None:
    """A policy slows down below 7 Mb/s, with hardly any dwell: without the band it climbs each time the link is back."""
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
    """Four links of each of five drones begin in one decision: an entry a drone in the log, and twenty switches.

    They begin at 2 s, when everyone has heard everyone; before, a link begins with the first descriptor that is not lost.
    """

    def late(view: FleetView, /) -> Sequence[Directive]:
        return says()(view) if view.me and view.me.stamp_ns >= 2_000_000_000 else []

    record = run_sortie(example(NO_PHASES, *PATIENT), late)
    result = outcome(record)
    carried: dict[tuple[int, int], str] = {}
    changed = 0
    for row in record.tables["directives"].to_pylist():
        link, now = (row["drone"], row["peer"]), describe(row)
        changed += carried.get(link, "nothing") != now
        carried[link] = now
    assert len(result["transitions"]) == 5
    assert changed == 20
    assert result["switches"] == pytest.approx(changed / 20 / (record.scenario.duration_s / 60))
