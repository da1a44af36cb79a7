"""Decisions and events as sentences, the same in the playback, in a bag and on a page of results."""

from __future__ import annotations

from typing import Any

from sortie.scenarios.report_text import percent


def decision_in_words(change: dict[str, Any]) -> str:
    """A transition as a sentence: `drone 2 → 0, 1: detections at 2 Hz, because goodput 3.1 < 5 Mb/s`."""
    peers = ", ".join(str(p) for p in change["peers"])
    reason = f", because {change['reason']}" if change["reason"] else ""
    return f"drone {change['drone']} → {peers}: {change['to']}{reason}"


_LOST_TO = {
    "collision_context": "collisions with descriptors",
    "collision_data": "collisions with payloads",
    "hidden": "hidden senders",
    "weak_signal": "weak signals",
    "half_duplex": "own transmissions",
}


def losses_in_words(context: dict[str, Any]) -> str:
    """What descriptors were lost to, the largest part first: `2.1 % collisions with payloads, 0.3 % weak signals`."""
    parts = sorted(((share, cause) for cause, share in context["lost_to"].items() if share), reverse=True)
    return ", ".join(f"{percent(share)} {_LOST_TO[cause]}" for share, cause in parts)


def turns_in_words(ap50: dict[str, Any]) -> str:
    """Which drones were scored where they took turns: `, 50 of 1,000 drones scored at a time`; empty where all were."""
    scored, every = ap50["scored_drones"], ap50["scorable_drones"]
    return f", {scored:,} of {every:,} drones scored at a time" if 0 < scored < every else ""


def event_in_words(row: dict[str, Any]) -> str:
    """An event and the drone that it affects: `drone 2: links of 2 lose 37 dB`."""
    return f"{'fleet' if row['drone'] < 0 else 'drone ' + str(row['drone'])}: {row['text']}"
