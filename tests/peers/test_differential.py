"""Random frames, whole and damaged: libmodbus and pymodbus agree with us on them, or a rule says why not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from damage import BITS, Said, frames
from differences import LIBMODBUS, PYMODBUS_ASCII, PYMODBUS_RTU, REPLIES, REQUESTS, compare, explain
from judges import UNKNOWN_CODE, Libmodbus, Pymodbus, Understood, Verdict, expected

from multidrop.core import (
    FrameFault,
    Framing,
    Message,
    build_reply,
    build_request,
    parse_reply,
    parse_request,
)

NUMBER = 3000  # of frames in each comparison
RTU, ASCII = Framing.RTU, Framing.ASCII
framings = pytest.mark.parametrize("framing", [RTU, ASCII], ids=str)

# ---- what we say ----


def received(said: Said) -> tuple[int, Verdict]:
    used, message = parse_request(said.framing, said.frame)
    return used, FrameFault(used).name if message is None else trimmed(message)


def answered(said: Said) -> Verdict:
    used, message = parse_reply(said.framing, said.frame, said.request)
    return FrameFault(used).name if message is None else trimmed(message)


def trimmed(message: Message) -> Message:
    """Without the bits that fill the last byte up: nobody is told them."""
    rest = message.count % 8
    if message.function not in BITS or not message.data or not rest:
        return message
    last = message.data[-1] & (1 << rest) - 1
    return replace(message, data=message.data[:-1] + bytes([last]))


def trim(verdict: Verdict) -> Verdict:
    return verdict if isinstance(verdict, str) else trimmed(verdict)


# ---- libmodbus ----


@pytest.fixture(scope="module")
def libmodbus(tmp_path_factory: pytest.TempPathFactory) -> Libmodbus:
    built: Path = tmp_path_factory.mktemp("libmodbus")
    return Libmodbus(built)


@pytest.mark.long
def test_requests_as_libmodbus_s_server_understands_them(libmodbus: Libmodbus) -> None:
    """It answers, and changes its registers, as our reading of the request demands."""
    requests = frames(1, RTU, NUMBER, replies=False)
    differences = []
    answers = 0
    for said, theirs in zip(requests, libmodbus.hear(requests), strict=True):
        used, message = received(said)
        ours = message if isinstance(message, str) else expected(used, message)
        if isinstance(theirs, Understood) and isinstance(message, Message) and theirs.reply:
            used, _ = parse_reply(RTU, theirs.reply, message)
            assert used == len(theirs.reply), said  # what it encodes, we take
            theirs = replace(theirs, reply=theirs.reply[1:-2])
            answers += 1
        differences += compare(said, ours, theirs)
    explain(differences, REQUESTS, LIBMODBUS)
    assert answers > NUMBER / 3


@pytest.mark.long
def test_requests_and_replies_as_libmodbus_s_client_has_them(libmodbus: Libmodbus) -> None:
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


# ---- pymodbus ----


def name(framing: Framing) -> str:
    return {RTU: PYMODBUS_RTU, ASCII: PYMODBUS_ASCII}[framing]


@pytest.mark.long
@framings
def test_requests_as_pymodbus_s_server_understands_them(framing: Framing) -> None:
    pymodbus = Pymodbus(framing)
    differences = []
    for said in frames(3, framing, NUMBER, replies=False):
        assert pymodbus.build_request(said.request) == build_request(framing, said.request)
        differences += compare(said, received(said)[1], trim(pymodbus.hear(said)))
    explain(differences, REQUESTS, name(framing))


@pytest.mark.long
@framings
def test_replies_as_pymodbus_s_client_understands_them(framing: Framing) -> None:
    pymodbus = Pymodbus(framing)
    differences = []
    for said in frames(4, framing, NUMBER, replies=True):
        differences += compare(said, answered(said), trim(pymodbus.ask(said)))
    explain(differences, REPLIES, name(framing))


@pytest.mark.slow
@framings
def test_replies_that_pymodbus_encodes_are_ours_byte_by_byte(framing: Framing) -> None:
    pymodbus = Pymodbus(framing)
    whole = [frame for frame in frames(5, framing, NUMBER, replies=True) if not frame.damage]
    for said in whole:
        used, reply = parse_reply(framing, said.frame, said.request)
        assert reply is not None, said
        assert used == len(said.frame)
        assert pymodbus.build_reply(reply) == build_reply(framing, reply) == said.frame
    assert len(whole) > NUMBER / 4
