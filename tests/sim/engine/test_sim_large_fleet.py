"""More than 200 drones: ids of two bytes, rosters of those in earshot, and a record of the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sim_examples import example

from sortie.fleet.memory import PeerMemory
from sortie.fleet.messages.auth import DropReason, Opened
from sortie.fleet.messages.wire import decode_descriptor, encode_descriptor
from sortie.fleet.peers import PeerTable
from sortie.fleet.plane import DroneStatus, FleetRules
from sortie.policies.contract import Descriptor, Roster
from sortie.scenarios.disc import LISTED_IDS, LISTED_MEMBERS
from sortie.scenarios.errors import SortieError
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.export.messages import descriptors
from sortie.sim.export.pcap import address, write_pcap
from sortie.sim.export.telemetry import save_tlog
from sortie.sim.folders import RunError
from sortie.sim.results import run_folder
from sortie.sim.results.link_traffic import mean_goodput
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

DRONES = 260
SETTINGS = (
    f"fleet.drones={DRONES}",
    "fleet.formation={shape: grid, spacing_m: 150, altitude_m: 60}",
    "duration_s=0.5",
    "perception.detector=none",
    "mission.phases=[{at_s: 0, phase: search}]",
)


@pytest.fixture(scope="module")
def flown() -> SortieRecord:
    return run_sortie(example(*SETTINGS))


def test_drones_of_any_id_hear_their_neighbours_alone(flown: SortieRecord) -> None:
    """Of ids that do not fit into a byte as of others; every descriptor fits into a kilobyte."""
    rosters = flown.tables["rosters"].to_pylist()
    assert {row["drone"] for row in rosters} == set(range(DRONES))
    last = {row["drone"]: row["members"] for row in rosters}
    sizes = np.array([len(members) for members in last.values()])
    assert 10 < sizes.mean() < 100
    assert any(max(members) > 254 for members in last.values())
    assert max(flown.tables["descriptors"]["wire_bytes"].to_pylist()) <= 1024
    asked = flown.tables["directives"]
    assert max(asked["drone"].to_pylist()) > 254
    assert outcome(flown)["context"]["lost"] is not None


def test_the_record_lists_goodput_as_the_descriptors_did(flown: SortieRecord, tmp_path: Path) -> None:
    """To the other members of the roster; messages are made from it again, and the kept run is the same."""
    rows = flown.tables["descriptors"]
    counts = rows["goodput_mbps"].combine_chunks().value_lengths().to_numpy()
    assert len(mean_goodput(rows)) == len(counts)
    said: list[Descriptor] = [d for _, d in descriptors(flown)]
    for d, count in zip(said, counts, strict=True):
        assert d.roster is not None
        assert len(d.roster.members) - 1 == count == len(d.peer_goodput_mbps)
        assert d.agent_id in d.roster.members
        again = decode_descriptor(encode_descriptor(d))
        assert (again.agent_id, again.roster) == (d.agent_id, d.roster)
    run_folder.save(flown, tmp_path / "run")
    assert run_folder.load(tmp_path / "run").fingerprint == flown.fingerprint


def test_exports_name_every_drone_or_refuse(flown: SortieRecord, tmp_path: Path) -> None:
    """Addresses of a packet capture differ from drone to drone; MAVLink has 255 system ids."""
    write_pcap(flown, tmp_path / "run.pcapng", 0)
    assert len({address(i) for i in range(5000)}) == 5000
    assert address(299) == bytes((10, 0, 1, 44))
    with pytest.raises(RunError, match=r"fleet\.drones is 260, must be at most 255 for MAVLink"):
        save_tlog(flown, tmp_path / "run.tlog", begin_us=0)


def test_directives_count_with_the_bytes_that_they_have(flown: SortieRecord) -> None:
    rows = flown.tables["directives"]
    long = sum(max(link) > 254 for link in zip(rows["drone"].to_pylist(), rows["peer"].to_pylist(), strict=True))
    assert long > 0
    assert flown.totals["context_directive_bytes"] == 36 * rows.num_rows + 4 * long


def test_who_hears_more_than_a_descriptor_can_list_lists_the_nearest() -> None:
    """Claims decide how near a drone is; a fleet of ids below 200 lists all."""
    rules = FleetRules(0.1, 10, 3.0, 10.0, 1.0, 0.0, 0.05)
    here_m = (0.0, 0.0, 60.0)

    def members(ids: range, me: int) -> tuple[int, ...]:
        memory = PeerMemory(me, rules, DroneStatus(), PeerTable(500, 10))
        for i in ids:
            memory.hold(_at(i, float(i - me)), 0.0)
        return memory.members(0.1, here_m)

    many = members(range(100, 400), 300)
    half = (LISTED_MEMBERS - 1) // 2
    assert many[:-1] == tuple(range(300 - half - 1, 300 + half + 1))[: LISTED_MEMBERS - 1]
    assert len(many) == LISTED_MEMBERS
    assert 300 in many
    assert members(range(LISTED_IDS), 30) == tuple(range(LISTED_IDS))


def test_an_id_that_no_drone_of_the_fleet_has_is_refused() -> None:
    memory = PeerMemory(1, FleetRules(0.1, 10, 3.0, 10.0, 1.0, 0.0, 0.05), DroneStatus())
    stranger = _at(4000, 5.0)._replace(roster=Roster(1, (4000,)))
    assert memory.hear(Opened(stranger, None, 0), 0.1) == DropReason.MALFORMED
    assert memory.hear(Opened(_at(254, 5.0), None, 0), 0.1) is None


def _at(drone: int, x_m: float) -> Descriptor:
    pose = ((x_m, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    return Descriptor(0, drone, *pose, 40.0, 1.0, 1.0, 1.0, (), bytes(64), 0, 0, None)  # type: ignore[arg-type]


def test_the_largest_fleet_and_the_first_too_large_one() -> None:
    assert example("fleet.drones=5000").publishes_rosters
    assert not example(f"fleet.drones={LISTED_IDS}").publishes_rosters
    with pytest.raises(SortieError, match=r"fleet\.drones.*5000"):
        example("fleet.drones=5001")
