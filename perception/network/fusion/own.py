"""Fusion of one's own: a user's torch module or function, checked at every call."""

from __future__ import annotations

import inspect
from typing import Any

import torch
from torch import Tensor

from sortie.perception.network.fusion.base import Fusion
from sortie.scenarios.plugins.reference import Params, PluginError, checked_call, name_of, resolve


class OwnFusion(Fusion):
    """Fuses by a model from outside, called as `Fusion.forward`. It keeps no state between calls.

    Args:
        reference: an installed plug-in's name, or `path/to/file.py:Name`: a function, or a class whose objects are called.
        params: keyword-only arguments of the function, or of the class.

    Raises:
        PluginError: a model that is not there, does not load, or has no such parameter.
    """

    name = "own"
    about = "a torch module or function of one's own"

    def __init__(self, reference: str, params: Params | None = None) -> None:
        super().__init__()
        found: Any = resolve("fusion", reference, params)
        if inspect.isclass(inspect.unwrap(getattr(found, "func", found))):
            with torch.random.fork_rng(devices=[]):  # parameters that nobody trained are the same in every run
                torch.manual_seed(0)
                found = checked_call("fusion", found)
            if not callable(found):
                raise PluginError(f"fusion {name_of(found)}: its objects cannot be called, must have forward")
        self.model = found

    def forward(self, agents: Tensor, takes_part: Tensor, weight: Tensor) -> Tensor:
        """As `Fusion.forward`. The model gets copies, so that it may change them, and contiguous ones, so that it may `view` them.

        Raises:
            PluginError: the model fails, or returns no tensor, another shape, or a number that is not finite.
        """
        copies = (given.clone(memory_format=torch.contiguous_format) for given in (agents, takes_part, weight))
        fused = checked_call("fusion", self.model, *copies)
        name, shape = f"fusion {name_of(self.model)}", (len(agents), *agents.shape[2:])
        if not isinstance(fused, Tensor):
            raise PluginError(f"{name}: returns {type(fused).__name__}, must be a torch tensor")
        if fused.shape != shape:
            raise PluginError(f"{name}: returns shape {tuple(fused.shape)}, must be {shape}")
        finite = bool(torch.isfinite(fused).all())
        if not (fused.is_floating_point() and finite):
            odd = "" if finite else " with numbers that are not finite"
            raise PluginError(f"{name}: returns {fused.dtype}{odd}, must be finite floats")
        return fused.float()
