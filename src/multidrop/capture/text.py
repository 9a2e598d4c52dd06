"""Sniffed exchanges as a line of text for people and an object of JSON for programs."""

from __future__ import annotations

import struct
from datetime import datetime
from typing import Any

from multidrop.capture.lookup import RegisterLookup, RegisterPlace, RequestTarget
from multidrop.capture.pairing import Junk, Sniffed, SniffedExchange
from multidrop.core import Framing, Message, Status, raw_value
from multidrop.drive.number_format import bits_in
from multidrop.iso_time import format_time

_MOST_SHOWN = 16  # raw registers in a line of text
_MOST_BYTES = 32


class ExchangeFormatter:
    """Format the exchanges of one line, in engineering units where the plant is known."""

    def __init__(self, lookup: RegisterLookup) -> None:
        self._lookup = lookup

    def text(self, sniffed: Sniffed) -> str:
        """Return one line of text, without the bus line's name."""
        clock = _clock(sniffed.time_ns)
        if isinstance(sniffed, Junk):
            return f"{clock}  unknown: {_hex(sniffed.raw)}"
        request = sniffed.request
        if request is None:
            reply = sniffed.reply
            assert reply is not None
            return (
                f"{clock}  address {reply.address}  function {reply.function:02X}: "
                f"reply without its request: {_hex(sniffed.raw[0][1])}"
            )
        target = self._lookup.find(sniffed.framing, request)
        drive = "all drives" if sniffed.is_broadcast else target.drive
        verb = "writes" if target.is_write else "reads"
        doubt = "" if sniffed.is_sure else " (or its confirmation)"
        return f"{clock}  {drive}  {verb}{doubt} {self._result(sniffed, request, target)}"

    def _result(self, exchange: SniffedExchange, request: Message, target: RequestTarget) -> str:
        places = target.places[:_MOST_SHOWN]
        names = ", ".join(place.name for place in places)
        if exchange.reply is not None and exchange.reply.exception:
            return f"{names}: refused, code {exchange.reply.exception:02X}H{_delay(exchange)}"
        if exchange.reply is None and not target.is_write:
            return f"{names}: no reply"
        data = data_of(exchange, request)
        more = len(target.places) - len(places)
        values = ", ".join(_shown(place, data) for place in places) + (f" and {more} more" if more else "")
        if exchange.is_broadcast:
            return f"{values} (broadcast)"
        return values + (": no reply" if exchange.reply is None else _delay(exchange))

    def json(self, sniffed: Sniffed) -> dict[str, Any]:
        """Return an object for JSON, without the bus line's name."""
        found: dict[str, Any] = {"time": format_time(sniffed.time_ns)}
        if isinstance(sniffed, Junk):
            return found | {"unknown": sniffed.raw.hex(" ").upper()}
        request, reply = sniffed.request, sniffed.reply
        message = request or reply
        assert message is not None
        found |= {
            "framing": str(sniffed.framing),
            "address": message.address,
            "function": message.function,
            "frames": [raw.hex(" ").upper() for _, raw, _ in sniffed.raw],
        }
        if request is None:
            return found | {"result": "reply without its request"}
        target = self._lookup.find(sniffed.framing, request)
        found |= {"drive": target.drive, "access": "write" if target.is_write else "read"}
        if reply is None:
            found["result"] = "broadcast" if sniffed.is_broadcast else "no reply"
        else:
            found["result"] = "refused" if reply.exception else "ok"
            found["reply_after_ns"] = sniffed.reply_time_ns - sniffed.time_ns
            if reply.exception:
                found["exception"] = reply.exception
        if not sniffed.is_sure:
            found["may_be_confirmation"] = True
        if found["result"] == "ok" or target.is_write:
            data = data_of(sniffed, request)
            found["values"] = {place.name: _number(place, data) for place in target.places}
        return found


def data_of(exchange: SniffedExchange, request: Message) -> bytes:
    """Return the data that was read or written: a write's reply does not always repeat it."""
    if exchange.framing is Framing.DELIXI and request.function == 0x02:
        return struct.pack(">I", request.start)
    if exchange.framing is not Framing.DELIXI and request.function >= 0x05:
        return request.data
    return exchange.reply.data if exchange.reply else request.data


def _clock(time_ns: int) -> str:
    """Return the local time of day, to the microsecond."""
    return f"{datetime.fromtimestamp(time_ns // 10**9).strftime('%H:%M:%S')}.{time_ns % 10**9 // 1000:06}"


def _delay(exchange: SniffedExchange) -> str:
    return f"  ({(exchange.reply_time_ns - exchange.time_ns) / 1e6:.1f} ms)"


def _hex(raw: bytes) -> str:
    more = f" and {len(raw) - _MOST_BYTES} bytes more" if len(raw) > _MOST_BYTES else ""
    return raw[:_MOST_BYTES].hex(" ").upper() + more


def _number(place: RegisterPlace, data: bytes) -> float | int | None:
    if place.register is not None:
        number = place.register.number_in(data, place.at)
        return number if number is None or place.register.values is None else int(number)
    raw = raw_value(data, place.at, place.number_format)
    return int(raw) if raw == raw else None  # NaN: the data ends before it


def _shown(place: RegisterPlace, data: bytes) -> str:
    register = place.register
    raw = raw_value(data, place.at, place.number_format)
    if register is None:
        return f"{place.name} = {int(raw)}" if raw == raw else f"{place.name} ?"
    value = register.value_in(data, place.at)
    if value is not None:
        return f"{register.name} = {register.format(value)}"
    is_there = bits_in(data, place.at, register.number_format, register.order) is not None
    return f"{register.name}: {Status.NO_VALUE}" if is_there else f"{register.name} ?"
