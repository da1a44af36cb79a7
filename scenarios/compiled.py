"""Loops compiled to machine code by numba: rounded as written, no fast-math, without Python's global lock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit


def compiled(loop: Callable[..., Any]) -> Any:
    """The loop, compiled at its first call and kept for later processes where a folder for that can be written.

    It may use constants of its own file alone: kept code does not see that another file has changed. A division by zero
    gives an infinity, as in numpy.
    """
    try:
        return njit(nogil=True, error_model="numpy", cache=True)(loop)
    except RuntimeError:  # neither beside the source nor in the user's cache folder
        return njit(nogil=True, error_model="numpy")(loop)


def part(loop: Callable[..., Any]) -> Any:
    """A loop that only compiled code of its own file calls: compiled with its caller, and kept with it."""
    without_wrappers: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(nogil=True, error_model="numpy", **without_wrappers)(loop)
