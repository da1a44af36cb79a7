"""How much of its companion computer a drone has left: the headrooms that its descriptor publishes.

Over some time, with the times of `fleet.computer` in the scenario and `perception.compute_delay_s` for a look:

    accelerator_s = looks × compute delay + feature maps received × fusion
    cpu_s         = driving cores × accelerator_s + decisions × decision + megabits sent and received / payload rate
    gpu headroom  = 1 − accelerator_s / time
    cpu headroom  = 1 − cpu_s / (cores × time)

Both are at least 0. What the radio's own processor does is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

from sortie.scenarios.schema import Computer


@dataclass(slots=True)
class Work:
    """What a drone's computer did since take-off; the parts of the drone count it up."""

    looks: int = 0
    """Frames in which perception ran."""
    maps: int = 0
    """Feature maps and raw images received, which are fused."""
    decisions: int = 0
    payload_bytes: int = 0
    """Sent and received, handshakes included."""

    def copy(self) -> Work:
        """The same, as it is now; `dataclasses.replace` takes several times as long."""
        return Work(self.looks, self.maps, self.decisions, self.payload_bytes)


def headrooms(computer: Computer, look_s: float, before: Work, after: Work, lasts_s: float) -> tuple[float, float]:
    """The shares of the processor and of the accelerator that were left over a time, 0 … 1.

    Args:
        computer: the platform.
        look_s: accelerator time of one look.
        before, after: what had been done at the time's begin and end.
        lasts_s: the time's length.
    """
    looks, maps = after.looks - before.looks, after.maps - before.maps
    decisions, payload_bytes = after.decisions - before.decisions, after.payload_bytes - before.payload_bytes
    accelerator_s = min(lasts_s, looks * look_s + maps * computer.fusion_s)
    cpu_s = (
        computer.driving_cores * accelerator_s
        + decisions * computer.decision_s
        + payload_bytes * 8e-6 / computer.payload_mbps
    )
    return max(0.0, 1.0 - cpu_s / (computer.cpu_cores * lasts_s)), 1.0 - accelerator_s / lasts_s
