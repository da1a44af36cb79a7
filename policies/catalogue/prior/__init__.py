"""Prior sharing methods as policies: each is one file here and one line in `METHODS`.

A method reads only the context that the paper's table names (`research/paper/axes.py` checks it). For everything else it does what full sharing does. A method that lacks a part of the published one is a stand-in: its name
ends in `-style`, and `Method.missing` says what it lacks. Fusions of their own are values of `perception.fusion`.
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

STAND_IN = "-style"
"""The end of a stand-in's name."""


def _none(params: Mapping[str, object]) -> int:
    return 0


@dataclass(frozen=True, slots=True)
class Method:
    """A prior method: its policy, the fusion it was published with, and the bytes of its handshake."""

    title: str
    """Its name in the paper's table."""
    missing: str
    """The parts of the published method that this one lacks; empty if it is whole."""
    policy: Callable[..., Sequence[Directive]]
    fusion: str | None = None
    """A value of `perception.fusion`; None if it has no fusion of its own."""
    handshake_bytes: Callable[[Mapping[str, object]], int] = _none
    """Bytes that each drone sends to each peer and frame before payloads, given the policy's parameters."""

    @property
    def name(self) -> str:
        """Its name in scenarios, lists and tables; that of a stand-in ends in `STAND_IN`."""
        return self.title.lower().replace(" ", "-") + (STAND_IN if self.missing else "")


_MATCHING = (
    "learned keys and queries where drones choose; coverage grids are matched instead (fusion when2com has them)"
)
METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method(
            "Where2comm",
            "the learned confidence map; coverage cells that the drone sees well replace it",
            where2comm,
            "where2comm",
            request_bytes,
        ),
        Method("When2com", _MATCHING, when2com, "when2com", lambda _: MATCH_BYTES),
        Method("Who2com", _MATCHING, who2com, "when2com", lambda _: MATCH_BYTES),
        Method(
            "V2VNet",
            "the learned compression of features and the network that compensates their delay",
            v2vnet,
            "v2vnet",
        ),
        Method("DiscoNet", "the distillation from a teacher that sees all raw data", disconet, "disconet"),
        Method(
            "SyncNet",
            "the recurrent prediction of a late peer's features; they are moved by ego motion and weighted by delay",
            syncnet,
        ),
        Method(
            "HydraCollab",
            "the learned choice between fusions; a threshold on shared coverage cells replaces it",
            hydracollab,
        ),
        Method("Fixed compression", "", fixed_compression),
    )
}
"""The methods by their names in scenarios."""
