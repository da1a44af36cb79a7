"""Vector-quantised features: a learned codebook, and features as a receiver reads them from codes.

A cell's 80 numbers become one byte a stage (residual vector quantisation: B.-H. Juang and A. Gray, ICASSP 1982). Stage by
stage the nearest of 256 entries is taken from what is left. A cell that is read is the sum of its entries. So the first
bytes of a cell are a coarser code of the same cell, and one codebook serves every length.

Sending a codebook's indices in place of features is the idea of CodeFilling (Y. Hu et al., CVPR 2024). Its codebook is
learned together with the network; this one is fitted to a finished network.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from sortie.perception import budget
from sortie.perception.errors import InputError
from sortie.perception.geometry import CHANNELS
from sortie.perception.network.model import CarNet
from sortie.scenarios.replacing import replacing

ENTRIES = 256
"""Of a stage: one byte names one of them."""


@dataclass(frozen=True, slots=True)
class Codebook:
    """A codebook of one network's features."""

    stages: Tensor
    """[stages, 256, 80] float32."""
    encoder: str
    """Digest of the encoder whose features it was fitted to (`encoder_digest`)."""

    @property
    def longest(self) -> int:
        """The most bytes that it gives a cell."""
        return len(self.stages)

    def encode(self, cells: Tensor, length: int) -> Tensor:
        """Codes uint8 [n, length] of cells float32 [n, 80].

        Raises:
            ValueError: a length that the codebook does not have.
        """
        if not 1 <= length <= self.longest:
            raise ValueError(f"length is {length}, must be 1 to {self.longest}, the codebook's stages")
        left, codes = cells.float(), torch.empty(len(cells), length, dtype=torch.uint8)
        for k, entries in enumerate(self.stages[:length]):
            # of |x − e|², |x|² is the same for every entry
            far = torch.addmm((entries * entries).sum(dim=1), left, entries.T, alpha=-2.0)
            nearest = far.argmin(dim=1)
            codes[:, k] = nearest.to(torch.uint8)
            left = left - entries[nearest]
        return codes

    def decode(self, codes: Tensor) -> Tensor:
        """The cells [n, 80] that codes uint8 [n, length] mean; float32 that is exact in float16, as plain features are."""
        cells = torch.zeros(len(codes), CHANNELS)
        for entries, code in zip(self.stages, codes.T, strict=False):
            cells += entries[code.long()]
        return cells.clamp_min(0.0).half().float()

    def read(self, features: Tensor, length: int, sent: Tensor | None = None) -> Tensor:
        """Features [80, h, w] as a receiver reads them from codes of `length` bytes; zeros where `sent` [h, w] is false."""
        table = features.flatten(1).T
        if sent is None:
            return self.decode(self.encode(table, length)).T.reshape(features.shape)
        at = sent.flatten().nonzero().squeeze(1)
        out = torch.zeros_like(table)
        out[at] = self.decode(self.encode(table[at], length))
        return out.T.reshape(features.shape)


def encoder_digest(net: CarNet) -> str:
    """A hash of everything that a network's features depend on; of the network as it was loaded, not folded."""
    digest = hashlib.blake2b(b"rectified", digest_size=8)
    for name, tensor in sorted(net.encoder.state_dict().items()):
        if tensor.dtype.is_floating_point:
            digest.update(name.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def save_codebook(codebook: Codebook, path: Path, facts: dict[str, Any]) -> None:
    """Write a codebook, under a temporary name first; `facts` is JSON about its making."""
    with replacing(path) as part:
        metadata = {"codebook": json.dumps({"encoder": codebook.encoder}), "sortie": json.dumps(facts)}
        save_file({"stages": codebook.stages.half().contiguous()}, part, metadata=metadata)
        part.chmod(0o644)  # the library makes it private


def load_codebook(path: Path, net: CarNet) -> Codebook:
    """The codebook in a file.

    Args:
        net: the network that it must belong to, as it was loaded.

    Raises:
        InputError: no such file, not a codebook, or one of another network.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such codebook; `python -m research fit codebook` makes one for a weights file")
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {})["codebook"])
            stages = file.get_tensor("stages").float()
            found = Codebook(stages, str(about["encoder"]))
    except (SafetensorError, OSError, KeyError, TypeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: not a codebook of this project ({error!r})") from None
    if stages.ndim != 3 or stages.shape[1:] != (ENTRIES, CHANNELS) or not 1 <= len(stages) <= budget.MAX_CODE_BYTES:
        wanted = f"[1 to {budget.MAX_CODE_BYTES}, {ENTRIES}, {CHANNELS}]"
        raise InputError(f"{path}: stages have shape {list(stages.shape)}, must be {wanted}")
    if not bool(torch.isfinite(stages).all()):
        raise InputError(f"{path}: stages hold values that are not finite")
    if found.encoder != encoder_digest(net):
        raise InputError(
            f"{path}: fitted to another encoder than the weights'; `python -m research fit codebook` makes one for them"
        )
    return found
