"""Frames in the log: those of each exchange by hand, at DEBUG."""

from __future__ import annotations

import logging

from multidrop.core import STATUSES, Completion, Exchange, build_request
from multidrop.transport.aside_log import log_aside


def log_frames(log: logging.Logger, port: str, exchange: Exchange, found: Completion) -> None:
    """Log both frames: direction, CLOCK_MONOTONIC in s, bytes, meaning."""
    if found.sent_ns:
        frame = build_request(exchange.framing, exchange.request).hex(" ").upper()
        at = found.sent_ns / 1e9
        log_aside(log, logging.DEBUG, "%s > %.6f %s %s", port, at, frame, exchange.request)
    meaning = found.reply if found.result > 0 else STATUSES[-found.result]
    at = (found.first_ns or found.begun_ns) / 1e9
    came = found.raw.hex(" ").upper() or "nothing"
    log_aside(log, logging.DEBUG, "%s < %.6f %s %s", port, at, came, meaning)
