"""`events`: what goes wrong, and when. Each class of this folder with a `kind` is one; a file that is added needs no other."""

from __future__ import annotations

import importlib
import pkgutil
from typing import TYPE_CHECKING, Annotated, Union, get_args

from pydantic import Field

from sortie.scenarios.schema.events.base import Event


def _kinds() -> dict[str, type[Event]]:
    """Every kind of event by its name, in alphabetical order."""
    found: dict[str, type[Event]] = {}
    for file in sorted(pkgutil.iter_modules(__path__), key=lambda each: each.name):
        for each in vars(importlib.import_module(f"{__name__}.{file.name}")).values():
            if isinstance(each, type) and issubclass(each, Event) and get_args(each.model_fields["kind"].annotation):
                (kind,) = get_args(each.model_fields["kind"].annotation)
                found[kind] = each
    return dict(sorted(found.items()))


KINDS = _kinds()
if TYPE_CHECKING:
    AnyEvent = Event
else:
    AnyEvent = Annotated[Union[tuple(KINDS.values())], Field(discriminator="kind")]  # noqa: UP007 (of a tuple)
