"""The facts that `multidrop doctor` reads from the system, and its findings as sentences."""

from __future__ import annotations

import errno
import fcntl
import os
import struct
from pathlib import Path
from typing import Any

import pytest
from batches import completed
from tables import table

from multidrop.cli.doctor_findings import (
    ROUNDS,
    RS485_ENABLED,
    RS485_RX_DURING_TX,
    Adapter,
    RS485Mode,
    WakeLateness,
    adapter_finding,
    decoded_rs485,
    echo_finding,
    find_adapter,
    latency_finding,
    low_latency,
    low_latency_finding,
    round_trip_finding,
    rs485_finding,
    rs485_mode,
    wake_finding,
)
from multidrop.core import RS485, Completion, Failure, Message
from multidrop.drive.line_settings import Settings
from multidrop.families.invt_che import InvtCHE

USUAL = Settings(9600, "8N1")
SENT = bytes.fromhex("F7 03 00 00 00 01 90 9C")
REFUSAL = bytes.fromhex("F7 83 04 61 1E")


def ended(raw: bytes, result: int = Failure.NO_REPLY, skipped: int = 0, exception: int = 0) -> Completion:
    """Return the outcome of the request to an unused address."""
    reply = Message(0xF7, 3, exception=exception)
    return completed(result, reply, raw, at_ns=1, skipped=skipped)


@pytest.fixture
def sysfs(tmp_path: Path) -> Path:
    """Return a folder like Linux's /sys with an FTDI adapter: `class` has links to folders in `devices`."""
    usb = tmp_path / "devices/pci0000:00/usb1/1-2"
    port = usb / "1-2:1.0/ttyUSB0"
    (port / "tty/ttyUSB0").mkdir(parents=True)
    for name, text in {
        "idVendor": "0403",
        "idProduct": "6001",
        "manufacturer": "FTDI",
        "product": "FT232R USB UART",
    }.items():
        (usb / name).write_text(text + "\n")
    (port / "latency_timer").write_text("16\n")
    driver = tmp_path / "bus/usb-serial/drivers/ftdi_sio"
    driver.mkdir(parents=True)
    (port / "driver").symlink_to(driver)
    devices = tmp_path / "bus/usb-serial/devices"
    devices.mkdir()
    (devices / "ttyUSB0").symlink_to(port)
    tty = tmp_path / "class/tty/ttyUSB0"
    tty.mkdir(parents=True)
    (tty / "device").symlink_to(port)
    return tmp_path


@pytest.mark.parametrize("is_link", [False, True])
def test_an_adapter_is_found_through_sysfs(sysfs: Path, is_link: bool) -> None:
    (sysfs / "by-id").symlink_to("/dev/ttyUSB0")
    adapter = find_adapter(str(sysfs / "by-id") if is_link else "/dev/ttyUSB0", sysfs)
    assert (adapter.name, adapter.driver, adapter.product) == ("ttyUSB0", "ftdi_sio", "FTDI FT232R USB UART")
    assert (adapter.usb_id, adapter.latency_timer) == ("0403:6001", 16)


def test_an_adapter_unknown_to_sysfs_has_only_a_name(sysfs: Path) -> None:
    assert find_adapter("/dev/ttyS7", sysfs) == Adapter("ttyS7")


def test_the_rs485_mode_is_decoded_from_the_struct_of_linux() -> None:
    # struct serial_rs485 in linux/serial.h: flags, two delays in ms, five words of padding
    assert decoded_rs485(struct.pack("=8I", 0x01, 0, 0, 0, 0, 0, 0, 0)) == RS485Mode(True, False)
    assert decoded_rs485(struct.pack("=8I", 0x13, 5, 5, 0, 0, 0, 0, 0)) == RS485Mode(True, True)
    assert decoded_rs485(bytes(32)) == RS485Mode(False, False)
    assert (RS485_ENABLED, RS485_RX_DURING_TX) == (1, 16)


def test_a_pty_has_no_low_latency_flag_and_no_rs485_mode() -> None:
    master, slave = os.openpty()
    try:
        assert low_latency(slave) is None
        assert rs485_mode(slave) is None
    finally:
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize(("settable", "mode"), [(True, RS485Mode(False, False)), (False, None)])
def test_the_rs485_mode_is_none_if_the_driver_refuses_the_ioctl(
    monkeypatch: pytest.MonkeyPatch, settable: bool, mode: RS485Mode | None
) -> None:
    """In the driver serial8250, for instance, TIOCGRS485 returns zeros and TIOCSRS485 fails with ENOTTY."""
    written: list[bytes] = []

    def ioctl(fd: int, request: int, data: bytearray) -> int:
        if request == 0x542F:
            if not settable:
                raise OSError(errno.ENOTTY, "Inappropriate ioctl for device")
            written.append(bytes(data))
        return 0

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    assert rs485_mode(0) == mode
    assert written == [bytes(32)] * settable


def test_reading_driver_settings_of_a_lost_port_raises_oserror() -> None:
    master, slave = os.openpty()
    os.close(master)
    os.close(slave)
    for ask in (low_latency, rs485_mode):
        with pytest.raises(OSError, match="Bad file descriptor"):
            ask(slave)


@table("driver", ["cp210x", "ch341-uart", "pl2303", "cdc_acm"])
def test_low_latency_is_not_advised_for_drivers_that_ignore_it(driver: str) -> None:
    finding = low_latency_finding(False, driver)
    assert finding.what == f"the driver {driver} does not delay received bytes: nothing to set"
    assert not finding.advice
    assert low_latency_finding(False, "ftdi_sio").advice


def test_the_doctor_command_gives_advice_if_the_latency_timer_is_long(sysfs: Path) -> None:
    finding = latency_finding(find_adapter("/dev/ttyUSB0", sysfs))
    assert finding.what == "16 ms: every reply may wait that long in the adapter"
    assert f"echo 1 | sudo tee {sysfs}/bus/usb-serial/devices/ttyUSB0/latency_timer" in finding.advice
    assert 'ATTR{latency_timer}="1"' in finding.advice


@table(
    ("finding", "what", "advised"),
    [
        (latency_finding(Adapter("ttyUSB0", latency_timer=1)), "1 ms: the shortest possible", False),
        (latency_finding(Adapter("ttyS0")), "the driver shows none", False),
        (adapter_finding(Adapter("ttyS0"), "/dev/ttyS0", "/dev/ttyS0"), "not on USB; driver unknown", False),
        (
            adapter_finding(
                Adapter("ttyUSB0", "ch341", "QinHeng", "1a86:7523"), "/dev/ttyUSB0", "/dev/ttyUSB0"
            ),
            "QinHeng (1a86:7523); driver ch341",
            False,
        ),
        (
            adapter_finding(Adapter("ttyUSB0"), "/dev/ttyUSB0", "/dev/serial/by-id/usb-FTDI_A1-port0"),
            "not on USB; driver unknown",
            True,
        ),
        (low_latency_finding(None), "the driver has no such flag", False),
        (low_latency_finding(True), "the flag is set; multidrop sets it whenever it opens the port", False),
        (
            low_latency_finding(False),
            "the flag is not set: the driver did not accept it from multidrop",
            True,
        ),
        (
            rs485_finding(None),
            "the driver has none: the adapter itself must switch between sending and receiving",
            False,
        ),
        (rs485_finding(None, RS485.RTS_UP), "rts-up: multidrop turns RTS on while a request leaves", False),
        (
            rs485_finding(None, RS485.RTS_UP, is_usb=True),
            "rts-up: multidrop turns RTS on while a request leaves, and on USB for at least 2 ms longer: a "
            "drive that answers sooner is not heard",
            True,
        ),
        (
            rs485_finding(RS485Mode(True, False), RS485.RTS_DOWN),
            "rts-down: multidrop turns RTS off while a request leaves; the driver's own mode is on too",
            True,
        ),
        (rs485_finding(RS485Mode(True, False), RS485.KERNEL), "on: the driver switches the direction", False),
        (rs485_finding(RS485Mode(False, False)), "off; the driver supports it", True),
        (rs485_finding(RS485Mode(True, False)), "on: the driver switches the direction", False),
        (
            rs485_finding(RS485Mode(True, True)),
            "on: the driver switches the direction, and the port receives its own requests: "
            "multidrop removes the echo",
            False,
        ),
        (echo_finding(ended(b""), SENT, USUAL), "none at 9600 8N1", False),
        (
            echo_finding(ended(SENT), SENT, USUAL),
            "the adapter receives its own requests at 9600 8N1; multidrop removes them",
            False,
        ),
        (echo_finding(ended(b"\x00\xff"), SENT, USUAL), "2 unexpected bytes at 9600 8N1: 00 FF", True),
        (
            echo_finding(ended(REFUSAL, len(REFUSAL), exception=4), SENT, USUAL),
            "none at 9600 8N1; address 247, which should be unused, answers with exception 04",
            True,
        ),
        (
            echo_finding(ended(REFUSAL, len(REFUSAL), len(SENT)), SENT, USUAL),
            "the adapter receives its own requests at 9600 8N1; address 247, which should be unused, answers "
            "with a value",
            True,
        ),
    ],
)
def test_each_finding_is_a_sentence_with_advice_if_needed(finding: object, what: str, advised: bool) -> None:
    assert finding.what == what
    assert bool(finding.advice) == advised


def test_the_doctor_command_gives_advice_if_the_round_trip_is_slow() -> None:
    drive = InvtCHE(1)
    usual = round_trip_finding(drive, [0.005] * ROUNDS, ROUNDS)
    assert usual.what.endswith("answers in 5.0 ms (median; 5.0 to 5.0 ms)")
    assert usual.advice == ""
    slow = round_trip_finding(drive, [0.005] * 3 + [0.0201] * 10, 13)
    assert "20.1 ms (median" in slow.what
    assert "usually takes 5.0 ms" in slow.advice
    assert not slow.is_failure
    assert "did not answer 4 requests" in round_trip_finding(drive, [], 4).what


def test_the_doctor_command_reports_lost_requests_as_a_failure_with_advice() -> None:
    lost = round_trip_finding(InvtCHE(1), [0.005] * 10, 17)
    assert lost.what.endswith("7 of 17 requests got no valid reply")
    assert lost.advice.startswith("check termination, bias, cable and signal ground")
    assert lost.is_failure


def test_the_round_trip_finding_shows_an_invalid_reply() -> None:
    came = "reply from another address (received 63 03 02 00 00)"
    nothing_good = round_trip_finding(InvtCHE(1), [], 4, came=came).what
    assert nothing_good == f"invt-che@1 gave no valid reply to 4 requests; received: {came}"
    assert round_trip_finding(InvtCHE(1), [0.005], 2, came=came).what.endswith(f"received instead: {came}")


def test_the_round_trip_over_a_network_states_the_time_on_the_wire() -> None:
    told = round_trip_finding(InvtCHE(1), [0.0004, 0.0005, 0.0006], 3, 0.0094)
    assert told.what.endswith(
        "answers in 0.5 ms (median; 0.4 to 0.6 ms) after its request was handed over "
        "(a wire at 9600 8N1 takes 9.4 ms of it)"
    )
    assert told.advice == ""
    assert round_trip_finding(InvtCHE(1), [0.0140], 1, 0.0094).advice == ""
    assert "the adapter or the network" in round_trip_finding(InvtCHE(1), [0.0240], 1, 0.0094).advice


EARLY, LATE = WakeLateness(0.0001, 0.0005, 0.003), WakeLateness(0.0001, 0.004, 0.05)
REFUSED = "the system refuses it; permit it so"


@table(
    ("realtime", "options", "verdict", "advice"),
    [
        (EARLY, {}, "too late for 9600 8N1: p99 must be below 3.65 ms", "set realtime = true at the top"),
        (EARLY, {"is_realtime": True}, "good enough for 9600 8N1", ""),
        (EARLY, {"is_realtime": True, "switch": RS485.RTS_UP}, "good enough for 9600 8N1: max must be", ""),
        (LATE, {"is_realtime": True}, "too late for 9600 8N1", "stop other programs on this computer"),
        (LATE, {}, "too late for 9600 8N1", "stop other programs on this computer"),
        (REFUSED, {}, "realtime: refused; too late", REFUSED),
    ],
)
def test_late_wake_ups_are_compared_with_the_silence_between_frames(
    realtime: WakeLateness | str, options: dict[str, Any], verdict: str, advice: str
) -> None:
    found = wake_finding(LATE, realtime, USUAL, **options)
    assert found.what.startswith("the core wakes 0.10 ms late (p50), 4.00 (p99), 50.00 (max); ")
    assert verdict in found.what
    assert found.advice.startswith(advice) if advice else not found.advice


def test_realtime_permission_is_advised_only_if_needed_or_requested() -> None:
    assert wake_finding(EARLY, REFUSED, USUAL).advice == ""
    assert wake_finding(EARLY, REFUSED, USUAL, is_realtime=True).advice == REFUSED
    switched = wake_finding(WakeLateness(0.0001, 0.0005, 0.004), EARLY, USUAL, RS485.RTS_DOWN)
    assert "too late" in switched.what
