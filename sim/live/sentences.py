"""The events of a live flight as sentences."""

from __future__ import annotations

from collections import Counter

from sortie.policies.staleness import LinkHealth
from sortie.sim.live.result import LiveResult, Noticed


def describe_changes(result: LiveResult) -> list[str]:
    """Lost processes and how the others noticed them, counts of staleness, then changes of what links carry, by time."""
    lines = [f"{gone.t_s:6.1f} s  drone {gone.drone}: its process {gone.how}" for gone in result.lost]
    lines += [_loss_text(n, result.drones - 1) for n in result.noticed]
    after_start = [c for c in result.health if c.t_s - result.begin_s > 1.0]
    counts = Counter(c.health for c in after_start)
    lines.append(
        f"contexts of peers went degraded {counts[LinkHealth.DEGRADED]} times, detached {counts[LinkHealth.DETACHED]} "
        f"times, and fresh again {counts[LinkHealth.FRESH]} times"
    )
    events = [(n.t_s, f"drone {n.drone}: {n.text}") for n in result.notices]
    carried: dict[tuple[int, int], str] = {}
    for o in result.orders:  # a disc that moves with its target is no change worth a line
        now = _payload_text(o.representation, o.rate_hz)
        if carried.get((o.drone, o.peer)) != now:
            events.append((o.t_s, f"drone {o.drone} → {o.peer}: {now}, because {o.reason}"))
        carried[o.drone, o.peer] = now
    return lines + [f"{t_s:6.1f} s  {text}" for t_s, text in sorted(events)]


def _payload_text(representation: str, rate_hz: float) -> str:
    return "nothing" if representation == "none" else f"{representation} at {rate_hz:g} Hz"


def _loss_text(noticed: Noticed, others: int) -> str:
    def span(s: tuple[float, float] | None) -> str:
        return "never" if s is None else f"after {s[0]:.2f}–{s[1]:.2f} s"

    return (
        f"          drone {noticed.drone} was degraded at the others {span(noticed.degraded_s)}, detached "
        f"{span(noticed.detached_s)} ({noticed.by} of {others})"
    )
