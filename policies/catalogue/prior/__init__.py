"""Prior sharing methods as policies: each is one file here and one line in `METHODS`.

A method reads the context that the paper's table says it reads and no more (`sortie.policies.verification.axes` watches it), and takes
everything else as full sharing has it. What it learned in a network stands in for by its rule, which its file tells;
fusions of their own are `perception.fusion`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from sortie.policies.catalogue.prior.disconet import disconet
from sortie.policies.catalogue.prior.fixed_compression import fixed_compression
from sortie.policies.catalogue.prior.hydracollab import hydracollab
from sortie.policies.catalogue.prior.syncnet import syncnet
from sortie.policies.catalogue.prior.v2vnet import v2vnet
from sortie.policies.catalogue.prior.when2com import MATCH_BYTES, when2com
from sortie.policies.catalogue.prior.where2comm import request_bytes, where2comm
from sortie.policies.catalogue.prior.who2com import who2com
from sortie.policies.contract import Directive


def _none(params: Mapping[str, object]) -> int:
    return 0


@dataclass(frozen=True, slots=True)
class Method:
    """A prior method: its policy, the fusion it was published with, and what its links cost before any payload."""

    title: str
    """As the paper's table has it."""
    policy: Callable[..., Sequence[Directive]]
    fusion: str | None = None
    """A value of `perception.fusion`; None where it takes whatever fusion there is."""
    handshake_bytes: Callable[[Mapping[str, object]], int] = _none
    """Bytes that each drone sends to each peer and frame before payloads, given the policy's parameters."""


METHODS: dict[str, Method] = {
    "where2comm": Method("Where2comm", where2comm, "where2comm", request_bytes),
    "when2com": Method("When2com", when2com, None, lambda _: MATCH_BYTES),
    "who2com": Method("Who2com", who2com, None, lambda _: MATCH_BYTES),
    "v2vnet": Method("V2VNet", v2vnet, "v2vnet"),
    "disconet": Method("DiscoNet", disconet, "disconet"),
    "syncnet": Method("SyncNet", syncnet),
    "hydracollab": Method("HydraCollab", hydracollab),
    "fixed-compression": Method("Fixed compression", fixed_compression),
}
"""By the name under which a scenario flies it."""
