"""Modbus' exception codes: which one tells a client of which error."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum

from multidrop import (
    BadReply,
    CancelledByStop,
    DriveException,
    Expired,
    LineError,
    NoReply,
    NotAttached,
    NotMaster,
    NotVerified,
    Unconfirmed,
    Unsupported,
    WriteForbidden,
)
from multidrop.gateway.commands import BUSY
from multidrop.gateway.http.rights import NOT_ALLOWED, NOT_LISTED
from multidrop.gateway.mqtt.throttle import PassingBusy


class ModbusCode(IntEnum):
    """Exception codes of a reply (application protocol V1.1b3, section 7)."""

    ILLEGAL_FUNCTION = 0x01
    ILLEGAL_ADDRESS = 0x02
    ILLEGAL_VALUE = 0x03
    DEVICE_FAILURE = 0x04
    ACKNOWLEDGE = 0x05
    BUSY = 0x06
    NO_PATH = 0x0A
    NO_RESPONSE = 0x0B


class Declined(Exception):
    """A request that is answered with an exception code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code:02X}H")
        self.code = code


# The first of these that an error is decides the code.
_CODES: tuple[tuple[type[BaseException], ModbusCode], ...] = (
    (PassingBusy, ModbusCode.BUSY),
    (Expired, ModbusCode.BUSY),
    (CancelledByStop, ModbusCode.BUSY),
    (LineError, ModbusCode.NO_PATH),
    (NotMaster, ModbusCode.NO_PATH),
    (NotAttached, ModbusCode.NO_PATH),
    (NoReply, ModbusCode.NO_RESPONSE),
    (BadReply, ModbusCode.NO_RESPONSE),
    (Unconfirmed, ModbusCode.NO_RESPONSE),
    (Unsupported, ModbusCode.ILLEGAL_FUNCTION),
    (NotVerified, ModbusCode.DEVICE_FAILURE),
    (ValueError, ModbusCode.ILLEGAL_VALUE),
)
# The same for refusals by the rule that they name.
_RULES: Mapping[str, ModbusCode] = {
    NOT_ALLOWED: ModbusCode.ILLEGAL_FUNCTION,
    NOT_LISTED: ModbusCode.ILLEGAL_ADDRESS,
    BUSY: ModbusCode.BUSY,
}


def code_of(error: BaseException | None) -> int:
    """Return the exception code that tells a client of this error; a drive's own code as it came."""
    if isinstance(error, DriveException):
        return error.code if 1 <= error.code <= 0x7F else ModbusCode.DEVICE_FAILURE
    if isinstance(error, WriteForbidden) and (code := _RULES.get(error.rule)):
        return code
    if isinstance(error, WriteForbidden) and error.is_budget:
        return ModbusCode.BUSY
    return next((code for kind, code in _CODES if isinstance(error, kind)), ModbusCode.DEVICE_FAILURE)
