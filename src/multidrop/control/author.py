"""Author of a write in the audit log: a person or program, and the interface it used."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

from multidrop.printable import printable

MOST_CHARACTERS = 200


class Author(NamedTuple):
    """An audit record's fields: `by` is who wrote, `way` the interface used, `id` the command's id."""

    by: str = ""
    way: str = ""
    id: str = ""


class _Named(NamedTuple):
    """The author that `written_by` sets, as printable text, and the error in its arguments, if any."""

    author: Author
    mistake: Exception | None


_named: ContextVar[_Named] = ContextVar("multidrop author")
_NOBODY = _Named(Author(), None)
_noted_first: ContextVar[bool] = ContextVar("multidrop noted first", default=False)


def present_author() -> Author:
    """Return the author of writes in this context; empty if none was named."""
    return _named.get(_NOBODY).author


def check_author() -> None:
    """Raise TypeError or ValueError if the present author's name is invalid. Not called for stops."""
    mistake = _named.get(_NOBODY).mistake
    if mistake is not None:
        raise mistake


@contextmanager
def written_by(who: str, way: str = "", command: str = "") -> Iterator[None]:
    """Record `who` as the author of all writes within the block, and `way` as the interface used.

    The audit record of a write or a stop then has `by`, such as "anna", and unless it is empty `way`, such as
    "web, 10.0.0.7". `command` is an id, recorded as `id`: it connects the records of a command with its
    answer. The block applies to this thread, or to this task and its calls of `asyncio.to_thread`. Other
    threads, such as those of `run_in_executor`, need a block of their own. The innermost block counts. Naming
    an author grants no rights.

    Within the block a write raises TypeError if an argument is not text, and ValueError if one is longer than
    200 characters or not printable, or if `who` is empty. A stop is sent nevertheless, and recorded with the
    printable part.
    """
    others = {"way": way, "command": command}
    given = {"who": who} | {name: text for name, text in others.items() if text != ""}
    mistakes = (_mistake(name, text) for name, text in given.items())
    author = Author(_spelt(who), _spelt(way), _spelt(command))
    token = _named.set(_Named(author, next(filter(None, mistakes), None)))
    try:
        yield
    finally:
        _named.reset(token)


@contextmanager
def noted_first() -> Iterator[None]:
    """Within the block, write a record with the outcome "called" to the audit log before each write.

    A second record has the real outcome. If the first record cannot be written, the write raises OSError and
    is not sent; a stop is always sent. The block applies to this thread or task, like that of `written_by`.
    """
    token = _noted_first.set(True)
    try:
        yield
    finally:
        _noted_first.reset(token)


def is_noted_first() -> bool:
    """Return True if the caller is inside a `noted_first` block."""
    return _noted_first.get()


def _mistake(name: str, text: object) -> Exception | None:
    if not isinstance(text, str):
        return TypeError(f"{name} = {_spelt(text)} is not text")
    if not text.strip() or len(text) > MOST_CHARACTERS or not text.isprintable():
        return ValueError(f"{name} = {text!r} is not 1 to {MOST_CHARACTERS} printable characters")
    return None


def _spelt(given: object) -> str:
    """Return any object, given as a name, as printable text."""
    try:
        text = given if isinstance(given, str) else repr(given)
    except Exception:  # raised by the caller's own `__repr__`
        text = type(given).__name__
    return printable(text).strip()[:MOST_CHARACTERS]
