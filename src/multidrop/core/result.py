"""Why there is no reply: as a number, as a status in columns, and in words."""

from __future__ import annotations

from enum import IntEnum

from multidrop._core import lib


class Result(IntEnum):
    """Why there is no reply, or why bytes are not what was looked for (enum md_result)."""

    INCOMPLETE = lib.MD_INCOMPLETE
    NO_START = lib.MD_NO_START
    BAD_CHARACTER = lib.MD_BAD_CHARACTER
    BAD_CHECKSUM = lib.MD_BAD_CHECKSUM
    BAD_ADDRESS = lib.MD_BAD_ADDRESS
    BAD_FUNCTION = lib.MD_BAD_FUNCTION
    BAD_LENGTH = lib.MD_BAD_LENGTH
    BAD_ECHO = lib.MD_BAD_ECHO
    BAD_REQUEST = lib.MD_BAD_REQUEST
    CUT_SHORT = lib.MD_CUT_SHORT
    NO_REPLY = lib.MD_NO_REPLY
    LINE_LOST = lib.MD_LINE_LOST
    SETTINGS_REFUSED = lib.MD_SETTINGS_REFUSED
    LATE_ANSWER_DUE = lib.MD_LATE_ANSWER_DUE
    EXPIRED = lib.MD_EXPIRED
    NOT_ASKED = lib.MD_NOT_ASKED
    POLL_ENDED = lib.MD_POLL_ENDED
    MAYBE_ECHO = lib.MD_MAYBE_ECHO

    def __str__(self) -> str:
        return _REASONS[self]


_REASONS = {
    Result.INCOMPLETE: "ok",
    Result.NO_START: "no frame in what was received",
    Result.BAD_CHARACTER: "bad character",
    Result.BAD_CHECKSUM: "bad checksum",
    Result.BAD_ADDRESS: "reply from another address",
    Result.BAD_FUNCTION: "reply to another function",
    Result.BAD_LENGTH: "reply of another length",
    Result.BAD_ECHO: "write confirmed with another address or value",
    Result.BAD_REQUEST: "request cannot be built",
    Result.CUT_SHORT: "reply cut short",
    Result.NO_REPLY: "no reply",
    Result.LINE_LOST: "port lost",
    Result.SETTINGS_REFUSED: "port refused its settings",
    Result.LATE_ANSWER_DUE: "not asked: late reply due",
    Result.EXPIRED: "not sent: expired",
    Result.NOT_ASKED: "not asked: drive is silent",
    Result.POLL_ENDED: "poll ended",
    Result.MAYBE_ECHO: "maybe the adapter's echo",
}

UNASKED = "not "  # so begin the reasons of misses that no request left for
EXCEPTION_STATUS = 256  # a column's status of exception code n is 256 + n


STATUSES = (
    *(_REASONS[Result(-code)] for code in range(-min(Result) + 1)),
    *([""] * (EXCEPTION_STATUS + min(Result) - 1)),  # codes that are not used
    *(f"exception {code:02X}" for code in range(256)),
)


def status_text(status: int) -> str:
    """What a status column says for the core's status code."""
    return STATUSES[status]
