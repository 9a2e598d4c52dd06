"""multidrop with the Linux drivers of USB serial adapters and of a 16550A, in a virtual machine."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
from rig import Guest, boot

KINDS = ("ftdi", "cp210x", "ch341", "pl2303", "acm")
USB = pytest.mark.parametrize("kind", KINDS)
FRAME = 8  # length in bytes of a request to read a register
RIGHT = [0x210, 0x215]  # values of device 2: see tools/kernel/far_end.py
SETTINGS = [(1200, "8N1"), (9600, "8E1"), (19200, "8O1"), (57600, "8E2"), (115200, "8N1"), (250000, "8N2")]


def is_near(baudrate: int, wanted: int) -> bool:
    """Return True if the baud rates differ by at most 2 %, which receivers tolerate."""
    return abs(baudrate - wanted) <= wanted / 50


@pytest.mark.slow
@USB
def test_requested_port_settings_reach_the_kernel_and_the_adapter(guest: Guest, kind: str) -> None:
    facts = guest.run("settings", kind=kind, wanted=SETTINGS)
    for (baudrate, form), fact in zip(SETTINGS, facts, strict=True):
        assert fact["read"] == RIGHT
        for speed, taken in (fact["kernel"], fact["adapter"]):
            assert taken == form
            assert is_near(speed, baudrate)


@pytest.mark.slow
def test_baud_rate_that_the_adapter_does_not_support_is_refused(guest: Guest) -> None:
    (fact,) = guest.run("settings", kind="cp210x", wanted=[(12345, "8E1")])
    assert "does not take the baud rate" in fact["read"]


@pytest.mark.slow
@USB
def test_failed_usb_transfers_lose_no_reply(guest: Guest, kind: str) -> None:
    assert guest.run("broken_transfers", kind=kind) == {"528.0": 30}


# ---- doctor, and ports that cannot be opened ----


@pytest.mark.slow
@pytest.mark.long
def test_doctor_suggests_only_settings_that_the_driver_supports(guest: Guest) -> None:
    """Only ftdi_sio has a latency timer and needs low latency. No driver has an RS-485 mode."""
    found = guest.run("doctor")
    assert found.keys() == {*KINDS, "8250"}
    for kind, findings in found.items():
        assert findings["RS-485 mode"][0].startswith("the driver has none"), kind
        assert findings["RS-485 mode"][1] == ""
        assert findings["low latency"][1] == "", kind
        says_needless = "does not delay received bytes" in findings["low latency"][0]
        assert says_needless == (kind != "ftdi"), kind
        assert findings["echo"][0].startswith("none at"), kind
    assert found["ftdi"]["latency timer"] == ["1 ms: the shortest possible", ""]
    drivers = {kind: findings["adapter"][0].rpartition(" ")[2] for kind, findings in found.items()}
    assert drivers == {
        "ftdi": "ftdi_sio",
        "cp210x": "cp210x",
        "ch341": "ch341-uart",
        "pl2303": "pl2303",
        "acm": "cdc_acm",
        "8250": "serial",
    }


@pytest.mark.slow
@pytest.mark.long
def test_scan_and_doctor_name_an_adapter_by_its_serial_number(guest: Guest) -> None:
    found = guest.run("lasting_names")
    assert found["scan"][0] == 0, found["scan"][1]
    assert f'port = "{found["by-id"]}"' in found["plant"]
    assert found["by-id"] in found["advice"]


@pytest.mark.slow
def test_error_names_the_reason_if_a_port_cannot_be_opened(guest: Guest) -> None:
    found = guest.run("refused_ports") | guest.run("absent_uart")
    for name, reason in {
        "locked": "in use by this or another program",
        "doctor of locked": "in use by this or another program",
        "exclusive": "in use by this or another program",
        "no permission": "no permission",
        "doctor": "there is no UART behind this name",
        "ttyS3": "there is no UART behind this name",
        "ttyS99": "there is no such port",
    }.items():
        status, said = found[name]
        assert status != 0, name
        assert reason in said, name
        assert "Traceback" not in said, name
    assert found["dialout"][0] == 0


# ---- the 16550A ----


@pytest.mark.slow
def test_a_16550_uart_accepts_the_port_settings_of_drives(guest: Guest) -> None:
    wanted = [(1200, "8N1"), (9600, "8E1"), (19200, "8O1"), (57600, "8E2"), (115200, "8N1"), (9600, "7E1")]
    for (baudrate, form), fact in zip(wanted, guest.run("uart", wanted=wanted), strict=True):
        assert fact == {"read": RIGHT, "kernel": [baudrate, form]}
    for fact in guest.run("uart", wanted=[(230400, "8N1"), (921600, "8N1")]):
        assert "does not take the baud rate" in fact["read"]


@pytest.mark.slow
def test_a_driver_without_an_rs485_mode_is_reported(guest: Guest) -> None:
    assert "the driver has no RS-485 mode" in guest.run("uart_mode", mode="kernel")["read"]


@pytest.mark.slow
@pytest.mark.long
def test_a_16550_refuses_a_baud_rate_without_a_divisor(guest: Guest) -> None:
    for fact, true in zip(
        guest.run("uart", wanted=[(76800, "8N1"), (12345, "8N1")]), (57600, 12800), strict=True
    ):
        assert f"its UART would run at {true}" in fact["read"]


# ---- RTS ----


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["rts-up", "rts-down"])
@USB
def test_rts_switches_the_transceiver_to_sending_for_each_request(guest: Guest, kind: str, mode: str) -> None:
    found = guest.run("rts", kind=kind, mode=mode, baudrate=9600, count=5)
    assert found["sent"] > 0  # not always five: a busy computer repeats requests or loses the port
    assert found["missing"] == 0


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("mode", ["rts-up", "rts-down"])
@pytest.mark.parametrize("baudrate", [9600, 38400, 115200])
@USB
def test_rts_stays_until_the_last_bit_has_left(guest: Guest, kind: str, baudrate: int, mode: str) -> None:
    found = guest.run("rts", kind=kind, mode=mode, baudrate=baudrate, count=300)
    assert found["sent"] > 0
    assert found["missing"] == found["early"] == 0


@pytest.mark.slow
@pytest.mark.long
@USB
def test_rts_is_lowered_while_a_stalled_adapter_accepts_no_bytes(guest: Guest, kind: str) -> None:
    """Otherwise the transceiver would block the line. Closing the port then discards the request."""
    found = guest.run("rts_in_stall", kind=kind)
    assert any("stalled: its adapter takes no bytes" in result for result in found["results"])
    held, after = found["held"], found["after"]
    assert held["rts_given_up"] >= 1
    assert after["sent"] == held["sent"]
    assert after["rts_missing"] == 0


UART_REGISTER = re.compile(r"serial_(read|write) (?:read|write) addr 0x0([0-7]) val 0x([0-9a-f]+)")
BUFFER, LINE_CONTROL, MODEM_CONTROL, LINE_STATUS = "0345"  # numbers of a UART's registers
DIVISOR_ACCESS, RTS, IS_EMPTY = 0x80, 2, 0x40  # bits of LINE_CONTROL, MODEM_CONTROL and LINE_STATUS


def check_transceiver(registers: list[str], sending: int) -> None:
    """Check that RTS has the level `sending` from each request until the UART reports that it is empty."""
    # S: a byte is sent while RTS has the level `sending`. s: a byte is sent while RTS has the other level.
    # e: the UART reports that it is empty. -: RTS leaves the level `sending`.
    events = ""
    line_control, rts = 0, None
    for access, register, text in UART_REGISTER.findall("\n".join(registers)):
        value = int(text, 16)
        if access == "read":
            events += "e" if register == LINE_STATUS and value & IS_EMPTY else ""
        elif register == LINE_CONTROL:
            line_control = value
        elif register == MODEM_CONTROL:
            before, rts = rts, int(bool(value & RTS))
            events += "-" if before == sending and rts != sending else ""
        elif register == BUFFER and not line_control & DIVISOR_ACCESS:
            events += "S" if rts == sending else "s"
    assert "s" not in events
    requests = [request for request in events.split("-") if "S" in request]
    assert len(requests) >= 2
    for request in requests:
        assert request.count("S") == FRAME
        assert request.endswith("e")


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["rts-up", "rts-down"])
def test_a_16550_switches_rts_back_after_the_last_bit_has_left(guest: Guest, mode: str) -> None:
    found = guest.run("uart_mode", mode=mode)
    assert found["read"] == RIGHT
    check_transceiver(found["registers"], sending=int(mode == "rts-up"))


@pytest.mark.slow
@pytest.mark.long
def test_the_rs485_mode_of_a_driver_raises_rts_until_the_last_bit_has_left(guest: Guest) -> None:
    found = guest.run("rs485_mode")
    assert found["read"] == RIGHT
    assert found["doctor"].startswith("off; the driver supports it")
    check_transceiver(found["registers"], sending=1)


# ---- stalls ----


def check_no_wrong_value(guest: Guest, kind: str, family: str, seconds: float) -> None:
    found = guest.run("stalling_family", kind=kind, family=family, seconds=seconds)
    assert found["wrong"] == []
    assert found["counts"]["good"] > 0
    assert found["counts"].keys() <= {"good", "NoReply", "LineBusy", "BadReply"}


@pytest.mark.slow
def test_a_stalled_adapter_gives_no_wrong_value(guest: Guest) -> None:
    check_no_wrong_value(guest, "ftdi", "ErmanERG220", 8.0)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("family", ["ErmanERG220", "YD1000", "InvtCHE", "Meter"])
@pytest.mark.parametrize("kind", ["ftdi", "acm"])
def test_no_family_reads_a_wrong_value_from_a_stalled_adapter(guest: Guest, kind: str, family: str) -> None:
    check_no_wrong_value(guest, kind, family, 18.0)


# ---- adapters that stall, with their Linux drivers: commands, signals and stops during a stall ----


START, STOP = "01050000ff00", "01050001ff00"  # start of the frames that set these coils of drive 1
SIGNALS = [*((kind, signal.SIGINT) for kind in KINDS), *((kind, signal.SIGTERM) for kind in ("ftdi", "acm"))]


@pytest.mark.slow
@pytest.mark.long
@USB
def test_closing_a_stalled_port_discards_an_unsent_start_command(guest: Guest, kind: str) -> None:
    """The driver of this adapter would wait for ever. `close` waits once, for less than a second."""
    found = guest.run("start_in_stall", kind=kind)
    assert len(found["waits"]) <= 1
    assert sum(found["waits"]) < 1
    assert found["left after the close"] == []


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(("kind", "number"), SIGNALS)
def test_a_signal_ends_a_poll_while_its_adapter_is_stalled(guest: Guest, kind: str, number: int) -> None:
    """The driver of this adapter would wait for ever. The poll waits once, and reports the wait."""
    found = guest.run("end_of_stalled_poll", kind=kind, signals=[number])
    assert found["status"] == 0
    assert found["output"].count("waiting 0.75 s for its adapter") <= 1
    assert found["left after the end"] == []


@pytest.mark.slow
@pytest.mark.long
@USB
def test_a_stop_during_a_stall_is_sent_after_at_most_one_read(guest: Guest, kind: str) -> None:
    found = guest.run("stop_in_stall", kind=kind, seconds=6.0)
    places = [at for at, frame in enumerate(found["frames"]) if frame.startswith(STOP)]
    assert places[0] <= 1
    assert "CommandOutcome.DONE" in found["stop"]
    assert found["misses"]["not sent: port stalled"] > 0
    assert "port lost" not in found["misses"]


# ---- a computer that sleeps (S3), with QEMU's USB adapter and its Linux driver. Each test boots a guest ----


@pytest.mark.long
@pytest.mark.parametrize("names", ["tty", "by-id"])
def test_a_poll_continues_after_the_computer_has_slept(built: Path, names: str) -> None:
    """After the sleep the adapter has another tty name, because the poll still holds the old one open."""
    with boot(built) as guest:
        found = guest.run("sleep_in_poll", names=names)
    assert found["slept"] > 1
    assert found["ttys"] == ["/dev/ttyUSB0", "/dev/ttyUSB1"]
    assert found["wrong"] == []
    assert found["came back"]


@pytest.mark.long
def test_no_write_is_repeated_after_the_computer_has_slept(built: Path) -> None:
    with boot(built) as guest:
        found = guest.run("sleep_in_write")
    assert found["slept"] > 1
    assert len(found["values"]) > 2
    assert found["values"] == sorted(set(found["values"]))
