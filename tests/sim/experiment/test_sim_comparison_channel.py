"""A policy that fills the channel is told beside the verdict: what it is compared by is the jam, not its choice."""

from __future__ import annotations

import sortie

SHORT = {"duration_s": 4, "perception.detector": "none"}


def test_a_full_channel_is_told() -> None:
    compared = sortie.compare("track_target", ["worked", "all-4(received_budget=1.0)"], SHORT)
    lines = [line for line in str(compared.summary()).replace("\n", " ").split(": ") if "the channel is full" in line]
    assert len(lines) == 1
    fates = compared.sorties[1].outcome["payload_fates"]
    missed = sum(n for fate, n in fates.items() if fate.startswith("expired")) / sum(fates.values())
    assert missed >= 0.5
    assert f"{100 * missed:.1f} %" in lines[0]
