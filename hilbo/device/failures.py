"""What goes wrong between host and device: two errors, and a sentence for each way in which a conversation fails."""

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
    """The device, or the line to it, does not do what was asked; `nack` is its refusal, if that is what it was."""

    def __init__(self, words: str, nack: Nack | None = None):
        super().__init__(words)
        self.nack = nack

    @property
    def in_contact(self) -> bool:
        """A motion was refused because the handle is in the material."""
        return self.nack is not None and self.nack.reason == NackReason.IN_CONTACT


class RefusalError(InputError):
    """The device refuses numbers that it was sent; `nack` has its reason and the numbers behind it."""

    def __init__(self, words: str, nack: Nack):
        super().__init__(words)
        self.nack = nack


def refusal(nack: Nack, request: str) -> DeviceError | RefusalError:
    """The error that a NACK of `request` (its name in PROTOCOL.md) is."""
    words = sentence(nack.reason, request, nack.ticks, nack.value, nack.limit)
    return (RefusalError if nack.reason in ABOUT_INPUT else DeviceError)(words, nack)


def restarted(line: str) -> str:
    """The device has started anew since the host greeted it."""
    return f"{line}: the device has restarted; it is stopped and knows no set: connect again, then send the set."


def fainted(line: str) -> str:
    """The heartbeats of this host have ended."""
    return (
        f"{line}: heartbeats have ended, because this program hung for {GRACE:g} s or their process was ended; the"
        " device lets go: connect again."
    )


def deserted(silent: str) -> str:
    """A request of a known device has stayed unanswered; `silent` is the sentence that says so."""
    return f"{silent} Heartbeats have ended, so that the device lets go: connect again."


def line_gone(line: str, error: OSError) -> str:
    """The port cannot be read or written any more."""
    return (
        f"{line}: the line to the device is gone ({error}); it stops by itself, check power and cable, then connect"
        " again."
    )


def not_taken(line: str, error: Exception) -> str:
    """Whoever takes what arrives has failed."""
    return (
        f"{line}: what the device says cannot be taken ({error}); heartbeats have ended and the device stops by itself;"
        " remove the cause, then connect again."
    )


def urgent(lost: str, request: str, written: bool) -> str:
    """STOP or ESTOP on a line that is lost; `lost` says why it is, `written` whether the line took the bytes."""
    how = "was written all the same; no answer can come" if written else "cannot be written"
    return f"{lost} {request} {how}: see that the device rests."


def silent(line: str, request: str, tries: int, *, received: bool, foreign: bool) -> str:
    """No answer came. `received`: anything at all did; `foreign`: frames did, and none of a device."""
    if not received:
        why = "nothing at all comes back; check power, cable and port"
    elif foreign:
        why = "what comes back is not of this protocol; check the port and its baud rate"
    else:
        why = "check the line"
    return f"{line}: {request} has had no answer in {tries} tries; {why}."
