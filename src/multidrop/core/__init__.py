"""The only room that imports the compiled module: frames, exchanges and columns for Python."""

from __future__ import annotations

from multidrop.core.columns import COLUMNS, Block, Columns, Field, Names, Wire, raw_value, spell
from multidrop.core.exchanges import Completion, Exchange, Respondent, completion, new_completion
from multidrop.core.frames import (
    Framing,
    Message,
    build_reply,
    build_request,
    crc16,
    lrc,
    parse_reply,
    parse_request,
    reply_length,
    sum8,
)
from multidrop.core.inbox import Inbox
from multidrop.core.latch import Latch, Permit
from multidrop.core.overheard import (
    HEARD_ROOM,
    Decoded,
    Decoder,
    Heard,
    Kind,
    Side,
    Span,
    Splitter,
    Unpacked,
    Unpacker,
)
from multidrop.core.ports import Echo, Port, now_ns, utc_minus_monotonic_ns
from multidrop.core.results import EXCEPTION_STATUS, STATUSES, UNASKED, Result, status_text
from multidrop.core.settings import REFUSALS, get_settings, set_settings
from multidrop.core.tally import DELAY_BUCKETS, Tally, delay_edge
from multidrop.core.taps import Tap, Wrappings

__all__ = [
    "COLUMNS",
    "DELAY_BUCKETS",
    "EXCEPTION_STATUS",
    "HEARD_ROOM",
    "REFUSALS",
    "STATUSES",
    "UNASKED",
    "Block",
    "Columns",
    "Completion",
    "Decoded",
    "Decoder",
    "Echo",
    "Exchange",
    "Field",
    "Framing",
    "Heard",
    "Inbox",
    "Kind",
    "Latch",
    "Message",
    "Names",
    "Permit",
    "Port",
    "Respondent",
    "Result",
    "Side",
    "Span",
    "Splitter",
    "Tally",
    "Tap",
    "Unpacked",
    "Unpacker",
    "Wire",
    "Wrappings",
    "build_reply",
    "build_request",
    "completion",
    "crc16",
    "delay_edge",
    "get_settings",
    "lrc",
    "new_completion",
    "now_ns",
    "parse_reply",
    "parse_request",
    "raw_value",
    "reply_length",
    "set_settings",
    "spell",
    "status_text",
    "sum8",
    "utc_minus_monotonic_ns",
]
