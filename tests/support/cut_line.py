"""A line to a hilbo server on this machine that can be cut: all its connections break at once, and new ones work."""

import contextlib
import socket
import threading

__all__ = ["CutLine"]


class CutLine:
    """`with CutLine(port) as line:` - passes on what comes to `line.port`, as if it were addressed to the server."""

    def __init__(self, port: int):
        self._to = port
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self._ends: list[socket.socket] = []

    def __enter__(self):
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(self, *_):
        self._server.close()
        self.cut()

    def cut(self):
        """Breaks every connection."""
        ends, self._ends = self._ends, []
        for end in ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._server.accept()
                far = socket.create_connection(("127.0.0.1", self._to))
                self._ends += [near, far]
                for pair in ((near, far), (far, near)):
                    threading.Thread(target=self._pass_on, args=pair, daemon=True).start()

    def _pass_on(self, source: socket.socket, target: socket.socket):
        own, server = (f"127.0.0.1:{port}".encode() for port in (self.port, self._to))  # the header Host
        with source, contextlib.suppress(OSError):
            while data := source.recv(65536):
                target.sendall(data.replace(own, server))
            target.shutdown(socket.SHUT_WR)
