"""Loops compiled to machine code by numba: rounded as written, no fast-math, without Python's global lock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit, types
from numba.core.typing.templates import Signature
from numba.extending import intrinsic


def compiled(loop: Callable[..., Any]) -> Any:
    """The loop, compiled at its first call and kept for later processes where a folder for that can be written.

    It may use constants of its own file alone: kept code does not see that another file has changed. A division by zero
    gives an infinity, as in numpy.
    """
    try:
        return njit(nogil=True, error_model="numpy", cache=True)(loop)
    except RuntimeError:  # neither beside the source nor in the user's cache folder
        return njit(nogil=True, error_model="numpy")(loop)


def _fma(_: Any, a: Any, b: Any, c: Any) -> tuple[Signature, Any]:
    def generate(_: Any, builder: Any, __: Any, args: Any) -> Any:
        return builder.fma(*args)

    return types.float32(types.float32, types.float32, types.float32), generate


fma: Any = intrinsic(_fma)
"""a · b + c of float32, rounded once; for compiled code."""
