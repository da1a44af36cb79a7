"""Runs a plan through ns-3: compiles the driver against the `ns3` wheel once, starts it, and reads what it wrote.

Each run is a process with a time limit. A run that crashes or hangs is started again with another seed, and stderr says so.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any

import pandas as pd

from research.validation.ns3.wifi_plan import FRAME_S, FloatArray, Plan

HERE = Path(__file__).resolve().parent
CACHE = Path(os.environ.get("SORTIE_NS3_CACHE", HERE / "build"))
MODULES = ("core", "network", "internet", "mobility", "propagation", "spectrum", "antenna", "energy", "stats", "bridge",
           "traffic-control", "wifi")  # fmt: skip
TRIES = 4
RUN_LIMIT_S = 1800.0


class Ns3Missing(Exception):
    """The wheel of ns-3, or a compiler, is not there."""


def wheel() -> tuple[Path, str]:
    """The folder of ns-3's headers and libraries, and its version such as `3.44`.

    Raises:
        Ns3Missing: if the wheel is not installed.
    """
    try:
        found = metadata.distribution("ns3")
    except metadata.PackageNotFoundError:
        raise Ns3Missing("ns-3 is not installed: pip install 'sortie-sim[ns3]'") from None
    return Path(str(found.locate_file("ns3"))), ".".join(found.version.split(".")[:2])


def driver(name: str = "sortie_wifi") -> Path:
    """The compiled driver; compiled now if its source, the wheel or the flags have changed.

    Raises:
        Ns3Missing: no wheel or no C++ compiler.
        RuntimeError: it does not compile.
    """
    folder, version = wheel()
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    if compiler is None:
        raise Ns3Missing("no C++ compiler: install g++, or set CXX")
    source = HERE / f"{name}.cc"
    libs = folder / "lib64"
    flags = ["-std=c++23", "-O2", f"-I{folder / 'include'}", f"-L{libs}", f"-Wl,-rpath,{libs}"]
    links = [f"-lns{version}-{module}" for module in MODULES]
    key = hashlib.sha256("\0".join([source.read_text("utf-8"), version, *flags, *links]).encode()).hexdigest()[:16]
    target = CACHE / f"{name}-{key}"
    if not target.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        made = target.with_suffix(f".{os.getpid()}")
        done = subprocess.run([compiler, *flags, str(source), "-o", str(made), *links], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{source.name} does not compile against ns-3 {version}:\n{done.stderr[-4000:]}")
        made.rename(target)
    return target


def run_ns3(
    plan: Plan,
    warm_s: float,
    stop_s: float,
    *,
    seed: int = 1,
    shadow_db: FloatArray | None = None,
    limit_s: float = RUN_LIMIT_S,
    **options: Any,
) -> dict[str, Any]:
    """One run.

    Args:
        plan: the traffic.
        warm_s, stop_s: figures count between these times.
        seed: run number of ns-3's random streams.
        shadow_db: [frames, N, N], added to each link's SNR; None is none.
        limit_s: wall-clock limit of a try.
        options: of the driver, such as `rate="HeMcs7"` or `rts=1`.

    Returns:
        `data` (a row a payload), `descriptors` (a row a receiver), and the driver's totals; with `frames=1` also
        `frames`, a row a frame on the air.

    Raises:
        RuntimeError: every try crashed or took too long.
    """
    binary = driver()
    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder)
        (at / "plan").write_text(plan.text())
        command = [str(binary), f"--plan={at / 'plan'}", f"--out={at / 'r'}", f"--warm={warm_s}", f"--stop={stop_s}"]
        if shadow_db is not None:
            shadow_db.astype("<f4").tofile(at / "shadow")
            command.append(f"--shadow={at / 'shadow'}")
        command += [f"--{key}={value}" for key, value in options.items()]
        why = ""
        for again in range(TRIES):
            try:
                done = subprocess.run(
                    [*command, f"--run={seed + 1000 * again}"], capture_output=True, text=True, timeout=limit_s
                )
            except subprocess.TimeoutExpired:
                why = f"took longer than {limit_s:g} s"
            else:
                if done.returncode == 0:
                    break
                why = f"ended with {done.returncode}: {done.stderr.strip()[-300:]}"
            print(f"ns-3 with seed {seed + 1000 * again} {why}", file=sys.stderr)  # noqa: T201
        else:
            raise RuntimeError(f"ns-3 failed {TRIES} times, the last one {why}")
        found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
        data, heard = pd.read_csv(at / "r.data.csv"), pd.read_csv(at / "r.bcast.csv")
        if options.get("frames"):
            found["frames"] = pd.read_csv(at / "r.frames.csv")
    data["delay"] = data["last"] - data["t"]
    data["ok"] = (data["got"] == data["fragments"]) & (data["delay"] <= FRAME_S + 1e-6)
    heard["ok"] = heard["delay"] >= 0.0
    return {"data": data, "descriptors": heard, "crashed": again, **found}
