"""Told: what is said of a command. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

from multidrop import BusError, Seen, Stopped, WriteForbidden
from multidrop.gateway.http.rights import NOT_ALLOWED, NOT_LISTED, Caller, Right
from multidrop.gateway.verb_rules import VERBS

_CALL = re.compile(r"(?P<how>call |run `multidrop )?\b(?P<verb>[a-z_-]+)(?P<end>\(\)|`)?")


class Told(NamedTuple):
    """The end of a command: what became of it, in the library's words."""

    is_done: bool
    text: str  # one sentence for a person
    error: BusError | ValueError | None = None  # that the library raised


def failed(failure: BaseException) -> Told:
    """Return the end of a command that failed so."""
    if not isinstance(failure, (BusError, ValueError)):
        failure = ValueError(str(failure) or type(failure).__name__)
    return Told(False, in_words(failure), failure)


def in_words(failure: BusError | ValueError) -> str:
    """Return a failure's sentence with what a gateway's user does in place of what a program would call."""
    text = str(failure)
    advice = failure.advice if isinstance(failure, WriteForbidden) else None
    if advice is not None and advice.plant:
        text = text.replace(advice.program, advice.plant)
    return _CALL.sub(_used, text)


def _used(call: re.Match[str]) -> str:
    verb = call["verb"].replace("-", "_")
    how = "use " if call["how"] else ""
    is_call = verb in VERBS and (call["how"] or call["end"])
    return f'{how}"{verb.replace("_", " ")}"' if is_call else call[0]


def of_stop(stopped: Stopped) -> Told:
    """Return what became of a stop."""
    if stopped.seen is Seen.STOPPED:
        return Told(True, f"stopped: seen to stand after {stopped.seconds:.1f} s")
    return Told(False, f"{stopped.seen.value}: {stopped.why}", BusError(stopped.why))


def as_one(found: Mapping[str, Told]) -> Told:
    """Return the end of a stop that went to several drives, because it may have meant each of them."""
    if len(found) == 1:
        return next(iter(found.values()))
    texts = (
        one.text if one.text.startswith(f"{name}: ") else f"{name}: {one.text}" for name, one in found.items()
    )
    failures = (one.error for one in found.values() if not one.is_done)
    return Told(all(one.is_done for one in found.values()), "; ".join(texts), next(failures, None))


def denied(caller: Caller, role: Right, what: str) -> Told:
    """Return the end of a command whose caller lacks this role."""
    needed = role.name.lower()
    sentence = f"{what} needs the role {needed}, and {caller.name} has {caller.role.name.lower()}"
    return failed(WriteForbidden(sentence, rule=NOT_ALLOWED))


def not_listed(what: str, key: str) -> WriteForbidden:
    """Return the reason why a write or a verb that the plant file does not list is refused."""
    return WriteForbidden(
        f'{what} is not in the plant file\'s list; add it to {key} = ["{what}"] of [serve.may]',
        rule=NOT_LISTED,
    )
