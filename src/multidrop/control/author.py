"""Author of a write: who asked for it and in which way, for the audit log."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

MOST_CHARACTERS = 200


class Author(NamedTuple):
    """Fields of an audit record."""

    by: str = ""
    way: str = ""


_author: ContextVar[Author] = ContextVar("multidrop author")
_UNKNOWN = Author()


def present_author() -> Author:
    """Return the author of what is written now in this context; empty where none was named."""
    return _author.get(_UNKNOWN)


@contextmanager
def written_by(who: str, way: str = "") -> Iterator[None]:
    """Note `who` as the author, and the way in, of all that is written within the block.

    Each write's audit record then has `by` and, unless it is empty, `way`, such as "anna" and "web,
    10.0.0.7". Stops are noted as all other writes. It holds for this thread and what it calls, or this task
    of asyncio and `asyncio.to_thread`; another thread, such as one of `run_in_executor`, names its own. The
    innermost block counts. It gives no right to anybody. Raises TypeError for what is no text, and ValueError
    for one that is empty, longer than 200 characters, or not printable.
    """
    token = _author.set(Author(_checked("who", who), _checked("way", way) if way != "" else ""))
    try:
        yield
    finally:
        _author.reset(token)


def _checked(name: str, text: str) -> str:
    if not isinstance(text, str):
        raise TypeError(f"{name} = {text!r} is no text")
    if not text.strip() or len(text) > MOST_CHARACTERS or not text.isprintable():
        raise ValueError(f"{name} = {text!r} is not 1 to {MOST_CHARACTERS} printable characters")
    return text
