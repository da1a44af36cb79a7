"""Files that a user names are read to their end, so they must have one."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


def regular(path: Path, *, or_pipe: bool = False) -> Path:
    """The path, if a read from it ends: a device such as /dev/zero, a pipe or a socket is refused.

    Args:
        or_pipe: allow a pipe, as the shell makes for `<(command)`. The reader must then limit what it reads.

    Raises:
        OSError: the path is none of these, or is not there. Readers turn it into their own error, as any other OSError.
    """
    mode = os.stat(path).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode) or (or_pipe and stat.S_ISFIFO(mode))):
        raise OSError(errno.EINVAL, "is a device, a pipe or a socket, must be a file", str(path))
    return path
