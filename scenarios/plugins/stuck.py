"""A process that ends its parent when the parent's threads stand still for too long. It imports nothing of Sortie.

`user_calls.py` starts it, with the file of the shared memory, its format, and the time of a tick.
"""

import mmap
import os
import select
import signal
import struct
import sys


def main() -> None:
    file, form, tick_s = int(sys.argv[1]), sys.argv[2], float(sys.argv[3])
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with its parent, by the end of its input
    memory, parent = mmap.mmap(file, struct.calcsize(form)), os.getppid()
    seen, still_s = 0, 0.0
    while not select.select([0], [], [], tick_s)[0]:
        ticks, longest_s, error = struct.unpack_from(form, memory, 0)
        still_s = still_s + tick_s if ticks == seen and longest_s else 0.0
        seen = ticks
        if longest_s and still_s > longest_s and os.getppid() == parent:
            os.write(2, b"error: " + error.rstrip(b"\0") + b"\n")
            os.kill(parent, signal.SIGXCPU)  # by which it is known
            if not select.select([0], [], [], 1.0)[0]:
                os.kill(parent, signal.SIGKILL)
            return


main()
