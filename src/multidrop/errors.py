"""The exceptions of a bus, as one class hierarchy; their fields hold the details.

A mistake of the caller is a ValueError or TypeError at the call; everything else is a BusError.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

_NONE: Mapping[str, Any] = MappingProxyType({})


class BusError(Exception):
    """Base class of the errors of a drive, of its port, and of the line between them."""


class LineError(BusError, OSError):
    """The port failed: it cannot be opened, does not support the settings, or vanished."""

    def __init__(self, port: str, reason: str) -> None:
        super().__init__(f"{port}: {reason}")
        self.port = port
        self.reason = reason
        self.is_sent = False  # whether at least a part of the request was sent
        self.received = b""  # the bytes that came after the request


class PortLost(LineError):
    """The port vanished, and is not back yet; it may be reopened later."""


class NoSuchPort(LineError, ValueError):
    """The port's name is invalid, which is a mistake of the caller."""


class NoReply(BusError, TimeoutError):
    """No byte came within the drive's timeout.

    `code` is the exception code with which a gateway reports the silent drive; 0 without such a report.
    """

    def __init__(self, drive: str, where: str = "", hint: str = "", code: int = 0) -> None:
        super().__init__(
            f"{drive} does not answer{where}: check its address, baud rate, format, wiring, and that it has "
            f"power{hint}"
        )
        self.drive = drive
        self.code = code


class BadReply(BusError):
    """Bytes were received that are not the reply to the request."""

    def __init__(self, drive: str, reason: str, frame: bytes) -> None:
        super().__init__(f"{drive}: {reason} (received {frame.hex(' ').upper() or 'nothing'})")
        self.drive = drive
        self.reason = reason
        self.frame = frame


class NoValue(BadReply):
    """A valid reply holds NaN, or a raw count that the family declares to mean "no value".

    `values` has the valid values of the same read, by register name.
    """

    def __init__(self, drive: str, register: str, values: Mapping[str, Any] = _NONE) -> None:
        super().__init__(drive, f"{register} holds no valid value", b"")
        self.args = (f"{drive}: {register} holds no valid value at present",)
        self.register = register
        self.values = values


class DriveException(BusError):
    """The drive answered with an exception: it did not carry out the request.

    `register` is the name of the register that could not be read, if the request had only one.
    """

    def __init__(self, drive: str, code: int, meaning: str, register: str | None = None) -> None:
        refuses = "refuses" if register is None else f"refuses {register}"
        super().__init__(f"{drive} {refuses}: code {code:02X}H, {meaning}")
        self.drive = drive
        self.code = code
        self.meaning = meaning
        self.register = register


class Unconfirmed(BusError):
    """The effect of a write is not known: it may have happened."""

    def __init__(self, drive: str, what: str, reason: str) -> None:
        super().__init__(f"{drive}: it is not known whether {what} took effect: {reason}")
        self.drive = drive
        self.what = what
        self.reason = reason


class Unsupported(BusError):
    """The family's document does not define this verb or this value."""


class NotVerified(BusError):
    """The drive confirmed the write but did not carry it out: it holds another value, or tripped."""

    def __init__(self, drive: str, what: str, reason: str) -> None:
        super().__init__(f"{drive}: {what} did not take effect: {reason}")
        self.drive = drive
        self.what = what
        self.reason = reason


class Expired(BusError):
    """Not sent: the line stayed busy until the write expired."""

    def __init__(self, drive: str, what: str, seconds: float) -> None:
        super().__init__(f"{drive}: {what} was not sent: its turn did not come within {seconds:g} s")
        self.drive = drive
        self.what = what
        self.seconds = seconds


class CancelledByStop(BusError):
    """A write or verb was cancelled before it was sent.

    The cause is a stop, or that the bus was closed or the drive detached.
    """

    def __init__(self, drive: str, what: str, why: str) -> None:
        super().__init__(f"{drive}: {what} was not sent: {why}; nothing more was sent")
        self.drive = drive
        self.what = what
        self.why = why


class NotMaster(BusError):
    """Not sent: this process is not the master of the line, or it hears another master.

    `heard` has the bytes of another master. `is_sent` says whether a part of the request was sent, as on a
    port that takes a few bytes at a time. No drive accepts such a part as a request.
    """

    def __init__(self, drive: str, port: str, *, heard: bytes = b"", is_sent: bool = False) -> None:
        if heard:
            came = heard[:16].hex(" ").upper()
            why = f"unexpected bytes came on {port}, as from another master ({came})"
        else:
            why = f"this process is not the master of {port}, and another one may be"
        super().__init__(f"{drive}: not sent: not master: {why}")
        self.drive = drive
        self.reason = why
        self.heard = heard
        self.is_sent = is_sent

    def of_a_stop(self) -> NotMaster:
        """Return the same error with the advice that a failed stop needs."""
        self.args = (
            f"{self.drive}: the stop was NOT sent, and the motor continues as it is: {self.reason}. "
            "Stop it through the line's present master, or at the drive itself",
        )
        return self


class PollingFailed(BusError):
    """Polling has ended on all lines, because the poller's thread failed; `__cause__` says why."""


class NotAttached(ValueError):
    """The drive is not on this bus: a mistake of the caller."""


class Advice(NamedTuple):
    """What the user can do after a refused write.

    There is one text each for a program, the command line, and a plant file's drive.

    `plant` is empty if it is the same as `command`.
    """

    program: str
    command: str
    plant: str = ""

    @classmethod
    def call(cls, verb: str) -> Advice:
        """Return the advice to call this method of the drive, or to run the command of the same name."""
        return cls(f"call {verb}()", f"run `multidrop {verb.replace('_', '-')}`")

    @classmethod
    def declare(cls, option: str, value: object) -> Advice:
        """Return the advice to declare an option of the drive."""
        return cls(
            f"declare {option} = {value}",
            f"add --option {option}={value}",
            f"write {option} = {value} below its [[line.drive]]",
        )


# a value of WriteForbidden.rule: this rule may refuse even a stop
ANOTHER_FAMILY = "another family is at its address"


class WriteForbidden(BusError, ValueError):
    """The library did not send a write, because a rule forbids it.

    The exception has the register, the rule, and the manual's section. `is_budget` is True if the write was
    refused only to save the register's EEPROM, so that it may be sent later.
    """

    def __init__(
        self,
        sentence: str,
        *,
        register: str = "",
        rule: str = "",
        place: str = "",
        advice: Advice | None = None,
        is_budget: bool = False,
    ) -> None:
        super().__init__(sentence)
        self.advice = advice  # `sentence` contains `advice.program`
        self.register = register
        self.rule = rule
        self.place = place
        self.is_budget = is_budget

    def for_command_line(self, *, in_plant: bool = False) -> str:
        """Return the error's sentence with the advice for the command line."""
        if self.advice is None:
            return str(self)
        typed = (in_plant and self.advice.plant) or self.advice.command
        return str(self).replace(self.advice.program, typed)


class CheckAgain(Exception):
    """The drive to be stopped answers like another family: stop the others first, then check it again."""
