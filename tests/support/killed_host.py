"""A host that dies: a whole conversation with a device, which asks before every step whether it may still live.

    python killed_host.py SLAVE

Prints "bytes" before each half of a message that it writes and "ticks N" where device time should pass, and waits for a
line on stdin before it goes on. The test kills it at one of these moments.
"""

import os
import sys

from device_port import FOAM, Talk
from device_wire import Type, set_crc, set_params


class Asking(Talk):
    """A talk whose messages come in two halves, each after a question."""

    def send(self, data: bytes) -> None:
        for part in (data[: len(data) // 2], data[len(data) // 2 :]):
            ask("bytes")
            os.write(self.file, part)


def ask(question: str) -> None:
    print(question, flush=True)
    sys.stdin.readline()


def main() -> None:
    talk = Asking(os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY))
    talk.hello()
    talk.expect_ack(Type.STREAM, bytes([10, 0]))
    for set_id, share in ((1, 1.0), (2, 0.9)):
        payload = set_params(set_id, *FOAM[:2], share * FOAM[2], FOAM[3])
        talk.expect_ack(Type.SET_PARAMS, payload)
        for _ in range(5 if set_id == 2 else 0):
            talk.heartbeat()
            ask("ticks 50")
        named = talk.named(set_id, set_crc(payload))
        talk.expect_ack(Type.COMMIT, named)
        ask("ticks 1")
        if set_id == 1:
            talk.heartbeat()
            talk.expect_ack(Type.START, talk.start(set_id, set_crc(payload)))
        for _ in range(10):
            talk.heartbeat()
            ask("ticks 50")
    talk.expect_ack(Type.STOP)
    ask("over")


if __name__ == "__main__":
    main()
