"""A set on its way into force: sent, checked by CRC, committed when the device lets it, read back bit for bit."""

from collections.abc import Sequence

from hilbo.device import protocol
from hilbo.device.failures import DeviceError
from hilbo.device.link import Link
from hilbo.device.messages import Ack, HelloReply, Message, SetParams, SetStates, Status
from hilbo.device.parameter_sets import InForce, ParameterSet, crc_of, differences, in_force
from hilbo.device.reasons import NackReason

__all__ = ["patiently", "put_in_force"]

_LATER = (NackReason.NOT_READY, NackReason.BUSY)
_NAP = 0.1  # s at most between two tries


def put_in_force(link: Link, device: HelloReply, wanted: ParameterSet, wait: float) -> InForce:
    """The set as the device has it in force, which is the wanted one, bit for bit.

    One that is in force already is not sent again. `wait` (s) is how long the device may take to warm its history.
    """
    status: Status = link.request(protocol.GetStatus())
    messages = wanted.messages(status.active_id, device.tick_rate_Hz)
    if status.active_id == 0 or crc_of(messages) != status.active_crc:
        set_id = max(status.active_id, status.staged_id) % 0xFFFF + 1
        messages = wanted.messages(set_id, device.tick_rate_Hz)
        give_up = link.now() + wait
        _stage(link, device, messages, give_up)
        commit = protocol.Commit(set_id=set_id, crc=crc_of(messages), boot_id=device.boot_id)
        patiently(link, device, commit, give_up)
    return _confirmed(link, messages)


def _stage(link: Link, device: HelloReply, messages: Sequence[SetParams | SetStates], give_up: float) -> None:
    """Send every message, with the CRC that each answer must have. BUSY while an earlier change is being taken back."""
    for count, message in enumerate(messages, 1):
        answer = patiently(link, device, message, give_up)
        if answer.crc != crc_of(messages[:count]):
            raise DeviceError(f"{link.name}: the device has received another set than was sent; send it again.")


def patiently(link: Link, device: HelloReply, message: Message, give_up: float) -> Ack:
    """The answer to a request that is repeated while the device says that it needs more ticks; `give_up`: a time of the
    link, after which its last NACK is the error."""
    while True:
        try:
            return link.request(message)
        except DeviceError as error:
            if error.nack is None or error.nack.reason not in _LATER or link.now() > give_up:
                raise
            link.pause(min(max(error.nack.ticks, 1) / device.tick_rate_Hz, _NAP))


def _confirmed(link: Link, messages: Sequence[SetParams | SetStates]) -> InForce:
    """The set that the device reports. Raises `DeviceError` if it is not the one that was sent."""
    reply = link.request(protocol.GetSet(bank=0))
    wrong, reported = differences(messages, reply), in_force(reply)
    if wrong or reported is None:
        raise DeviceError(
            f"{link.name}: the device has another set in force than was sent ({', '.join(wrong)}); do not use it, send"
            " the set again."
        )
    return reported
