"""Ports for Modbus tools, on fake lines: which requests are answered, when, and which writes are refused."""

from __future__ import annotations

import asyncio
import errno
import os
import random
import socket
import time
from collections.abc import Awaitable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import checksums
import pytest
from lines import until
from modbus_gateway import FakeCommands, FakeHub, FakeLine, in_thread, plant_of
from ptys import PATIENCE, opened, receive
from tables import table

from multidrop import (
    BadReply,
    CancelledByStop,
    DriveException,
    Expired,
    NoReply,
    NotMaster,
    Plant,
    PlantError,
    WriteForbidden,
)
from multidrop.control import CommandOutcome, CommandResult
from multidrop.errors import PortLost
from multidrop.families import DelixiNative, InnovertIBD, InvtCHE
from multidrop.gateway.http.rights import NOT_LISTED, Right
from multidrop.gateway.modbus_server import tool_ports
from multidrop.gateway.modbus_server.protocol import MbapRequest
from multidrop.gateway.modbus_server.tool_connections import MOST_FRAME, RequestCutter, Terminal, rtu_reply
from multidrop.gateway.modbus_server.tool_ports import MOST_SHARE, Tool, ToolPorts, ToolSettings
from multidrop.gateway.settings import read_settings

SETPOINT, CONTROL, START, STOP = 0x2000, 0x1000, 1, 5  # CHE100 manual v1.4, p. 117
TIMEOUT = 10.0  # s; long, so that every answer of a drive is in time even on a busy machine
QUIET = 0.1  # s; if no byte arrives for so long, there is no reply


class Rig(NamedTuple):
    ports: ToolPorts
    hub: FakeHub
    commands: FakeCommands
    line: FakeLine
    link: Path


@contextmanager
def serving(folder: Path, *, ask: Any = None, **settings: Any) -> Iterator[Rig]:
    """Run the tool port of a line with three drives, as a pseudo-terminal and as a TCP port."""
    plant = plant_of(
        ("hall", InvtCHE(1, name="mill")),
        ("hall", InnovertIBD(3, name="pump")),
        ("hall", DelixiNative(4, name="belt")),
    )
    hub, commands, line = FakeHub(), FakeCommands(), FakeLine()
    known = ToolSettings(
        **{"pty": {"hall": "port"}, "rtu": {"hall": "127.0.0.1:0"}, "timeout": TIMEOUT, **settings}
    )
    fakes: Any = plant, hub, commands
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tool_ports, "utilisation_of", lambda plant, line: 0.0)
        with in_thread(lambda: ToolPorts(*fakes, known, ask or line.ask, folder)) as ports:
            until(lambda: ports.lines and ports.lines["hall"].share.share == MOST_SHARE)
            yield Rig(ports, hub, commands, line, folder / "port")


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with serving(tmp_path, may="write") as made:
        yield made


@pytest.fixture(params=["pty", "tcp"])
def tool(request: pytest.FixtureRequest, rig: Rig) -> Iterator[int]:
    """Yield a file descriptor of the tool port, as a Modbus tool opens it."""
    where = str(rig.link) if request.param == "pty" else f"socket://127.0.0.1:{rig.ports.ports['hall']}"
    with opened(where) as fd:
        yield fd


def reply_to(tool: int, patience: float) -> bytes:
    """Return the next reply without its checksum, or b"" if none arrives within `patience` s."""
    reply = receive(tool, 5, patience)
    while reply and checksums.rtu(reply[:-2]) != reply:
        more = receive(tool, 1, patience)
        assert more, reply.hex(" ")
        reply += more
    return reply[:-2]


def ask(tool: int, body: str) -> bytes:
    """Send a request, and return its reply without the checksum."""
    os.write(tool, checksums.rtu(body))
    reply = reply_to(tool, PATIENCE)
    assert reply
    return reply


def is_unanswered(tool: int, body: str) -> bool:
    """Send a request, and return True if no reply arrives."""
    os.write(tool, checksums.rtu(body))
    return reply_to(tool, QUIET) == b""


def code(tool: int, body: str) -> int | None:
    """Send a request, and return the exception code of the reply; None for a normal reply."""
    reply = ask(tool, body)
    return reply[2] if reply[1] & 0x80 else None


def test_a_read_by_each_modbus_function_gets_the_drives_reply(rig: Rig, tool: int) -> None:
    assert ask(tool, "01 03 00 10 00 02") == bytes.fromhex("01 03 04 0010 0011")
    assert ask(tool, "01 04 70 00 00 01") == bytes.fromhex("01 04 02 7000")  # undeclared
    assert ask(tool, "01 01 00 01 00 0A") == bytes.fromhex("01 01 02 5501")
    assert rig.line.asked == [("mill", 3, 16, 2), ("mill", 4, 0x7000, 1), ("mill", 1, 1, 10)]


def test_a_tool_can_read_the_status_and_the_identification_of_a_drive(rig: Rig, tool: int) -> None:
    assert ask(tool, "01 07") == bytes.fromhex("01 07 2A")
    assert ask(tool, "01 11") == bytes.fromhex("01 11 01 2A")  # this reply states its length
    assert ask(tool, "01 2B 0E 01 00") == bytes.fromhex("01 2B 2A")
    assert rig.line.asked == [("mill", 0x07, 0, 0), ("mill", 0x11, 0, 0), ("mill", 0x2B, 0x0100, 0)]


def test_a_failed_read_of_a_modbus_tool_gets_no_reply_or_an_exception(rig: Rig) -> None:
    with opened(str(rig.link)) as tool:
        for failure, answer in (
            (DriveException("mill", 0x12, "write not allowed"), 0x12),
            (ValueError("count"), 3),
            (Expired("mill", "a read", 1.0), 6),
            (CancelledByStop("mill", "a read", "a stop was called"), 6),
            (NoReply("mill"), None),
            (BadReply("mill", "damaged", b"\1"), None),
            (PortLost("/dev/hall", "unplugged"), None),
            (NotMaster("mill", "/dev/hall"), None),
        ):
            rig.line.failure = failure
            if answer is None:
                assert is_unanswered(tool, "01 03 00 10 00 02"), failure
            else:
                assert code(tool, "01 03 00 10 00 02") == answer


def test_a_modbus_tool_gets_no_answer_from_unknown_or_silent_drives(rig: Rig, tool: int) -> None:
    assert is_unanswered(tool, "02 03 00 10 00 02")
    assert is_unanswered(tool, "00 06 20 00 00 00")
    rig.hub.states["mill"] = "silent"
    assert is_unanswered(tool, "01 03 00 10 00 02")
    assert rig.commands.refused[0][0] == "all"
    assert rig.line.asked == []
    assert rig.commands.stopped == []


def test_a_modbus_tool_gets_exception_01_for_unsupported_requests(rig: Rig, tool: int) -> None:
    assert code(tool, "04 03 00 10 00 02") == 1
    assert code(tool, "01 41 01 02 03") == 1
    assert code(tool, "01 08 00 04 00 00") == 1  # "force listen only mode", which would silence a drive
    assert rig.line.asked == []


def test_later_requests_of_a_modbus_tool_are_answered_after_an_internal_error(
    rig: Rig, tool: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    serve = rig.ports.lines["hall"].serve
    failures = [ZeroDivisionError("a bug")]

    def fail_once(request: MbapRequest, tool: Tool) -> Awaitable[bytes | None] | None:
        if failures:
            raise failures.pop()
        return serve(request, tool)

    monkeypatch.setattr(rig.ports.lines["hall"], "serve", fail_once)
    os.write(tool, checksums.rtu("01 03 00 10 00 01") + checksums.rtu("01 03 00 11 00 01"))
    assert reply_to(tool, PATIENCE) == bytes.fromhex("01 03 02 0011")
    assert "ZeroDivisionError: a bug" in caplog.text
    assert ask(tool, "01 03 00 10 00 01") == bytes.fromhex("01 03 02 0010")


def test_only_the_newest_pending_request_of_a_modbus_tool_is_answered(rig: Rig, tool: int) -> None:
    rig.line.seconds = 0.05
    requests = [checksums.rtu(f"01 03 00 {at:02X} 00 01") for at in (1, 2, 3)]
    os.write(tool, b"".join(requests))
    assert receive(tool, 7) == checksums.rtu("01 03 02 0003")
    assert receive(tool, 1, QUIET) == b""


@pytest.mark.long
def test_a_modbus_tool_gets_no_reply_after_the_timeout_of_its_port(tmp_path: Path) -> None:
    with serving(tmp_path, timeout=0.05) as rig, opened(str(rig.link)) as tool:
        rig.ports.lines["hall"].share.share = 100.0  # no pauses
        rig.line.seconds = 0.2
        os.write(tool, checksums.rtu("01 03 00 01 00 01"))
        until(lambda: rig.line.asked)
        assert receive(tool, 1, 0.4) == b""
        rig.line.seconds = 0.0
        while len(rig.line.asked) < 2:  # repeat it: under load, the gateway may answer "busy"
            os.write(tool, checksums.rtu("01 03 00 02 00 01"))
            time.sleep(0.05)
        time.sleep(0.2)  # longer than the port's timeout
        assert receive(tool, 1, QUIET) == b""


@pytest.mark.long
def test_a_pc_tool_that_exceeds_its_share_of_bus_time_gets_exception_06(tmp_path: Path) -> None:
    with serving(tmp_path, timeout=1.0) as rig, opened(str(rig.link)) as tool:
        rig.ports.lines["hall"].share.share = 0.01
        rig.line.seconds = 0.06
        found = [code(tool, "01 03 00 01 00 01") for _ in range(5)]
        assert {*found} == {None, 6}
        assert len(rig.line.asked) == found.count(None)


def test_eight_flooding_modbus_tools_have_one_request_on_the_line_at_a_time(tmp_path: Path) -> None:
    """A stop therefore waits for at most one request of a Modbus tool."""
    under_way = most = 0

    async def ask(drive: str, function: int, start: int, count: int, expiry: float) -> list[int]:
        nonlocal under_way, most
        under_way += 1
        most = max(most, under_way)
        await asyncio.sleep(0.001)
        under_way -= 1
        return [start] * count

    with serving(tmp_path, ask=ask) as rig, ExitStack() as stack:
        rig.ports.lines["hall"].share.share = 100.0  # no pauses
        port = rig.ports.ports["hall"]
        tools = [stack.enter_context(opened(f"socket://127.0.0.1:{port}")) for _ in range(8)]
        for start in range(30):
            for tool in tools:
                os.write(tool, checksums.rtu(f"01 03 00 {start:02X} 00 01"))
            for tool in tools:
                assert reply_to(tool, PATIENCE) == bytes.fromhex(f"01 03 02 00 {start:02X}")
    assert most == 1


@pytest.mark.slow
def test_a_modbus_tool_with_random_timeouts_gets_only_replies_to_its_last_request(tmp_path: Path) -> None:
    chance, answered = random.Random(43), 0

    async def ask(drive: str, function: int, start: int, count: int, expiry: float) -> list[int]:
        await asyncio.sleep(chance.random() * 0.08)
        return [start]

    with serving(tmp_path, ask=ask, timeout=0.06) as rig, opened(str(rig.link)) as tool:
        rig.ports.lines["hall"].share.share = 100.0  # no pauses
        for start in range(128):
            os.write(tool, checksums.rtu(f"01 03 00 {start:02X} 00 01"))
            reply = reply_to(tool, 0.07 + chance.random() * 0.05)
            assert reply in (b"", bytes.fromhex(f"01 03 02 00 {start:02X}"), bytes.fromhex("01 83 06"))
            answered += len(reply) == 5
    assert answered > 20


def test_serial_settings_made_by_a_modbus_tool_have_no_effect(rig: Rig) -> None:
    import termios

    with opened(str(rig.link)) as tool:
        attributes = termios.tcgetattr(tool)
        attributes[1] |= termios.OPOST
        attributes[3] |= termios.ECHO | termios.ICANON
        attributes[4] = attributes[5] = termios.B1200
        termios.tcsetattr(tool, termios.TCSANOW, attributes)
        os.write(tool, checksums.rtu("01 06 20 00 0A 0A"))  # 0A is a line feed, which a terminal could change
        assert receive(tool, 8) == checksums.rtu("01 06 20 00 0A 0A")
        assert receive(tool, 1, QUIET) == b""
    assert len(rig.commands.written) == 1


def test_writes_of_modbus_tools_are_refused_and_recorded_by_default(tmp_path: Path) -> None:
    with serving(tmp_path) as rig, opened(str(rig.link)) as tool:
        for body in (
            f"01 06 {CONTROL:04X} {START:04X}",
            f"01 06 {CONTROL:04X} {STOP:04X}",
            f"01 06 {SETPOINT:04X} 1388",
            f"01 10 {SETPOINT:04X} 0001 02 1388",
            "01 05 0000 FF00",
            "01 0F 0000 0001 01 01",
        ):
            assert code(tool, body) == 1
        assert rig.commands.written == rig.commands.stopped == []
        why = "answered with exception 01H"
        assert rig.commands.refused[0] == ("mill", "request 01 06 10 00 00 01", why)
        assert len(rig.commands.refused) < 6  # at most one record a second


def test_a_modbus_tool_can_write_a_setpoint_but_not_start_a_drive(rig: Rig, tool: int) -> None:
    assert code(tool, f"01 06 {SETPOINT:04X} 1388") is None
    drive, register, value, caller = rig.commands.written[0]
    assert (drive, register, value) == ("mill", "setpoint", 50.0)
    assert (caller.way, caller.role) == ("tool", Right.WRITE)
    assert code(tool, f"01 06 {CONTROL:04X} {START:04X}") == 3
    assert code(tool, f"01 06 {CONTROL:04X} {STOP:04X}") is None
    assert code(tool, f"01 06 {CONTROL:04X} 0007") == 3  # fault reset
    assert [drives for drives, _ in rig.commands.stopped] == [["mill"]]
    assert len(rig.commands.written) == 1


def test_each_stop_of_a_modbus_tool_is_sent_although_reads_follow(rig: Rig, tool: int) -> None:
    stop, read = checksums.rtu(f"01 06 {CONTROL:04X} {STOP:04X}"), checksums.rtu("01 03 00 01 00 01")
    os.write(tool, stop + read + stop + read)
    assert receive(tool, 7) == checksums.rtu("01 03 02 0001")
    assert len(rig.commands.stopped) == 2


def test_the_request_after_a_refused_write_gets_its_own_answer(rig: Rig, tool: int) -> None:
    os.write(tool, checksums.rtu(f"01 06 {CONTROL:04X} {START:04X}") + checksums.rtu("01 03 00 01 00 01"))
    assert receive(tool, 7) == checksums.rtu("01 03 02 0001")


def test_a_stop_right_after_an_incomplete_request_is_sent(rig: Rig, tool: int) -> None:
    os.write(tool, bytes.fromhex("01 10 0000 007B F6") + checksums.rtu(f"01 06 {CONTROL:04X} {STOP:04X}"))
    assert receive(tool, 8) == checksums.rtu(f"01 06 {CONTROL:04X} {STOP:04X}")
    assert len(rig.commands.stopped) == 1


def test_only_the_stop_in_a_write_of_several_registers_is_sent(rig: Rig, tool: int) -> None:
    assert code(tool, f"01 10 {CONTROL:04X} 0002 04 {STOP:04X} 0000") == 3
    assert len(rig.commands.stopped) == 1


def test_a_failed_write_of_a_modbus_tool_gets_an_exception_or_no_answer(rig: Rig) -> None:
    """A write is recorded as refused only if it was not sent to the drive."""
    with opened(str(rig.link)) as tool:
        for error, answer in (
            (WriteForbidden("not listed", rule=NOT_LISTED), 2),
            (DriveException("mill", 0x12, "not allowed"), 0x12),
            (NoReply("mill"), None),
        ):
            rig.commands.told = CommandResult(CommandOutcome.REFUSED, "no", error)
            if answer is None:
                assert is_unanswered(tool, f"01 06 {SETPOINT:04X} 1388"), error
            else:
                assert code(tool, f"01 06 {SETPOINT:04X} 1388") == answer
    assert [(drive, why) for drive, _, why in rig.commands.refused] == [("mill", "no")]


def test_hostile_bytes_from_a_modbus_tool_do_not_affect_the_next_tool(rig: Rig, tool: int) -> None:
    for noise in (bytes(4096), b"\xff" * 3000, bytes(range(256)) * 8, b"\x01\x10\x00"):
        with suppress(BlockingIOError):
            os.write(tool, noise)
        until(lambda: not is_unanswered(tool, "01 03 00 10 00 01"))
        assert ask(tool, "01 03 00 10 00 01") == bytes.fromhex("01 03 02 0010")
    assert {*rig.line.asked} == {("mill", 3, 16, 1)}


def test_a_ninth_modbus_tool_on_one_tcp_port_is_refused(rig: Rig) -> None:
    tools = [socket.create_connection(("127.0.0.1", rig.ports.ports["hall"])) for _ in range(9)]
    try:
        for tool in tools[:8]:
            assert ask(tool.fileno(), "01 03 00 10 00 01") == bytes.fromhex("01 03 02 0010")
        assert tools[8].recv(1) == b""
    finally:
        for tool in tools:
            tool.close()


def test_an_idle_modbus_tool_is_disconnected_when_another_one_connects(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = ("127.0.0.1", rig.ports.ports["hall"])
    with socket.create_connection(where, PATIENCE) as idle:
        assert ask(idle.fileno(), "01 03 00 10 00 01") == bytes.fromhex("01 03 02 0010")
        monkeypatch.setattr(tool_ports, "IDLE_S", 0.0)
        with socket.create_connection(where, PATIENCE):
            assert idle.recv(1) == b""


def test_a_modbus_tool_at_another_address_than_those_of_the_settings_is_refused(tmp_path: Path) -> None:
    with (
        serving(tmp_path, clients=["10.0.0.7"]) as rig,
        socket.create_connection(("127.0.0.1", rig.ports.ports["hall"]), PATIENCE) as tool,
    ):
        assert tool.recv(1) == b""


def test_a_modbus_tool_can_connect_after_a_failed_accept(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    failures: list[None] = []

    def accept() -> Any:
        failures.append(None)
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(tool_ports, "SWEEP_S", 0.2)
    with monkeypatch.context() as patch:
        patch.setattr(rig.ports._listeners["hall"], "accept", accept, raising=False)
        tool = socket.create_connection(("127.0.0.1", rig.ports.ports["hall"]))
        until(lambda: failures)
        with opened(str(rig.link)) as other:
            assert ask(other, "01 03 00 10 00 01") == bytes.fromhex("01 03 02 0010")
        # The port pauses after each failed attempt to accept the connection, so the event loop stays free.
        assert len(failures) < 10
    with tool:
        assert ask(tool.fileno(), "01 03 00 10 00 01") == bytes.fromhex("01 03 02 0010")


def test_only_a_symlink_left_by_a_killed_gateway_is_replaced(tmp_path: Path) -> None:
    link = tmp_path / "port"
    link.write_text("a file")
    with pytest.raises(OSError, match="a file of this name exists, and no gateway made it"):
        Terminal(link)
    assert link.read_text() == "a file"
    link.unlink()
    other = tmp_path / "other"
    other.symlink_to("/dev/pts/7")
    with pytest.raises(OSError, match="no gateway made it"):
        Terminal(other)
    killed = Terminal(link)
    with pytest.raises(OSError, match=f"the link {link} cannot be made: another gateway uses this link"):
        Terminal(link)
    assert killed._lock is not None
    killed._lock.close()  # the kernel also releases the lock of a killed process
    present = Terminal(link)
    killed.close()
    assert link.is_symlink()  # the link of the terminal `present`
    present.close()
    assert not link.is_symlink()
    with pytest.raises(OSError, match="No such file or directory"):
        Terminal(tmp_path / "missing" / "port")


@table(
    ("text", "sentence"),
    [
        ('may = "look"', "pty and rtu are empty"),
        ('pty = { hal = "p" }', "pty: there is no line 'hal'; did you mean hall?"),
        ('pty = { belt = "p" }', "pty: all drives of line belt speak Delixi's own protocol"),
        ('pty = { hall = "p", belt = "p" }', "pty: belt = 'p' is in use by hall"),
        ("pty = { hall = 7 }", "pty: hall = 7 is not a text"),
        (
            'rtu = { hall = "4001" }',
            '"4001" is not an address and port; write rtu = { hall = "127.0.0.1:4001" }',
        ),
        ('rtu = { hall = "0.0.0.0:4001" }', "is open to other machines"),
        ('pty = { hall = "p" }\nmay = "root"', "may = 'root' is not one of look, stop, write"),
        ('pty = { hall = "p" }\ntimeout = 60', "timeout = 60 is not from 0.05 to 10 s"),
        ('pty = { hall = "p" }\nclients = ["here"]', "clients: 'here' is neither an address nor a network"),
        ('pty = { hall = "p" }\nbaud = 9600', "baud"),
    ],
)
def test_each_mistake_in_the_settings_for_pc_tools_is_reported(
    text: str, sentence: str, tmp_path: Path
) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(f"[serve.tool]\n{text}\n" + LINES)
    with pytest.raises(PlantError) as wrong:
        read_settings(Plant.load(path), {})
    (mistake,) = wrong.value.mistakes
    assert "[serve.tool]" in mistake
    assert sentence in mistake


def test_an_error_says_that_windows_has_no_ports_for_pc_tools(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows' event loop has no `add_reader`, which tool ports need."""
    monkeypatch.setattr("multidrop.gateway.modbus_server.tool_ports.sys.platform", "win32")
    with pytest.raises(ValueError, match=r"^Windows has no tool ports, because [^\n]*; use Linux$"):
        ToolSettings(rtu={"hall": "127.0.0.1:4001"})


LINES = """
[[line]]
name = "hall"
port = "/dev/ttyUSB0"
[[line.drive]]
name = "mill"
model = "invt-che"
address = 1
[[line]]
name = "belt"
port = "/dev/ttyUSB1"
[[line.drive]]
name = "belt-1"
model = "delixi-native"
address = 1
"""


# ---- requests are cut out of a tool's bytes by length and checksum, whatever else the tool sends ----


# Frames printed in manuals: ERMAN ER-G-220 1.7, INVT CHE100 p. 122, INNOVERT IBD part 9. The last two are
# examples of the Modbus application protocol V1.1b3 (6.13 and 6.21), with separately computed checksums.
FRAMES = [
    bytes.fromhex(text)
    for text in (
        "01 01 00 00 00 0C 3C 0F",
        "01 03 00 01 00 04 15 C9",
        "01 05 00 00 FF 00 8C 3A",
        "01 0F 00 00 00 09 02 01 01 25 2C",
        "01 10 00 0C 00 02 04 00 C8 01 90 73 F8",
        "02 06 00 08 13 88 05 6D",
        "01 06 20 00 00 01 43 CA",
    )
]
REPORT_ID, READ_IDENTITY = (checksums.rtu(bytes.fromhex(text)) for text in ("01 11", "01 2B 0E 01 00"))
VENDORS_OWN = checksums.rtu(bytes.fromhex("01 41 01 02 03 04 05"))
EVERY_FRAME = [*FRAMES, REPORT_ID, READ_IDENTITY]


def taken(cutter: RequestCutter) -> list[bytes]:
    """Take all requests from the cutter; return them as frames. Another function computes the checksums."""
    found: list[bytes] = []
    while (request := cutter.take()) is not None:
        found.append(checksums.rtu(bytes([request.unit, request.function]) + request.data))
    return found


def cut(*pieces: bytes) -> list[bytes]:
    cutter, found = RequestCutter(), []
    for piece in pieces:
        cutter.add(piece)
        found += taken(cutter)
    return found


@table("frame", [*EVERY_FRAME, VENDORS_OWN])
def test_a_modbus_request_is_recognised_if_it_arrives_byte_by_byte(frame: bytes) -> None:
    assert cut(frame) == [frame]
    assert cut(*(frame[at : at + 1] for at in range(len(frame)))) == [frame]


def test_pipelined_requests_are_recognised_in_their_order() -> None:
    assert cut(b"".join(EVERY_FRAME)) == EVERY_FRAME


@table("noise", [b"\0", b"\x01\x03\x00", b"\xff\xff\xff", FRAMES[1][:-1] + b"\0"])
def test_a_request_after_noise_or_a_damaged_frame_is_recognised(noise: bytes) -> None:
    assert cut(noise + FRAMES[0]) == [FRAMES[0]]


def test_a_request_behind_an_incomplete_frame_is_found_after_silence() -> None:
    """The request may be a stop. The incomplete frame may come from a tool that was closed."""
    cutter = RequestCutter()
    cutter.add(bytes.fromhex("01 10 00 00 00 7B F6") + FRAMES[6])
    assert taken(cutter) == []
    found: list[bytes] = []
    while cutter.skip():
        found += taken(cutter)
    assert found == [FRAMES[6]]


def test_an_incomplete_request_is_dropped_after_silence() -> None:
    cutter = RequestCutter()
    cutter.add(FRAMES[4][:7])
    assert taken(cutter) == []
    assert cutter.has_rest
    while cutter.skip():
        assert taken(cutter) == []
    cutter.add(FRAMES[0])
    assert taken(cutter) == [FRAMES[0]]


def test_random_bytes_are_not_recognised_as_a_modbus_request() -> None:
    """By chance, one position in 65,536 has a valid checksum; the bytes of this seed have none."""
    chance, cutter = random.Random(43), RequestCutter()
    for _ in range(400):
        cutter.add(chance.randbytes(chance.randrange(1, 64)))
        assert taken(cutter) == []
        assert len(cutter._came) <= MOST_FRAME


def test_requests_between_random_bytes_are_recognised_unchanged_and_in_order() -> None:
    chance = random.Random(44)
    for _ in range(200):
        put_in = [chance.choice(EVERY_FRAME) for _ in range(4)]
        cutter, found = RequestCutter(), []
        for frame in put_in:
            cutter.add(chance.randbytes(chance.randrange(0, 6)) if chance.random() < 0.5 else b"")
            at = chance.randrange(len(frame))
            for piece in (frame[:at], frame[at:]):
                cutter.add(piece)
                found += taken(cutter)
            if chance.random() < 0.3:
                while cutter.skip():
                    found += taken(cutter)
        left = iter(put_in)
        assert all(frame in left for frame in found)


def test_a_reply_has_the_modbus_rtu_checksum() -> None:
    reply = bytes.fromhex("01 03 02 18 00 B2 44")  # frame printed in the INNOVERT IBD manual, part 9
    assert rtu_reply(bytes(6) + reply[:-2]) == reply
