"""Which data files a user's code has read in this process: a row of a flight depends on what they held."""

from __future__ import annotations

import os
import sys
import sysconfig
from importlib.util import source_from_cache
from pathlib import Path
from types import FrameType

from sortie.sim.identity import file_digest

_SORTIE = str(Path(__file__).parents[2]) + os.sep
_LIBRARIES = tuple(
    {sysconfig.get_path(name) + os.sep for name in ("stdlib", "platstdlib", "purelib", "platlib")} | {"<"}
)
"""Libraries, which read for whoever calls them."""
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
_read: dict[str, str] = {}
_watching = _looking = False


def watch() -> None:
    """From now on, note what a user's code opens for reading, as it is then. Python has no way to end that.

    Python tells of what Python opens; what a compiled library opens by itself, as pyarrow and HDF5 do, is not seen.
    """
    global _watching
    if not _watching:
        _watching = True
        sys.addaudithook(_note)


def files_read() -> dict[str, str]:
    """SHA-256 digests by absolute path, of everything so far: a module keeps what it read when it was loaded."""
    return dict(_read)


def _note(event: str, arguments: tuple[object, ...]) -> None:
    global _looking
    if event != "open" or _looking:
        return
    path, _, flags = arguments
    if not isinstance(path, str) or not isinstance(flags, int) or flags & _WRITING:
        return
    _looking = True  # a digest opens the file
    try:
        if _is_users(sys._getframe(1)):
            file = Path(source_from_cache(path) if path.endswith(".pyc") else path).resolve()
            if file.is_file():
                _read[str(file)] = file_digest(file)
    except (OSError, ValueError):  # whoever opens it gets the error
        pass
    finally:
        _looking = False


def _is_users(frame: FrameType | None) -> bool:
    """Whether the innermost code that is no library's is a user's, and Sortie has called it: a user's program reads what it likes."""
    users = False
    while frame is not None:
        file = frame.f_code.co_filename
        if file.startswith(_SORTIE):
            return users
        users = users or not file.startswith(_LIBRARIES)
        frame = frame.f_back
    return False
