"""Read arrays and codebooks from files that may be damaged."""

from __future__ import annotations

import hashlib
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.perception.budget import CODEBOOK_BYTES
from sortie.perception.errors import InputError
from sortie.scenarios.regular import regular

_MOST_DEFLATED = 1040
"""Deflate makes at most so many bytes of one, and a little more at a stream's begin and end."""


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an npz file.

    What the archive claims is compared with what its bytes can hold, before memory is taken for it.

    Raises:
        Exception: a damaged archive can raise nearly anything: zlib.error, RuntimeError, NotImplementedError.
    """
    with regular(path).open("rb") as stream:
        with zipfile.ZipFile(stream) as archive:
            for info in archive.infolist():
                if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError(f"{info.filename} is compressed by method {info.compress_type}, must be 0 or 8")
                with archive.open(info) as member:
                    version = np.lib.format.read_magic(member)
                    first = version == (1, 0)
                    read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
                    shape, _, dtype = read(member)
                claimed, most = math.prod(shape) * dtype.itemsize, _MOST_DEFLATED * (info.compress_size + 64)
                if claimed > min(info.file_size, most):
                    raise ValueError(f"{info.filename} is of {claimed} B, its {info.compress_size} B cannot hold them")
        stream.seek(0)
        with np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}


def codebook_digest(path: Path) -> str:
    """What a codebook's file is named by on the wire: 14 digits of a hash of its bytes.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        return hashlib.blake2b(regular(path).read_bytes(), digest_size=CODEBOOK_BYTES - 1).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read as a codebook ({error.strerror})") from None
