"""Frames of single exchanges in words, for the logger `multidrop.line` at DEBUG."""

from __future__ import annotations

import logging

from multidrop.core import Completion, Exchange, Framing, Message, Result, build_request

_FUNCTIONS = {
    0x01: "read coils",
    0x02: "read discrete inputs",
    0x03: "read holding registers",
    0x04: "read input registers",
    0x05: "write a coil",
    0x06: "write a register",
    0x0F: "write coils",
    0x10: "write registers",
}


def log_exchange(log: logging.Logger, port: str, exchange: Exchange, found: Completion) -> None:
    """Log the request and the reply: direction, CLOCK_MONOTONIC in s, bytes as hex, and meaning."""
    request = exchange.request
    if found.sent_ns:
        frame = build_request(exchange.framing, request)
        log.debug("%s > %.6f %s: %s", port, found.sent_ns / 1e9, _hex(frame), _asked(exchange))
    if request.address or not found.sent_ns:
        at_ns = found.first_ns or found.last_ns or found.begun_ns
        log.debug("%s < %.6f %s: %s", port, at_ns / 1e9, _hex(found.raw) or "nothing", _became(found))


def _hex(frame: bytes) -> str:
    return frame.hex(" ").upper()


def _asked(exchange: Exchange) -> str:
    request = exchange.request
    if exchange.framing is Framing.DELIXI:
        return f"address {request.address}, function {request.function}, parameter {request.start:04X}H"
    what = _FUNCTIONS.get(request.function, f"function {request.function:02X}H")
    count = f", {request.count} of them" if request.count else ""
    return f"address {request.address}, {what} from {request.start:04X}H{count}{_data(request)}"


def _became(found: Completion) -> str:
    if found.result <= 0:
        return str(Result(found.result))
    if found.reply.exception:
        return f"exception {found.reply.exception:02X}H"
    return f"good{_data(found.reply)}"


def _data(message: Message) -> str:
    return f", data {_hex(message.data)}" if message.data else ""
