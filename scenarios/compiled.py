"""Loops compiled to machine code by numba: rounded as written, no fast-math, without Python's global lock."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba import njit
from numba.core import event


def compiled(loop: Callable[..., Any], *, allocates: bool = True) -> Any:
    """The loop, compiled at its first call and kept for later processes where a folder for that can be written.

    It may use constants of its own file alone: kept code does not see that another file has changed. A division by zero
    gives an infinity, as in numpy.

    Args:
        loop: the function.
        allocates: whether it makes arrays. One that makes none counts no references, which can take a quarter of its time.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": allocates}
    try:
        return njit(cache=True, **options)(loop)
    except RuntimeError:  # neither beside the source nor in the user's cache folder
        return njit(**options)(loop)


def part(loop: Callable[..., Any]) -> Any:
    """A loop that only compiled code of its own file calls, and that makes no arrays: compiled into its caller."""
    without_wrappers: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "_nrt": False}
    return njit(nogil=True, error_model="numpy", forceinline=True, **without_wrappers)(loop)


@contextmanager
def when_compiling(tell: Callable[[], object]) -> Iterator[None]:
    """Call `tell` once, before the first loop that is compiled within this context. A loop that was kept is only loaded."""
    told: list[object] = []

    class First(event.Listener):
        def on_start(self, event: object) -> None:
            if not told:
                told.append(tell())

        def on_end(self, event: object) -> None:
            pass

    with event.install_listener("numba:compile", First()):
        yield
