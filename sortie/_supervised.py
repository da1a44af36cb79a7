"""A parent for commands of which the exit code is a verdict: code that they run may not choose another one.

A policy can end its process from compiled code, from a thread, or when Python exits, with an exit code of its choice. The
command therefore runs in a child that reports its exit code through a pipe. All is written by then, so the report ends the
child: what a policy left behind, a thread for instance, counts no more.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from types import FrameType

from sortie.scenarios.exit_codes import USER

COMMANDS = ("check", "verify")
_PIPE = "SORTIE_REPORTS_TO"
_ENDED = b"error: the process ended before the command did; code that it runs must not end the process\n"
_LOOK_S = 0.1


def supervised() -> int | None:
    """Run this command line in a child and return its exit code; None where this process is to run it itself."""
    if _to is not None or not {*sys.argv[1:2]} & {*COMMANDS}:
        return None
    children: list[subprocess.Popen[bytes]] = []

    def forward(number: int, frame: FrameType | None) -> None:
        if number != signal.SIGINT or sys.stdin is None or not sys.stdin.isatty():
            children[0].send_signal(number)  # a terminal sends Ctrl-C to the child itself

    reads, writes = os.pipe()
    command = [sys.executable, "-P", "-m", "sortie", *sys.argv[1:]]  # -P: no module of the folder in which it is called
    ends = {signal.SIGINT, signal.SIGTERM}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ends)  # also the child's, until it can answer (`_signals`)
    child = subprocess.Popen(command, pass_fds=[writes], env=os.environ | {_PIPE: str(writes)})  # noqa: S603 - this command again
    children.append(child)
    for number in ends:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, forward)
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)
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
    if reported:
        child.kill()
        child.wait()
        return reported[0]
    status = child.wait()
    if status == 0:
        os.write(2, _ENDED)
        return USER
    return status if status > 0 else 128 - status


def report(code: object) -> None:
    """Tell the parent this command's exit code, as `SystemExit` has it, once everything is written."""
    if _to is not None:
        os.write(_to, bytes([code & 255 if isinstance(code, int) else int(code is not None)]))


_held = os.environ.pop(_PIPE, None)  # before any code of others runs
_to = None if _held is None else int(_held)
