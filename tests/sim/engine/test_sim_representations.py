"""Boxes with uncertainty and codes in whole sorties: what flies, what is fused, and what the surrogate cannot estimate."""

from __future__ import annotations

import pytest
from sim_examples import example

from sortie.perception.errors import InputError
from sortie.scenarios.representation import BOXES, NAME_OF, REPRESENTATION_OF, Representation
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.export.messages import directives
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.report_figures import SENT as REPORT

SHORT = ("duration_s=4", "perception.sample_rate_hz=1")


BUDGET = "policy.params={received_budget: 0.05}"


def flown(policy: str, *more: str) -> SortieRecord:
    return run_sortie(example(*SHORT, f"policy.name={policy}", "policy.params={}", *more))


def kinds(record: SortieRecord) -> set[str]:
    return {r["representation"] for r in record.tables["transmissions"].to_pylist()}


def test_uncertain_boxes_fly_by_the_surrogate_and_count_36_bytes_each() -> None:
    record = flown("uncertain-boxes", "perception.detector=surrogate")
    rows = record.tables["transmissions"].to_pylist()
    assert kinds(record) == {"uncertain_boxes"}
    assert all(r["payload_bytes"] == 76 + 36 * r["boxes"] for r in rows)
    assert any(r["boxes"] > 5 for r in rows)
    assert {how for r in record.tables["fusions"].to_pylist() for how in r["representations"]} == {"uncertain_boxes"}
    assert {d.representation for _, d in directives(record)} >= {Representation.UNCERTAIN_BOXES}
    assert outcome(record)["ap50"]["full_scene"] is not None


def test_codes_are_traffic_of_exact_size_and_the_surrogate_says_that_it_cannot_estimate_them() -> None:
    alone = ("perception.detector=none", "perception.code_bytes=5")
    record = flown("codes", *alone, BUDGET)
    rows = record.tables["transmissions"].to_pylist()
    assert kinds(record) == {"codes"}
    assert {r["cells"] for r in rows} == {204, 205}
    assert all(r["payload_bytes"] == 76 + 8 + 5 * r["cells"] + r["index_bytes"] for r in rows)
    plain = flown("all-4", *alone, BUDGET)
    assert {r["cells"] for r in plain.tables["transmissions"].to_pylist()} == {204, 205}
    with pytest.raises(
        InputError, match=r"the surrogate cannot estimate what codes do: .* Set perception.detector to torch"
    ):
        flown("codes", "perception.detector=surrogate")


def test_every_representation_has_its_colours_and_its_way_on_the_air() -> None:
    from sortie.sim.results.palette import SENT

    sent = set(REPRESENTATION_OF) - {"none"}
    assert sent <= set(SENT)
    assert sent <= set(REPORT)
    assert len({SENT[name] for name in sent}) == len({REPORT[name] for name in sent}) == len(sent)
    assert {NAME_OF[r] for r in BOXES} == {"tracks", "detections", "uncertain_boxes"}
