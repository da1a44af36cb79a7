"""Code that a command runs cannot end it with an exit code of its choice."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

POLICIES = """
import atexit, ctypes, os, threading

def compiled(view):
    ctypes.CDLL(None)._exit(0)

def thread(view):
    ends = threading.Thread(target=lambda: os._exit(0))
    ends.start()
    ends.join()

def late(view, seen=[]):
    if not seen:
        seen.append(atexit.register(lambda: os._exit(0)))
    return 3

def fine(view):
    return []

def lingers(view, seen=[]):
    if not seen:
        seen.append(threading.Thread(target=threading.Event().wait))
        seen[0].start()
    return []

def lasts(view, seen=[]):
    # as the end of a process takes long on a busy machine
    if not seen:
        seen.append(atexit.register(threading.Event().wait))
    return []

def slow(view):
    print("decides", flush=True)
    while True:
        pass
"""
SCENARIO = """
name: short
duration_s: 0.3
fleet: {{drones: 2}}
mission: {{phases: [{{phase: search}}]}}
perception: {{detector: none}}
policy: {{name: '{policy}'}}
"""


def command(folder: Path, policy: str) -> list[str]:
    (folder / "mine.py").write_text(POLICIES)
    (folder / "short.yaml").write_text(SCENARIO.format(policy=folder / f"mine.py:{policy}"))
    return [sys.executable, "-m", "sortie", "check", str(folder / "short.yaml")]


@pytest.mark.parametrize(
    ("policy", "code", "line"),
    [
        ("compiled", 2, "error: the process ended before the command did"),
        ("thread", 2, "error: the process ended before the command did"),
        ("late", 2, "returns int, must be a sequence of directives"),
        ("fine", 0, ""),
        ("lingers", 0, ""),
        ("lasts", 0, ""),
    ],
)
def test_the_exit_code_is_the_commands(tmp_path: Path, policy: str, code: int, line: str) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit(7)")  # beside the call, as anybody may have one
    script = [str(Path(sys.executable).with_name("sortie")), *command(tmp_path, policy)[3:]]
    done = subprocess.run(script, capture_output=True, text=True, check=False, timeout=600, cwd=tmp_path)
    assert (done.returncode, line in done.stderr) == (code, True), done.stderr


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_to_the_command_ends_what_it_runs(tmp_path: Path, sent: signal.Signals, code: int) -> None:
    started = subprocess.Popen(
        command(tmp_path, "slow"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, stdin=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert started.stdout is not None
    assert started.stdout.readline() == "decides\n"
    time.sleep(0.1)
    started.send_signal(sent)
    started.communicate(timeout=600)
    assert started.returncode == code
