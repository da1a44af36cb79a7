"""Invariants are judged on what the gates enforce: counted against the record's own directives, each with its cause."""

from __future__ import annotations

import pytest
from sim_examples import example

from sortie.policies.contract import DIRECTIVE_BOUNDS
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

KEPT = "any_link(representation >= detections and rate_hz >= 2)"
CUT_OFF = "events=[{kind: link_drop, at_s: 2, until_s: 4, drone: 0, loss_db: 120}]"
SHIELDED = (f"policy.invariants='{KEPT}'", "policy.shield=true")


def gates_that_share_nothing(record: SortieRecord) -> list[tuple[float, int]]:
    """Decisions after which a drone sends no peer its detections, from the gates' own rows."""
    directives = record.tables["directives"].to_pylist()
    found, sending, k = [], {}, 0
    decisions = {(r["t_s"], r["drone"]) for r in record.tables["descriptors"].to_pylist()}  # at the same moment
    for t_s, drone in sorted(decisions):
        while k < len(directives) and directives[k]["t_s"] <= t_s:
            d = directives[k]
            rung = d["representation"] in ("detections", "features", "raw")
            sending[d["drone"], d["peer"]] = rung and d["rate_hz"] >= 2
            k += 1
        if not any(on for (sender, _), on in sending.items() if sender == drone):
            found.append((t_s, drone))
    return found


@pytest.mark.parametrize("policy", ["silence", "worked"])
def test_the_outcome_counts_what_the_gates_did(policy: str) -> None:
    """Judged on the policy's output, the shielded silence kept its line from the first decision; its gates did not."""
    record = run_sortie(example(f"policy.name={policy}", "policy.params={}", CUT_OFF, *SHIELDED))
    found = gates_that_share_nothing(record)
    told = outcome(record)["policies"]
    assert told["violated_ticks"] == len(found) > 5
    rows = record.tables["violations"].to_pylist()
    assert {(r["cause"], r["line"], r["peer"]) for r in rows} == {("no peer", KEPT, -1)}
    first = {r["drone"]: r for r in rows if r["t_s"] < 0.1}
    assert set(first) == {0, 1, 2, 3, 4}, "nobody is heard before the first decision"
    assert all(r["until_s"] == r["t_s"] for r in first.values())
    (row,) = [r for r in rows if r["t_s"] > 0.1]
    cut_off_s = [t_s for t_s, drone in found if t_s > 0.1 and drone == 0]
    assert (row["t_s"], row["until_s"]) == (min(cut_off_s), max(cut_off_s))
    assert 2.9 < row["t_s"] < row["until_s"] < 4.2, (
        "from detached (10 periods of 0.1 s after 2 s) until it is heard again"
    )
    events = [e["text"] for e in outcome(record)["events"] if e["kind"] == "violation"]
    assert events == [f"{KEPT}: broken by no peer"] * 6
    assert told["violations_by_cause"] == {"policy": 0, "staleness": 0, "damping": 0, "no_peer": 6}


@pytest.mark.parametrize(
    ("policy", "line", "cause"),
    [
        ("silence", KEPT, "policy"),
        ("boxes", KEPT, "damping"),
        ("boxes", "every_link(representation >= detections)", "staleness"),
    ],
)
def test_a_violation_names_the_step_that_broke_the_line(policy: str, line: str, cause: str) -> None:
    record = run_sortie(example(f"policy.name={policy}", "policy.params={}", CUT_OFF, f"policy.invariants='{line}'"))
    rows = [r for r in record.tables["violations"].to_pylist() if r["cause"] == cause]
    assert {r["drone"] for r in rows} >= {1, 2, 3, 4}
    told = outcome(record)["policies"]
    assert told["violations_by_cause"][cause] == len(rows)
    assert told["invariant_violations"] == sum(told["violations_by_cause"].values())
    if cause == "damping":
        assert all(0.15 < r["until_s"] - r["t_s"] < 0.25 for r in rows if r["t_s"] < 1), "the dwell time of 0.3 s"


def test_the_shield_never_gives_a_link_more_than_its_age_allows() -> None:
    """A line that asks for features on every link: links to degraded peers get detections at 2 Hz, detached ones nothing."""
    line = "representation >= features and rate_hz >= 10 and rho >= 0.1"
    record = run_sortie(example(CUT_OFF, f"policy.invariants='{line}'", "policy.shield=true"))
    rows = record.tables["directives"].to_pylist()
    assert {r["link"] for r in rows} == {"fresh", "degraded", "detached"}
    for r in rows:
        if r["link"] == "degraded":
            assert r["representation"] in ("none", "detections")
            assert r["rate_hz"] <= 2
        elif r["link"] == "detached":
            assert r["representation"] == "none"
    fresh = [r for r in rows if r["link"] == "fresh" and r["t_s"] > 0.5]
    assert all(r["representation"] == "features" and r["rate_hz"] <= DIRECTIVE_BOUNDS["rate_hz"].high for r in fresh)
    assert {r["cause"] for r in record.tables["violations"].to_pylist()} == {"staleness"}


def test_a_link_at_no_rate_carries_nothing() -> None:
    """A shield that raises a link makes it send; detections at 0 Hz would keep the letter of the line alone."""
    record = run_sortie(
        example(
            "policy.name=silence",
            "policy.params={}",
            "policy.invariants='any_link(representation >= detections)'",
            "policy.shield=true",
        )
    )
    assert {r["drone"] for r in record.tables["transmissions"].to_pylist()} == {0, 1, 2, 3, 4}
