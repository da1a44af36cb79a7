"""What a user can put right in files, fields and missing extras, as one error of one line."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from sortie.scenarios.errors import SortieError
from sortie.sim.folders import RunError

EXTRAS = {"matplotlib": "report", "SALib": "campaign", "threadpoolctl": "campaign", "cyclonedds": "dds", "pettingzoo": "env",
          "gymnasium": "env", "rosbags": "ros2", "zarr": "zarr", "distributed": "campaign", "torch": "torch", "rerun": "view", "pymavlink": "mavlink"}  # fmt: skip
"""Which extra brings a library that not everybody needs."""


def missing(error: ImportError) -> Exception:
    """The extra that an import lacks, as one line; what no extra brings is the error itself."""
    name = (error.name or "").partition(".")[0]
    if name == "cyclonedds" and sys.version_info >= (3, 14):
        return RunError("cyclonedds is missing: it has no wheels for Python 3.14; use Python 3.11 to 3.13")
    return RunError(f"{name} is missing: pip install 'sortie-sim[{EXTRAS[name]}]'") if name in EXTRAS else error


@contextmanager
def path_errors() -> Iterator[None]:
    """A path that cannot be used, or a working folder that was deleted, is one line; other errors of the system stay.

    Raises:
        RunError: naming the path.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise RunError(f"{error.filename}: {error.strerror or error}") from error
        try:
            os.getcwd()
        except FileNotFoundError:
            raise RunError("the working folder was deleted; change to another folder") from error
        raise


@contextmanager
def user_errors() -> Iterator[None]:
    """A file, field or missing extra is the user's to mend: one line, no traceback."""
    try:
        yield
    except ImportError as error:
        raise missing(error) from error
    except OSError as error:
        where = "" if error.filename is None else f"{error.filename}: "
        raise RunError(f"{where}{error.strerror or error}") from error
    except SortieError:
        raise
    except ValueError as error:
        raise RunError(str(error)) from error
