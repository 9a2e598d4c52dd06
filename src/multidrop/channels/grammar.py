"""Parse expressions of computed channels, such as "integral(pump-1.output_power)".

The result is a list of steps for a stack machine: operands come before their operator. Parsing and evaluation
recurse at most MOST_DEPTH levels deep, for any text. No text reaches Python's own parser.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from math import isfinite
from typing import NamedTuple

MOST_CHARACTERS = 1000  # limit of an expression's length
MOST_DEPTH = 40  # limit of nested parentheses, calls and signs
MOST_ARGUMENTS = 130  # limit of a call's arguments, which allows a table of 64 points


class ExpressionError(ValueError):
    """A mistake in an expression, and its column, counted from 1."""

    def __init__(self, column: int, sentence: str) -> None:
        super().__init__(f"column {column}: {sentence}")
        self.column = column


class NumberStep(NamedTuple):
    """A step of a parsed expression: a number."""

    column: int
    value: float


class TextStep(NamedTuple):
    """A step of a parsed expression: a text in quotes, such as a unit."""

    column: int
    text: str


class ReferenceStep(NamedTuple):
    """A step of a parsed expression: a register or channel.

    `drive` is "" if the expression names no drive.
    """

    column: int
    drive: str
    name: str


class CallStep(NamedTuple):
    """A step of a parsed expression: a function or operator that is applied to the last `arity` operands.

    The negation -x has the name "-1", because "-" is the subtraction.
    """

    column: int
    name: str
    arity: int


Step = NumberStep | TextStep | ReferenceStep | CallStep

SIGN = "-1"
_PRECEDENCES = {
    "or": 1,
    "and": 2,
    **dict.fromkeys(("<", "<=", ">", ">=", "==", "!="), 4),
    **dict.fromkeys("+-", 5),
    **dict.fromkeys("*/", 6),
}
_NOT, _COMPARISON, _SIGNED = 3, 4, 7

_TOKEN = re.compile(
    r"""\s*(?:
    (?P<number>[0-9]+(?:\.[0-9]*)?(?:[eE][+-]?[0-9]+)?|\.[0-9]+(?:[eE][+-]?[0-9]+)?)
    |(?P<reference>[^\W\d][\w-]*\.[^\W\d]\w*|"[^"]*"\.[^\W\d]\w*|'[^']*'\.[^\W\d]\w*)
    |(?P<text>"[^"]*"|'[^']*')
    |(?P<word>[^\W\d]\w*)
    |(?P<sign><=|>=|==|!=|[-+*/()<>,])
    |(?P<end>\Z)
    )""",
    re.VERBOSE,
)


# operators of other languages, each with the advice that completes the error
_INSTEAD = {sign: f"; write {word}" for sign, word in (("=", "=="), ("&", "and"), ("|", "or"), ("!", "not"))}


class _Token(NamedTuple):
    kind: str
    text: str
    column: int


def _tokens(text: str) -> Iterator[_Token]:
    at = 0
    while True:
        found = _TOKEN.match(text, at)
        if found is None:
            place = at + len(text[at:]) - len(text[at:].lstrip())
            hint = _INSTEAD.get(text[place], "")
            sentence = f"{text[place]!r} is neither a number, a name nor an operator{hint}"
            raise ExpressionError(place + 1, sentence)
        kind = found.lastgroup or ""
        yield _Token(kind, found[kind], found.start(kind) + 1)
        if kind == "end":
            return
        at = found.end()


def parse(text: str) -> list[Step]:
    """Return the steps of an expression. Raises ExpressionError for a mistake."""
    if len(text) > MOST_CHARACTERS:
        raise ExpressionError(MOST_CHARACTERS, f"the expression has more than {MOST_CHARACTERS} characters")
    return _ExpressionParser(text).steps


class _ExpressionParser:
    """Parses one expression by precedence climbing."""

    def __init__(self, text: str) -> None:
        self._tokens = _tokens(text)
        self._token = next(self._tokens)
        self._depth = 0
        self.steps: list[Step] = []
        self._expression(0)
        if self._token.kind != "end":
            raise self._missing("an operator")

    def _missing(self, missing: str) -> ExpressionError:
        shown = f"{self._token.text!r}" if self._token.text else "the end"
        return ExpressionError(self._token.column, f"{missing} is missing before {shown}")

    def _next(self) -> _Token:
        token, self._token = self._token, next(self._tokens, self._token)
        return token

    def _expect(self, sign: str) -> None:
        if self._token.text != sign or self._token.kind != "sign":
            raise self._missing(repr(sign))
        self._next()

    def _expression(self, least: int) -> None:
        """Parse an expression that has only operators with a precedence of at least `least`."""
        self._depth += 1
        if self._depth > MOST_DEPTH:
            raise ExpressionError(
                self._token.column, f"the expression has more than {MOST_DEPTH} nested levels; split it"
            )
        self._operand()
        precedence = _PRECEDENCES.get(self._token.text, -1)
        while precedence >= max(least, 1):
            operator = self._next()
            self._expression(precedence + 1)
            self.steps.append(CallStep(operator.column, operator.text, 2))
            before, precedence = precedence, _PRECEDENCES.get(self._token.text, -1)
            if before == precedence == _COMPARISON:
                raise ExpressionError(
                    self._token.column, "comparisons cannot be chained; write (a < b) and (b < c)"
                )
        self._depth -= 1

    def _operand(self) -> None:
        token = self._next()
        if token.kind == "number":
            value = float(token.text)
            if not isfinite(value):
                raise ExpressionError(token.column, f"the number {token.text} is too large")
            self.steps.append(NumberStep(token.column, value))
        elif token.kind == "text":
            self.steps.append(TextStep(token.column, token.text[1:-1]))
        elif token.kind == "reference":
            drive, _, name = token.text.rpartition(".")
            self.steps.append(ReferenceStep(token.column, drive.strip("\"'"), name))
        elif token.text == "-":
            self._negative(token)
        elif token.text == "not":
            self._expression(_NOT)
            self.steps.append(CallStep(token.column, "not", 1))
        elif token.kind == "word" and token.text not in _PRECEDENCES:
            self._name(token)
        elif token.text == "(":
            self._expression(0)
            self._expect(")")
        else:
            shown = f"{token.text!r}" if token.text else "the end"
            raise ExpressionError(token.column, f"a number, a name or ( is missing before {shown}")

    def _negative(self, sign: _Token) -> None:
        before = len(self.steps)
        self._expression(_SIGNED)
        step = self.steps[-1]
        if len(self.steps) == before + 1 and isinstance(step, NumberStep):
            self.steps[-1] = NumberStep(sign.column, -step.value)
        else:
            self.steps.append(CallStep(sign.column, SIGN, 1))

    def _name(self, token: _Token) -> None:
        """Parse a function call if "(" follows the name.

        Otherwise it names a register of the channel's drive.
        """
        if self._token.text != "(":
            self.steps.append(ReferenceStep(token.column, "", token.text))
            return
        self._next()
        count = 0
        while count == 0 or self._token.text == ",":
            if count:
                self._next()
            if count == MOST_ARGUMENTS:
                raise ExpressionError(
                    self._token.column, f"the call has more than {MOST_ARGUMENTS} arguments"
                )
            self._expression(0)
            count += 1
        self._expect(")")
        self.steps.append(CallStep(token.column, token.text, count))
