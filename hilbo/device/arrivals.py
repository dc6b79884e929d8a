"""The bytes that a line brings: from its port, or from the helper process that reads the port in its place.

One thread reads. Two processes that read one line would each get a part of what it brings, so the port changes hands in
order: the reading thread lets go, the helper starts, and the thread goes on with what the helper passes on, to its end.
"""

import threading
from typing import Any

from hilbo.device.heartbeat import HelperHeart
from hilbo.device.ports import POLL

__all__ = ["Arrivals"]


class Arrivals:
    """Bytes of a `ports.Port`. `read` is for one thread alone, the others for the one that starts a helper."""

    def __init__(self, port: Any):
        self._port = port
        self._change = threading.Condition()
        self._handing_over = self._let_go = self._over = False
        self._helper: HelperHeart | None = None

    def read(self) -> bytes:
        """What has arrived, after a short wait; empty if nothing has. Raises OSError when the line is gone."""
        with self._change:
            self._let_go = self._handing_over
            self._change.notify_all()
            self._change.wait_for(lambda: not self._handing_over or self._over)
            self._let_go, helper = False, self._helper
        if helper is None:
            return self._port.read()
        data = helper.read(POLL)
        if data is None:  # it has ended, and all of it is read
            with self._change:
                self._helper = None if self._helper is helper else self._helper
        return data or b""

    def hand_over(self) -> None:
        """Returns once nobody reads the port; `resume` comes next."""
        with self._change:
            self._handing_over = True
            self._change.wait_for(lambda: self._let_go or self._over)

    def resume(self, helper: HelperHeart | None) -> None:
        """Go on reading: from this helper, or from the port as before."""
        with self._change:
            self._helper, self._handing_over = helper or self._helper, False
            self._change.notify_all()

    def end(self) -> None:
        """Nobody will read any more: let nobody wait for that."""
        with self._change:
            self._over = True
            self._change.notify_all()
