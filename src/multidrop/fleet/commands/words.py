"""Words of commands: what a gateway is asked for and what it answers, as JSON. Pure: bytes come in."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any, NamedTuple

from multidrop.control import CommandOutcome as CommandOutcome
from multidrop.control import CommandResult, with_name

MOST_BYTES = 64 * 1024  # of a request
MOST_CHARACTERS = 200  # of a name, an id or a value's text
NOBODY = "somebody"  # who gives no name


class CommandAnswer(NamedTuple):
    """The end of a command: `held` is the value that the drive then said it holds, as text with its unit.

    `drives` has an answer for each drive of a stop.
    """

    outcome: CommandOutcome
    text: str  # one sentence for a person
    gateway: str = ""
    held: str = ""
    drives: Mapping[str, CommandAnswer] = {}

    @property
    def is_done(self) -> bool:
        return self.outcome is CommandOutcome.DONE

    @classmethod
    def of(cls, drive: str, result: CommandResult) -> CommandAnswer:
        """Return the answer for a command's result on a drive."""
        return cls(result.outcome, with_name(drive, result.text), held=result.held)

    def as_json(self) -> dict[str, Any]:
        """Return it for a message or a log, without what is empty."""
        found: dict[str, Any] = {"outcome": self.outcome.value, "text": self.text}
        found |= {key: text for key, text in (("gateway", self.gateway), ("held", self.held)) if text}
        if self.drives:
            found["drives"] = {name: answer.as_json() for name, answer in self.drives.items()}
        return found


class CommandRequest(NamedTuple):
    """One command to one drive: a verb with its options, or a register and the value to write.

    `id` is the asker's own and new for each command, so that copies of a message are told as such.
    """

    id: str
    by: str
    drive: str
    verb: str = ""
    options: Mapping[str, object] = {}
    register: str = ""
    value: float | str = ""

    @property
    def entry(self) -> str:
        """Return the entry of the plant's list that allows it."""
        return f"{self.drive}.{self.verb or self.register}"

    @property
    def words(self) -> str:
        """Say what is asked for."""
        if self.register:
            return f"{self.entry} = {self.value}"
        options = ", ".join(f"{name} = {value}" for name, value in self.options.items())
        return f"{self.entry}({options})"


class StopRequest(NamedTuple):
    """A stop of these drives of a line, or of all with None. An asker's `id` is new for each stop."""

    id: str
    by: str
    drives: tuple[str, ...] | None


class Offered(NamedTuple):
    """A gateway's promise to do something once, if it is told to soon."""

    token: str
    subject: str  # to which the token is to be sent
    text: str  # what will be done
    gateway: str


def encode(message: NamedTuple) -> bytes:
    """Return a request or an offer as JSON."""
    return json.dumps(message._asdict(), separators=(",", ":")).encode()


def read_json(data: bytes) -> dict[str, Any]:
    """Return the JSON object of a message. Raises ValueError for any other."""
    if len(data) > MOST_BYTES:
        raise ValueError(f"the message is longer than {MOST_BYTES} bytes")
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        raise ValueError("the message is not JSON") from None
    if not isinstance(found, dict):
        raise ValueError("the message is not a JSON object")
    return found


def read_command(data: bytes) -> CommandRequest:
    """Return the command of a message from anybody. Raises ValueError, in one sentence."""
    found = read_json(data)
    id, by, drive = (_text(found, key) for key in ("id", "by", "drive"))
    verb, register = (_text(found, key, is_needed=False) for key in ("verb", "register"))
    if bool(verb) == bool(register):
        raise ValueError("a command has either a verb or a register")
    options = found.get("options", {})
    if not isinstance(options, dict):
        raise ValueError("options is no JSON object")
    if verb:
        return CommandRequest(id, by, drive, verb=verb, options=options)
    return CommandRequest(id, by, drive, register=register, value=_value(found))


def read_stop(data: bytes) -> tuple[StopRequest, str]:
    """Return the stop of a message from anybody, and why it is one of all drives where it names none.

    A stop is never refused. To stop too many drives can be mended, and to stop none cannot. Whoever asks is
    named in printable words, "" being no id.
    """
    try:
        found = read_json(data)
    except ValueError as mistake:
        return StopRequest("", NOBODY, None), str(mistake)
    request = StopRequest(spelt(found.get("id")), spelt(found.get("by")) or NOBODY, None)
    drives = found.get("drives")
    if isinstance(drives, str):
        drives = [drives]
    if isinstance(drives, list) and drives and all(isinstance(name, str) for name in drives):
        return request._replace(drives=tuple(drives)), ""
    return request, "" if drives is None else "drives is neither a list of names nor null"


def spelt(given: object) -> str:
    r"""Return a name, whatever was given as one; what cannot be printed is spelt out: an escape is `\x1b`."""
    text = str(given) if isinstance(given, (str, int, float)) else ""
    return (text if text.isprintable() else repr(text)[1:-1]).strip()[:MOST_CHARACTERS]


def _text(found: Mapping[str, Any], key: str, *, is_needed: bool = True) -> str:
    text = found.get(key, "")
    if not isinstance(text, str) or len(text) > MOST_CHARACTERS or not text.isprintable():
        raise ValueError(f"{key} is no text of at most {MOST_CHARACTERS} printable characters")
    if is_needed and not text.strip():
        raise ValueError(f"{key} is missing")
    return text


def _value(found: Mapping[str, Any]) -> float | str:
    value = found.get("value")
    if isinstance(value, str):
        return _text(found, "value")
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not _is_finite(value):
        raise ValueError("value is missing, or is neither a number nor a text")
    return value


def _is_finite(value: float) -> bool:
    try:
        return isfinite(value)
    except OverflowError:  # an int that no float holds
        return False


def read_offer(data: bytes) -> Offered | CommandAnswer:
    """Return a gateway's offer, or its answer where it makes none. Raises ValueError."""
    found = read_json(data)
    if "token" not in found:
        return read_answer(data)
    return Offered(*(_long_text(found, key) for key in Offered._fields))


def read_answer(data: bytes) -> CommandAnswer:
    """Return a gateway's answer. Raises ValueError."""
    return _answer(read_json(data))


def _answer(found: Any) -> CommandAnswer:
    if not isinstance(found, dict):
        raise ValueError("an answer is no JSON object")
    drives = found.get("drives", {})
    if not isinstance(drives, dict):
        raise ValueError("drives of an answer is no JSON object")
    return CommandAnswer(
        CommandOutcome(_long_text(found, "outcome")),
        _long_text(found, "text"),
        str(found.get("gateway", "")),
        str(found.get("held", "")),
        {name: _answer(one) for name, one in drives.items()},
    )


def _long_text(found: Mapping[str, Any], key: str) -> str:
    text = found.get(key)
    if not isinstance(text, str):
        raise ValueError(f"{key} of an answer is no text")
    return text


def worst(answers: Sequence[CommandAnswer]) -> CommandOutcome:
    """Return the outcome of several drives' commands together: the one that a person must know first."""
    order = (
        CommandOutcome.UNKNOWN,
        CommandOutcome.NOT_SENT,
        CommandOutcome.REFUSED,
        CommandOutcome.FAILED,
        CommandOutcome.UNDER_WAY,
        CommandOutcome.DONE,
    )
    return min((answer.outcome for answer in answers), key=order.index, default=CommandOutcome.REFUSED)
