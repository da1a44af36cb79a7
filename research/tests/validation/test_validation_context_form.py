"""Smaller descriptors, in flight: fewer bytes, staleness in their own period, and no honest drone doubted."""

from __future__ import annotations

import pytest
from sim_examples import example

from research.validation import minimal_context
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

SEARCH = "mission.phases=[{at_s: 0, phase: search}]"


def bytes_of(*overrides: str) -> int:
    return int(outcome(run_sortie(example(SEARCH, *overrides)))["bytes"]["context_descriptors"])


def test_a_smaller_form_sends_the_bytes_that_it_should() -> None:
    """180 B and 28 B of authentication; 17 B, 18 numbers of 16 bits, 64 bits of grid, the same 28 B."""
    assert bytes_of() == 5 * 60 * (180 + 28)
    small = ("context.form=small",)
    assert bytes_of(*small) == 5 * 60 * (17 + 18 * 2 + 8 + 28)
    assert bytes_of("context.publish_every=5") == 5 * 12 * (180 + 28)


def test_ages_count_in_the_descriptors_own_period() -> None:
    """At 2 Hz a descriptor of half a second ago is as fresh as one of a tenth at 10 Hz: no link is degraded."""
    record = run_sortie(
        example("context.publish_every=5", "policy.name=all-4", "policy.params={received_budget: 0.02}")
    )
    assert set(record.tables["directives"]["link"].to_pylist()) == {"fresh"}
    assert max(record.tables["ages"]["age_s"].to_pylist()) > 0.4
    drones = record.tables["transmissions"]
    assert drones.num_rows > 500


@pytest.mark.parametrize("form", minimal_context.FORMS.values(), ids=list(minimal_context.FORMS))
def test_no_form_makes_honest_drones_doubt_each_other(form: tuple[str, ...]) -> None:
    record = run_sortie(example(*form, "duration_s=25", "policy.name=deputies", "policy.params={}"))
    assert outcome(record)["distrusted_by"] == {}


def test_the_table_is_made() -> None:
    rows = list(minimal_context.measure([1], 3.0, ["deputies"], ["the paper's", "no grid"]))
    assert rows[0].difference.delta == 0.0
    assert rows[1].context_bytes_per_s < 0.8 * rows[0].context_bytes_per_s
    assert [row[-1] is None for row in minimal_context.table(rows).rows] == [True, False]
