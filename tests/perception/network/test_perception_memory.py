"""Freed memory that is kept is not taken from the kernel again: counted in page faults."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

MAPS = """
import resource, sys, numpy as np
from sortie.perception.network.memory import keep_freed
assert sys.argv[1] == "given back" or keep_freed()
def maps(): [np.ones(1 << 20) for _ in range(20)]
maps()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
maps()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(
    not sys.platform.startswith("linux") or "glibc" not in os.confstr("CS_GNU_LIBC_VERSION"), reason="glibc's"
)
def test_freed_maps_are_kept_also_where_a_nanny_has_them_given_back() -> None:
    faults = {
        case: int(
            subprocess.run(
                [sys.executable, "-c", MAPS, case], capture_output=True, text=True, check=True,
                env=os.environ | {"MALLOC_TRIM_THRESHOLD_": "65536"},
            ).stdout
        )
        for case in ("given back", "kept")
    }  # fmt: skip
    assert faults["given back"] > 10 * max(faults["kept"], 1), faults
