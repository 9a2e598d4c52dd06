"""The only room that imports the compiled module: frames, exchanges and columns for Python."""

from __future__ import annotations

from multidrop.core.columns import COLUMNS, Columns, Field, Names, NumberFormat, RowLayout, raw_value, spell
from multidrop.core.counters import DELAY_BUCKETS, Counters, delay_edge
from multidrop.core.exchange import Completion, Exchange, Peer, completion
from multidrop.core.frame import (
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
from multidrop.core.latch import Latch, Permit
from multidrop.core.port import Echo, Port, now_ns, utc_minus_monotonic_ns
from multidrop.core.port_settings import (
    REFUSALS,
    CharacterFormat,
    get_settings,
    is_pseudo_terminal,
    must_take,
    refused_names,
    set_settings,
)
from multidrop.core.result import EXCEPTION_STATUS, STATUSES, UNASKED, Failure, FrameFault, Status
from multidrop.core.row_queue import RowQueue
from multidrop.core.sniffer import (
    STREAM_ROOM,
    Decoded,
    Decoder,
    FrameSpan,
    Kind,
    Side,
    Splitter,
    Stream,
    Unpacked,
    Unpacker,
)
from multidrop.core.tap import Tap, Wrappings

__all__ = [
    "COLUMNS",
    "DELAY_BUCKETS",
    "EXCEPTION_STATUS",
    "REFUSALS",
    "STATUSES",
    "STREAM_ROOM",
    "UNASKED",
    "CharacterFormat",
    "Columns",
    "Completion",
    "Counters",
    "Decoded",
    "Decoder",
    "Echo",
    "Exchange",
    "Failure",
    "Field",
    "FrameFault",
    "FrameSpan",
    "Framing",
    "Kind",
    "Latch",
    "Message",
    "Names",
    "NumberFormat",
    "Peer",
    "Permit",
    "Port",
    "RowLayout",
    "RowQueue",
    "Side",
    "Splitter",
    "Status",
    "Stream",
    "Tap",
    "Unpacked",
    "Unpacker",
    "Wrappings",
    "build_reply",
    "build_request",
    "completion",
    "crc16",
    "delay_edge",
    "get_settings",
    "is_pseudo_terminal",
    "lrc",
    "must_take",
    "now_ns",
    "parse_reply",
    "parse_request",
    "raw_value",
    "refused_names",
    "reply_length",
    "set_settings",
    "spell",
    "sum8",
    "utc_minus_monotonic_ns",
]
