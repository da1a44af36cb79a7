"""Which errors are the user's, as one line, and which are defects of Sortie."""

from __future__ import annotations

import errno
import os
import platform
import shlex
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sortie.scenarios.errors import SortieError
from sortie.scenarios.plugins.reference import PluginError, describe_error, passes_through_users
from sortie.sim.folders import RunError
from sortie.sim.identity import code_version

_HOME = Path(__file__).parents[1]
"""Files below it are Sortie's own."""
_USED_UP = (errno.ENOSPC, errno.EDQUOT, errno.EMFILE, errno.ENFILE)
"""The disk, a quota or the number of open files."""

EXTRAS = {
    "matplotlib": "report",
    "jinja2": "report",
    "SALib": "campaign",
    "threadpoolctl": "campaign",
    "cyclonedds": "dds",
    "pettingzoo": "env",
    "gymnasium": "env",
    "rosbags": "ros2",
    "zarr": "zarr",
    "distributed": "campaign",
    "torch": "torch",
    "rerun": "view",
    "pymavlink": "mavlink",
}
"""Which extra brings a library that not everybody needs."""


def missing(error: ImportError) -> Exception:
    """The extra that an import lacks, as one line; what no extra brings is the error itself."""
    name = (error.name or "").partition(".")[0]
    if name == "cyclonedds" and sys.version_info >= (3, 14):
        return RunError("cyclonedds is missing: it has no wheels for Python 3.14; use Python 3.11 to 3.13")
    return RunError(f"{name} is missing: pip install 'sortie-sim[{EXTRAS[name]}]'") if name in EXTRAS else error


def of_user(error: Exception) -> SortieError | None:
    """An error as one that the user can put right; None where it is a defect of Sortie.

    These are the user's: every `SortieError`, what code of the user raises, a missing extra, and an error of the
    operating system about a path outside Sortie, about a full disk, used-up memory or the limit of open files.
    """
    if isinstance(error, SortieError):
        return error
    if passes_through_users(error):
        return PluginError(describe_error(error))
    if isinstance(error, ImportError):
        found = missing(error)
        return found if isinstance(found, SortieError) else None
    if isinstance(error, OSError):
        return _of_system(error)
    if isinstance(error, MemoryError):
        return RunError("the memory is used up; free some, or fly a smaller fleet or a shorter flight")
    return None


def _of_system(error: OSError) -> SortieError | None:
    if error.filename is not None:
        path = Path(os.fsdecode(error.filename))
        return None if path.is_relative_to(_HOME) else RunError(f"{path}: {error.strerror or error}")
    if error.errno in _USED_UP:
        return RunError(f"{os.strerror(error.errno)}; free some and run the command again")
    try:
        os.getcwd()
    except FileNotFoundError:
        return RunError("the working folder was deleted; change to another folder")
    return None


@contextmanager
def user_errors() -> Iterator[None]:
    """What the user can put right becomes a `SortieError` of one line (`of_user`); other errors stay as they are."""
    try:
        yield
    except Exception as error:
        users = of_user(error)
        if users is None or users is error:
            raise
        raise users from error


def in_line(error: Exception, most: int) -> str:
    """An error for a cell of a table, of so many characters at most. It says where a defect of Sortie arose."""
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"
    if of_user(error) is None:
        last = traceback.extract_tb(error.__traceback__)[-1]
        text = f"a defect of Sortie ({Path(last.filename).name}, line {last.lineno}): {text}"
    return text[:most]


def as_text(error: Exception) -> str:
    """An error for a report: one line if it is the user's, else its traceback and how to report the defect."""
    users = of_user(error)
    if users is not None:
        return f"{type(users).__name__}: {users}"
    return "".join(traceback.format_exception(error)) + defect()


def defect() -> str:
    """How to report a defect of Sortie; it comes after a traceback."""
    program = Path(sys.argv[0])
    named = ["python", "-m", program.parent.name] if program.name == "__main__.py" else [program.name]
    command = shlex.join([*named, *sys.argv[1:]])
    return (
        "This is a defect of Sortie, not a mistake of yours. Please report it to the project, with the lines above,\n"
        f"the version ({code_version()}, Python {platform.python_version()}) and what you ran: {command}"
    )
