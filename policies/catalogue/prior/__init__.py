"""Prior sharing methods as policies: each is one file here and one line in `METHODS`.

A method reads only the context that the paper's table names (`sortie.policies.verification.axes` checks it). For
everything else it does what full sharing does. Where the method has a learned network, a rule replaces it; the method's
file describes the rule. Fusions of their own are values of `perception.fusion`.
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
    """A prior method: its policy, the fusion it was published with, and the bytes of its handshake."""

    title: str
    """Its name in the paper's table."""
    policy: Callable[..., Sequence[Directive]]
    fusion: str | None = None
    """A value of `perception.fusion`; None if it has no fusion of its own."""
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
"""The methods by their names in scenarios."""
