"""Connection to a device over one line: requests with answers, heartbeats, and unsolicited messages.

One request is in flight at a time; without an answer the same bytes are sent again, three times in all. A thread of its
own reads, and heartbeats are sent (`hilbo.device.heartbeat`) while a request waits and while this process computes. The
end of the connection for any reason ends the heartbeats, and so does a request that stays unanswered: the device then
goes to HOLD. A START or DRIVE without an answer is followed by a STOP. ESTOP waits for no other request, and STOP and
ESTOP are tried on a line that is lost in one direction only. firmware/PROTOCOL.md has the rules and the bytes.
"""

import contextlib
import random
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from hilbo.device import failures, protocol
from hilbo.device.arrivals import Arrivals
from hilbo.device.failures import DeviceError
from hilbo.device.frames import Receiver, WireError
from hilbo.device.heartbeat import BEAT, Heard, HelperHeart, ThreadHeart, heart_for
from hilbo.device.messages import (
    Ack,
    Drive,
    Echo,
    EchoReply,
    Estop,
    GetLimits,
    GetSet,
    GetStatus,
    Heartbeat,
    Hello,
    HelloReply,
    Limits,
    Message,
    Nack,
    Notice,
    Pulse,
    Set,
    Start,
    Status,
    Stop,
    Telemetry,
    code_of,
    name_of,
)
from hilbo.device.reasons import NackReason
from hilbo.errors import InputError

__all__ = ["Link"]

_ANSWER = {
    Hello: HelloReply,
    GetStatus: Status,
    GetSet: Set,
    GetLimits: Limits,
    Echo: EchoReply,
}
_URGENT = frozenset({code_of(Stop), code_of(Estop)})
_ALWAYS = (Hello, GetStatus, Stop, Estop)  # allowed for a restarted device too


class Link:
    """Connection over a `ports.Port`, from construction to `close`.

    `boot_id`: the device's start, once known; `stops`: its count of stops as last reported; `heard`: its newest tick;
    `faint`: why heartbeats have ended, empty while they continue; `lost`: why the line is lost, else None. `patience`:
    timeout (s) of an answer; `tries`: attempts per request; `capture` receives all bytes read. `ticks` advances a
    simulated device by a number of 1 ms ticks: its time then passes only in `pause`, and no clock is used. Counters:
    `retries`, `stray` answers that match no request, `strange` frames that are no message of a device, `dropped`
    frames; `round_trips`: times (s) of the last answers.
    """

    def __init__(
        self,
        port: Any,
        *,
        patience: float = 0.1,
        tries: int = 3,
        capture: Callable | None = None,
        ticks: Callable[[int], Any] | None = None,
    ):
        self.name, self.patience, self.tries = port.name, patience, tries
        self.boot_id: int | None = None
        self.lost: str | None = None
        self.restarted, self.faint = False, ""
        self.stops, self.heard = 0, Heard(0)
        self.retries = self.stray = self.strange = self.received = 0
        self.round_trips: deque[float] = deque(maxlen=100_000)
        self.notices: deque[Notice] = deque(maxlen=1000)
        self.on_telemetry: Callable[[Telemetry], None] | None = None
        self._port, self._capture, self._receiver = port, capture, Receiver()
        self._ticks, self._passed = ticks, 0
        self._seq = random.randrange(256)  # differs from the last request of an earlier host
        self._expected: tuple[int, int, type] | None = None
        self._answer: Message = None
        self._asking, self._writing, self._news = threading.Lock(), threading.Lock(), threading.Condition()
        self._closing = threading.Event()
        self._heart: HelperHeart | ThreadHeart | None = None
        self._arrivals = Arrivals(port)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._quiet = False  # no heartbeats, until an ESTOP is acknowledged
        try:
            self.write(b"\0")
        except DeviceError:
            port.close()
            raise
        self._reader.start()

    @property
    def dropped(self) -> int:
        """Number of damaged frames received."""
        return self._receiver.dropped

    def request(self, message: Message) -> Message:
        """Send a request, wait for its answer and return it; one request at a time. ESTOP is also written at once,
        before others. A START or DRIVE that fails is followed by STOP. Raises `RefusalError` for refused numbers,
        `InputError` for numbers that do not fit the message, else `DeviceError`."""
        if isinstance(message, Estop) and not self.lost:
            self._hush(True)  # if every ESTOP is lost, the device's watchdog ends its force
            self.shout(message)
        if isinstance(message, Stop | Estop) and self.lost:
            raise DeviceError(failures.urgent(self.lost, name_of(type(message)), self.shout(message)))
        with self._asking:
            if (self.restarted or self.faint) and not self.lost and not isinstance(message, _ALWAYS):
                raise DeviceError(failures.restarted(self.name) if self.restarted else self.faint)
            self._seq = (self._seq + 1) % 256
            try:
                frame = protocol.encode(message, self._seq)
            except WireError as error:
                raise InputError(f"{error}; send numbers that fit.") from error
            kind = type(message)
            try:
                answer = self._ask(frame, (self._seq, code_of(kind), _ANSWER.get(kind, Ack)))
                if answer is None:
                    raise DeviceError(self._unanswered(kind))
            except BaseException:
                if kind in (Start, Drive):
                    self.shout(Stop())  # the device may be moving
                raise
        if isinstance(answer, Nack):
            raise self._refusal(answer, name_of(kind))
        if kind is Estop:
            self._hush(False)
        return answer

    def _unanswered(self, kind: type) -> str:
        """Return the sentence for an unanswered request; for a known device, also end the heartbeats and set
        `faint`."""
        foreign = bool(self._receiver.dropped) and self.boot_id is None
        why = failures.silent(self.name, name_of(kind), self.tries, received=self.received > 0, foreign=foreign)
        if self.boot_id is None:
            return why
        self.faint = self.faint or failures.deserted(why)
        self._end_beats()
        return failures.deserted(why)

    def _ask(self, frame: bytes, expected: tuple[int, int, type]) -> Message:
        """Send a frame up to `tries` times and return the `expected` answer (sequence number, request code, class), or
        None if none came. Raises `DeviceError` if the line is lost."""
        with self._news:
            self._expected, self._answer = expected, None
        for attempt in range(self.tries):
            begun = time.perf_counter()
            self.retries += attempt > 0
            self.write(frame)
            with self._news:
                self._news.wait_for(lambda: self._answer is not None or self.lost, self.patience)
                if self.lost:
                    raise DeviceError(self.lost)
                if self._answer is not None:
                    self.round_trips.append(time.perf_counter() - begun)
                    self._expected = None
                    return self._answer
        with self._news:
            self._expected = None
        return None

    def shout(self, message: Message) -> bool:
        """Write STOP or ESTOP to the line at once, bypassing all locks, even if the line is lost; return whether it was
        written. The leading 0x00 ends any frame another thread has begun; the device accepts both messages in every
        state."""
        try:
            self._port.write(b"\0" + protocol.encode(message, 0))
        except OSError:
            return False
        return True

    def write(self, data: bytes) -> None:
        """Write the bytes of complete frames to the line. Raises `DeviceError` if the line is lost, or is lost by this
        write."""
        try:
            with self._writing:  # taken by `close` too, so that no port is closed during a write
                if self.lost:
                    raise DeviceError(self.lost)
                self._port.write(data)
        except OSError as error:
            raise DeviceError(self._lose(error)) from error

    def beat(self, boot_id: int | None) -> None:
        """Stop the heartbeats, and start them for this start of the device, unless `boot_id` is None. With simulated
        time one is sent now and the others by `pause`. Raises `DeviceError` if the helper does not start, or the line
        is lost."""
        self.boot_id = boot_id
        self._end_beats()
        if boot_id is None:
            return
        self.heartbeat()
        if self.simulated_time:
            return
        self._arrivals.hand_over()
        try:
            self._heart = heart_for(self._port, boot_id, self.heard.tick, self._beat_here, self._fainted)
        except OSError as error:
            raise DeviceError(f"The process that sends heartbeats cannot be started: {error}.") from error
        finally:
            self._arrivals.resume(self._heart if isinstance(self._heart, HelperHeart) else None)
        if self._quiet:  # set while the helper was starting
            self._hush(True)
        if self.lost:
            self._end_beats()

    def _end_beats(self) -> None:
        """Stop the heartbeats, if any; return after the last one."""
        with self._news:
            heart, self._heart = self._heart, None
        if isinstance(heart, HelperHeart):
            heart.close(self._reader)
        elif heart is not None:
            heart.close()

    @contextlib.contextmanager
    def silence(self) -> Iterator[None]:
        """Suspend the heartbeats within this block, to test the watchdog."""
        boot_id = self.boot_id
        self.beat(None)
        try:
            yield
        finally:
            self.beat(boot_id)

    def heartbeat(self) -> None:
        """Send one heartbeat now, unless the device is unknown or an ESTOP waits for its answer."""
        if self.boot_id is not None and not self._quiet:
            self.write(protocol.encode(Heartbeat(boot_id=self.boot_id, tick=self.heard.tick), 0))

    def _hush(self, quiet: bool) -> None:
        """Pause the heartbeats at once (`quiet`), or resume them."""
        with self._news:
            self._quiet, heart = quiet, self._heart
        if isinstance(heart, HelperHeart):
            heart.hush(quiet)

    @property
    def simulated_time(self) -> bool:
        """Whether the device's time is simulated, and passes only in `pause`."""
        return self._ticks is not None

    def now(self) -> float:
        """Time (s, arbitrary origin) of the clock that `pause` uses."""
        return self._passed / 1000 if self.simulated_time else time.monotonic()

    def pause(self, seconds: float) -> None:
        """Wait for `seconds`. With simulated time: advance the device by as much, at least 1 ms, with heartbeats, and
        read all that it sent."""
        if self._ticks is None:
            time.sleep(seconds)
            return
        until = self._passed + max(1, round(1000 * seconds))
        while self._passed < until:
            count = min(until - self._passed, round(1000 * BEAT))
            self.heartbeat()
            self._ticks(count)
            self._passed += count
            self.request(GetStatus())

    def close(self) -> None:
        """Mark the connection as lost, end heartbeats and reading thread, and close the port; the device is not stopped
        first."""
        self._closing.set()
        with self._news:
            self.lost = self.lost or f"{self.name}: the connection has been closed; open it again."
            self._news.notify_all()
        self._arrivals.end()
        self.beat(None)
        if self._reader is not threading.current_thread():
            self._reader.join()  # reads and writes of a port are short
        with self._writing:
            self._port.close()

    def _beat_here(self) -> None:
        """Send a heartbeat from this process. Raises OSError if the line is lost."""
        try:
            self.heartbeat()
        except DeviceError as error:
            raise OSError(str(error)) from error

    def _fainted(self) -> None:
        """Record in `faint` that the helper process has ended, unless a reason is recorded already."""
        self.faint = self.faint or failures.fainted(self.name)

    def _read(self) -> None:
        """Loop of the reading thread: receive until the connection is closed, the line is lost, or a receiver
        raises."""
        while not self._closing.is_set():
            try:
                data = self._arrivals.read()
            except OSError as error:
                self._lose(error)
                return
            try:
                self._heard(data)
            except Exception as error:  # of a receiver; without a reader the heartbeats must end
                self._end(failures.not_taken(self.name, error))
                return

    def _heard(self, data: bytes) -> None:
        """Process received bytes: count them, pass them to `capture`, and handle each complete frame."""
        self.received += len(data)
        if self._capture is not None and data:
            self._capture(data)
        for frame in self._receiver.feed(data):
            self._take(frame)

    def _take(self, frame) -> None:
        """Decode a frame and pass its message to the telemetry receiver, the notices or the waiting request; a frame
        that is no message is counted in `strange`."""
        try:
            message = protocol.decode(frame)
        except WireError:
            self.strange += 1
            return
        self._learn(message)
        if isinstance(message, Pulse):
            return
        if isinstance(message, Telemetry):
            if self.on_telemetry is not None:
                self.on_telemetry(message)
        elif isinstance(message, Notice):
            self.notices.append(message)
        else:
            self._give(frame.seq, message)

    def _learn(self, message: Message) -> None:
        """Update `restarted`, the newest tick and `stops` from a received message."""
        if isinstance(message, HelloReply):
            self.heard.tick = message.tick
        elif isinstance(message, Notice | Status | Pulse) and self.boot_id not in (None, message.boot_id):
            self.restarted = True
        elif isinstance(message, Notice | Status | Pulse | Telemetry):
            self.heard.newer(message.tick)
        if isinstance(message, Notice | Status | Pulse | Ack):
            self.stops = message.stops
        elif isinstance(message, Nack) and message.reason == NackReason.STALE:
            self.stops = message.ticks

    def _give(self, seq: int, message: Message) -> None:
        """Deliver an answer to the waiting request; one that does not match it, in kind and number `seq`, is dropped
        and counted in `stray`, unless it acknowledges a `shout`."""
        with self._news:
            if self._expected is not None and self._answer is None and _fits(seq, message, self._expected):
                self._answer = message
                self._news.notify_all()
            elif not (isinstance(message, Ack) and message.request in _URGENT and seq == 0):  # the answer to `shout`
                self.stray += 1

    def _lose(self, error: OSError) -> str:
        """Mark the line as lost because of `error` and end the heartbeats; return the first reason recorded."""
        return self._end(failures.line_gone(self.name, error))

    def _end(self, why: str) -> str:
        """Mark the connection as lost for the reason `why` and end the heartbeats; return the first reason recorded."""
        with self._news:
            self.lost = self.lost or why
            self._news.notify_all()
            why = self.lost
        self._arrivals.end()
        self._end_beats()
        return why

    def _refusal(self, nack: Nack, request: str) -> Exception:
        """Return the error for a NACK to the `request` (its name in PROTOCOL.md); set `restarted` if the NACK shows
        that the device has restarted."""
        if nack.reason in (NackReason.BOOT_ID, NackReason.NO_HELLO) and request != "HELLO":
            self.restarted = True
            return DeviceError(failures.restarted(self.name), nack)
        return failures.refusal(nack, request)


def _fits(seq: int, message: Message, expected: tuple[int, int, type]) -> bool:
    """Whether a message answers the waiting request `expected` (sequence number, request code, class of the answer)."""
    wanted, request, kind = expected
    acknowledges = isinstance(message, Ack | Nack) and message.request == request
    return seq == wanted and (acknowledges or (type(message) is kind and kind is not Ack))
