"""An optional part of the build: `SORTIE_COMPILE=1 pip install .` compiles the radio's hottest files with mypyc.

Without the variable the package is plain Python, and this file adds nothing. `pyproject.toml` holds all else.
"""

import gc
import os
import shutil
import sys
import sysconfig
import tomllib
from pathlib import Path
from typing import Any

from setuptools import setup

COMPILED = [
    "sortie/radio/air.py",
    "sortie/radio/channel/snr.py",
    "sortie/radio/counters.py",
    "sortie/radio/goodput.py",
    "sortie/radio/mac/airtime.py",
    "sortie/radio/mac/broadcasts.py",
    "sortie/radio/mac/jobs.py",
    "sortie/radio/mac/medium.py",
    "sortie/radio/rates.py",
    "sortie/radio/sample.py",
    "sortie/radio/transmission.py",
]
"""What every payload and descriptor goes through, but for `edca.py`, which numba compiles. The rest gains nothing from it."""

MYPY = "mypy==2.4.1"
"""As in `constraints.txt`: another release may refuse these files, or compile them otherwise."""


def compiled() -> dict[str, Any]:
    """Arguments for `setup`: the modules to compile, or, while pip asks what the build needs, mypy and numpy."""
    if "editable_wheel" in sys.argv or "develop" in sys.argv:
        raise SystemExit(
            "SORTIE_COMPILE=1 does not work with an editable install (pip install -e), because a compiled module would hide "
            "later changes of its source; use `pip install .`"
        )
    compiler = (os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc").split()[0]
    if os.name == "posix" and shutil.which(compiler) is None:
        raise SystemExit(f"SORTIE_COMPILE=1 needs a C compiler, but `{compiler}` is not installed")
    if not Path(sysconfig.get_path("include"), "Python.h").exists():
        raise SystemExit(
            "SORTIE_COMPILE=1 needs Python's C headers (Python.h; the package python3-dev on Debian and Ubuntu)"
        )
    try:
        from mypyc.build import mypycify
    except ImportError:
        if "egg_info" not in sys.argv:  # the environment of the build is complete, and nothing would be compiled
            raise SystemExit(f"SORTIE_COMPILE=1 needs {MYPY} in the environment of the build") from None
        needed = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
        return {"setup_requires": [MYPY, *(one for one in needed if one.startswith("numpy>"))]}
    gc.set_threshold(1_000_000)  # half of mypyc's time went into searches for garbage
    # types are checked by `make lint`, where all libraries are installed
    checks = ["--config-file=", "--ignore-missing-imports", "--follow-imports=silent"]
    modules = mypycify([*checks, *COMPILED], opt_level="2", debug_level="0", group_name="sortie")
    for module in modules if os.name == "posix" else ():
        module.extra_compile_args.append("-ffp-contract=off")  # a multiply-add that is rounded once gives other records
    return {"ext_modules": modules}


setup(**(compiled() if os.environ.get("SORTIE_COMPILE", "0") not in ("", "0") else {}))
