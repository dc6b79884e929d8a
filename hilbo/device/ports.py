"""Ports to a device: serial port (pyserial) or TCP socket, with a clear error if one cannot be opened.

Reading waits at most `POLL` seconds for data; reading and writing raise OSError if the line is lost.
"""

import contextlib
import errno
import os
import socket
from typing import Any, NamedTuple

from hilbo.errors import InputError

__all__ = ["BAUD", "POLL", "Port", "PortInfo", "SerialPort", "SocketPort", "list_ports", "open_port"]

BAUD = 921_600
"""Line rate (baud) where none is given; a pseudo-terminal and a USB device have no rate."""
POLL = 0.05  # s
_STUCK = 10.0  # s, write timeout
_NO_PYSERIAL = "Serial ports need pyserial; install it with: pip install 'hilbo[hardware]'."
_BUSY = {errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK}


class PortInfo(NamedTuple):
    """Serial port of this computer."""

    name: str
    description: str


class SerialPort:
    """Serial port or pseudo-terminal, opened exclusively. Raises `InputError` if it cannot be opened."""

    def __init__(self, name: str, baud: int = BAUD):
        self.name = name
        self._serial: Any = _opened(name, baud)

    def fileno(self) -> int:
        """File descriptor of the open port."""
        return self._serial.fileno()

    def read(self) -> bytes:
        """Return the bytes that have arrived, after a short wait; empty if none. Raises OSError if the line is lost."""
        try:
            return self._serial.read(max(1, self._serial.in_waiting))
        except TypeError as error:
            raise _closed() from error

    def write(self, data: bytes) -> None:
        """Write all of the bytes. Raises OSError if the line is lost."""
        try:
            self._serial.write(data)
        except TypeError as error:
            raise _closed() from error

    def close(self) -> None:
        """Close the port; calling it twice is no error."""
        with contextlib.suppress(OSError):
            self._serial.close()


class SocketPort:
    """Port over a connected TCP socket."""

    def __init__(self, connected: socket.socket, name: str):
        self.name = name
        self._socket = connected
        self._socket.settimeout(POLL)

    def fileno(self) -> int:
        """File descriptor of the socket."""
        return self._socket.fileno()

    def read(self) -> bytes:
        """Return the bytes that have arrived, after a short wait; empty if none.

        Raises OSError if the peer has disconnected.
        """
        try:
            data = self._socket.recv(4096)
        except TimeoutError:
            return b""
        if not data:
            raise OSError(errno.ENOTCONN, "the other side has closed the connection")
        return data

    def write(self, data: bytes) -> None:
        """Send all of the bytes. Raises OSError if the peer has disconnected."""
        self._socket.sendall(data)

    def close(self) -> None:
        """Close the socket; calling it twice is no error."""
        self._socket.close()


def _closed() -> OSError:
    """Return the OSError that replaces pyserial's TypeError for a port closed by another thread during a read or
    write."""
    return OSError(errno.EBADF, "the port is closed")


Port = SerialPort | SocketPort
"""Any object with `name`, `read`, `write` and `close`; with `fileno`, a helper process sends the heartbeats."""


def open_port(where: str, baud: int = BAUD) -> Port:
    """Open `where`: "socket://HOST:PORT" as a TCP connection (`baud` is ignored), all else as the name of a serial
    port.

    Raises `InputError` if it cannot be opened.
    """
    return _connected(where) if where.startswith("socket://") else SerialPort(where, baud)


def list_ports() -> list[PortInfo]:
    """Return the serial ports of this computer, sorted by name. Raises `InputError` if pyserial is not installed."""
    try:
        from serial.tools.list_ports import comports
    except ImportError as error:
        raise InputError(_NO_PYSERIAL) from error
    return [PortInfo(port.device, port.description or "") for port in sorted(comports())]


def _connected(where: str) -> SocketPort:
    """Connect to `where`, socket://HOST:PORT, within 3 s. Raises `InputError` for a bad address or a failed
    connection."""
    host, separator, number = where.removeprefix("socket://").rpartition(":")
    if not (separator and host and number.isdigit()):
        raise InputError(f'"{where}" is no address; write it like socket://192.168.0.7:5000.')
    try:
        connected = socket.create_connection((host, int(number)), timeout=3)
    except (OSError, OverflowError) as error:
        raise InputError(
            f"{where}: no server answers ({error}); check address and port, and that it listens."
        ) from error
    with contextlib.suppress(OSError):
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return SocketPort(connected, where)


def _opened(name: str, baud: int) -> Any:
    """Open a serial port exclusively by pyserial, and return its object. Raises `InputError` if it cannot be opened."""
    try:
        import serial
    except ImportError as error:
        raise InputError(_NO_PYSERIAL) from error
    try:
        # Exclusive, so that no two programs use one device.
        return serial.Serial(name, baud, timeout=POLL, write_timeout=_STUCK, exclusive=True)
    except (OSError, ValueError) as error:
        raise InputError(_why_not(name, baud, error)) from error


def _why_not(name: str, baud: int, error: Exception) -> str:
    """Sentence for a serial port that cannot be opened because of `error`: the cause and what to do."""
    number = getattr(error, "errno", None)
    if number in _BUSY or "exclusively lock" in str(error):
        return f"{name}: another program uses this port; close it, or choose another port."
    if number in (errno.EACCES, errno.EPERM) and os.path.exists(name):
        return f"{name}: you may not open this port; on Linux, join the group that owns it (ls -l {name})."
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "FileNotFoundError" in str(error):
        return f"{name}: there is no such port; plug the device in, or choose one of `hilbo device ports`."
    if number == errno.ENOTTY or "ioctl" in str(error) or not isinstance(error, OSError):
        return f"{name}: is no serial port that takes {baud} baud ({error}); choose another port or --baud."
    return f"{name}: cannot be opened ({error}); check the port."
