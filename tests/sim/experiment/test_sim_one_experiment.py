"""One name is one experiment: flown and evaluated on the same frames, `best-2` gives the same bytes and the same AP."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest
from recording_examples import record_flight
from sim_examples import example

from sortie.perception.evaluation import SINGLE, Sharing, evaluate_recording
from sortie.perception.metrics.ap import average_precision
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.accuracy import matched
from sortie.sim.results.record import SortieRecord

pytestmark = pytest.mark.slow

FLIGHT = (
    "duration_s=6",
    "mission.phases=[{at_s: 0, phase: search}]",
    "fleet.formation.shape=line",
    "fleet.formation.spacing_m=18",
    "policy.dwell_s=0",
    "radio.shadowing_sigma_db=0",
    "perception.sample_rate_hz=10",
)
SETTLED_S = 1.5
"""By then every descriptor was heard and every drone has sent."""
CELL_BYTES = 160
DELAY_S = 0.095
"""From a frame's begin to its fusion."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A frame a second, each for the half second before and after: a payload is of the frame it is fused in."""
    return record_flight(
        example(*FLIGHT), tmp_path_factory.mktemp("recording") / "flight.npz", features=False, every=10
    )


def flown(recording: Path, policy: str, params: str) -> SortieRecord:
    recorded = ("perception.detector=recorded", f"perception.recording={recording}")
    return run_sortie(example(*FLIGHT, *recorded, f"policy.name={policy}", f"policy.params={{{params}}}"))


@pytest.mark.parametrize(("name", "budget"), [("all-4", 0.02), ("best-2", 0.0006), ("worst-2", 0.02)])
def test_flown_and_evaluated_sharing_agree(recording: Path, name: str, budget: float) -> None:
    record = flown(recording, name, f"received_budget: {budget}")
    condition = Sharing(budget, name)
    found = evaluate_recording(recording, [condition, SINGLE]).at(0.1)

    sent = record.tables["transmissions"].to_pylist()
    assert {t["status"] for t in sent if t["captured_s"] < 5.5} == {"delivered"}, "the links are perfect"
    at = {
        (round(t_s), ego): m
        for (t_s, ego), m in matched(record, mission=False).items()
        if t_s > SETTLED_S and round(t_s - DELAY_S, 6).is_integer()
    }
    frames = sorted({t_s for t_s, _ in at})
    assert frames == [2, 3, 4, 5]
    for f in frames:
        # what reached each ego of the captures a tenth of a second before, against what the evaluation counts
        cells = Counter[int]()
        for t in sent:
            if t["captured_s"] == pytest.approx(f - 0.1):
                cells[t["peer"]] += t["cells"]
        evaluated = found.payload_bytes[condition].reshape(-1, 5)[f] / CELL_BYTES
        assert [cells[ego] for ego in range(5)] == evaluated.tolist()
        assert set(cells.values()) == {int(budget * 4 * 4096)}, "every ego receives its whole budget"
    rows = np.arange(len(found.payload_bytes[condition])).reshape(-1, 5)[frames].ravel()
    shared, alone = (average_precision([found.matched(c)[i] for i in rows]) for c in (condition, SINGLE))
    assert average_precision(list(at.values())) == shared
    assert shared > alone


def test_the_senders_choice_is_another_experiment(recording: Path) -> None:
    """Equal bytes for the fleet, but some egos receive from more drones than others."""
    record = flown(recording, "best-2-receivers", "sent_budget: 0.02")
    sent = record.tables["transmissions"].filter(pc.field("captured_s") > SETTLED_S)
    into = {ego: len(set(sent.filter(pc.field("peer") == ego)["drone"].to_pylist())) for ego in range(5)}
    assert sum(into.values()) == 10
    assert set(into.values()) != {2}
