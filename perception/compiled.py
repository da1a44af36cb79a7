"""Compiled loops of this room: `compiled` (`sortie.scenarios.compiled`), and a fused multiply-add."""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from sortie.scenarios.compiled import compiled

__all__ = ["compiled", "fma"]


def _fma(_: Any, a: Any, b: Any, c: Any) -> tuple[Signature, Any]:
    def generate(_: Any, builder: Any, __: Any, args: Any) -> Any:
        return builder.fma(*args)

    return types.float32(types.float32, types.float32, types.float32), generate


fma: Any = intrinsic(_fma)
"""a · b + c of float32, rounded once; for compiled code."""
