"""Plans that nobody chose: drawn from a seed, and run through ns-3 and through the Air.

    python -m research.validation.ns3.wifi_drawn --seed 7 --plans 12      prints the table; the seed is yours

`make figures FIGURE=ns3_drawn` stores the plans of one seed.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np

from research.validation.ns3.wifi_compare import SEEDS, loads_table
from research.validation.ns3.wifi_plan import FRAME_S, Case, pairs_of
from research.validation.stored import Table
from sortie.radio import AirSettings
from sortie.radio.sample import Service
from sortie.scenarios.streams import stream

DRONES, PAYLOAD_BYTES, MCS = (3, 30), (13_000, 200_000), (3, 11)
LOADS = (0.05, 1.5)
"""Offered payload bits over what one sender carries alone at the MCS."""
FADES = ("none", "none", "frame", "ppdu")
LONGEST_LINE = 12
"""Drones; so all hear each other."""


def drawn(seed: int, number: int) -> Case:
    """One plan: shape, fleet, payload, MCS, load and fading at random; long enough for some thousand payloads or frames."""
    rng = stream(seed, number, (), "validation.ns3")
    shape = str(rng.choice(["cross", "grid", "line"]))
    drones = int(rng.integers(DRONES[0], min(DRONES[1], LONGEST_LINE if shape == "line" else DRONES[1]) + 1))
    size, load = (float(np.exp(rng.uniform(*np.log(ends)))) for ends in (PAYLOAD_BYTES, LOADS))
    mcs, fade = int(rng.integers(MCS[0], MCS[1] + 1)), str(rng.choice(FADES))
    alone_mbps = Service(AirSettings(), 0.0)._full_mbps[mcs]
    links = round(load * alone_mbps * 1e6 * FRAME_S / (8 * size))
    case: dict[str, Any] = {"shape": shape, "drones": drones, "payload_bytes": round(size), "mcs": mcs, "fade": fade}
    most = len(pairs_of(Case("", **case).positions_m(), drones * drones))
    pairs = min(max(1, links), most)
    of_alone = pairs * 8 * size / FRAME_S / (alone_mbps * 1e6)
    name = f"{drones} in a {shape}, {size / 1e3:.0f} kB over {pairs} links, MCS {mcs}"
    words = {"none": "", "frame": ", fading by frame", "ppdu": ", fading by exchange"}[fade]
    return Case(name + words, pairs=pairs, load=of_alone, stop_s=6.0 if drones < 10 else 2.4, **case)


def table(seed: int, plans: int, seeds: tuple[int, ...] = SEEDS) -> Table:
    """Drawn plans by both simulators."""
    about = (
        f"{plans} plans, drawn from the seed {seed}; {len(seeds)} seeds for each. The load is the offered payload over what "
        "one sender carries alone. Speed compares the medians of processor time."
    )
    return loads_table([drawn(seed, k) for k in range(plans)], seeds, about)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--plans", type=int, default=12)
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="runs of each plan")
    asked = parser.parse_args()
    sys.stdout.write(table(asked.seed, asked.plans, tuple(range(1, asked.seeds + 1))).markdown() + "\n")


if __name__ == "__main__":
    main()
