"""Lost ports: the reported reason, closing with a stalled adapter, baud rates that a UART cannot have."""

from __future__ import annotations

import errno
import os
import pty
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import serial
from tables import table
from toy import Toy

from multidrop.bus import Bus
from multidrop.core import NO_DIVISOR, RS485, Failure, Port, TransactionIds, port_settings
from multidrop.errors import NoReply, PortLost
from multidrop.sim import Simulator, Wire, simulated
from multidrop.transport import clock, open_port, port_identity
from multidrop.transport.line import Line
from multidrop.transport.open_port import CLOSING_S, STALLED, OpenPort, failing_refusals, why_lost


@table(
    ("port", "error", "why"),
    [
        ("/dev/null", 0, "hung up"),
        ("/dev/null", errno.EIO, os.strerror(errno.EIO)),
        ("/dev/ttyUSB999", 0, "unplugged"),
        ("/dev/ttyUSB999", errno.EIO, "unplugged"),
        ("/dev/ttyUSB999", errno.ETIMEDOUT, STALLED),
        ("/dev/pts/99999", 0, "hung up"),
        ("socket://10.0.0.7:4001", 0, "hung up"),
        ("socket://10.0.0.7:4001", errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT)),
    ],
)
def test_why_lost_distinguishes_unplugged_stalled_and_hung_up(port: str, error: int, why: str) -> None:
    assert why_lost(port, error) == why


@pytest.fixture
def terminal() -> Iterator[str]:
    ends = pty.openpty()
    yield os.ttyname(ends[1])
    for end in ends:
        os.close(end)


@pytest.mark.parametrize("must_discard", [False, True])
def test_closing_a_stalled_port_is_bounded_and_discards_a_command_at_once(
    must_discard: bool, terminal: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    closed: list[float] = []

    def close(fd: int, seconds: float) -> None:
        closed.append(seconds)
        os.close(fd)

    monkeypatch.setattr(open_port, "close_descriptor", close)
    monkeypatch.setattr(clock, "sleep", lambda seconds: None)
    found = Line(terminal).open()
    monkeypatch.setattr(serial.Serial, "out_waiting", 8)
    found._opened.must_discard = must_discard
    found.close()
    assert closed == [0.0 if must_discard else CLOSING_S]
    assert ("waiting 0.75 s for its adapter" in caplog.text) != must_discard


def test_a_lost_port_states_why_before_it_is_reopened(terminal: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = Line(terminal).open()
    core = SimpleNamespace(lost=True, lost_error=0, called_off=True, is_stalled=False, stop=lambda: None)
    found.queue = core  # type: ignore[assignment]
    found.drop()
    assert found.why_lost == f"{terminal}: the port was lost (hung up)"
    assert found._opened.must_discard
    found.close()


def test_reads_reopen_a_port_that_was_closed_to_discard_a_command() -> None:
    with Simulator([Wire([simulated(Toy(1))])]) as sim, Bus(sim.wires[0].path) as bus:
        toy = bus.attach(Toy, 1)
        assert bus.line.queue
        bus.line._discard(bus.line.queue)
        assert bus.line.queue is None
        assert toy.read(toy.output_current) is not None


@table(
    ("sent_ns", "said"),
    [
        (0, f"nothing was sent: the port took no bytes until the time-out ({STALLED})"),
        (1, f"the request was sent only in part: the port took no bytes until the time-out ({STALLED})"),
    ],
)
def test_a_command_that_was_held_back_is_not_logged_as_a_lost_port(
    sent_ns: int, said: str, terminal: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    found = Line(terminal).open()
    held = SimpleNamespace(
        count=-1, result=Failure.LINE_LOST, error=errno.ETIMEDOUT, sent_ns=sent_ns, raw=b""
    )
    monkeypatch.setattr(Port, "carry_out", lambda *given: held)
    with pytest.raises(PortLost) as failure:
        found.carry_out(SimpleNamespace())  # type: ignore[arg-type]
    assert failure.value.reason == said
    assert not found.is_lost
    found.close()
    assert "lost" not in caplog.text


def test_ctrl_c_does_not_leave_a_called_off_command_in_the_driver(
    terminal: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = Line(terminal).open()

    def interrupted(*given: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Port, "called_off", True)
    monkeypatch.setattr(Port, "carry_out", interrupted)
    with pytest.raises(KeyboardInterrupt):
        found.carry_out(SimpleNamespace())  # type: ignore[arg-type]
    assert found.queue is None  # the port is closed
    found.close()


def test_a_silent_drive_behind_a_stalled_adapter_is_reported_as_such(
    terminal: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Line, "is_stalled", True)
    with Bus(terminal) as bus:
        toy = bus.attach(Toy, 1)
        with pytest.raises(NoReply, match=f"but the port is {STALLED}"):
            toy.read(toy.output_current)


# ---- baud rates ----


@table(
    ("baudrate", "sentence"),
    [
        (76800, "its UART would run at 57600; the nearest possible baud rates are 57600 and 115200"),
        (12345, "its UART would run at 12800; the nearest possible baud rates are 11520 and 12800"),
        (38400, "its driver replaces 38400 baud by a custom divisor: setserial /dev/ttyS1 spd_normal"),
    ],
)
def test_an_impossible_baud_rate_is_refused_with_the_nearest_ones(baudrate: int, sentence: str) -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(port_settings, "lib", SimpleNamespace(md_port_baud_base=lambda fd: 115200))
        found = OpenPort("/dev/ttyS1", TransactionIds.MATCH, RS485.OFF, None)
        found._serial = SimpleNamespace(fileno=lambda: 0)  # type: ignore[assignment]
        assert found.refusal(NO_DIVISOR, baudrate).endswith(sentence)


@pytest.mark.parametrize(
    ("driver", "is_checked"),
    [("serial8250", True), ("serial", True), ("dw-apb-uart", False), ("ftdi_sio", False)],
)
def test_only_uarts_with_whole_divisors_are_checked(
    driver: str, is_checked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("tty/ttyS1", "drivers", "devices/card"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "drivers" / driver).mkdir()
    (tmp_path / "devices" / "card" / "driver").symlink_to(tmp_path / "drivers" / driver)
    (tmp_path / "tty/ttyS1/device").symlink_to(tmp_path / "devices/card")
    monkeypatch.setattr(port_identity, "TTYS", tmp_path / "tty")
    assert bool(failing_refusals("/dev/ttyS1") & NO_DIVISOR) == is_checked
