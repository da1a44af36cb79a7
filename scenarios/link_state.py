"""What a drone knows of an outgoing link. A goodput's value says it, so that a descriptor needs no further field.

| goodput | state |
|---|---|
| 0 | unknown: no payload lately, and no descriptor of the peer was ever heard |
| above 0, at most `SILENT_MBPS` | silent: nothing got through the last time, or the peer's descriptors stay away |
| above `SILENT_MBPS`, at most `PROBED_MBPS` | probed: no payload lately, but the peer's descriptors arrive |
| above `PROBED_MBPS` | measured, with payloads of the last `MEASURED_FOR_S` |

The paper's descriptor has one 32-bit float for each peer and 0 for a link without a measurement. A silent or a probed
link is therefore written as a rate that carries nothing. A reader without this table takes all three for a link that
carries nothing.

A descriptor that is heard went the other way, from the peer to this drone. Path loss and shadowing are the same both
ways. Noise, jammers and queues at the two ends are not. So a probed link has no rate. Its value has the share of the
peer's descriptors that arrived, which is how far the link can be relied on (`heard_share`).
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

SILENT_MBPS = 2.0**-10
"""What a known link reads at least: about 1 kb/s, exact as a 32-bit float."""
PROBED_MBPS = 2.0 * SILENT_MBPS
"""What a link reads if all descriptors of its peer arrived."""
WAITING_MBPS = 2.0 * PROBED_MBPS
"""What a link reads at least if its payloads only waited behind others: nothing was tried, so it is not silent."""
MEASURED_FOR_S = 2.5
"""A measurement counts for so long: five periods of the slowest rung, 2 Hz. Peers hold a claim against what arrived in the
2 s before it (`sortie.fleet.trust`), so a measurement lasts longer than that."""


class LinkState(IntEnum):
    """What is known of an outgoing link, in ascending order of its goodput."""

    UNKNOWN = 0
    SILENT = 1
    PROBED = 2
    MEASURED = 3


def state_of(goodput_mbps: float) -> LinkState:
    """The state that a goodput says, Mb/s."""
    if goodput_mbps > PROBED_MBPS:
        return LinkState.MEASURED
    if goodput_mbps > SILENT_MBPS:
        return LinkState.PROBED
    return LinkState.SILENT if goodput_mbps > 0.0 else LinkState.UNKNOWN


def is_tried(goodput_mbps: Any) -> Any:
    """Whether a payload or missing descriptors tell what a link carries, for a goodput or an array of them, Mb/s."""
    return (goodput_mbps > PROBED_MBPS) | ((goodput_mbps > 0.0) & (goodput_mbps <= SILENT_MBPS))


def probed_mbps(share: float) -> float:
    """The value of a link without a recent measurement, Mb/s.

    Args:
        share: of the peer's latest descriptors those that arrived, 0 … 1; 0 is a silent link.
    """
    return SILENT_MBPS + share * (PROBED_MBPS - SILENT_MBPS)


def heard_share(goodput_mbps: float) -> float | None:
    """The share of the peer's latest descriptors that arrived, by the goodput of a probed link; None for other links."""
    if state_of(goodput_mbps) != LinkState.PROBED:
        return None
    return (goodput_mbps - SILENT_MBPS) / (PROBED_MBPS - SILENT_MBPS)
