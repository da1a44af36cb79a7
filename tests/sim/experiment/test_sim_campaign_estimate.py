"""`sortie campaign --dry-run`: how many runs there are, and how long they will take."""

from __future__ import annotations

from itertools import count
from pathlib import Path

from sortie.scenarios.reading.campaign import load_campaign
from sortie.sim.experiment import estimate
from sortie.sim.experiment.plan import make_plan

CAMPAIGN = """
campaign: tiny
base: track_target
set: {duration_s: 90, perception.detector: none}
policies: [worked, silence]
vary: {fleet.drones: {kind: grid, values: [2, 3, 4]}}
replications: 5
metrics: [bytes.data_sent]
"""


def test_the_runs_are_counted_and_a_run_is_worked_out_from_its_first_seconds(tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(CAMPAIGN)
    plan = make_plan(load_campaign(tmp_path / "tiny.yaml"))
    ticks = count()
    seconds = estimate.run_s(plan, clock=lambda: 2.0 * next(ticks))  # two seconds for each simulated one
    assert seconds == 180.0
    words = estimate.in_words(plan, seconds, 2)
    assert words.startswith(
        "tiny: 30 runs (2 policies × 3 grid points × 5 replications), about 45 minutes with 2 workers"
    )
