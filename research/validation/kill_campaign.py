"""Kill a campaign's processes at random moments, start-up included, and see that nothing is lost.

    python -m research.validation.kill_campaign --kills 40

Each trial starts a campaign in a new folder: with one worker, with two, or on a dask cluster that is joined. It kills the
driver, a worker or the scheduler with SIGKILL or SIGTERM. Then the same command runs to the end. A trial passes when

- the disturbed command printed at most one line about it, and no traceback;
- nothing of it is left running;
- the table is byte for byte the one of a campaign that nobody disturbed.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

BASE = "name: small\nduration_s: 1\nfleet: {drones: 2}\nperception: {detector: none}\n"
CAMPAIGN = """
campaign: killed
base: base.yaml
vary: {fleet.battery.initial_soc: {kind: uniform, low: 0.2, high: 1}}
sample: {count: 20}
policies: [worked, "best-2(received_budget=0.1)"]
metrics: [bytes.data_sent, energy_j.total]
seed: 5
"""
ENGINES = {"1": ("driver", "worker"), "2": ("driver", "worker"), "cluster": ("driver", "worker", "scheduler")}
"""What may be killed, by the number of workers or on a cluster."""
ENDS_S = 180.0
"""A command that takes longer than this hangs."""


@dataclass(frozen=True)
class Trial:
    """One kill, and what came of it."""

    engine: str
    victim: str
    number: signal.Signals
    at_s: float
    code: int | None
    """The exit code of the disturbed command; None where it went on for too long."""
    said: list[str]
    """What it printed on stderr."""
    left: int
    """Processes of it that were still running after its end."""
    again: int
    """The exit code of the command after it."""
    same: bool
    """Whether the table is that of the undisturbed campaign."""

    @property
    def passed(self) -> bool:
        silent = self.victim == "driver" and self.number == signal.SIGKILL
        lines = len(self.said) <= (0 if silent else 1) and not any("Traceback" in line for line in self.said)
        return self.code is not None and lines and self.left == 0 and self.again == 0 and self.same

    def __str__(self) -> str:
        what = f"{self.engine:7} {self.victim:9} {self.number.name:8} at {self.at_s:5.1f} s: exit {self.code}"
        return f"{'pass' if self.passed else 'FAIL'} {what}, table {'same' if self.same else 'OTHER'}; {' | '.join(self.said)}"


def main() -> int:
    """Fly the trials; the exit code is 1 where one fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=40, help="number of trials (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the moments and victims (default: %(default)s)")
    options = parser.parse_args()
    draw = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "base.yaml").write_text(BASE)
        (folder / "killed.yaml").write_text(CAMPAIGN)
        begin_s = time.monotonic()
        assert _command(folder, "whole", ["--workers", "1"]).wait() == 0
        takes_s = time.monotonic() - begin_s
        whole = (folder / "whole" / "runs" / "table.parquet").read_bytes()
        trials = list[Trial]()
        for i in itertools.count():
            if len(trials) == options.kills:
                break
            if (trial := _trial(folder, f"trial-{i}", draw, takes_s, whole)) is not None:
                trials.append(trial)
                sys.stdout.write(f"{len(trials):3} {trial}\n")
                sys.stdout.flush()
    passed = sum(trial.passed for trial in trials)
    sys.stdout.write(
        f"{passed} of {len(trials)} kills: one line at most, nothing left running, resumed, the same table\n"
    )
    return 0 if passed == len(trials) else 1


def _trial(folder: Path, name: str, draw: random.Random, takes_s: float, whole: bytes) -> Trial | None:
    """One kill; None where the command was through before it."""
    engine = draw.choice(list(ENGINES))
    victim, number = draw.choice(ENGINES[engine]), draw.choice([signal.SIGKILL, signal.SIGTERM])
    at_s, pick = draw.uniform(0, takes_s), draw.random()
    with _cluster(engine == "cluster") as (how, others):
        driver = _command(
            folder, name, [*how, "--wait-for-workers", "5"] if engine == "cluster" else ["--workers", engine]
        )
        begin_s = time.monotonic()
        while time.monotonic() < begin_s + at_s or not (found := _victims(victim, driver.pid, others)):
            if driver.poll() is not None:
                driver.communicate()
                return None
            time.sleep(0.01)
        at_s = time.monotonic() - begin_s
        os.kill(found[int(pick * len(found))], number)
        try:
            _, text = driver.communicate(timeout=ENDS_S)
            code: int | None = driver.returncode
        except subprocess.TimeoutExpired:
            driver.kill()
            text, code = driver.communicate()[1] + "\nit hangs", None
        left = _still_running(driver.pid)
    again = _command(folder, name, ["--workers", "1"])
    again.communicate()
    table = folder / name / "runs" / "table.parquet"
    same = table.is_file() and table.read_bytes() == whole
    return Trial(engine, victim, number, at_s, code, text.splitlines(), left, again.returncode, same)


def _command(folder: Path, name: str, how: list[str]) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "sortie", "campaign", str(folder / "killed.yaml"), *how]
    command += ["--out", str(folder / name), "--no-report"]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


@contextmanager
def _cluster(wanted: bool) -> Iterator[tuple[list[str], dict[str, list[int]]]]:
    """A scheduler and two workers, each with the process that watches over it."""
    if not wanted:
        yield [], {}
        return
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "scheduler.json"
        begin = [sys.executable, "-m", "dask", "scheduler", "--port", "0", "--no-dashboard"]
        scheduler = _quietly([*begin, "--scheduler-file", str(file)])
        work = [sys.executable, "-m", "dask", "worker", "--scheduler-file", str(file), "--nthreads", "1"]
        workers = [_quietly([*work, "--no-dashboard"]) for _ in range(2)]
        try:
            _wait_for(file.is_file)
            _wait_for(lambda: all(_children(worker.pid) for worker in workers))
            address = json.loads(file.read_text())["address"]
            pids = [pid for worker in workers for pid in (worker.pid, *_children(worker.pid))]
            yield ["--scheduler", address], {"scheduler": [scheduler.pid], "worker": pids}
        finally:
            for process in (scheduler, *workers):
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def _quietly(command: list[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


def _wait_for(happened: Callable[[], object], most_s: float = 60.0) -> None:
    end_s = time.monotonic() + most_s
    while not happened():
        assert time.monotonic() < end_s, "the cluster did not start"
        time.sleep(0.1)


def _victims(victim: str, driver: int, others: dict[str, list[int]]) -> list[int]:
    if victim == "driver":
        return [driver]
    return others[victim] if others else _children(driver)


def _children(pid: int) -> list[int]:
    """A process' children, and theirs."""
    try:
        direct = [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
        for task in Path(f"/proc/{pid}/task").iterdir():
            direct += [int(p) for p in (task / "children").read_text().split()]
    except OSError:
        return []
    direct = sorted(set(direct))
    return direct + [p for one in direct for p in _children(one)]


def _still_running(session: int, most_s: float = 10.0) -> int:
    """How many processes of a session run on, after they had time to go."""
    end_s = time.monotonic() + most_s
    while (found := of_session(session)) and time.monotonic() < end_s:
        time.sleep(0.2)
    for pid in found:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return len(found)


def of_session(session: int) -> list[int]:
    """A session's processes, but for those that have ended and wait to be asked how."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            state, _, _, its, *_ = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(its) == session and state != "Z":
                found.append(int(folder.name))
    return found


if __name__ == "__main__":
    sys.exit(main())
