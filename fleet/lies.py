"""What a drone may say against the truth: false coverage, goodput or battery in the descriptor that it publishes.

The drone's own policy reads the truth; only what goes on the air is false, and it is properly authenticated.
"""

from __future__ import annotations

from sortie.fleet.coverage import NOVEL_FLAG
from sortie.policies.contract import Coverage, Descriptor
from sortie.scenarios.schema.events.base import About, Claim

_ALL = {
    claim: bytes([state * 0b01010101]) * 64 for claim, state in (("much", Coverage.NOVEL), ("little", Coverage.UNSEEN))
}
MUCH_MBPS, LITTLE_MBPS = 500.0, 0.1
MUCH_SOC, LITTLE_SOC = 1.0, 0.05


def falsified(d: Descriptor, about: About, claim: Claim) -> Descriptor:
    """The descriptor with one lie in it.

    Args:
        about: coverage claims that every cell is new (much) or unseen (little); goodput claims 500 or 0.1 Mb/s to
            everyone; battery claims a full or an almost empty one.
    """
    much = claim == "much"
    match about:
        case "coverage":
            flags = d.novelty_flags | NOVEL_FLAG if much else d.novelty_flags & ~NOVEL_FLAG
            return d._replace(coverage_grid=_ALL[claim], novelty_flags=flags)
        case "goodput":
            return d._replace(peer_goodput_mbps=(MUCH_MBPS if much else LITTLE_MBPS,) * len(d.peer_goodput_mbps))
        case "battery":
            return d._replace(battery_soc=MUCH_SOC if much else LITTLE_SOC)
