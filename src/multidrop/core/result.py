"""Faults of frames, failures of exchanges and statuses of rows: their numbers and texts."""

from __future__ import annotations

from enum import IntEnum

from multidrop._core import lib


class FrameFault(IntEnum):
    """Reasons why bytes are not a frame (enum md_frame_fault)."""

    INCOMPLETE = lib.MD_INCOMPLETE
    NO_START = lib.MD_NO_START
    BAD_CHARACTER = lib.MD_BAD_CHARACTER
    BAD_CHECKSUM = lib.MD_BAD_CHECKSUM
    BAD_ADDRESS = lib.MD_BAD_ADDRESS
    BAD_FUNCTION = lib.MD_BAD_FUNCTION
    BAD_LENGTH = lib.MD_BAD_LENGTH
    BAD_ECHO = lib.MD_BAD_ECHO
    BAD_REQUEST = lib.MD_BAD_REQUEST


class Failure(IntEnum):
    """Reasons why an exchange has no reply, besides FrameFault (enum md_failure)."""

    CUT_SHORT = lib.MD_CUT_SHORT
    NO_REPLY = lib.MD_NO_REPLY
    LINE_LOST = lib.MD_LINE_LOST
    SETTINGS_REFUSED = lib.MD_SETTINGS_REFUSED
    LATE_ANSWER_DUE = lib.MD_LATE_ANSWER_DUE
    EXPIRED = lib.MD_EXPIRED
    POLL_ENDED = lib.MD_POLL_ENDED
    MAYBE_ECHO = lib.MD_MAYBE_ECHO
    NOT_MASTER = lib.MD_NOT_MASTER
    OTHER_MASTER = lib.MD_OTHER_MASTER
    POLLING_FAILED = lib.MD_POLLING_FAILED
    STALLED = lib.MD_STALLED


class Status(IntEnum):
    """A row's status: OK, or why the row has no value (enum md_status). Exception codes are not members."""

    OK = lib.MD_OK
    NO_START = -FrameFault.NO_START
    BAD_CHARACTER = -FrameFault.BAD_CHARACTER
    BAD_CHECKSUM = -FrameFault.BAD_CHECKSUM
    BAD_ADDRESS = -FrameFault.BAD_ADDRESS
    BAD_FUNCTION = -FrameFault.BAD_FUNCTION
    BAD_LENGTH = -FrameFault.BAD_LENGTH
    BAD_ECHO = -FrameFault.BAD_ECHO
    BAD_REQUEST = -FrameFault.BAD_REQUEST
    CUT_SHORT = -Failure.CUT_SHORT
    NO_REPLY = -Failure.NO_REPLY
    LINE_LOST = -Failure.LINE_LOST
    SETTINGS_REFUSED = -Failure.SETTINGS_REFUSED
    LATE_ANSWER_DUE = -Failure.LATE_ANSWER_DUE
    EXPIRED = -Failure.EXPIRED
    NOT_ASKED = lib.MD_NOT_ASKED
    POLL_ENDED = -Failure.POLL_ENDED
    MAYBE_ECHO = -Failure.MAYBE_ECHO
    NO_VALUE = lib.MD_NO_VALUE
    NOT_MASTER = -Failure.NOT_MASTER
    OTHER_MASTER = -Failure.OTHER_MASTER
    POLLING_FAILED = -Failure.POLLING_FAILED
    STALLED = -Failure.STALLED

    def __str__(self) -> str:
        return STATUSES[self]


_WORDS: dict[int, str] = {
    Status.OK: "ok",
    Status.NO_START: "no frame in what was received",
    Status.BAD_CHARACTER: "bad character",
    Status.BAD_CHECKSUM: "bad checksum",
    Status.BAD_ADDRESS: "reply from another address",
    Status.BAD_FUNCTION: "reply to another function",
    Status.BAD_LENGTH: "reply of another length",
    Status.BAD_ECHO: "write confirmed with another address or value",
    Status.BAD_REQUEST: "request cannot be built",
    Status.CUT_SHORT: "reply cut short",
    Status.NO_REPLY: "no reply",
    Status.LINE_LOST: "port lost",
    Status.SETTINGS_REFUSED: "port refused its settings",
    Status.LATE_ANSWER_DUE: "not asked: late reply due",
    Status.EXPIRED: "not sent: expired",
    Status.NOT_ASKED: "not asked: drive is silent",
    Status.POLL_ENDED: "poll ended",
    Status.MAYBE_ECHO: "maybe the adapter's echo",
    Status.NO_VALUE: "no valid value",
    Status.NOT_MASTER: "not sent: not master",
    Status.OTHER_MASTER: "not sent: another master",
    Status.POLLING_FAILED: "not asked: polling failed",
    Status.STALLED: "not sent: port stalled",
}

UNASKED = "not "  # start of the texts of statuses for values that were not requested
EXCEPTION_STATUS: int = lib.MD_EXCEPTION  # status of an exception, to which its code is added

STATUSES = (
    *(_WORDS.get(code, "") for code in range(EXCEPTION_STATUS)),
    *(f"exception {code:02X}" for code in range(256)),
)
"""The text of every status code."""
