"""Errors of the communication with a device, and the sentence for each kind of failure."""

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
        """Whether a motion was refused because the handle is in the material."""
        return self.nack is not None and self.nack.reason == NackReason.IN_CONTACT


class RefusalError(InputError):
    """The device refused numbers that it was sent; `nack` has its reason and the numbers concerned."""

    def __init__(self, words: str, nack: Nack):
        super().__init__(words)
        self.nack = nack


def refusal(nack: Nack, request: str) -> DeviceError | RefusalError:
    """Error for a NACK of `request` (its name in PROTOCOL.md)."""
    words = sentence(nack.reason, request, nack.ticks, nack.value, nack.limit)
    return (RefusalError if nack.reason in ABOUT_INPUT else DeviceError)(words, nack)


def restarted(line: str) -> str:
    """Message: the device has restarted since the host greeted it."""
    return f"{line}: the device has restarted; it is stopped and knows no set: connect again, then send the set."


def fainted(line: str) -> str:
    """Message: the heartbeats of this host have ended."""
    return (
        f"{line}: heartbeats have ended, because this program hung for {GRACE:g} s or their process was ended; the"
        " device lets go: connect again."
    )


def deserted(silent: str) -> str:
    """Message: a request to a known device stayed unanswered; extends the sentence `silent`."""
    return f"{silent} Heartbeats have ended, so that the device lets go: connect again."


def line_gone(line: str, error: OSError) -> str:
    """Message: the port can no longer be read or written."""
    return (
        f"{line}: the line to the device is gone ({error}); it stops by itself, check power and cable, then connect"
        " again."
    )


def not_taken(line: str, error: Exception) -> str:
    """Message: the receiver of incoming data failed."""
    return (
        f"{line}: what the device says cannot be taken ({error}); heartbeats have ended and the device stops by itself;"
        " remove the cause, then connect again."
    )


def urgent(lost: str, request: str, written: bool) -> str:
    """Message: STOP or ESTOP on a lost line; `lost` is why it is lost, `written` whether the line took the bytes."""
    how = "was written all the same; no answer can come" if written else "cannot be written"
    return f"{lost} {request} {how}: see that the device rests."


def silent(line: str, request: str, tries: int, *, received: bool, foreign: bool) -> str:
    """Message: no answer came. `received`: bytes came back; `foreign`: frames came back, but not from a device."""
    if not received:
        why = "nothing at all comes back; check power, cable and port"
    elif foreign:
        why = "what comes back is not of this protocol; check the port and its baud rate"
    else:
        why = "check the line"
    return f"{line}: {request} has had no answer in {tries} tries; {why}."
