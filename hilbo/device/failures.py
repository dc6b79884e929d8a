"""Errors of the communication with a device, and the sentence for each kind of failure.

The functions build the text (or the error) and raise nothing; `line` is the name of the port.
"""

from hilbo.device.heartbeat import GRACE
from hilbo.device.messages import Nack
from hilbo.device.reasons import ABOUT_INPUT, NackReason, sentence
from hilbo.errors import InputError

__all__ = [
    "DeviceError",
    "RefusalError",
    "deserted",
    "fainted",
    "line_gone",
    "not_taken",
    "refusal",
    "restarted",
    "silent",
    "urgent",
]


class DeviceError(RuntimeError):
    """The device or the line to it failed; `nack` is the device's refusal, if there was one."""

    def __init__(self, words: str, nack: Nack | None = None):
        super().__init__(words)
        self.nack = nack

    @property
    def in_contact(self) -> bool:
        """Whether the device refused a motion because the handle is in the material."""
        return self.nack is not None and self.nack.reason == NackReason.IN_CONTACT


class RefusalError(InputError):
    """The device refused numbers that it was sent; `nack` has its reason and the numbers concerned."""

    def __init__(self, words: str, nack: Nack):
        super().__init__(words)
        self.nack = nack


def refusal(nack: Nack, request: str) -> DeviceError | RefusalError:
    """Return the error for a NACK of `request` (its name in PROTOCOL.md): `RefusalError` if the numbers sent are the
    cause, else `DeviceError`."""
    words = sentence(nack.reason, request, nack.ticks, nack.value, nack.limit)
    return (RefusalError if nack.reason in ABOUT_INPUT else DeviceError)(words, nack)


def restarted(line: str) -> str:
    """Sentence: the device has restarted since the handshake."""
    return f"{line}: the device has restarted; it is stopped and knows no set: connect again, then send the set."


def fainted(line: str) -> str:
    """Sentence, from the name of the `line` on: the heartbeats of this host have ended, because it hung or the helper
    process was ended."""
    return (
        f"{line}: heartbeats have ended, because this program hung for {GRACE:g} s or their process was ended; the"
        " device lets go: connect again."
    )


def deserted(silent: str) -> str:
    """Sentence: the heartbeats have ended after a request stayed unanswered; `silent` is the sentence about the
    request."""
    return f"{silent} Heartbeats have ended, so that the device lets go: connect again."


def line_gone(line: str, error: OSError) -> str:
    """Sentence, from the name of the `line` on: the port can no longer be read or written because of `error`."""
    return (
        f"{line}: the line to the device is gone ({error}); it stops by itself, check power and cable, then connect"
        " again."
    )


def not_taken(line: str, error: Exception) -> str:
    """Sentence, from the name of the `line` on: the connection has ended because `error` was raised while received data
    were processed."""
    return (
        f"{line}: the output of the device cannot be processed ({error}); heartbeats have ended and the device stops by"
        " itself; remove the cause, then connect again."
    )


def urgent(lost: str, request: str, written: bool) -> str:
    """Sentence: STOP or ESTOP (`request`) on a lost line. `lost`: sentence that says why the line is lost; `written`:
    whether the bytes could still be written."""
    how = "was written all the same; no answer can come" if written else "cannot be written"
    return f"{lost} {request} {how}: see that the device rests."


def silent(line: str, request: str, tries: int, *, received: bool, foreign: bool) -> str:
    """Sentence: `request` was not answered in `tries` tries. `received`: any bytes came back; `foreign`: they came from
    no device with this protocol."""
    if not received:
        why = "nothing at all comes back; check power, cable and port"
    elif foreign:
        why = "what comes back is not of this protocol; check the port and its baud rate"
    else:
        why = "check the line"
    return f"{line}: {request} has had no answer in {tries} tries; {why}."
