"""A user's policy loaded so that the search sees everything that could tell its stand-ins from real objects.

The source must be plain Python (`plain`). It is compiled with a check at each place where Python would answer for a stand-in
without asking it: calls, `is`, text with numbers in it, attributes, sets (`call_checks`, `value_checks`). What the checks raise
is also recorded. What the policy keeps from one decision to the next is compared after every one.
"""

from __future__ import annotations

import builtins
import inspect
import types
from collections.abc import Callable, Sequence
from pathlib import Path as File
from typing import Any

from sortie.policies.verification.call_checks import CHECKS, attribute, guarded
from sortie.policies.verification.confine import Reached
from sortie.policies.verification.kept import Kept, kept_by
from sortie.policies.verification.notes import NOTED, noted, taking_notes
from sortie.policies.verification.outside import Outside
from sortie.policies.verification.pure import PURE_MODULES, is_of_policies
from sortie.policies.verification.source_checks import compiled
from sortie.policies.verification.symbols import Refused
from sortie.policies.verification.watch import WATCH, stop
from sortie.scenarios.plugins.user_code import is_users, load


class Remembers(Reached):
    """A policy that changes something that lasts until its next decision."""

    def __init__(self, what: str) -> None:
        BaseException.__init__(self, f"remembers: {what}, which lasts until the next decision")


class Instrumented:
    """An instrumented policy: as the plain one, but what it may not do raises, and so does what it keeps."""

    def __init__(self, function: Callable[..., Any], module: types.ModuleType) -> None:
        self.function, self.module = function, module
        self._kept: Kept | None = None

    def __call__(self, view: Any, /, **params: Any) -> Any:
        """The policy's answer.

        Raises:
            Reached: it used something that is not in its view, or it remembers something.
            Refused: it did something that cannot be followed.
        """
        if self._kept is None:
            self._kept = kept_by(self.function, self.module)
        WATCH.stopped = None
        try:
            self._look(view, params)
            return self.function(view, **params)
        finally:
            if WATCH.stopped is not None:
                raise WATCH.stopped
            changed = self._kept.changed() or WATCH.changed()
            if changed:
                raise Remembers(changed)

    def _look(self, view: Any, params: dict[str, Any]) -> None:
        """Call the policy's viewpoint, as a flight does before it asks for directives: it may change what the policy reads."""
        viewpoint = getattr(self.function, "viewpoint", None)
        if viewpoint is None:
            return
        known = inspect.signature(viewpoint).parameters
        with taking_notes():  # of no use: the plain policy is asked for directives alone
            viewpoint(view, **{name: value for name, value in params.items() if name in known})


def instrumented(path: File, attribute: str) -> Instrumented:
    """Load a user's file anew, with the checks.

    Raises:
        Reached: loading it used a clock, a file or the like.
        Refused: it has something that cannot be checked.
        Exception: what the file raises.
    """
    WATCH.begin()
    WATCH.is_loading = True
    try:
        module = load(path, compiled, _builtins)
    except SyntaxError as error:
        raise Refused(str(error)) from None
    finally:
        WATCH.is_loading = False
        if WATCH.stopped is not None:
            raise WATCH.stopped
    return Instrumented(getattr(module, attribute), module)


BUILTINS = {name: guarded(value) for name, value in vars(builtins).items() if name[:2] != "__"}
"""What a policy finds under the builtins' names."""


def _builtins(find: Callable[..., Any]) -> dict[str, Any]:
    """The builtins of an instrumented module, whose imports find what they find otherwise."""

    def importing(name: str, *rest: Any) -> Any:
        module = find(name, *rest)
        wanted: Sequence[str] = (rest[2] or ()) if len(rest) > 2 else ()
        home = module.__name__
        if is_users(home):
            if not WATCH.is_loading:  # in flight its code runs now, and before the first decision in a search
                stop("imports a module of its own within a function")
            if module.__file__ and not module.__file__.endswith(".py"):
                stop(f"imports compiled code ({File(module.__file__).name})")
            return module
        if is_of_policies(home) or home.partition(".")[0] in PURE_MODULES:
            return _Names(module, wanted) if wanted else module
        return Outside(home)

    return vars(builtins) | BUILTINS | CHECKS | {NOTED: noted, "__import__": importing}


class _Names(types.ModuleType):
    """The names that a `from … import` takes from a module, each as `attribute` gives it."""

    def __init__(self, module: types.ModuleType, wanted: Sequence[str]) -> None:
        super().__init__(module.__name__)
        if "*" in wanted:
            raise SyntaxError(f"imports all names of {module.__name__}")
        for name in wanted:
            try:
                setattr(self, name, attribute(module, name))
            except AttributeError:
                __import__(f"{module.__name__}.{name}")
                setattr(self, name, getattr(module, name))
