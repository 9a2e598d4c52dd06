"""What the library advises a program to do, as whoever types a command does it.

Its sentences say `call VERB()` and `declare NAME = VALUE`. What a program knows of a drive from one call to
the next, a command does not: what is to be known is an option of the command itself.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from multidrop.drive.verbs import VERBS

_COMMANDS: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r"call set_frequency before start", "add --frequency HZ"),
    (
        r"call reset_fault\(\), or declare (\w+) = (\w+)",
        r"run `multidrop reset-fault` and add --option \1=\2",
    ),
    (r'declare ram = \["(\w+)"\]', r"add --ram \1"),
    (r"declare (\w+) = (\w+)", r"add --option \1=\2"),
    (r"call (\w+)\(\)", lambda it: f"run {_command(it)}"),
    (rf"\b({'|'.join(VERBS)})\(\)", lambda it: _command(it)),
)


def _command(verb: re.Match[str]) -> str:
    return f"`multidrop {verb[1].replace('_', '-')}`"


def typed(sentence: str) -> str:
    """The sentence with what is to be typed."""
    for advice, command in _COMMANDS:
        sentence = re.sub(advice, command, sentence)
    return sentence
