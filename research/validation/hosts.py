"""Fly a campaign on a cluster of hosts with addresses of their own; cut hosts off, let others join, and compare the tables.

    python -m research.validation.hosts                  every trial below, by dask's own time-outs
    python -m research.validation.hosts cut blip         these trials

Four network namespaces are the hosts. Each has an address on a bridge, and they share the file system: `head` has the
scheduler, `desk` the command `sortie campaign --scheduler`, `first` and `second` have workers. A trial passes when

- the command ends as the trial says, and printed at most one line about what happened;
- the table is byte for byte the one of the same campaign flown with `--workers 1` on this machine.

The command needs Linux, root and `ip` of iproute2. It removes its namespaces however it ends; those of a command that was
killed are removed by the next one.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

BASE = "name: small\nduration_s: 1\nfleet: {drones: 2}\nperception: {detector: none}\n"
CAMPAIGN = """
campaign: hosts
base: base.yaml
vary: {{fleet.battery.initial_soc: {{kind: uniform, low: 0.2, high: 1}}}}
sample: {{count: {draws}}}
policies: [worked, "best-2(received_budget=0.1)"]
metrics: [bytes.data_sent, energy_j.total]
seed: 5
"""
HOSTS = {"head": "10.77.0.1", "desk": "10.77.0.2", "first": "10.77.0.3", "second": "10.77.0.4"}
ADDRESS = f"tcp://{HOSTS['head']}:8786"
SWITCH = "switch"
"""The namespace that has the bridge, so that nothing of the machine's own network is changed."""
PREFIX = "sortie-"
LEAST_TIMEOUT_S = 11.0
"""Dask's `distributed.comm.timeouts.tcp` may not be shorter."""
STARTS_S = 120.0
"""A scheduler or worker that takes longer than this does not start."""
ENDS_S = 600.0
"""A command that takes longer than this hangs."""


class Network:
    """The hosts: namespaces whose names carry this process's number, joined by a bridge."""

    def __init__(self) -> None:
        _remove(lambda pid: not Path(f"/proc/{pid}").exists())
        _ip("netns", "add", _space(SWITCH))
        _ip("-n", _space(SWITCH), "link", "add", "bridge", "type", "bridge")
        _ip("-n", _space(SWITCH), "link", "set", "bridge", "up")
        for host, address in HOSTS.items():
            _ip("netns", "add", _space(host))
            cable = ["netns", _space(host), "type", "veth", "peer", "name", host, "netns", _space(SWITCH)]
            _ip("link", "add", "eth0", *cable)
            _ip("-n", _space(SWITCH), "link", "set", host, "master", "bridge", "up")
            _ip("-n", _space(host), "address", "add", f"{address}/24", "dev", "eth0")
            for device in ("lo", "eth0"):
                _ip("-n", _space(host), "link", "set", device, "up")
        self._processes = list[subprocess.Popen[Any]]()

    def cut(self, host: str) -> None:
        """Unplug a host's cable: what it sends and what is sent to it is lost, and nobody is told."""
        _ip("-n", _space(SWITCH), "link", "set", host, "down")

    def mend(self, host: str) -> None:
        """Plug the cable in again."""
        _ip("-n", _space(SWITCH), "link", "set", host, "up")

    def start(self, host: str, command: Sequence[str], **how: Any) -> subprocess.Popen[Any]:
        """Start a command on a host."""
        on_host = ["ip", "netns", "exec", _space(host), *command]
        process = subprocess.Popen(on_host, start_new_session=True, **how)
        self._processes.append(process)
        return process

    def close(self) -> None:
        """End everything that was started, and remove the hosts."""
        for process in self._processes:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            for pipe in (process.stdout, process.stderr):
                if pipe is not None:
                    pipe.close()
        _remove(lambda pid: pid == os.getpid())


def why_not() -> str:
    """What this machine lacks, in one line; empty where it can make such hosts."""
    if sys.platform != "linux" or shutil.which("ip") is None:
        return "hosts.py cannot run here: it needs Linux and the command ip (iproute2)"
    if os.geteuid() != 0:
        return "hosts.py cannot run here: only root may make network namespaces"
    try:
        with closing(Network()) as network:
            network.start("desk", ["true"]).wait()
    except RuntimeError as error:
        return f"hosts.py cannot run here: {error}"
    return ""


def _ip(*words: str) -> str:
    done = subprocess.run(["ip", *words], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"ip {' '.join(words)}: {' '.join(done.stderr.split())}")
    return done.stdout


def _space(host: str) -> str:
    return f"{PREFIX}{os.getpid()}-{host}"


def _remove(which: Callable[[int], bool]) -> None:
    """Delete this command's namespaces of some processes; their cables and addresses go with them."""
    for line in _ip("netns", "list").splitlines():
        name = line.split()[0]
        pid, _, host = name.removeprefix(PREFIX).partition("-")
        if name.startswith(PREFIX) and host in (*HOSTS, SWITCH) and pid.isdigit() and which(int(pid)):
            _ip("netns", "delete", name)


class Flight:
    """A campaign that is flown on the cluster."""

    def __init__(self, network: Network, folder: Path, runs: int, timeout_s: float | None) -> None:
        self.network, self.folder, self.runs = network, folder, runs
        self.timeout_s = timeout_s or 30.0
        """After this long without an answer, dask takes a host for dead."""
        timeout = {} if timeout_s is None else {"DASK_DISTRIBUTED__COMM__TIMEOUTS__TCP": f"{timeout_s:g}s"}
        self._how = {"env": {**os.environ, **timeout}, "stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL}
        self._logs = 0

    def begin(self) -> None:
        """Start the scheduler, two workers on `first`, and the command; returns once a fifth of the runs is flown."""
        self._dask("head", "Scheduler at", "scheduler", "--host", HOSTS["head"], "--no-dashboard")
        self.join("first", workers=2)
        self.command()
        self.await_rows(self.runs // 5)

    def join(self, host: str, workers: int = 1) -> None:
        """Let a host's workers join."""
        # a worker that is cut off ends within the time-out
        many = ["--nworkers", str(workers), "--nthreads", "1", "--no-dashboard", "--death-timeout", "600"]
        self._dask(host, "Registered to", "worker", ADDRESS, *many)

    def command(self) -> None:
        """Start `sortie campaign`."""
        file, to = str(self.folder / "hosts.yaml"), str(self.folder / "flown")
        command = [sys.executable, "-m", "sortie", "campaign", file, "--scheduler", ADDRESS, "--out", to, "--no-report"]
        self._driver = self.network.start("desk", command, stderr=subprocess.PIPE, text=True, **self._how)

    def await_end(self) -> tuple[int | None, list[str]]:
        """The command's exit code, None where it hangs, and its lines on stderr."""
        try:
            _, text = self._driver.communicate(timeout=ENDS_S)
        except subprocess.TimeoutExpired:
            self._driver.kill()
            return None, self._driver.communicate()[1].splitlines()
        return self._driver.returncode, text.splitlines()

    def await_rows(self, count: int) -> None:
        """Wait until so many runs are on disk."""
        _wait_for(lambda: self.rows >= count or self._driver.poll() is not None, f"{count} rows", ENDS_S)

    @property
    def rows(self) -> int:
        """Runs on disk."""
        with suppress(sqlite3.OperationalError):  # not there yet
            file = f"file:{self.folder / 'flown' / 'campaign.sqlite'}?mode=ro"
            with closing(sqlite3.connect(file, uri=True, timeout=60)) as db:
                return int(db.execute("SELECT count(*) FROM rows").fetchone()[0])
        return 0

    def _dask(self, host: str, ready: str, *words: str) -> None:
        """Start a part of the cluster, and wait until its log says that it is ready."""
        self._logs += 1
        log = self.folder / f"{self._logs}-{host}.log"
        with log.open("w") as file:
            self.network.start(host, [sys.executable, "-m", "dask", *words], stderr=file, **self._how)
        _wait_for(lambda: ready in log.read_text(), f"dask {words[0]} on {host}", STARTS_S)


def _wait_for(happened: Callable[[], object], what: str, most_s: float) -> None:
    end_s = time.monotonic() + most_s
    while not happened():
        if time.monotonic() > end_s:
            raise RuntimeError(f"no {what} within {most_s:g} s")
        time.sleep(0.1)


# --- what happens to the hosts ----------------------------------------------------------------------


def _cut(flight: Flight) -> None:
    """The workers' host is cut off for good; workers of another host, which joined just before, fly the rest."""
    flight.join("second")
    flight.network.cut("first")


def _back(flight: Flight) -> None:
    """As `cut`; the host comes back after everybody took it for dead, its flown batches with it."""
    _cut(flight)
    time.sleep(flight.timeout_s + 5)
    if flight.rows == flight.runs:
        raise RuntimeError("the campaign ended before the host came back; give more --runs")
    flight.network.mend("first")


def _blip(flight: Flight) -> None:
    """The only workers' host is cut off for two seconds."""
    flight.network.cut("first")
    time.sleep(2)
    flight.network.mend("first")


def _alone(flight: Flight) -> None:
    """The only workers' host is cut off; another joins long after everybody knows it."""
    flight.network.cut("first")
    time.sleep(flight.timeout_s + 10)
    flight.join("second")


def _desk(flight: Flight) -> None:
    """The command's own host is cut off, until it has ended."""
    flight.network.cut("desk")


TRIALS: dict[str, Callable[[Flight], None]] = {
    "cut": _cut, "back": _back, "blip": _blip, "alone": _alone, "desk": _desk,
}  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What came of a trial."""

    trial: str
    code: int | None
    said: list[str]
    rows: int
    """On disk when it happened to the hosts."""
    runs: int
    same: bool
    """Whether the table, in the end, is that of one worker on this machine."""
    seconds: float

    @property
    def passed(self) -> bool:
        code = 2 if self.trial == "desk" else 0
        one_line = len(self.said) <= 1 and not any("Traceback" in line for line in self.said)
        return self.code == code and one_line and 0 < self.rows < self.runs and self.same

    def __str__(self) -> str:
        what = f"{self.trial:6} after {self.rows} of {self.runs} runs: exit {self.code} in {self.seconds:.0f} s"
        return f"{'pass' if self.passed else 'FAIL'} {what}, table {'same' if self.same else 'OTHER'}; {' | '.join(self.said)}"


def fly(name: str, runs: int, timeout_s: float | None, folder: Path) -> Outcome:
    """One trial, in a folder that `prepare` has made."""
    shutil.rmtree(folder / "flown", ignore_errors=True)
    with closing(Network()) as network:
        flight = Flight(network, folder, runs, timeout_s)
        flight.begin()
        begin_s, rows = time.monotonic(), flight.rows
        TRIALS[name](flight)
        code, said = flight.await_end()
        if name == "desk":  # the same command goes on once the cable is in again
            network.mend("desk")
            flight.command()
            flight.await_end()
        seconds = time.monotonic() - begin_s
    return Outcome(name, code, said, rows, runs, _table(folder / "flown") == _table(folder / "alone"), seconds)


def prepare(folder: Path, runs: int) -> None:
    """Write the campaign, and fly it with one worker on this machine.

    Raises:
        CalledProcessError: it cannot be flown.
    """
    (folder / "base.yaml").write_text(BASE)
    (folder / "hosts.yaml").write_text(CAMPAIGN.format(draws=runs // 2))
    command = [sys.executable, "-m", "sortie", "campaign", str(folder / "hosts.yaml"), "--workers", "1"]
    subprocess.run([*command, "--out", str(folder / "alone"), "--no-report"], check=True, stdout=subprocess.DEVNULL)


def _table(folder: Path) -> bytes | None:
    file = folder / "runs" / "table.parquet"
    return file.read_bytes() if file.is_file() else None


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """SIGTERM ends the command by way of its `finally`s."""
    before = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def main() -> int:
    """Fly the trials; the exit code is 1 where one fails, 2 where there can be none."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trials", nargs="*", metavar="TRIAL", help=f"any of {', '.join(TRIALS)} (default: all)")
    parser.add_argument("--runs", type=int, default=600, help="of each campaign, an even number (default: %(default)s)")
    parser.add_argument("--timeout", type=float, help="seconds until dask takes a host for dead (default: dask's own)")
    options = parser.parse_args()
    if options.timeout is not None and options.timeout < LEAST_TIMEOUT_S:
        parser.error(f"--timeout {options.timeout:g}: dask takes {LEAST_TIMEOUT_S:g} s or more")
    if unknown := set(options.trials) - TRIALS.keys():
        parser.error(f"no trial is called {', '.join(sorted(unknown))}; there are {', '.join(TRIALS)}")
    if reason := why_not():
        sys.stderr.write(reason + "\n")
        return 2
    with _ended_by_sigterm(), ExitStack() as opened:
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory()))
        prepare(folder, options.runs)
        passed = True
        for name in options.trials or TRIALS:
            outcome = fly(name, options.runs, options.timeout, folder)
            passed &= outcome.passed
            sys.stdout.write(f"{outcome}\n")
            sys.stdout.flush()
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
