"""Invariants of the registered policies; `sortie verify NAME` proves them."""

from __future__ import annotations

PROMISES: dict[str, str] = {
    "worked": """
        when battery < 0.6: rate_hz <= 5
        when battery < 0.3: representation <= detections and rate_hz <= 2
        when goodput_mbps < 5: representation <= detections and rate_hz <= 2
        when phase == track and region and representation > none: roi
        when target_in_region and peers >= 1: any_link(representation >= detections and rate_hz >= 2)
        when human_in_region and peers >= 1: any_link(representation >= detections and rate_hz >= 2)
        count_links(representation > none) <= 2
        representation <= features
    """,
    "silence": "representation == none",
}
"""Invariants by the policy's name. A policy without an entry is checked for the plane's properties alone."""
