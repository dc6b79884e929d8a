"""Transfer of a parameter set to a device: send, check the CRC, commit when the device allows it, and read back."""

from collections.abc import Sequence
from dataclasses import replace

from hilbo.device.failures import DeviceError
from hilbo.device.link import Link
from hilbo.device.messages import Ack, Commit, GetSet, GetStatus, HelloReply, Message, SetParams, SetStates, Status
from hilbo.device.parameter_sets import InForce, crc_of, differences, in_force
from hilbo.device.reasons import NackReason

__all__ = ["put_in_force", "retry_while_busy"]

_LATER = (NackReason.NOT_READY, NackReason.BUSY)
_LONGEST_PAUSE = 0.1  # s between two tries


def put_in_force(link: Link, device: HelloReply, wanted: Sequence[SetParams | SetStates], wait: float) -> InForce:
    """Activate a parameter set, and return it as the device reports it, compared bit for bit.

    `wanted`: messages of a `ParameterSet`; they get their number (`set_id`) here. A set that is already active is not
    sent again. `wait` (s): timeout for the device to fill the set's history. Raises `RefusalError` if the device
    refuses the set, `DeviceError` after the timeout, or if the device reports another set.
    """
    status: Status = link.request(GetStatus())
    messages = [replace(message, set_id=status.active_id) for message in wanted]
    if status.active_id == 0 or crc_of(messages) != status.active_crc:
        set_id = max(status.active_id, status.staged_id) % 0xFFFF + 1
        messages = [replace(message, set_id=set_id) for message in wanted]
        give_up = link.now() + wait
        _stage(link, device, messages, give_up)
        commit = Commit(set_id=set_id, crc=crc_of(messages), boot_id=device.boot_id)
        retry_while_busy(link, device, commit, give_up)
    return _confirmed(link, messages)


def _stage(link: Link, device: HelloReply, messages: Sequence[SetParams | SetStates], give_up: float) -> None:
    """Send all messages of a set, waiting while the device is busy. Raises `DeviceError` if the CRC in an answer shows
    that the device received something else, and as `retry_while_busy`, with the same `give_up`."""
    for count, message in enumerate(messages, 1):
        answer = retry_while_busy(link, device, message, give_up)
        if answer.crc != crc_of(messages[:count]):
            raise DeviceError(f"{link.name}: the device has received another set than was sent; send it again.")


def retry_while_busy(link: Link, device: HelloReply, message: Message, give_up: float) -> Ack:
    """Send a request, repeat it after a pause while the device answers NOT_READY or BUSY, and return the final answer.

    `give_up`: time of the link's clock (s) after which such a refusal is raised as `DeviceError`. Other errors are
    raised at once.
    """
    while True:
        try:
            return link.request(message)
        except DeviceError as error:
            if error.nack is None or error.nack.reason not in _LATER or link.now() > give_up:
                raise
            link.pause(min(max(error.nack.ticks, 1) / device.tick_rate_Hz, _LONGEST_PAUSE))


def _confirmed(link: Link, messages: Sequence[SetParams | SetStates]) -> InForce:
    """Read back the active set and return it. Raises `DeviceError` if there is none, or it differs from
    `messages`."""
    reply = link.request(GetSet(bank=0))
    wrong, reported = differences(messages, reply), in_force(reply)
    if wrong or reported is None:
        raise DeviceError(
            f"{link.name}: the active set of the device is not the one that was sent ({', '.join(wrong)}); do not use"
            " it, send the set again."
        )
    return reported
