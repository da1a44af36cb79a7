"""The process that reads damaged files: it may hang, run out of memory or die, and its parent tells of which file."""

from __future__ import annotations

import faulthandler
import json
import mmap
import os
import resource
import signal
import sys
import time
import traceback
import warnings
from pathlib import Path
from random import Random

from fuzz_mutators import mutated
from fuzz_readers import READERS, Reader

MEMORY_BYTES = 1 << 30
"""That a file may take."""
MOST_CHARACTERS = 2000
_PAGE = os.sysconf("SC_PAGE_SIZE")


class Cases:
    """The files of a reader's cases; the first ones are intact."""

    def __init__(self, name: str) -> None:
        self.name, self.reader = name, READERS[name]
        intact = self.reader.corpus()
        self.intact, self.corpus = len(intact), [*intact, *self.reader.odd()]

    def __getitem__(self, number: int) -> bytes:
        if number < len(self.corpus):
            return self.corpus[number]
        return mutated(Random(f"{self.name} {number}"), self.corpus, self.reader.mutators)


def fault_of(reader: Reader, path: Path, intact: bool = False) -> dict[str, str] | None:
    """What is wrong with how a file is read; None where nothing is."""
    try:
        reader.read(path)
    except reader.refusals as error:
        line, chain = str(error), []
        cause: BaseException | None = error
        while cause is not None:
            chain.append(cause)
            cause = cause.__cause__ or cause.__context__
        wrong = (
            "more than a line" if len(line.splitlines()) != 1
            else "too long a line" if len(line) > MOST_CHARACTERS
            else "does not name the file" if issubclass(reader.refusals[0], Exception) and reader.suffix and str(path) not in line
            else "took more memory than there is" if any(isinstance(one, MemoryError) for one in chain)
            else "refuses a valid file" if intact
            else ""
        )  # fmt: skip
        return {"what": f"{wrong}: {line[:500]}", "key": f"{wrong} {_place(error)}"} if wrong else None
    except BaseException as error:
        text = "".join(traceback.format_exception(error, limit=-6))
        return {"what": text[-3000:], "key": f"{type(error).__name__} {_place(error)}"}
    return None


def _place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if "/site-packages/" not in f.filename and "/lib/python" not in f.filename]
    return f"{Path(own[-1].filename).name}:{own[-1].lineno}" if own else ""


def work(name: str, first: int, last: int, folder: Path) -> None:
    """Read case after case; each fault is a line of JSON on the standard output.

    `place` in the folder holds numbers of 8 B: the present case, the slowest case's µs and number, processor time in ms.
    """
    cases = Cases(name)
    reader = cases.reader
    warnings.simplefilter("error")  # a warning on a user's terminal is no line that tells what is wrong
    with (folder / "place").open("r+b") as shared, mmap.mmap(shared.fileno(), 32) as now:
        path = folder / f"case{reader.suffix}"
        for data in cases.corpus:  # loads what is loaded when first needed
            path.write_bytes(data)
            fault_of(reader, path)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * _PAGE
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        faulthandler.enable()
        faulthandler.register(signal.SIGPROF, chain=True)  # then the default: the process ends
        slowest_us = 0
        for number in range(first, last):
            path.write_bytes(cases[number])
            now[:8] = number.to_bytes(8, "little")
            begin = time.process_time_ns()
            signal.setitimer(signal.ITIMER_PROF, reader.limit_s)
            found = fault_of(reader, path, number < cases.intact)
            signal.setitimer(signal.ITIMER_PROF, 0)
            took_us = (time.process_time_ns() - begin) // 1000
            if took_us > slowest_us:
                slowest_us = took_us
                now[8:24] = slowest_us.to_bytes(8, "little") + number.to_bytes(8, "little")
            times = os.times()
            now[24:32] = int(1000 * sum(times[:4])).to_bytes(8, "little")
            if found:
                sys.stdout.write(json.dumps({"case": number, **found}) + "\n")
                sys.stdout.flush()
