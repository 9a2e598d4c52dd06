"""JSON messages for commands: requests, offers and answers. This module does no I/O."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from sys import float_info
from typing import Any, NamedTuple

from multidrop.control import CommandOutcome, CommandResult, with_name
from multidrop.printable import is_number

MOST_BYTES = 64 * 1024  # limit of a message's size in bytes
MOST_CHARACTERS = 200  # limit of a name's, an id's or a value's length
UNNAMED = "somebody"  # name of a stop's sender if the message has no name


class CommandAnswer(NamedTuple):
    """The outcome of a command or a stop.

    `held` is the register's value in the drive after a write, as text with its unit.
    `drives` has an answer for each drive of a stop.
    """

    outcome: CommandOutcome
    text: str  # one sentence for users
    gateway: str = ""
    held: str = ""
    drives: Mapping[str, CommandAnswer] = {}

    @property
    def ok(self) -> bool:
        return self.outcome is CommandOutcome.DONE

    @classmethod
    def of(cls, drive: str, result: CommandResult) -> CommandAnswer:
        return cls(result.outcome, with_name(drive, result.text), held=result.held)

    def as_json(self) -> dict[str, Any]:
        """Return this answer as JSON for a message or a log, without empty fields."""
        found: dict[str, Any] = {"outcome": self.outcome.value, "text": self.text}
        found |= {key: text for key, text in (("gateway", self.gateway), ("held", self.held)) if text}
        if self.drives:
            found["drives"] = {name: answer.as_json() for name, answer in self.drives.items()}
        return found


class CommandRequest(NamedTuple):
    """One command to one drive: a verb with its options, or a register and the value to write.

    The sender chooses a new `id` for each command, so that copies of a message are recognised.
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
        """Return the entry of `[fleet.may]` that allows this command, such as "pump.start"."""
        return f"{self.drive}.{self.verb or self.register}"

    @property
    def words(self) -> str:
        if self.register:
            return f"{self.entry} = {self.value}"
        options = ", ".join(f"{name} = {value}" for name, value in self.options.items())
        return f"{self.entry}({options})"


class StopRequest(NamedTuple):
    """A stop of some drives of a line; of all its drives if `drives` is None. Each stop has its own `id`."""

    id: str
    by: str
    drives: tuple[str, ...] | None


class Offered(NamedTuple):
    """A gateway's offer to carry out a checked command once, if the sender returns its token soon."""

    token: str
    subject: str  # the subject to which the sender returns the token
    text: str  # what the gateway will do, as a sentence
    gateway: str


def encode(message: NamedTuple) -> bytes:
    return json.dumps(message._asdict(), separators=(",", ":")).encode()


def read_json(data: bytes) -> dict[str, Any]:
    """Return the JSON object in a message. Raises ValueError if the message has none."""
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
    """Return the command in a message. Raises ValueError with one sentence."""
    found = read_json(data)
    id, by, drive = (_text(found, key) for key in ("id", "by", "drive"))
    verb, register = (_text(found, key, is_needed=False) for key in ("verb", "register"))
    if bool(verb) == bool(register):
        raise ValueError("a command must have either a verb or a register")
    options = found.get("options", {})
    if not isinstance(options, dict):
        raise ValueError("options must be a JSON object")
    if verb:
        return CommandRequest(id, by, drive, verb=verb, options=options)
    return CommandRequest(id, by, drive, register=register, value=_value(found))


def read_stop(data: bytes) -> tuple[StopRequest, str]:
    """Return the stop in a message, and a sentence about damage in the message ("" if it is intact).

    A damaged message stops all drives of the line: stopping too many drives does less harm than stopping
    none. Names are made printable; a missing id is "".
    """
    try:
        found = read_json(data)
    except ValueError as mistake:
        return StopRequest("", UNNAMED, None), str(mistake)
    request = StopRequest(spelt(found.get("id")), spelt(found.get("by")) or UNNAMED, None)
    drives = found.get("drives")
    if isinstance(drives, str):
        drives = [drives]
    if isinstance(drives, list) and drives and all(isinstance(name, str) for name in drives):
        return request._replace(drives=tuple(drives)), ""
    return request, "" if drives is None else "drives is neither a list of names nor null"


def spelt(given: object) -> str:
    r"""Convert a received name to printable text, such as `\x1b` for an escape character."""
    text = str(given) if isinstance(given, (str, int, float)) else ""
    return (text if text.isprintable() else repr(text)[1:-1]).strip()[:MOST_CHARACTERS]


def _text(found: Mapping[str, Any], key: str, *, is_needed: bool = True) -> str:
    text = found.get(key, "")
    if not isinstance(text, str) or len(text) > MOST_CHARACTERS or not text.isprintable():
        raise ValueError(f"{key} must be text of at most {MOST_CHARACTERS} printable characters")
    if is_needed and not text.strip():
        raise ValueError(f"{key} is missing")
    return text


def _value(found: Mapping[str, Any]) -> float | str:
    value = found.get("value")
    if isinstance(value, str):
        return _text(found, "value")
    if not is_number(value) or not abs(value) <= float_info.max:
        raise ValueError("value is missing, or is neither a number nor a text")
    return value


def read_offer(data: bytes) -> Offered | CommandAnswer:
    """Return a gateway's offer, or its answer if it refuses. Raises ValueError for an invalid message."""
    found = read_json(data)
    if "token" not in found:
        return read_answer(data)
    return Offered(*(_long_text(found, key) for key in Offered._fields))


def read_answer(data: bytes) -> CommandAnswer:
    return _answer(read_json(data))


def _answer(found: Any) -> CommandAnswer:
    if not isinstance(found, dict):
        raise ValueError("an answer must be a JSON object")
    drives = found.get("drives", {})
    if not isinstance(drives, dict):
        raise ValueError("`drives` of an answer must be a JSON object")
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
        raise ValueError(f"{key} of an answer must be text")
    return text


def worst(answers: Sequence[CommandAnswer]) -> CommandOutcome:
    """Return the most serious outcome among these answers."""
    order = (
        CommandOutcome.UNKNOWN,
        CommandOutcome.NOT_SENT,
        CommandOutcome.REFUSED,
        CommandOutcome.FAILED,
        CommandOutcome.UNDER_WAY,
        CommandOutcome.DONE,
    )
    return min((answer.outcome for answer in answers), key=order.index, default=CommandOutcome.REFUSED)
