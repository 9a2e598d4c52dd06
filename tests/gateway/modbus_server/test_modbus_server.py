"""The Modbus server's answer to each request: values, exception codes, and writes that reach a drive."""

from __future__ import annotations

import asyncio
import struct
import threading
import time
from collections.abc import Iterator
from math import inf
from typing import Any

import pytest
from lines import until
from modbus_gateway import DONE, PATIENCE, Gateway, plant_of, request, serving
from tables import table

from multidrop import (
    BadReply,
    BusError,
    CancelledByStop,
    Drive,
    DriveException,
    Expired,
    NoReply,
    NotMaster,
    NotVerified,
    Unconfirmed,
    Unsupported,
    WriteForbidden,
    reading,
    setting,
)
from multidrop.control import CommandOutcome, CommandResult, NotAttached
from multidrop.control.commands import MOST_STOPS
from multidrop.core import NumberFormat
from multidrop.drive import COIL, Kept
from multidrop.errors import PortLost
from multidrop.families import DelixiNative, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.gateway.commands import BUSY
from multidrop.gateway.http.rights import NOT_ALLOWED, NOT_LISTED, Caller, Right
from multidrop.gateway.modbus_server.passed_requests import ClientWrites
from multidrop.gateway.modbus_server.protocol import PassingBusy
from multidrop.gateway.modbus_server.settings import ModbusSettings

CHE_OUTPUT_VOLTAGE, CHE_SETPOINT, CHE_CONTROL = 0x3003, 0x2000, 0x1000  # CHE100 manual v1.4, p. 117
IBD_CONTROL, IBD_STOP = 0x2000, 1
BLOCK = 0xF000


class Meter(Drive):
    """A user's own drive class."""

    level = reading(0, "m", step=0.1)
    energy = setting(2, "kWh", number_format=NumberFormat.U32, order="CDAB", span=(0, 4e9), kept=Kept.RAM)
    relay = setting(5, table=COIL)


def plant() -> Any:
    return plant_of(
        ("hall", InvtCHE(1, name="mill")),
        ("hall", Meter(2, name="meter")),
        ("hall", InnovertIBD(3, name="pump")),
        ("hall", DelixiNative(4, name="belt")),
    )


@pytest.fixture
def gateway() -> Iterator[Gateway]:
    """A server whose clients may write, with values of the drives "mill" and "meter"."""
    with serving(plant(), ModbusSettings(listen="127.0.0.1:0", may="write")) as found:
        found.hub.values.update(
            {("mill", "output_voltage"): 231.0, ("meter", "level"): 12.5, ("meter", "relay"): 1.0}
        )
        yield found


def code(gateway: Gateway, unit: int, function: int, *words: int, data: bytes = b"") -> int | None:
    with gateway.client() as client:
        return client.ask(unit, function, *words, data=data).code


def test_a_polled_value_is_answered_without_a_request_on_the_line(gateway: Gateway) -> None:
    with gateway.client() as client:
        assert client.ask(1, 3, CHE_OUTPUT_VOLTAGE, 1).words == [231]
        assert client.ask(2, 3, 0, 1).words == [125]
        assert client.ask(2, 1, 5, 1).data == b"\x01\x01"
    assert gateway.line.asked == []


@pytest.mark.parametrize("why", ["a failed read", "old", "never asked", "from before the machine slept"])
def test_a_stale_value_is_read_again_from_the_drive(gateway: Gateway, why: str) -> None:
    key = "mill", "output_voltage"
    if why == "a failed read":
        gateway.hub.values[key] = None
    elif why == "old":
        gateway.hub.ages[key] = 60.0
    elif why == "from before the machine slept":
        gateway.hub.woken_ns = time.monotonic_ns() + 3600 * 10**9
    else:
        del gateway.hub.values[key]
    with gateway.client() as client:
        assert client.ask(1, 3, CHE_OUTPUT_VOLTAGE, 1).words == [CHE_OUTPUT_VOLTAGE]
    assert gateway.line.asked == [("mill", 3, CHE_OUTPUT_VOLTAGE, 1)]


def test_bits_read_from_a_drive_are_packed_with_the_first_bit_lowest() -> None:
    with (
        serving(plant(), ModbusSettings(listen="127.0.0.1:0", passing="any")) as gateway,
        gateway.client() as client,
    ):
        # the simulated inputs at odd addresses are 1
        assert client.ask(2, 2, 1, 10).data == bytes([2, 0b01010101, 0b01])


def test_modbus_reads_of_undeclared_addresses_are_refused_by_default(gateway: Gateway) -> None:
    assert code(gateway, 1, 3, 0x7000, 1) == 2
    assert code(gateway, 1, 4, CHE_OUTPUT_VOLTAGE, 1) == 2  # this register is declared only for function 3
    assert code(gateway, 4, 3, 0, 1) == 2  # the drive of unit id 4 does not use Modbus
    assert gateway.line.asked == []


def test_undeclared_registers_can_be_read_if_the_settings_allow_any_read() -> None:
    with serving(plant(), ModbusSettings(listen="127.0.0.1:0", passing="any")) as gateway:
        assert code(gateway, 1, 4, 0x7000, 2) is None
        assert gateway.line.asked == [("mill", 4, 0x7000, 2)]


def test_modbus_reads_send_nothing_to_drives_if_passing_is_off() -> None:
    with serving(plant(), ModbusSettings(listen="127.0.0.1:0", passing="off")) as gateway:
        gateway.hub.values["mill", "output_voltage"] = 231.0
        assert code(gateway, 1, 3, CHE_OUTPUT_VOLTAGE, 1) is None
        gateway.hub.values["mill", "output_voltage"] = None
        assert code(gateway, 1, 3, CHE_OUTPUT_VOLTAGE, 1) == 0x0B
        assert code(gateway, 1, 3, 0x7000, 1) == 2
        assert gateway.line.asked == []


def test_a_read_from_a_silent_drive_is_answered_without_a_request_on_the_line(gateway: Gateway) -> None:
    gateway.hub.values["mill", "output_voltage"] = None
    gateway.hub.states["mill"] = "silent"
    assert code(gateway, 1, 3, CHE_OUTPUT_VOLTAGE, 1) == 0x0B
    assert gateway.line.asked == []


def test_values_polled_before_a_write_are_not_used_after_it(gateway: Gateway) -> None:
    gateway.hub.values["mill", "setpoint"] = 10.0
    gateway.hub.ages["mill", "output_voltage"] = 0.2
    with gateway.client() as client:
        assert client.ask(1, 6, CHE_SETPOINT, 5000).code is None
        # read from the drive, not taken from polled values
        assert client.ask(1, 3, CHE_OUTPUT_VOLTAGE, 1).words == [CHE_OUTPUT_VOLTAGE]
        gateway.hub.ages["mill", "output_voltage"] = 0.0
        assert client.ask(1, 3, CHE_OUTPUT_VOLTAGE, 1).words == [231]


def test_values_polled_before_a_command_are_not_used_after_a_reload(gateway: Gateway) -> None:
    """The command came from another interface than Modbus."""
    gateway.hub.ages["mill", "output_voltage"] = 0.2
    with gateway.client() as client:
        assert client.ask(1, 3, CHE_OUTPUT_VOLTAGE, 1).words == [231]
        gateway.commands.ended["mill"] = time.monotonic_ns()
        gateway.server.adopt(plant())
        # read from the drive, not taken from polled values
        assert client.ask(1, 3, CHE_OUTPUT_VOLTAGE, 1).words == [CHE_OUTPUT_VOLTAGE]


@table(
    ("function", "start", "count", "expected"),
    [
        *((function, 0, 0, 3) for function in (1, 2, 3, 4)),
        *((function, 0, 2001, 3) for function in (1, 2, 3, 4)),
        *((function, 0xFFFF, 2, 2) for function in (1, 2, 3, 4)),
        *((function, 0x7000, 1, 2) for function in (1, 2, 3, 4)),
        (3, 0, 126, 3),  # one word more than a reply can have
    ],
)
def test_invalid_address_ranges_are_answered_with_exception_codes(
    gateway: Gateway, function: int, start: int, count: int, expected: int
) -> None:
    assert code(gateway, 1, function, start, count) == expected


@table("function", [1, 3, 5, 6])
@table("data", [b"", b"\0", b"\0\0\0", b"\0\0\0\1\0"])
def test_a_request_of_wrong_length_is_answered_with_illegal_data_value(
    gateway: Gateway, function: int, data: bytes
) -> None:
    assert code(gateway, 1, function, data=data) == 3


@table("function", [0, 7, 8, 11, 17, 20, 22, 23, 43, 0x41, 0x80, 0x83, 0xFF])
def test_unsupported_functions_are_refused(gateway: Gateway, function: int) -> None:
    with gateway.client() as client:
        client.send(request(1, 1, function, 0, 1))
        reply = client.receive()
        assert reply is not None
        assert (reply.function, reply.data) == (function | 0x80, b"\x01")
    assert (gateway.line.asked, gateway.commands.written, gateway.commands.stopped) == ([], [], [])


def test_an_unknown_unit_id_is_answered_with_gateway_path_unavailable(gateway: Gateway) -> None:
    for unit in (5, 247, 255):
        assert code(gateway, unit, 3, 0, 1) == 0x0A
        assert code(gateway, unit, 6, 0, 1) == 0x0A


@table("function", [3, 5, 6, 16, 8])
def test_a_modbus_broadcast_closes_the_connection_and_reaches_no_drive(
    gateway: Gateway, function: int
) -> None:
    with gateway.client() as client:
        client.send(request(1, 0, function, BLOCK + 10, 1))
        assert client.receive() is None
    assert (gateway.line.asked, gateway.commands.written, gateway.commands.stopped) == ([], [], [])


FAILURES = [
    (NoReply("mill"), 0x0B),
    (BadReply("mill", "wrong checksum", b"\1"), 0x0B),
    (PortLost("/dev/ttyUSB0", "vanished"), 0x0A),
    (NotMaster("mill", "/dev/ttyUSB0"), 0x0A),
    (NotAttached("mill is on no bus"), 0x0A),
    (Expired("mill", "a read", 1.0), 0x06),
    (PassingBusy("the line was not free for it"), 0x06),
    (Unsupported("the document of mill has no such thing"), 0x01),
    (DriveException("mill", 2, "illegal address"), 0x02),
    (DriveException("mill", 0x11, "password"), 0x11),
    (ValueError("count = 100 is not from 1 to 16"), 0x03),
    (BusError("whatever"), 0x04),
]


@pytest.mark.parametrize(("failure", "expected"), FAILURES, ids=lambda one: type(one).__name__)
def test_a_client_gets_the_exception_code_for_its_failed_read(
    gateway: Gateway, failure: Exception, expected: int
) -> None:
    gateway.hub.values.clear()
    gateway.line.failure = failure
    assert code(gateway, 1, 3, CHE_OUTPUT_VOLTAGE, 1) == expected


@pytest.mark.slow
def test_reads_beyond_the_clients_share_of_bus_time_are_answered_busy(gateway: Gateway) -> None:
    gateway.hub.values.clear()
    gateway.line.seconds = 0.6  # three times BURST_S, the bus time that clients may use at once
    with gateway.client() as client:
        client.send(b"".join(request(number, 1, 3, CHE_OUTPUT_VOLTAGE, 1) for number in range(12)))
        replies = [client.receive() for _ in range(12)]
    codes = {reply.transaction: reply.code for reply in replies if reply is not None}
    assert codes == {0: None, **dict.fromkeys(range(1, 12), 6)}
    assert len(gateway.line.asked) == 1  # No bus time is left for 2 s, so the other reads expire.


def test_a_modbus_write_becomes_a_command_and_is_echoed(gateway: Gateway) -> None:
    with gateway.client() as client:
        assert client.ask(1, 6, CHE_SETPOINT, 5000).data == bytes.fromhex("20 00 13 88")
        reply = client.ask(1, 16, CHE_SETPOINT, 1, data=bytes.fromhex("02 13 88"))
        assert reply.data == bytes.fromhex("20 00 00 01")
        assert client.ask(2, 5, 5, 0xFF00).data == bytes.fromhex("00 05 FF 00")
        assert client.ask(2, 15, 5, 1, data=b"\x01\x00").data == bytes.fromhex("00 05 00 01")
        reply = client.ask(2, 16, 2, 2, data=bytes.fromhex("04 00 02 00 01"))  # CDAB
        assert reply.data == bytes.fromhex("00 02 00 02")
    caller = Caller("anyone", "modbus", "127.0.0.1", Right.WRITE)
    assert gateway.commands.written == [
        ("mill", "setpoint", 50.0, caller),
        ("mill", "setpoint", 50.0, caller),
        ("meter", "relay", 1.0, caller),
        ("meter", "relay", 0.0, caller),
        ("meter", "energy", 0x0001_0002, caller),
    ]


@table(
    ("function", "words", "data", "expected"),
    [
        (6, (0x7000, 1), b"", 2),  # 2: no register has this address
        (6, (0, 1), b"", 2),  # the register is read-only
        (6, (2, 1), b"", 3),  # this write has only the first half of a 32-bit register
        (6, (3, 1), b"", 2),  # this write has only the second half of a 32-bit register
        (16, (2, 1), b"\2\0\1", 3),
        (16, (2, 3), b"\6" + bytes(6), 3),  # one word more than the register has
        (16, (2, 2), b"\4\0\0\0", 3),  # three bytes of data, although the count before them is four
        (16, (2, 2), b"\2\0\0\0\0", 3),
        (16, (2, 0), b"\0", 3),
        (16, (2, 124), b"\xf8" + bytes(247), 3),
        (16, (0xFFFF, 2), b"\4" + bytes(4), 2),
        (5, (5, 0x0001), b"", 3),
        (5, (5, 0xFF01), b"", 3),
        (5, (6, 0xFF00), b"", 2),
        (15, (5, 2), b"\1\3", 3),
        (15, (5, 1), b"\2\0\0", 3),
        # the registers that every drive has at the same addresses
        (6, (BLOCK + 10, 0), b"", 3),
        (6, (BLOCK, 1), b"", 2),
        (16, (BLOCK + 10, 2), b"\4\0\0\0\1", 3),
        (16, (BLOCK + 9, 2), b"\4\0\1\0\0", 2),
        (16, (BLOCK + 11, 1), b"\2\0\1", 2),
    ],
)
def test_invalid_writes_are_refused(
    gateway: Gateway, function: int, words: tuple[int, ...], data: bytes, expected: int
) -> None:
    assert code(gateway, 2, function, *words, data=data) == expected
    assert (gateway.commands.written, gateway.commands.stopped) == ([], [])


@table(("address", "words"), [(CHE_CONTROL, (1, 5)), (CHE_CONTROL - 1, (5, 1)), (CHE_SETPOINT, (5, 5))])
def test_a_write_of_two_registers_without_a_stop_is_refused(
    gateway: Gateway, address: int, words: tuple[int, int]
) -> None:
    assert code(gateway, 1, 16, address, 2, data=struct.pack(">B2H", 4, *words)) in (2, 3)
    assert (gateway.commands.written, gateway.commands.stopped) == ([], [])


OUTCOMES = [
    (WriteForbidden("no", rule=NOT_LISTED), 2),
    (WriteForbidden("no", rule=NOT_ALLOWED), 1),
    (WriteForbidden("no", rule=BUSY), 6),
    (WriteForbidden("no", rule="it was written 1000 times in a year", is_budget=True), 6),
    (WriteForbidden("no", rule="50.1 Hz is above the upper limit"), 3),
    (Expired("mill", "setpoint", 1.0), 6),
    (CancelledByStop("mill", "setpoint", "a stop was called"), 6),
    (Unconfirmed("mill", "setpoint", "no reply"), 0x0B),
    (NoReply("mill"), 0x0B),
    (NotVerified("mill", "setpoint", "it holds 49"), 4),
    # raised if the drive changed the value (Effect.TAKEN_AS)
    (BusError("mill: setpoint was taken as 49"), 4),
    (DriveException("mill", 6, "busy"), 6),
    (DriveException("mill", 4, "failure"), 4),
    (PortLost("/dev/ttyUSB0", "vanished"), 0x0A),
]


@pytest.mark.parametrize(("failure", "expected"), OUTCOMES, ids=lambda one: str(one)[:40])
def test_a_client_gets_the_exception_code_for_its_failed_write(
    gateway: Gateway, failure: Any, expected: int
) -> None:
    gateway.commands.told = CommandResult(CommandOutcome.FAILED, str(failure), failure)
    assert code(gateway, 1, 6, CHE_SETPOINT, 5000) == expected


def test_a_write_is_refused_if_the_gateway_was_suspended_meanwhile(gateway: Gateway) -> None:
    standstill, now_ns = gateway.server._standstill, [10**12]
    with gateway.client() as client:
        standstill._clock = lambda: now_ns[0]
        standstill.note()
        now_ns[0] += 5 * 10**9
        assert client.ask(1, 6, CHE_SETPOINT, 5000).code is None
        now_ns[0] += 5 * 10**9 + 1
        assert client.ask(1, 6, CHE_SETPOINT, 5000).code == 6
        assert client.ask(1, 6, CHE_CONTROL, 5).code is None  # a stop is never refused
        now_ns[0] += 10**9 - 1
        assert client.ask(1, 6, CHE_SETPOINT, 5000).code == 6
        now_ns[0] += 1
        assert client.ask(1, 6, CHE_SETPOINT, 5000).code is None
    assert len(gateway.commands.written) == 2
    ((drive, what, why),) = gateway.commands.refused  # at most one record a second
    assert (drive, what) == ("mill", "request 01 06 20 00 13 88")
    assert "the gateway was suspended" in why


def test_a_read_only_gateway_refuses_writes_as_illegal_function() -> None:
    with serving(plant(), ModbusSettings(listen="127.0.0.1:0")) as gateway:
        for function, address, value in (
            *((5, 5, 0xFF00), (6, CHE_SETPOINT, 1), (6, CHE_CONTROL, 5), (6, BLOCK + 10, 1)),
        ):
            assert code(gateway, 1, function, address, value) == 1
        assert code(gateway, 1, 16, CHE_CONTROL, 2, data=b"\4\0\5\0\0") == 1  # contains a stop
        assert (gateway.commands.written, gateway.commands.stopped) == ([], [])


def test_modbus_clients_with_the_right_to_stop_can_only_stop() -> None:
    with serving(plant(), ModbusSettings(listen="127.0.0.1:0", may="stop")) as gateway:
        for address, value in ((CHE_SETPOINT, 5000), (CHE_CONTROL, 1), (0x7000, 1)):
            assert code(gateway, 1, 6, address, value) == 1
        assert gateway.commands.stopped == []
        assert code(gateway, 1, 6, CHE_CONTROL, 5) is None
        assert gateway.commands.stopped == [(["mill"], Caller("anyone", "modbus", "127.0.0.1", Right.STOP))]
        assert gateway.commands.written == []


@table("value", [v for v in range(20) if v not in (5, 6, 8)])
def test_modbus_clients_can_write_only_stop_values_to_a_control_register(
    gateway: Gateway, value: int
) -> None:
    assert code(gateway, 1, 6, CHE_CONTROL, value) == 3
    assert (gateway.commands.written, gateway.commands.stopped) == ([], [])


def test_a_modbus_write_of_any_stop_value_stops_the_drive(gateway: Gateway) -> None:
    with gateway.client() as client:
        assert client.ask(1, 6, CHE_CONTROL, 5).data == bytes.fromhex("10 00 00 05")
        assert client.ask(1, 16, CHE_CONTROL, 1, data=bytes.fromhex("02 00 05")).code is None
        assert client.ask(1, 6, CHE_CONTROL, 6).code is None  # coast
        assert client.ask(1, 6, CHE_CONTROL, 8).code is None  # jog stop
        assert client.ask(3, 6, IBD_CONTROL, IBD_STOP).code is None
        assert client.ask(3, 6, IBD_CONTROL, 0).code == 3  # 0 is "no command", which stops no motor
        for yes in (1, 2, 0xFF00, 0xFFFF):  # values that masters write for "true"
            # This register of the gateway stops a drive. It is at the same address for every drive, even for
            # this one, which does not use Modbus.
            assert client.ask(4, 6, BLOCK + 10, yes).code is None
    stopped = [drives for drives, _ in gateway.commands.stopped]
    assert stopped == [["mill"]] * 4 + [["pump"]] + [["belt"]] * 4


MIXED = {  # unit id, address and words; each write contains a stop
    "the stop first": (1, CHE_CONTROL, (5, 0)),
    "between others": (1, CHE_CONTROL - 1, (7, 5, 7)),
    "a coast": (1, CHE_CONTROL, (6, 1)),
    "with a setpoint": (3, IBD_CONTROL, (IBD_STOP, 5000)),
    "the common block's": (4, BLOCK + 10, (1, 1)),
    "after the common block's state": (4, BLOCK + 9, (1, 0xFF00)),
    "a whole block of 16": (4, BLOCK, (*[0] * 10, 1, *[0] * 5)),
}


@table("mixed", MIXED)
@table("may", ["stop", "write"])
def test_only_the_stop_in_a_write_of_several_words_is_sent(mixed: str, may: str) -> None:
    unit, address, words = MIXED[mixed]
    data = struct.pack(f">B{len(words)}H", 2 * len(words), *words)
    with serving(plant(), ModbusSettings(listen="127.0.0.1:0", may=may)) as gateway:
        for _ in range(MOST_STOPS + 1):
            assert code(gateway, unit, 16, address, len(words), data=data) == 3
        until(lambda: bool(gateway.commands.stopped))  # the request is answered before the stop is sent
        names = {1: "mill", 3: "pump", 4: "belt"}
        assert {str(drives) for drives, _ in gateway.commands.stopped} == {f"['{names[unit]}']"}
        assert gateway.commands.written == []


def test_only_the_stop_in_a_write_of_several_coils_is_sent() -> None:
    """Coils 0 to 2 of the ER-G-220 are start, stop, and emergency stop. The write sets only stop."""
    drives = plant_of(("hall", ErmanERG220(1, name="mixer")))
    with serving(drives, ModbusSettings(listen="127.0.0.1:0", may="write")) as gateway:
        assert code(gateway, 1, 15, 0, 3, data=b"\1\1") == 3  # this write sets start and not stop
        assert gateway.commands.stopped == []
        assert code(gateway, 1, 15, 0, 3, data=b"\1\2") == 3
        until(lambda: bool(gateway.commands.stopped))  # the request is answered before the stop is sent
        assert [drives for drives, _ in gateway.commands.stopped] == [["mixer"]]
        assert gateway.commands.written == []


class HeldCommands:
    """Commands that wait until `release` is set. With `only_writes`, stops do not wait."""

    def __init__(self, gateway: Gateway, *, only_writes: bool = False) -> None:
        self.release, self.ended = threading.Event(), threading.Event()
        self._commands, self._only_writes = gateway.commands, only_writes
        gateway.commands.told = self._carry_out

    async def _carry_out(self) -> CommandResult:
        is_stop = bool(self._commands.stopped)
        while not (self.release.is_set() or (self._only_writes and is_stop)):
            await asyncio.sleep(0.01)
        self.ended.set()
        return DONE


@pytest.mark.parametrize("is_disconnected", [False, True])
def test_a_slow_modbus_stop_continues_after_its_acknowledgement(
    gateway: Gateway, is_disconnected: bool
) -> None:
    held = HeldCommands(gateway)
    with gateway.client() as client:
        client.send(request(1, 1, 6, CHE_CONTROL, 5))
        if is_disconnected:
            client.send(b"\xff" * 20)  # invalid bytes, so the server closes the connection
        reply = client.receive()
        assert (reply and reply.code) == (None if is_disconnected else 5)
    assert not held.ended.is_set()
    held.release.set()
    assert held.ended.wait(PATIENCE)


def test_a_modbus_stop_does_not_wait_for_earlier_writes_of_its_client(gateway: Gateway) -> None:
    """Sixteen writes hang. The stop that the client sends after them is called immediately."""
    held = HeldCommands(gateway, only_writes=True)
    with gateway.client() as client:
        for number in range(16):
            client.send(request(number, 1, 6, CHE_SETPOINT, number))
        client.send(request(16, 1, 6, CHE_SETPOINT, 1))
        reply = client.receive()
        assert reply is not None
        assert (reply.transaction, reply.code) == (16, 6)
        client.send(request(17, 1, 6, CHE_CONTROL, 5))
        reply = client.receive()
        assert reply is not None
        assert (reply.transaction, reply.code) == (17, None)
        held.release.set()
        assert {reply.transaction for _ in range(16) if (reply := client.receive())} == set(range(16))


def test_modbus_stops_beyond_a_limit_are_combined_into_one_stop(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the first answers wait for their stops: thousands of waiting answers would delay other stops."""
    waiting, later = list[object](), ClientWrites._later

    def noted(*details: Any) -> Any:
        waiting.append(details)
        return later(*details)

    monkeypatch.setattr(ClientWrites, "_later", noted)
    held = HeldCommands(gateway)
    with gateway.client() as client:
        for number in range(100):
            client.send(request(number, 1, 6, CHE_CONTROL, 5))
        codes = [reply.code for _ in range(100) if (reply := client.receive())]
        assert codes == [5] * 100
        assert len(waiting) == MOST_STOPS
        until(lambda: len(gateway.commands.stopped) > MOST_STOPS)
        assert len(gateway.commands.stopped) == MOST_STOPS + 1
        held.release.set()


@table(
    ("failure", "expected"),
    [(BusError("not seen to stand"), 0x0B), (NoReply("mill"), 0x0B), (PortLost("/dev/x", "gone"), 0x0A)],
)
def test_a_failed_modbus_stop_is_answered_with_an_exception_code(
    gateway: Gateway, failure: BusError, expected: int
) -> None:
    gateway.commands.told = CommandResult(CommandOutcome.FAILED, str(failure), failure)
    assert code(gateway, 1, 6, CHE_CONTROL, 5) == expected


def test_an_unexpected_error_during_a_modbus_stop_is_logged(
    gateway: Gateway, caplog: pytest.LogCaptureFixture
) -> None:
    async def fails() -> CommandResult:
        raise RuntimeError("a mistake of ours")

    gateway.commands.told = fails
    assert code(gateway, 1, 6, CHE_CONTROL, 5) == 0x0B
    assert "a mistake of ours" in caplog.text


def test_a_reply_of_a_wrong_length_counts_as_no_reply(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def short(*request: object) -> list[int]:
        return [1]

    gateway.hub.values.clear()
    monkeypatch.setattr(gateway.server, "_ask", short)
    assert code(gateway, 1, 3, CHE_OUTPUT_VOLTAGE, 2) == 0x0B


def block(gateway: Gateway, unit: int = 1, function: int = 3) -> list[int]:
    with gateway.client() as client:
        return client.ask(unit, function, BLOCK, 11).words


UNKNOWN = [0x8000, 0]


def test_common_modbus_registers_contain_the_values_of_a_running_drive(gateway: Gateway) -> None:
    """The Modbus server has these registers at the same addresses for every drive."""
    gateway.hub.states["mill"] = "runs"
    gateway.hub.values.update(
        {("mill", "output_frequency"): 49.99, ("mill", "output_current"): 12.3, ("mill", "setpoint"): -5.0}
    )
    gateway.hub.ages = dict.fromkeys(gateway.hub.values, 0.5)
    for function in (3, 4):
        found = block(gateway, function=function)
        assert found[:8] == [2, 0, 0, 4999, 0, 1230, 0xFFFF, 0xFFFF - 499]
        assert found[8] == 0
        # Age in ms. The test's hub and the server read the clock one after the other.
        assert 250 <= found[9] < 5000
        assert found[10] == 0
    assert gateway.line.asked == []
    gateway.hub.values["mill", "output_frequency"] = 1500.0
    assert block(gateway)[2:4] == [2, 0x49F0]  # 150000 has two words


def test_common_modbus_registers_mark_unknown_values_by_reserved_numbers(gateway: Gateway) -> None:
    gateway.hub.values.clear()
    assert block(gateway) == [0, 0xFFFF, *UNKNOWN, *UNKNOWN, *UNKNOWN, 0xFFFF, 0xFFFF, 0]
    gateway.hub.states["mill"] = "silent"
    gateway.hub.values["mill", "output_frequency"] = 49.99
    gateway.hub.ages["mill", "output_frequency"] = 70.0
    found = block(gateway)
    assert found[:4] == [4, 0xFFFF, *UNKNOWN]
    assert 69_990 <= found[8] << 16 | found[9] < 80_000


def test_common_modbus_registers_hide_values_from_before_a_computer_sleep(gateway: Gateway) -> None:
    """Such values become unknown, however recent they look. Their age is the largest number that fits."""
    gateway.hub.values["mill", "output_frequency"] = 49.99
    gateway.hub.woken_ns = time.monotonic_ns() + 3600 * 10**9
    found = block(gateway)
    assert found[2:4] == UNKNOWN
    assert found[8:10] == [0xFFFF, 0xFFFE]  # the largest age that fits


@table(("number", "expected"), [(5.0, 5), (None, 0xFFFE), (0.0, 0xFFFE), (inf, 0xFFFE), (0.5, 0xFFFE)])
def test_common_modbus_registers_include_the_fault_number(
    gateway: Gateway, number: float | None, expected: int
) -> None:
    gateway.hub.states["mill"] = "fault"
    gateway.hub.values["mill", "fault"] = number
    assert block(gateway)[:2] == [3, expected]


def test_a_read_across_the_edge_of_the_common_modbus_registers_is_refused(gateway: Gateway) -> None:
    gateway.hub.states["mill"] = "stands"
    with gateway.client() as client:
        assert client.ask(1, 3, BLOCK, 1).words == [1]
        assert client.ask(1, 3, BLOCK, 16).code is None
        assert client.ask(1, 3, BLOCK - 1, 2).code == 2
        assert client.ask(1, 3, BLOCK + 15, 2).code == 2
        assert client.ask(1, 3, BLOCK - 1, 18).code == 2


def test_drives_of_every_family_have_the_common_modbus_registers(gateway: Gateway) -> None:
    for unit, drive in enumerate(("mill", "meter", "pump", "belt"), 1):
        gateway.hub.states[drive] = "runs"
        assert block(gateway, unit)[0] == 2


def test_a_line_can_be_served_on_a_separate_modbus_tcp_port() -> None:
    found = plant_of(("hall", InvtCHE(1, name="mill")), ("yard", Meter(1, name="meter")))
    with serving(found, ModbusSettings(listen="127.0.0.1:0", ports={"yard": 0})) as gateway:
        gateway.hub.values.update({("mill", "output_voltage"): 231.0, ("meter", "level"): 12.5})
        with gateway.client() as main, gateway.client("yard") as yard:
            assert main.ask(1, 3, CHE_OUTPUT_VOLTAGE, 1).words == [231]
            assert yard.ask(1, 3, 0, 1).words == [125]


def test_the_modbus_server_refuses_a_new_plant_if_unit_ids_clash(gateway: Gateway) -> None:
    with gateway.client() as client:
        with pytest.raises(ValueError, match="unit 1 would be"):
            gateway.server.adopt(plant_of(("hall", InvtCHE(1, name="a")), ("yard", InvtCHE(1, name="b"))))
        assert client.ask(1, 3, CHE_OUTPUT_VOLTAGE, 1).words == [231]
        gateway.server.adopt(plant_of(("hall", Meter(9, name="meter"))))
        assert client.ask(1, 3, CHE_OUTPUT_VOLTAGE, 1).code == 0x0A
        assert client.ask(9, 3, 0, 1).words == [125]
