"""A scripted device in Python, for what no device of ours does by itself: lies, silence, late and double answers.

It knows just enough of firmware/PROTOCOL.md to hold a conversation; the real core is tested in its own process.
"""

import contextlib
import socket
import threading
import zlib
from collections import Counter
from functools import partial

from hilbo.device import frames, messages, protocol
from hilbo.device.link import Link
from hilbo.device.messages import code_of
from hilbo.device.ports import SocketPort
from hilbo.device.reasons import NackReason, State
from hilbo.hardware_bridge import Renderer

NUMBERS = ("K0_N_per_mm", "K1_N_per_mm", "B1_N_s_alpha_per_mm", "alpha", "force_limit_N")
NO_SET = dict.fromkeys(NUMBERS, 0.0) | {"set_id": 0, "memory": 0, "length": 0}


class Peer:
    """`swallow` so many answers, `double` them, or keep a `late` one until its request has come again, or until so many
    `beats` have come; `refuse` maps a class of requests to a NACK's fields, and how many `times`; `restart_at` is a
    class of requests whose arrival finds the device restarted; `lie` replaces fields of SET."""

    def __init__(self, **hello):
        self.hello = {"damping_N_s_per_m": 0.95, "force_limit_N": 20.0} | hello
        self.swallow, self.double, self.late, self.beats = 0, False, False, 0
        self.refuse, self.restart_at, self.lie = {}, None, {}
        self.kept = b""
        self.done: Counter = Counter()
        self.heartbeats = self.ticks = self.stops = 0
        self.pulses = True
        self.boot_id, self.greeted = 100, False
        self.state, self.active, self.staged = State.STOPPED, None, None
        self.last, self.last_answer = None, b""
        self.socket, self.over = None, False

    def connect(self, **options) -> Link:
        """A new line to this device."""
        ours, theirs = socket.socketpair()
        self.socket = theirs
        threading.Thread(target=self._serve, args=(theirs,), daemon=True).start()
        return Link(SocketPort(ours, "peer"), **options)

    @contextlib.contextmanager
    def listening(self):
        """Where a host in another process can connect, once."""
        with socket.create_server(("127.0.0.1", 0)) as server:

            def serve():
                self.socket, _ = server.accept()
                self._serve(self.socket)

            thread = threading.Thread(target=serve)
            thread.start()
            yield f"socket://127.0.0.1:{server.getsockname()[1]}"
            thread.join()

    def open(self, *, damping=None, **options) -> Renderer:
        return Renderer(partial(self.connect, **options), damping=damping)

    def restart(self):
        self.boot_id, self.greeted = self.boot_id + 1, False
        self.state, self.active, self.staged, self.last = State.STOPPED, None, None, None

    def say(self, message, seq=0):
        self.socket.sendall(protocol.encode(message, seq))

    def hang_up(self):
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)

    def mute(self):
        """Hears what comes and can answer nothing any more."""
        self.pulses, self.swallow = False, 10**9
        self.socket.shutdown(socket.SHUT_WR)

    def _serve(self, line):
        receiver = frames.Receiver()
        with line, contextlib.suppress(OSError):
            while data := line.recv(4096):
                for frame in receiver.feed(data):
                    self._take(line, frame)
        self.over = True

    def _take(self, line, frame):
        message = protocol.decode(frame)
        if isinstance(message, messages.Heartbeat):
            self.heartbeats += 1
            self.ticks += 50
            if self.pulses:
                line.sendall(protocol.encode(self._pulse(), frame.seq))
            self.beats -= self.beats > 0
            if self.kept and not self.late and not self.beats:
                answer, self.kept = self.kept, b""
                line.sendall(answer)
            return
        if isinstance(message, self.restart_at or ()):
            self.restart_at = None
            self.restart()
        if self.last != frame:
            self.last = frame
            self.last_answer = protocol.encode(self._answer(message), frame.seq)
            self.done[type(message)] += 1
        if self.swallow:
            self.swallow -= 1
        elif (self.late or self.beats) and not self.kept:
            self.kept = self.last_answer
        elif not self.beats:
            answers = self.kept + self.last_answer * (2 if self.double else 1)
            self.kept, self.late = b"", False  # the test may ask for the next as soon as it has its answer
            line.sendall(answers)

    def _answer(self, message):
        kind = type(message)
        if kind in self.refuse:
            refusal = dict(self.refuse[kind])
            times = refusal.pop("times", 0)
            self.refuse[kind] = refusal | ({"times": times - 1} if times > 1 else {})
            if times == 1:
                del self.refuse[kind]
            return self._nack(kind, **refusal)
        if not self.greeted and kind not in (messages.Hello, messages.GetStatus, messages.Stop, messages.Estop):
            return self._nack(kind, reason=NackReason.NO_HELLO)
        if getattr(message, "boot_id", self.boot_id) != self.boot_id:
            return self._nack(kind, reason=NackReason.BOOT_ID)
        return getattr(self, f"_{messages.name_of(kind).lower()}", self._ack)(message)

    def _nack(self, kind, reason, ticks=0, value=0.0, limit=0.0):
        return messages.Nack(request=code_of(kind), reason=int(reason), ticks=ticks, value=value, limit=limit)

    def _pulse(self):
        known = {"tick": self.ticks, "boot_id": self.boot_id, "state": int(self.state), "reason": 0}
        return messages.Pulse(**known, stops=self.stops)

    def _ack(self, message, crc=0, set_id=0):
        self.stops += isinstance(message, messages.Stop | messages.Estop)
        changes = {messages.Start: State.RUNNING, messages.Stop: State.STOPPED, messages.Estop: State.ESTOP}
        self.state = changes.get(type(message), self.state)
        return messages.Ack(request=code_of(type(message)), set_id=set_id, crc=crc, stops=self.stops)

    def _hello(self, message):
        self.greeted = True
        names = {name: 0 for name in protocol._wire(messages.HelloReply)}
        floats = {name: 0.0 for name, word in protocol._wire(messages.HelloReply).items() if word == "f32"}
        known = {"version": messages.VERSION, "schema": messages.SCHEMA, "boot_id": self.boot_id}
        rest = {"tick_rate_Hz": 1000, "encoder_step_mm": 0.0127, "most_taps": 255, "watchdog_ticks": 250}
        return messages.HelloReply(**(names | floats | rest | known | self.hello))

    def _set_params(self, message):
        self.staged = [message, zlib.crc32(protocol.payload_of(message))]
        return self._ack(message, self.staged[1], message.set_id)

    def _set_states(self, message):
        self.staged[1] = zlib.crc32(protocol.payload_of(message), self.staged[1])
        return self._ack(message, self.staged[1], message.set_id)

    def _commit(self, message):
        if self.staged is None:
            return self._nack(messages.Commit, NackReason.NOTHING_STAGED)
        self.active = self.staged
        return self._ack(message, self.active[1], message.set_id)

    def _get_set(self, message):
        if self.active is None:
            return messages.Set(bank=0, flags=0, crc=0, minimum_damping_N_s_per_m=0.0, **NO_SET)
        head, crc = self.active
        values = {name: getattr(head, name) for name in NO_SET}
        return messages.Set(
            **({"bank": 0, "flags": 1, "crc": crc, "minimum_damping_N_s_per_m": 0.5} | values | self.lie)
        )

    def _get_limits(self, message):
        ends = {
            f"{name}_{end}": float(end == "high") for name in ("K0", "K1", "B1", "alpha") for end in ("low", "high")
        }
        return messages.Limits(**ends, delay_us=0, continuous_force_N=20.0, heating_s=10.0)

    def _get_status(self, message):
        counts = {name: 0 for name, word in protocol._wire(messages.Status).items() if word != "f32"}
        floats = {name: 0.0 for name, word in protocol._wire(messages.Status).items() if word == "f32"}
        known = {"boot_id": self.boot_id, "state": int(self.state), "stops": self.stops, "tick": self.ticks}
        if self.active:
            known |= {"active_id": self.active[0].set_id, "active_crc": self.active[1]}
        return messages.Status(**(counts | floats | known))

    def _echo(self, message):
        return messages.EchoReply(data=message.data)
