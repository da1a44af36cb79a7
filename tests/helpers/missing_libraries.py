"""A Python that lacks libraries, as an installation without extras does; so do the processes that it starts."""

from __future__ import annotations

import os
from pathlib import Path

HOOK = """
import sys


class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in LIBRARIES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, Missing())
"""


def path_without(folder: Path, *libraries: str) -> str:
    """The PYTHONPATH with which Python starts without these libraries; `folder` keeps what makes it so."""
    (folder / "sitecustomize.py").write_text(f"LIBRARIES = {libraries!r}\n{HOOK}")
    return os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))
