"""A parent for commands of which the exit code is a verdict: their code may not end the process before it is reached.

A policy can end its process from compiled code, from a thread, or when Python exits, with an exit code of its choice. The
command therefore runs in a child that reports its exit code through a pipe. A thread that a policy leaves behind may also keep
the process from ending: the child is killed some time after its report.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from types import FrameType

COMMANDS = ("check", "verify")
_PIPE = "SORTIE_REPORTS_TO"
_ENDED = b"error: the process ended before the command did; code that it runs must not end the process\n"
_LINGERED = b"error: the process did not end after the command; code that it runs must not leave a thread behind\n"
GRACE_S = 20.0
"""How long a child may go on after its report, s."""
_LOOK_S = 0.1


def supervised() -> int | None:
    """Run this command line in a child and return its exit code; None where this process is to run it itself."""
    if _to is not None or not {*sys.argv[1:2]} & {*COMMANDS}:
        return None
    children: list[subprocess.Popen[bytes]] = []

    def forward(number: int, frame: FrameType | None) -> None:
        if not children:
            os._exit(128 + number)
        if number != signal.SIGINT or sys.stdin is None or not sys.stdin.isatty():
            children[0].send_signal(number)  # a terminal sends Ctrl-C to the child itself

    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, forward)
    reads, writes = os.pipe()
    command = [sys.executable, "-P", "-m", "sortie", *sys.argv[1:]]  # -P: no module of the folder in which it is called
    child = subprocess.Popen(command, pass_fds=[writes], env=os.environ | {_PIPE: str(writes)})  # noqa: S603 - this command again
    children.append(child)
    os.close(writes)
    reported, is_open = b"", True
    while not reported and is_open:
        # its end, too, as somebody else may still hold the other end of the pipe
        has_ended = child.poll() is not None
        if select.select([reads], [], [], 0.0 if has_ended else _LOOK_S)[0]:
            reported = os.read(reads, 1)
            is_open = bool(reported)
        elif has_ended:
            is_open = False
    try:
        status = child.wait(GRACE_S if reported else None)
    except subprocess.TimeoutExpired:
        child.kill()
        status = child.wait()
        os.write(2, _LINGERED)
    if reported:
        return reported[0] or int(status != 0)
    if status == 0:
        os.write(2, _ENDED)
        return 1
    return status if status > 0 else 128 - status


def report(code: object) -> None:
    """Tell the parent this command's exit code, as `SystemExit` has it."""
    if _to is not None:
        os.write(_to, bytes([code & 255 if isinstance(code, int) else int(code is not None)]))


_held = os.environ.pop(_PIPE, None)  # before any code of others runs
_to = None if _held is None else int(_held)
