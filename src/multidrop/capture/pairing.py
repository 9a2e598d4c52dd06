"""Pair sniffed requests with their replies; report bytes outside of frames as junk."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from multidrop.core import FrameSpan, Framing, Kind, Message, Side

_MOST_JUNK = 4096  # largest number of bytes in one Junk
_COUNTED = ("exchanges", "broadcasts", "unanswered", "strays", "unknown_bytes")


def _is_broadcast(framing: Framing, request: Message) -> bool:
    """Return True for a request to address 0, except on Modbus TCP, where 0 is an ordinary unit id."""
    return request.address == 0 and framing is not Framing.TCP


@dataclass(frozen=True)
class SniffedExchange:
    """A request and its reply; either is None if it was not sniffed or never sent.

    `is_sure` is False if the frame taken for the request may be a reply: replies to functions 05, 06 and 08
    are copies of their requests.
    """

    framing: Framing
    request: Message | None
    reply: Message | None
    time_ns: int
    reply_time_ns: int
    is_sure: bool
    raw: tuple[tuple[Side, bytes, int], ...]  # for each frame: sender, bytes, time in ns

    @property
    def is_broadcast(self) -> bool:
        return self.request is not None and _is_broadcast(self.framing, self.request)


@dataclass(frozen=True)
class Junk:
    """Bytes that belong to no frame."""

    time_ns: int
    raw: bytes


Sniffed = SniffedExchange | Junk


class Pairing:
    """Pairs the requests and replies of one line, and counts them."""

    def __init__(self) -> None:
        self._counts = dict.fromkeys(_COUNTED, 0)
        self._asked: FrameSpan | None = None
        self._junk: list[FrameSpan] = []

    def pair(self, spans: Iterable[FrameSpan]) -> Iterator[Sniffed]:
        """Yield the exchanges and the junk in these frames.

        A request stays pending until its reply or another request follows.
        """
        for span in spans:
            if span.kind is Kind.JUNK:
                yield from self._add_junk(span)
                continue
            if span.kind is Kind.REPLY and self._asked:
                asked, self._asked = self._asked, None
                self._counts["exchanges"] += 1
                yield _exchange(asked, span)
                yield from self._flush_junk()
                continue
            yield from self.flush()
            if span.kind in (Kind.REPLY, Kind.STRAY):
                self._counts["strays"] += 1
                yield _exchange(None, span)
            elif _is_broadcast(span.framing, span.message):
                self._counts["broadcasts"] += 1
                yield _exchange(span, None)
            else:
                self._asked = span

    def flush(self) -> Iterator[Sniffed]:
        """Yield the pending request as unanswered, then the pending junk."""
        if self._asked:
            asked, self._asked = self._asked, None
            self._counts["unanswered"] += 1
            yield _exchange(asked, None)
        yield from self._flush_junk()

    def counts(self) -> dict[str, int]:
        return dict(self._counts)

    def _add_junk(self, span: FrameSpan) -> Iterator[Sniffed]:
        self._counts["unknown_bytes"] += len(span.raw)
        self._junk.append(span)
        if sum(len(span.raw) for span in self._junk) >= _MOST_JUNK:
            yield from self._flush_junk()

    def _flush_junk(self) -> Iterator[Junk]:
        if self._junk:
            junk, self._junk = self._junk, []
            yield Junk(junk[0].time_ns, b"".join(span.raw for span in junk))


def _exchange(asked: FrameSpan | None, answer: FrameSpan | None) -> SniffedExchange:
    first = asked or answer
    assert first is not None
    frames = [(Side.ASKING, asked.raw, asked.time_ns)] if asked else []
    frames += [(Side.ANSWERING, answer.raw, answer.time_ns)] if answer else []
    return SniffedExchange(
        first.framing,
        asked.message if asked else None,
        answer.message if answer else None,
        first.time_ns,
        answer.time_ns if answer else 0,
        asked is None or asked.kind is Kind.REQUEST,
        tuple(frames),
    )
