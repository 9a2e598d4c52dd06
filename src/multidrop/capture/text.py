"""What was sniffed as people and programs read it: a line of text or an object of JSON each."""

from __future__ import annotations

import struct
from datetime import UTC, datetime
from typing import Any

from multidrop.capture.lookup import Meaning, Meanings, RegisterPlace
from multidrop.capture.pairing import Junk, Sniffed, SniffedExchange
from multidrop.core import Framing, Message, raw_value

_MOST_SHOWN = 16  # raw registers in a line of text
_MOST_BYTES = 32


class EchoProbe:
    """Tells what was heard on one line, in engineering units where the plant is known."""

    def __init__(self, meanings: Meanings) -> None:
        self._meanings = meanings

    def text(self, sniffed: Sniffed) -> str:
        """One line, without the line's name."""
        clock = _clock(sniffed.time_ns)
        if isinstance(sniffed, Junk):
            return f"{clock}  unknown: {_hex(sniffed.raw)}"
        asked = sniffed.request
        if asked is None:
            assert sniffed.reply is not None
            it = sniffed.reply
            return (
                f"{clock}  address {it.address}  function {it.function:02X}: reply without its request: "
                + (_hex(sniffed.raw[0][1]))
            )
        meaning = self._meanings.of(sniffed.framing, asked)
        who = "all drives" if sniffed.is_broadcast else meaning.drive
        verb = "writes" if meaning.is_write else "reads"
        doubt = "" if sniffed.is_sure else " (or its confirmation)"
        return f"{clock}  {who}  {verb}{doubt} {self._answer(sniffed, asked, meaning)}"

    def _answer(self, heard: SniffedExchange, asked: Message, meaning: Meaning) -> str:
        names = ", ".join(place.name for place in meaning.places[:_MOST_SHOWN])
        if heard.reply is not None and heard.reply.exception:
            return f"{names}: refused, code {heard.reply.exception:02X}H{_delay(heard)}"
        if heard.reply is None and not meaning.is_write:
            return f"{names}: no reply"
        data = data_of(heard, asked)
        shown = [_shown(place, data) for place in meaning.places[:_MOST_SHOWN]]
        more = len(meaning.places) - len(shown)
        values = ", ".join(shown) + (f" and {more} more" if more else "")
        if heard.is_broadcast:
            return f"{values} (broadcast)"
        return values + (": no reply" if heard.reply is None else _delay(heard))

    def json(self, sniffed: Sniffed) -> dict[str, Any]:
        """The same for programs."""
        time = datetime.fromtimestamp(sniffed.time_ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        told: dict[str, Any] = {"time": f"{time}.{sniffed.time_ns % 10**9:09}Z"}
        if isinstance(sniffed, Junk):
            return told | {"unknown": sniffed.raw.hex(" ").upper()}
        message = sniffed.request or sniffed.reply
        assert message is not None
        told |= {
            "framing": str(sniffed.framing),
            "address": message.address,
            "function": message.function,
            "frames": [raw.hex(" ").upper() for _, raw, _ in sniffed.raw],
        }
        if sniffed.request is None:
            return told | {"result": "reply without its request"}
        meaning = self._meanings.of(sniffed.framing, sniffed.request)
        told |= {"drive": meaning.drive, "access": "write" if meaning.is_write else "read"}
        if sniffed.reply is None:
            told["result"] = "broadcast" if sniffed.is_broadcast else "no reply"
        else:
            told["result"] = "refused" if sniffed.reply.exception else "ok"
            told["reply_after_ns"] = sniffed.reply_time_ns - sniffed.time_ns
        if told["result"] == "refused":
            told["exception"] = sniffed.reply.exception if sniffed.reply else 0
        if not sniffed.is_sure:
            told["may_be_confirmation"] = True
        data = data_of(sniffed, sniffed.request)
        if told["result"] == "ok" or meaning.is_write:
            told["values"] = {place.name: _number(place, data) for place in meaning.places}
        return told


def data_of(heard: SniffedExchange, asked: Message) -> bytes:
    """What was read or written: a write's reply does not always repeat it."""
    if heard.framing is Framing.DELIXI and asked.function == 0x02:
        return struct.pack(">I", asked.start)
    if heard.framing is not Framing.DELIXI and asked.function >= 0x05:
        return asked.data
    return heard.reply.data if heard.reply else asked.data


def _clock(time_ns: int) -> str:
    """Local time of day, as on the wall of whoever watches."""
    return f"{datetime.fromtimestamp(time_ns // 10**9).strftime('%H:%M:%S')}.{time_ns % 10**9 // 1000:06}"


def _delay(heard: SniffedExchange) -> str:
    return f"  ({(heard.reply_time_ns - heard.time_ns) / 1e6:.1f} ms)"


def _hex(raw: bytes) -> str:
    more = f" and {len(raw) - _MOST_BYTES} bytes more" if len(raw) > _MOST_BYTES else ""
    return raw[:_MOST_BYTES].hex(" ").upper() + more


def _number(place: RegisterPlace, data: bytes) -> float | int | None:
    raw = raw_value(data, place.at, place.number_format)
    if raw != raw:  # NaN: the data ends before it
        return None
    if place.register is None or place.register.values is not None:
        return int(raw)
    scale = place.register.scale
    return raw * scale.numerator / scale.denominator


def _shown(place: RegisterPlace, data: bytes) -> str:
    raw = raw_value(data, place.at, place.number_format)
    if raw != raw:
        return f"{place.name} ?"
    register = place.register
    if register is None:
        return f"{place.name} = {int(raw)}"
    return f"{register.name} = {register.format(register.decode(raw))}"
