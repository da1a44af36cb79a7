"""The flight that tests of exports read: flown once in each process."""

from __future__ import annotations

from functools import cache

import pyarrow.compute as pc
import pytest
from sim_examples import example

from sortie.fleet.messages.auth import Sealer
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.record import SortieRecord

SECONDS = 5
EVENTS = (
    "{kind: gnss_loss, at_s: 1.95, until_s: 3.97, drone: 1}",
    "{kind: drone_lost, at_s: 2, drone: 3}",
    "{kind: link_drop, at_s: 3.5, drone: 2, loss_db: 60}",
)


@cache
def flown() -> tuple[SortieRecord, tuple[bytes, ...]]:
    """Five seconds with a detector and the events; and the sealed descriptors as they went on the air."""
    sent: list[bytes] = []
    seal = Sealer.seal

    def tapped(self: Sealer, payload: bytes) -> bytes:
        sent.append(seal(self, payload))
        return sent[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Sealer, "seal", tapped)
        events = f"events=[{', '.join(EVENTS)}]"
        record = run_sortie(example(f"duration_s={SECONDS}", "perception.detector=surrogate", events))
    return record, tuple(sent)


def in_seconds(record: SortieRecord) -> list[dict[str, object]]:
    """The rows of a record second by second, as an observer of the flight gets them."""
    return [
        {
            name: table.filter((pc.field("t_s") >= second) & (pc.field("t_s") < second + 1))
            for name, table in record.tables.items()
            if "t_s" in table.column_names
        }
        for second in range(SECONDS)
    ]
