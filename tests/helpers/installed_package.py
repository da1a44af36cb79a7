"""A package that is installed for the length of a test."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest

from sortie.scenarios.plugins.reference import installed


@contextmanager
def installed_package(folder: Path, name: str, source: str, offers: Mapping[str, Mapping[str, str]]) -> Iterator[None]:
    """Offers models of the module ``name`` by entry points.

    ``offers`` has for each kind the names of models, and where each lies (``module:name``). Afterwards the module is
    forgotten as well, so that the next test with a package of this name does not meet this one.
    """
    (folder / f"{name}.py").write_text(source)
    about = folder / f"{name}-1.2.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
    (about / "RECORD").write_text(f"{name}.py,,\n")
    (about / "entry_points.txt").write_text(
        "".join(
            f"[sortie.{kind}]\n" + "".join(f"{model} = {place}\n" for model, place in models.items())
            for kind, models in offers.items()
        )
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        installed.cache_clear()
        before = sys.modules.pop(name, None)
        try:
            yield
        finally:
            sys.modules.pop(name, None)
            if before is not None:
                sys.modules[name] = before
    installed.cache_clear()
