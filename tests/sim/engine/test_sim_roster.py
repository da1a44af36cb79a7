"""Rosters in flight: a fleet with a late joiner, a leaver and a drone that comes back, each goodput by id."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import recorded
from sim_examples import example

from sortie.fleet.agent import Agent
from sortie.fleet.messages.wire import encode_descriptor
from sortie.policies.contract import Descriptor
from sortie.sim.engine import sortie as engine
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.export.messages import descriptors
from sortie.sim.results import run_folder
from sortie.sim.results.link_traffic import LinkTraffic
from sortie.sim.results.views import Decision, decisions


@functools.cache
def made() -> list[Decision]:
    """In the recorded flight drone 3 joins at 2 s, 2 goes home and lands at 4 s, and 1 is away from 1 s to 4 s."""
    return list(decisions(recorded("members").tables))


def own(decision: Decision) -> Descriptor:
    me = decision.view.me
    assert me is not None
    return me


def test_each_goodput_is_the_members_own_in_every_frame() -> None:
    """A flight of its own, without a hysteresis band, so that drones publish what they measure, which is noted."""
    measured: dict[tuple[float, int], dict[int, float]] = {}
    listed = Agent._goodput_mbps

    def kept(self: Agent) -> tuple[float, ...]:
        found = listed(self)
        measured[self._env.now, self.drone] = dict(zip(self._listed.tolist(), found, strict=True))
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Agent, "_goodput_mbps", kept)
        scenario = recorded("members").scenario
        policy = scenario.policy.model_copy(update={"hysteresis": 0.0})
        flown = run_sortie(scenario.model_copy(update={"policy": policy}))
    checked = 0
    for d in decisions(flown.tables):
        me, known = own(d), measured[d.t_s, d.drone]
        assert me.roster is not None
        for peer in set(range(5)) - {d.drone}:
            is_member = peer in me.roster.members
            expected = known[peer] if is_member else 0.0
            assert me.goodput_to(peer) == np.float32(expected)
            checked += is_member and expected > 1.0
    assert checked > 100


def test_the_roster_is_the_drone_and_its_attached_peers() -> None:
    for d in made():
        assert own(d).roster == d.view.roster
        assert d.view.roster.members == d.view.members == tuple(sorted({d.drone, *d.view.attached.peers}))


def test_members_follow_who_joins_leaves_and_comes_back() -> None:
    """Ten periods after a drone fell silent it is no member; a quarter of a second after it came it is one, of all."""
    together = [(0.25, 1.0, (0, 1, 2, 4)), (2.3, 3.6, (0, 2, 3, 4)), (5.5, 6.0, (0, 1, 3, 4))]
    for begin_s, end_s, members in together:
        now = [d for d in made() if begin_s < d.t_s < end_s]
        assert {d.drone for d in now} == set(members)
        assert {d.view.roster.members for d in now} == {members}


def test_drones_that_know_the_same_members_have_equal_rosters() -> None:
    """All that fly agree on the members at the end, whenever they came; so does what they read of each other."""
    last = {d.drone: d for d in made() if d.t_s > 5.8}
    assert sorted(last) == [0, 1, 3, 4]
    assert {d.view.roster.members for d in last.values()} == {(0, 1, 3, 4)}
    for d in last.values():
        heard = d.view.attached.descriptors.values()
        assert {h.roster.members for h in heard if h.roster is not None} == {(0, 1, 3, 4)}
        assert all(h.counts(d.drone) for h in heard)


def test_an_epoch_begins_with_each_change_and_with_nothing_else() -> None:
    for drone in range(5):
        before = None
        for roster in (d.view.roster for d in made() if d.drone == drone):
            if before is not None:
                assert roster.epoch == before.epoch + (roster.members != before.members)
            before = roster
        assert before is not None
        assert before.epoch > 1


def test_the_record_lists_goodput_to_all_and_the_rosters() -> None:
    """Playback and reports read a list of one length, as without rosters."""
    flown = recorded("members")
    rows = flown.tables["descriptors"]
    assert set(map(len, rows["goodput_mbps"].to_pylist())) == {4}
    by_decision = {(d.t_s, d.drone): own(d) for d in made()}
    for row in rows.to_pylist():
        assert row["goodput_mbps"] == pytest.approx(by_decision[row["t_s"], row["drone"]].goodput_by_id(5), rel=1e-6)
    epochs = [r["epoch"] for r in flown.tables["rosters"].to_pylist() if r["drone"] == 0]
    assert epochs == sorted({d.view.roster.epoch for d in made() if d.drone == 0})
    goodput, _ = LinkTraffic(5, 10.0).add(np.array([5.9]), rows, flown.tables["transmissions"])
    assert goodput[0, 0, 2] == 0.0
    last = [r["goodput_mbps"][3] for r in rows.to_pylist() if r["drone"] == 0 and r["t_s"] < 5.9][-1]
    assert goodput[0, 0, 4] == last


def test_a_bag_has_the_rosters_and_their_bytes() -> None:
    flown = recorded("members")
    sizes = [b - 28 for b in flown.tables["descriptors"]["wire_bytes"].to_pylist()]
    remade = [d for _, d in descriptors(flown)]
    assert [len(encode_descriptor(d)) for d in remade] == sizes
    rosters = {(r["drone"], r["epoch"]): tuple(r["members"]) for r in flown.tables["rosters"].to_pylist()}
    assert {(d.agent_id, d.roster.epoch): d.roster.members for d in remade if d.roster is not None} == rosters


def test_a_fleet_in_which_some_publish_no_roster(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flight of its own: drones 0 and 4 are of an older version; all read each goodput by its id."""
    build = engine.build

    def mixed(*arguments: object) -> engine.Parts:
        parts = build(*arguments)  # type: ignore[arg-type]
        for drone in (0, 4):
            parts.agents[drone]._rules = replace(parts.agents[drone]._rules, roster=False)
        return parts

    monkeypatch.setattr(engine, "build", mixed)
    mixed_fleet = list(decisions(run_sortie(recorded("members").scenario).tables))
    for d in mixed_fleet:
        for i, heard in d.view.descriptors.items():
            assert (heard.roster is None) == (i in (0, 4))
    for d in (d for d in mixed_fleet if d.t_s > 5.8):
        assert d.view.roster.members == (0, 1, 3, 4)
        assert all(h.goodput_to(d.drone) > 0.0 for h in d.view.attached.descriptors.values() if h.agent_id != d.drone)


def test_without_the_setting_there_is_no_roster_and_a_run_from_before_rosters_is_read(tmp_path: Path) -> None:
    """A short flight of its own, without rosters and with views."""
    record = run_sortie(example("duration_s=1", "mission.phases=[{}]", "record.views=true"))
    assert "rosters" not in record.tables
    plain = list(decisions(record.tables))
    assert all(own(d).roster is None for d in plain)
    without = record.tables["view_descriptors"].drop_columns(["roster"])
    run_folder.save(replace(record, tables={**record.tables, "view_descriptors": without}), tmp_path / "run")
    assert list(decisions(run_folder.load(tmp_path / "run").tables)) == plain
