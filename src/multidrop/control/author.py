"""Author of a write: who asked for it and in which way, for the audit log."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

from multidrop.printable import printable

MOST_CHARACTERS = 200


class Author(NamedTuple):
    """Fields of an audit record."""

    by: str = ""
    way: str = ""


class _Named(NamedTuple):
    """The author of a block, in words that a log can have, and what is wrong with those that were given."""

    author: Author
    mistake: Exception | None


_named: ContextVar[_Named] = ContextVar("multidrop author")
_NOBODY = _Named(Author(), None)
_noted_first: ContextVar[bool] = ContextVar("multidrop noted first", default=False)


def present_author() -> Author:
    """Return the author of what is written now in this context; empty where none was named."""
    return _named.get(_NOBODY).author


def check_author() -> None:
    """Raise what is wrong with the name of the present author, as `written_by` says. No stop asks this."""
    mistake = _named.get(_NOBODY).mistake
    if mistake is not None:
        raise mistake


@contextmanager
def written_by(who: str, way: str = "") -> Iterator[None]:
    """Note `who` as the author, and the way in, of all that is written within the block.

    Each write's audit record then has `by` and, unless it is empty, `way`, such as "anna" and "web,
    10.0.0.7". Stops are noted as all other writes. It holds for this thread and what it calls, or this task
    of asyncio and `asyncio.to_thread`; another thread, such as one of `run_in_executor`, names its own. The
    innermost block counts. It gives no right to anybody. Under what is no text nothing is written and each
    write raises TypeError; ValueError under one that is empty, longer than 200 characters, or not printable.
    A stop is sent all the same: its record has what can be printed of it.
    """
    mistake = _mistake("who", who) or (_mistake("way", way) if way != "" else None)
    token = _named.set(_Named(Author(_spelt(who), _spelt(way)), mistake))
    try:
        yield
    finally:
        _named.reset(token)


@contextmanager
def noted_first() -> Iterator[None]:
    """Send no write within the block before the bus's audit log has a line of it; a stop is always sent.

    The `outcome` of that line is "called"; another one says what came of it. A write whose line cannot be
    written raises OSError, and nothing is sent. It holds for this thread or task, as `written_by` does.
    """
    token = _noted_first.set(True)
    try:
        yield
    finally:
        _noted_first.reset(token)


def is_noted_first() -> bool:
    """Return True within `noted_first`."""
    return _noted_first.get()


def _mistake(name: str, text: object) -> Exception | None:
    if not isinstance(text, str):
        return TypeError(f"{name} = {_spelt(text)} is no text")
    if not text.strip() or len(text) > MOST_CHARACTERS or not text.isprintable():
        return ValueError(f"{name} = {text!r} is not 1 to {MOST_CHARACTERS} printable characters")
    return None


def _spelt(given: object) -> str:
    """Return a name, whatever was given as one, as a log can have it."""
    try:
        text = given if isinstance(given, str) else repr(given)
    except Exception:  # it is a caller's own
        text = type(given).__name__
    return printable(text).strip()[:MOST_CHARACTERS]
