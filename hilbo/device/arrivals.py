"""Source of the bytes received on a line: the port itself, or the helper process that reads the port instead.

Two processes reading one line would each get part of the data, so only one thread reads, and the port changes hands in
order: the reading thread lets go, the helper starts, and the thread continues with the helper's output until it ends.
"""

import threading
from typing import Any

from hilbo.device.heartbeat import HelperHeart
from hilbo.device.ports import POLL

__all__ = ["Arrivals"]


class Arrivals:
    """Bytes received on a `ports.Port`.

    `read` is for one thread only, the other methods for the thread that starts a helper.
    """

    def __init__(self, port: Any):
        self._port = port
        self._change = threading.Condition()
        self._handing_over = self._released = self._over = False
        self._helper: HelperHeart | None = None

    def read(self) -> bytes:
        """Return the bytes that have arrived, after a short wait; empty if there are none. Blocks between `hand_over`
        and `resume`. Raises OSError if the line is lost."""
        with self._change:
            self._released = self._handing_over
            self._change.notify_all()
            self._change.wait_for(lambda: not self._handing_over or self._over)
            self._released, helper = False, self._helper
        if helper is None:
            return self._port.read()
        data = helper.read(POLL)
        if data is None:  # the helper has ended, and all of its output is read
            with self._change:
                self._helper = None if self._helper is helper else self._helper
        return data or b""

    def hand_over(self) -> None:
        """Pause `read`, and return once the reading thread no longer uses the port, or after `end`. `resume` must
        follow."""
        with self._change:
            self._handing_over = True
            self._change.wait_for(lambda: self._released or self._over)

    def resume(self, helper: HelperHeart | None) -> None:
        """Let `read` continue with the output of `helper`, until that helper ends; with None, from the same source as
        before."""
        with self._change:
            self._helper, self._handing_over = helper or self._helper, False
            self._change.notify_all()

    def end(self) -> None:
        """Mark reading as ended, so that no call of `hand_over` or `read` waits any longer."""
        with self._change:
            self._over = True
            self._change.notify_all()
