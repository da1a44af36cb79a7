"""A stranger on the bus, without a key: it silences, repeats and forges what drone 0 sends to drone 1.

python dds_attacker.py DOMAIN
"""

import os
import sys
import time

from dds_peer import Directive, say

from sortie.sim.export.topics import CONTEXT, Topic, TopicKind
from sortie.sim.live.bus import Bus
from sortie.sim.live.payload_message import pack_bytes, unpack_bytes

SILENCE = Directive(0, 1, 0, 100, [0.0, 0.0, 0.0], 0.0, 0.0, 0.1, 1.0).serialize(use_version_2=False)
"""Drone 0 is to send nothing to drone 1; written by hand as rosidl writes it."""


def main() -> None:
    bus = Bus(int(sys.argv[1]))
    topics = [CONTEXT, *(Topic(kind, 0, 1) for kind in (TopicKind.DIRECTIVE, TopicKind.FEATURES))]
    ways = [(bus.reader(topic, 1), bus.writer(topic)) for topic in topics]
    say("listening")
    while True:
        for reader, writer in ways:
            for cdr in reader.take():
                writer.write(cdr)  # a repetition
                if reader.topic.kind == TopicKind.FEATURES:
                    content = unpack_bytes(cdr)
                    writer.write(pack_bytes(content[:-16] + os.urandom(16)))  # with a tag of its own
        ways[1][1].write(SILENCE)
        time.sleep(0.02)


if __name__ == "__main__":
    main()
