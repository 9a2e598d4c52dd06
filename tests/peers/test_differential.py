"""Compare the decoding of random frames, valid and damaged, with libmodbus and pymodbus. Each known
difference has a rule.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from judges import (
    BITS,
    COIL_VALUES,
    ECHOES,
    FUNCTIONS,
    MOST,
    READS,
    UNKNOWN_CODE,
    Libmodbus,
    Pymodbus,
    SampleFrame,
    Understood,
    Verdict,
    data_bytes,
    expected,
    frames,
    request_body,
)

from multidrop.core import (
    FrameFault,
    Framing,
    Message,
    build_reply,
    build_request,
    parse_reply,
    parse_request,
)

LIBMODBUS, PYMODBUS_RTU, PYMODBUS_ASCII = "libmodbus", "pymodbus rtu", "pymodbus ascii"
PYMODBUS = (PYMODBUS_RTU, PYMODBUS_ASCII)
ALL = (LIBMODBUS, *PYMODBUS)


def count_of(said: SampleFrame) -> int:
    return int.from_bytes(said.body[4:6])


def start_of(said: SampleFrame) -> int:
    return int.from_bytes(said.body[2:4])


def contradicts_itself(said: SampleFrame) -> bool:
    """Return True for a multiple write whose byte count does not match its register count or is too large."""
    function, count = said.function, count_of(said)
    return function in (0x0F, 0x10) and (
        said.octet(6) != data_bytes(function, count) or count > MOST[function]
    )


def has_other_length(said: SampleFrame, length: int) -> bool:
    return len(said.body) != length


def request_length(said: SampleFrame) -> int:
    return 7 + said.octet(6) if said.function in (0x0F, 0x10) else 6


def reply_length(said: SampleFrame) -> int:
    if said.function & 0x80:
        return 3
    return 3 + said.octet(2) if said.function in READS else 6


def is_lower_case(said: SampleFrame) -> bool:
    return said.frame != said.frame.upper()


def is_to_another_function(said: SampleFrame) -> bool:
    return said.function & 0x7F != said.request.function


def confirms_another_write(said: SampleFrame) -> bool:
    is_write = said.function in (*ECHOES, 0x0F, 0x10)
    return is_write and said.body[2:6] != request_body(said.request)[2:6]


def has_other_data(said: SampleFrame) -> bool:
    asked = data_bytes(said.request.function, said.request.count)
    return said.function in READS and said.octet(2) != asked


@dataclass(frozen=True)
class Rule:
    """A known difference from another library: stricter (only multidrop rejects the frame), looser (only the
    other library rejects it), or otherwise (both decode it, differently).
    """

    kind: str
    judges: tuple[str, ...]
    when: Callable[[SampleFrame], bool]
    reason: str


REQUESTS = [
    Rule(
        "stricter",
        ALL,
        contradicts_itself,
        "the frame contradicts itself, and what its sender meant is not known: they answer with exception "
        "03, or carry out a part of it",
    ),
    Rule(
        "stricter",
        (LIBMODBUS,),
        lambda said: said.function not in FUNCTIONS or len(said.body) == 2,
        "it gives unknown functions a length of its own, and answers with exception 01; what has no known "
        "length cannot be told from noise",
    ),
    Rule(
        "stricter",
        PYMODBUS,
        lambda said: bool(said.function & 0x80),
        "another drive's exception reply, heard on the same line, is no request",
    ),
    Rule(
        "stricter",
        (PYMODBUS_ASCII,),
        is_lower_case,
        "the serial-line guide V1.02 (2.5.2) has the digits 0-9 and A-F, and a flipped bit makes A an a",
    ),
    Rule(
        "stricter",
        (PYMODBUS_ASCII,),
        lambda said: said.function not in FUNCTIONS,
        "no drive of ours has the function, so that we know no length of it",
    ),
    Rule(
        "stricter",
        (PYMODBUS_ASCII,),
        lambda said: has_other_length(said, request_length(said)),
        "the text is longer or shorter than its message: an eight-bit checksum overlooks one damage in 256, "
        "the length finds it",
    ),
    Rule(
        "looser",
        (LIBMODBUS,),
        lambda said: said.function == 0x08,
        "it has no 08, which ERMAN's drives answer",
    ),
    Rule(
        "looser",
        (LIBMODBUS,),
        lambda said: said.octet(0) > 247,
        "its server cannot have such an address; a parser says what is there, and no drive of ours answers",
    ),
    Rule(
        "looser",
        PYMODBUS,
        lambda said: said.function in READS and not 1 <= count_of(said) <= MOST[said.function],
        "a count that cannot be answered is a good frame: the drive answers it with exception 03",
    ),
    Rule(
        "looser",
        (PYMODBUS_RTU,),
        lambda said: said.function == 0x08 and start_of(said) != 0,
        "a subfunction that it does not know; the drive's side answers it with an exception",
    ),
    Rule(
        "other meaning",
        PYMODBUS,
        lambda said: said.function == 0x05 and said.body[4:6] not in COIL_VALUES,
        "it takes every value but 0 for ON; ours goes to the drive's side as it is, which refuses it",
    ),
]
REPLIES = [
    Rule(
        "stricter",
        ALL,
        confirms_another_write,
        "a write confirmed with another address or value was not carried out as it was meant",
    ),
    Rule(
        "stricter",
        ALL,
        lambda said: bool(said.function & 0x80) and said.octet(2) == 0,
        "there is no exception 00",
    ),
    Rule(
        "stricter",
        PYMODBUS,
        is_to_another_function,
        "an answer to another function is a late one, or damaged",
    ),
    Rule(
        "stricter",
        PYMODBUS,
        has_other_data,
        "more or fewer data than were asked for are not the registers that were asked for",
    ),
    Rule("stricter", (PYMODBUS_ASCII,), is_lower_case, "as in requests"),
    Rule(
        "stricter",
        (PYMODBUS_ASCII,),
        lambda said: has_other_length(said, reply_length(said)),
        "as in requests",
    ),
    Rule(
        "looser",
        (LIBMODBUS,),
        lambda said: said.octet(2) > 0x0B,
        "makes have codes of their own, such as CHE's 12H; it says only that the code is none of its own",
    ),
    Rule(
        "other meaning",
        PYMODBUS,
        lambda said: said.request.function == 0x08 and said.function == 0x89,
        "ERMAN's document (section 8) prints 89H for an exception to 08, where 88H was meant",
    ),
]


@dataclass(frozen=True)
class Difference:
    said: SampleFrame
    ours: Understood | Verdict
    theirs: Understood | Verdict

    @property
    def kind(self) -> str:
        if isinstance(self.ours, str):
            return "stricter"
        return "looser" if isinstance(self.theirs, str) else "other meaning"


def explain(differences: Iterable[Difference], rules: list[Rule], judge: str) -> None:
    """Fail unless a rule explains every difference, and every rule explains a difference."""
    rules = [rule for rule in rules if judge in rule.judges]
    stale = list(rules)
    for difference in differences:
        found = next(
            (rule for rule in rules if rule.kind == difference.kind and rule.when(difference.said)), None
        )
        assert found is not None, f"{judge} differs without a rule ({difference.kind}): {difference}"
        if found in stale:
            stale.remove(found)
    assert not stale, f"{judge} does not differ any more: {[rule.reason for rule in stale]}"


def compare(said: SampleFrame, ours: Understood | Verdict, theirs: Understood | Verdict) -> list[Difference]:
    """Return the differences: none if both reject the frame, or both decode it identically."""
    if (isinstance(ours, str) and isinstance(theirs, str)) or ours == theirs:
        return []
    return [Difference(said, ours, theirs)]


NUMBER = 3000  # frames in each comparison
RTU, ASCII = Framing.RTU, Framing.ASCII
framings = pytest.mark.parametrize("framing", [RTU, ASCII], ids=str)


def received(said: SampleFrame) -> tuple[int, Verdict]:
    used, message = parse_request(said.framing, said.frame)
    return used, FrameFault(used).name if message is None else trimmed(message)


def answered(said: SampleFrame) -> Verdict:
    used, message = parse_reply(said.framing, said.frame, said.request)
    return FrameFault(used).name if message is None else trimmed(message)


def trimmed(message: Message) -> Message:
    """Return the message without the padding bits of the last byte."""
    rest = message.count % 8
    if message.function not in BITS or not message.data or not rest:
        return message
    last = message.data[-1] & (1 << rest) - 1
    return replace(message, data=message.data[:-1] + bytes([last]))


def trim(verdict: Verdict) -> Verdict:
    return verdict if isinstance(verdict, str) else trimmed(verdict)


@pytest.fixture(scope="module")
def libmodbus(tmp_path_factory: pytest.TempPathFactory) -> Libmodbus:
    built: Path = tmp_path_factory.mktemp("libmodbus")
    return Libmodbus(built)


@pytest.mark.long
def test_every_request_is_decoded_as_by_a_libmodbus_server(libmodbus: Libmodbus) -> None:
    """Check that the server's replies and registers match our decoding of each request."""
    requests = frames(1, RTU, NUMBER, replies=False)
    differences = []
    answers = 0
    for said, theirs in zip(requests, libmodbus.hear(requests), strict=True):
        used, message = received(said)
        ours = message if isinstance(message, str) else expected(used, message)
        if isinstance(theirs, Understood) and isinstance(message, Message) and theirs.reply:
            used, _ = parse_reply(RTU, theirs.reply, message)
            assert used == len(theirs.reply), said  # multidrop accepts libmodbus's reply
            theirs = replace(theirs, reply=theirs.reply[1:-2])
            answers += 1
        differences += compare(said, ours, theirs)
    explain(differences, REQUESTS, LIBMODBUS)
    assert answers > NUMBER / 3


@pytest.mark.long
def test_requests_and_decoded_replies_equal_those_of_a_libmodbus_client(libmodbus: Libmodbus) -> None:
    replies = [frame for frame in frames(2, RTU, NUMBER, replies=True) if frame.request.function != 0x08]
    differences = []
    values = 0
    for said, (request, theirs) in zip(replies, libmodbus.ask(replies), strict=True):
        assert request == build_request(RTU, said.request)
        differences += compare(said, answered(said), theirs)
        values += isinstance(theirs, Message)
    explain(differences, REPLIES, LIBMODBUS)
    assert values > NUMBER / 3
    assert any(difference.theirs == UNKNOWN_CODE for difference in differences)


def name(framing: Framing) -> str:
    return {RTU: PYMODBUS_RTU, ASCII: PYMODBUS_ASCII}[framing]


@pytest.mark.long
@framings
def test_every_request_is_decoded_as_by_a_pymodbus_server(framing: Framing) -> None:
    pymodbus = Pymodbus(framing)
    differences = []
    for said in frames(3, framing, NUMBER, replies=False):
        assert pymodbus.build_request(said.request) == build_request(framing, said.request)
        differences += compare(said, received(said)[1], trim(pymodbus.hear(said)))
    explain(differences, REQUESTS, name(framing))


@pytest.mark.long
@framings
def test_every_reply_is_decoded_as_by_a_pymodbus_client(framing: Framing) -> None:
    pymodbus = Pymodbus(framing)
    differences = []
    for said in frames(4, framing, NUMBER, replies=True):
        differences += compare(said, answered(said), trim(pymodbus.ask(said)))
    explain(differences, REPLIES, name(framing))


@pytest.mark.slow
@framings
def test_every_reply_is_encoded_as_by_pymodbus(framing: Framing) -> None:
    pymodbus = Pymodbus(framing)
    whole = [frame for frame in frames(5, framing, NUMBER, replies=True) if not frame.damage]
    for said in whole:
        used, reply = parse_reply(framing, said.frame, said.request)
        assert reply is not None, said
        assert used == len(said.frame)
        assert pymodbus.build_reply(reply) == build_reply(framing, reply) == said.frame
    assert len(whole) > NUMBER / 4
