"""A set on its way into force: sent, checked by CRC, committed when the device lets it, read back bit for bit."""

from collections.abc import Sequence

from hilbo.device import protocol
from hilbo.device.link import DeviceError, Link
from hilbo.device.messages import Ack, HelloReply, Message, Status
from hilbo.device.parameter_sets import InForce, Wanted, crc_of, differences, in_force
from hilbo.device.reasons import NackReason

__all__ = ["put_in_force"]

_LATER = (NackReason.NOT_READY, NackReason.BUSY)
_NAP = 0.1  # s at most between two tries


def put_in_force(link: Link, device: HelloReply, wanted: Wanted, wait: float) -> InForce:
    """The set as the device has it in force, which is the wanted one, bit for bit.

    One that is in force already is not sent again. `wait` (s) is how long the device may take to warm its history.
    """
    status: Status = link.request(protocol.GetStatus())
    parts = wanted.messages(status.active_id)
    if status.active_id == 0 or crc_of(parts) != status.active_crc:
        parts = wanted.messages(max(status.active_id, status.staged_id) % 0xFFFF + 1)
        give_up = link.now() + wait
        _stage(link, device, parts, give_up)
        commit = protocol.Commit(set_id=parts[0].set_id, crc=crc_of(parts), boot_id=device.boot_id)
        _patiently(link, device, commit, give_up)
    return _confirmed(link, parts)


def _stage(link, device, parts: Sequence[Message], give_up) -> None:
    """Every part, with the CRC that each answer must have. BUSY while an earlier change is being taken back."""
    for count, part in enumerate(parts, 1):
        answer = _patiently(link, device, part, give_up)
        if answer.crc != crc_of(parts[:count]):
            raise DeviceError(f"{link.name}: the device has received another set than was sent; send it again.")


def _patiently(link, device, message, give_up) -> Ack:
    """The answer to a request that is repeated while the device says that it needs more ticks."""
    while True:
        try:
            return link.request(message)
        except DeviceError as error:
            if error.nack is None or error.nack.reason not in _LATER or link.now() > give_up:
                raise
            link.pause(min(max(error.nack.ticks, 1) / device.tick_rate_Hz, _NAP))


def _confirmed(link, parts) -> InForce:
    reply = link.request(protocol.GetSet(bank=0))
    wrong, found = differences(parts, reply), in_force(reply)
    if wrong or found is None:
        raise DeviceError(
            f"{link.name}: the device has another set in force than was sent ({', '.join(wrong)}); do not use it, send"
            " the set again."
        )
    return found
