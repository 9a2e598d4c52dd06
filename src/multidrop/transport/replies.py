"""A completion in the drive's own terms: its good reply, or the error that says why there is none."""

from __future__ import annotations

from typing import Any

from multidrop.core import STATUSES, Completion, Failure, Framing, Message
from multidrop.drive.family import Drive
from multidrop.errors import BadReply, DriveException, NoReply, NotMaster, NoValue
from multidrop.transport.mixed_up import mixed_up, silence_hint


def good_reply(drive: Drive, completion: Completion) -> Message:
    """Return the good reply; raises NoReply, BadReply or DriveException."""
    result, reply = completion.result, completion.reply
    if result > 0 and not reply.exception:
        return reply
    if result > 0:
        raise refusal_of(drive, reply.exception)
    if result in (Failure.NO_REPLY, Failure.LATE_ANSWER_DUE):
        raise no_reply(drive, completion)
    advice = mixed_up(_port_of(drive), completion.raw)
    raise BadReply(drive.name, STATUSES[-result] + advice, completion.raw)


def no_reply(drive: Drive, completion: Completion) -> NoReply:
    """Return the error of a drive that is silent, or whose gateway says that it is."""
    if drive.framing is Framing.TCP and completion.raw:
        code = completion.raw[-1]
        return NoReply(drive.name, f" behind the gateway, which says so (exception {code:02X}H)")
    return NoReply(drive.name, hint="" if drive.bus is None else silence_hint(_port_of(drive)))


def check_master(drive: Drive, completion: Completion) -> None:
    """Raise NotMaster where the request was held back, because another process may be the line's master."""
    if completion.result in (Failure.NOT_MASTER, Failure.OTHER_MASTER):
        is_sent = completion.sent_ns > 0
        raise NotMaster(drive.name, _port_of(drive), heard=completion.raw, is_sent=is_sent)


def refusal_of(drive: Drive, code: int, register: str | None = None) -> DriveException:
    """Return the error of an exception, and of the register that was asked for by itself."""
    return DriveException(drive.name, code, drive.exception(code), register)


def no_value(drive: Drive, found: dict[str, Any]) -> NoValue:
    """Return the error of the first register for which the drive gave no value, with the others' values."""
    known = {name: value for name, value in found.items() if value is not None}
    return NoValue(drive.name, next(name for name in found if name not in known), known)


def _port_of(drive: Drive) -> str:
    return drive.bus.line.port if drive.bus else ""
