"""Damaged inputs for every reader: `python tests/fuzz [READER ...] [--seconds S]`, or `make fuzz`.

A case is a valid file, damaged by draws that follow from the reader's name and the case's number. A reader must read it,
or refuse it with one line that names it, within limits of time and memory. What it may not: raise anything else, warn,
hang, end the process. Such a file is kept in runs/fuzz, with the command that tries it again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))
sys.path.insert(1, str(Path(__file__).resolve().parents[2]))

KEPT = Path("runs/fuzz")
STILL_S = 600.0
"""A worker that stands so long on one case, by the clock on the wall, hangs."""


@dataclass
class Tally:
    """What came of one reader."""

    name: str
    cases: int = 0
    cpu_s: float = 0.0
    slowest_s: float = 0.0
    slowest: int = 0
    faults: dict[str, dict[str, object]] = field(default_factory=dict)
    """The first of each kind."""


def run(name: str, seconds: float, first: int, last: int = 1 << 62) -> Tally:
    """Try one reader for so much processor time; a worker that dies is replaced, and its case counts as a fault."""
    tally, begin = Tally(name), first
    while tally.cpu_s < seconds and begin < last:
        with tempfile.TemporaryDirectory() as folder:
            begin = _work(tally, Path(folder), seconds, begin, last)
    return tally


def _work(tally: Tally, folder: Path, seconds: float, begin: int, last: int) -> int:
    """Watch one worker until its end; returns the number of the next case."""
    place, faults, errors = folder / "place", folder / "faults", folder / "errors"
    place.write_bytes(begin.to_bytes(8, "little") + bytes(24))
    command = [
        sys.executable,
        __file__,
        tally.name,
        "--worker",
        str(folder),
        "--first",
        str(begin),
        "--last",
        str(last),
    ]
    with faults.open("w") as out, errors.open("w") as err:
        worker = subprocess.Popen(command, stdout=out, stderr=err)
    before_s, ended, moved_s, at = tally.cpu_s, "", time.monotonic(), b""
    while True:
        running = worker.poll() is None
        held = place.read_bytes()
        now, slow_us, slow, cpu_ms = (int.from_bytes(held[k : k + 8], "little") for k in (0, 8, 16, 24))
        if held != at:
            at, moved_s = held, time.monotonic()
        tally.cpu_s = before_s + cpu_ms / 1000
        tally.slowest_s, tally.slowest = max((tally.slowest_s, tally.slowest), (slow_us / 1e6, slow))
        if not running:
            break
        if tally.cpu_s >= seconds:
            ended = "done"
        elif time.monotonic() - moved_s > STILL_S:
            ended = f"stands still for {STILL_S:g} s"
        if ended:
            worker.kill()
        time.sleep(0.1)
    tally.cases += now + 1 - begin
    for line in faults.read_text().splitlines():
        with contextlib.suppress(ValueError):  # cut off when its time was over
            found = json.loads(line)
            tally.faults.setdefault(found["key"], found)
    if ended == "done" or worker.returncode == 0:
        return last
    told = errors.read_text()[-3000:]
    if not cpu_ms and worker.returncode > 0:
        raise SystemExit(f"{tally.name}: its worker does not start\n{told}")
    how = ended or _words(worker.returncode)
    where = re.findall(r'File "([^"]+)", line (\d+)', told)
    tally.faults.setdefault(f"{how} {where[:1]}", {"case": now, "what": f"{told}\n{how}"})
    return now + 1


def _words(code: int) -> str:
    if code == -signal.SIGPROF:
        return "takes more processor time than it may"
    return f"ends the process: {signal.Signals(-code).name}" if code < 0 else f"ends the process with {code}"


def keep(tally: Tally) -> None:
    """Write the faults' files and texts."""
    from fuzz_worker import Cases

    cases = Cases(tally.name) if tally.faults else None
    for fault in tally.faults.values():
        assert cases is not None
        KEPT.mkdir(parents=True, exist_ok=True)
        number = int(str(fault["case"]))
        (KEPT / f"{tally.name}-{number}{cases.reader.suffix}").write_bytes(cases[number])
        (KEPT / f"{tally.name}-{number}.txt").write_text(str(fault["what"]))
        last = str(fault["what"]).strip().splitlines()[-1][:150]
        sys.stdout.write(f"FAULT {tally.name}: {last}\n      python tests/fuzz {tally.name} --case {number}\n")


def main() -> int:
    parser = argparse.ArgumentParser(description="Try every reader with damaged inputs.")
    parser.add_argument("readers", nargs="*", help="default: all")
    parser.add_argument("--seconds", type=float, default=60.0, help="processor time for each reader")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="readers at once")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--last", type=int, default=1 << 62, help="number behind the last case")
    parser.add_argument("--case", type=int, help="try one case and print what comes of it")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        from fuzz_worker import work

        work(options.readers[0], options.first, options.last, options.worker)
        return 0
    if options.case is not None:
        options.first, options.last = options.case, options.case + 1
    from fuzz_readers import READERS

    names = options.readers or list(READERS)
    if unknown := [name for name in names if name not in READERS]:
        parser.error(f"no reader {unknown[0]}, there are {', '.join(READERS)}")
    with ThreadPoolExecutor(options.jobs) as pool:
        tallies = []
        for tally in pool.map(lambda name: run(name, options.seconds, options.first, options.last), names):
            tallies.append(tally)
            sys.stdout.write(f"{tally.name}: {tally.cases} cases, {len(tally.faults)} kinds of fault\n")
            sys.stdout.flush()
            keep(tally)
            if options.case is not None:
                sys.stdout.writelines(f"{fault['what']}\n" for fault in tally.faults.values())
    sys.stdout.write(f"\n{'reader':12}{'cases':>10}{'CPU s':>8}{'cases/s':>9}{'faults':>8}  slowest\n")
    for t in tallies:
        rate = t.cases / t.cpu_s if t.cpu_s else 0.0
        slow = f"{t.slowest_s:.3f} s (case {t.slowest})"
        sys.stdout.write(f"{t.name:12}{t.cases:10}{t.cpu_s:8.0f}{rate:9.0f}{len(t.faults):8}  {slow}\n")
    return int(any(t.faults for t in tallies))


if __name__ == "__main__":
    sys.exit(main())
