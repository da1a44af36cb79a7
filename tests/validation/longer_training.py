"""Whether longer training alone makes whole maps better than boxes (`make figures FIGURE=longer_training`).

The plan, committed before the longer run was begun and before any of these frames was looked at with either network:

- Networks. The fine one as it is shipped (3,430 steps of 16 frames), and the same after a third stage: `sortie train --warm-start
  fine.safetensors --seed 2 --batch 32 --scenes 350 --peak-lr 0.003 --varied 0.4 --precision bfloat16 --grid fine --device cuda`, with
  as many `--steps` as six minutes of a GPU allow. Its weights are not shipped: this asks what limits, not which network to fly.
- Frames. The test split of benchmark seed 12, 120 scenes with one fleet-frame of five egos each; intervals over scenes.
- Ways. Silence, averaged boxes, whole maps, whole maps that are read alone too; all but silence with corrected poses too.

Expected: silence, averaged boxes and whole maps all gain one to four points; whole maps less averaged boxes moves by less than a
point, because both are limited by how well a drone places a car and by poses; so whole maps stay within two points of averaged boxes
with estimated poses; whole maps that are read alone too beat averaged boxes by two points with either network.
"""

from __future__ import annotations

from pathlib import Path

from read_maps import COLUMNS, Way, frame_rows, frames
from stored import ROOT, Column, Table

from sortie.perception.network.checkpoint import read_facts

BENCH_SEED, SCENES = 12, 120
LONGER = ROOT / "runs/train/longer.safetensors"
"""What the command makes with `--out`."""
SENT = (("detections",), ("features", 1.0), ("features", 1.0, True))
WAYS = (Way("none"), *(Way(*sent, matched=matched) for matched in (False, True) for sent in SENT))


def table(scenes: int = SCENES) -> Table:
    """Each way with either network."""
    rows = [
        [name, *row]
        for name, weights in (("as shipped", Path("fine.safetensors")), ("trained longer", LONGER))
        for row in frame_rows(frames(scenes, WAYS, weights, BENCH_SEED))
    ]
    run = read_facts(LONGER)["runs"][-1]
    about = (
        f"{scenes} frames of the test split of benchmark seed {BENCH_SEED}, five egos each; intervals over scenes. Longer: "
        f"{run['done']} steps more of {run['batch']} frames in {run['minutes']:.0f} minutes on an {run['device']}."
    )
    return Table([Column("network"), *COLUMNS], rows, about)
