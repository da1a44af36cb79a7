"""Decisions made again over recorded views: the policies that flew answer alike, another one differs where it must."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import pytest
from cli_examples import command, refusal
from sim_examples import PATIENT

import sortie
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Directive, FleetView, Representation

pytestmark = pytest.mark.slow

SHORT = {"duration_s": 4, "perception.detector": "none", "record.views": True}
DROP = {"events": [{"kind": "link_drop", "at_s": 1, "drone": 1, "loss_db": 40, "until_s": 3}]}


def fly(**fields: object) -> sortie.Run:
    return sortie.fly("track_target", {**SHORT, **fields})


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> sortie.Run:
    """In the drop drone 1 hears hardly a descriptor: patient links go on sending, and its policy decides throughout."""
    patient = dict(field.split("=") for field in PATIENT)
    flown = sortie.fly("track_target", {**SHORT, **DROP, **{field: float(n) for field, n in patient.items()}})
    return sortie.open_run(flown.save(tmp_path_factory.mktemp("replay") / "run", recording=False))


def test_the_policy_that_flew_decides_alike(tmp_path: Path) -> None:
    for policy in ("worked", "best-2", "adaptive", "vantage", "deputies", "silence"):
        flown = sortie.fly("track_target", {**SHORT, **DROP}, policy=policy)
        again = sortie.replay(sortie.open_run(flown.save(tmp_path / policy, recording=False)))
        assert again.same
        assert again.decisions == 200
        assert again.flown == again.policy


def test_each_policy_of_a_flight_decides_where_it_did() -> None:
    changes = [
        {"at_s": 1, "name": "best-2", "params": {"received_budget": 0.1}},
        {"phase": "track", "name": "vantage"},
        {"at_s": 3, "name": "best-2", "params": {"received_budget": 0.2}},
    ]
    phases = [{"at_s": 0, "phase": "search"}, {"at_s": 2, "phase": "track", "region": {"radius_m": 32}}]
    again = sortie.replay(fly(**{"policy.changes": changes, "mission.phases": phases}))
    assert again.same
    assert again.policy.count("best-2") == 2
    assert "vantage" in again.policy


def counting() -> Callable[[FleetView], list[Directive]]:
    """A policy with a memory: the number of its calls decides, over all drones."""
    calls = 0

    def counts(view: FleetView) -> list[Directive]:
        nonlocal calls
        calls += 1
        return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=calls % 7) for p in view.peers]

    return counts


def test_decisions_are_made_in_the_order_of_flight() -> None:
    flown = sortie.fly("track_target", SHORT, policy=counting())
    assert sortie.replay(flown, counting()).same
    late = counting()
    late(FleetView(0, 0.1, {}, {}))
    assert not sortie.replay(flown, late).same


def test_a_difference_says_where_in_what_and_why(run: sortie.Run) -> None:
    def hasty(view: FleetView) -> list[Directive]:
        """The worked policy, but drone 1 sends drone 0 half as often from 2 s on."""
        me = view.me
        late = view.ego == 1 and me is not None and me.stamp_ns >= 2_000_000_000
        return [
            d._replace(rate_hz=d.rate_hz / 2, reason="hasty") if late and d.destination == 0 and d.rate_hz else d
            for d in worked(view, rho=0.25)
        ]

    hasty.__qualname__ = "hasty[old]"
    again = sortie.replay(run, hasty)
    assert not again.same
    found = {(d.drone, d.peer, d.fields, d.replayed_reason) for d in again.differences}
    assert found == {(1, 0, ("rate_hz",), "hasty")}
    first = again.differences[0]
    assert 2.0 <= first.t_s < 2.1
    assert first.decision == 20
    assert (first.flown, first.replayed) == ("rate_hz 2", "rate_hz 1")
    assert first.flown_reason.startswith("goodput")
    assert [(s.begin, s.decisions) for s in again.spans] == [(first, 20)]
    assert again.table.num_rows == len(again.differences) == 20
    text = str(again.summary())
    assert "hasty[old] over the views of" in text  # brackets are no markup
    assert "1→0" in text
    assert "The recorded world does not answer" in text


def test_the_command_is_a_test_for_ci(run: sortie.Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run.path is not None
    assert command("replay", run.path, "--expect-same") == 0
    assert command("replay", run.path, "--policy", "worked(rho=0.1)") == 0
    assert command("replay", run.path, "--policy", "worked(rho=0.1)", "--expect-same", "--out", tmp_path / "d.csv") == 1
    capsys.readouterr()
    with (tmp_path / "d.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(sortie.replay(run, "worked(rho=0.1)").differences)
    assert {row["fields"] for row in rows} == {"rho"}


def test_what_cannot_be_replayed_is_refused_in_one_line(
    run: sortie.Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = sortie.fly("track_target", {**SHORT, "duration_s": 1, "record.views": False})
    plain.save(tmp_path / "plain", recording=False)
    assert "--set record.views=true" in refusal(tmp_path, ["replay", "plain"], capsys)
    assert run.path is not None
    assert "unknown policy 'best-3'" in refusal(tmp_path, ["replay", run.path, "--policy", "best-3"], capsys)
    by_function = sortie.fly("track_target", {**SHORT, "duration_s": 1}, policy=counting())
    with pytest.raises(sortie.RunError, match="counts' decided in flight, a function"):
        sortie.replay(by_function)
    with pytest.raises(sortie.PolicyError, match=r"at 1\.\d+ s: .*on drone \d raises ZeroDivisionError"):
        sortie.replay(run, lambda view: [Directive(view.ego, 1 // (view.me.stamp_ns < 1e9), reason="x")] * 0)
    with pytest.raises(sortie.RunError, match="must be a Run"):
        sortie.replay("runs/x")  # type: ignore[arg-type]
