"""Log entries of `multidrop.*`: opened, lost and reopened ports, frames, writes, refusals and stops."""

from __future__ import annotations

import logging
import os
import threading
import tty
from pathlib import Path
from typing import Any

import checksums
import pytest
from lines import PATIENCE
from simulated_bus import one
from toy import PatientToy

from multidrop import Bus, LineError, WriteForbidden
from multidrop.families import InvtCHE
from multidrop.sim import SimulatedDrive, Simulator, Wire
from multidrop.transport import aside_log, clock
from multidrop.transport.aside_log import flush_log
from multidrop.transport.line import MOST_LOSSES, LineLog

pytestmark = pytest.mark.usefixtures("_patient")


def messages(caplog: pytest.LogCaptureFixture, logger: str) -> list[tuple[str, str]]:
    return [(record.levelname, record.getMessage()) for record in caplog.records if record.name == logger]


def test_opening_and_closing_a_port_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with (
        caplog.at_level(logging.INFO, "multidrop"),
        Simulator([Wire([SimulatedDrive(PatientToy(1))])]) as sim,
    ):
        port = sim.wires[0].path
        Bus(port).close()
    told = messages(caplog, "multidrop.line")
    assert told == [("INFO", f"{port}: opened ({port})"), ("INFO", f"{port}: closed")]


def test_a_port_that_cannot_be_opened_is_logged_as_not_opened(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    with caplog.at_level(logging.INFO, "multidrop"):
        bus = Bus.awaiting(str(tmp_path / "port"))
        with pytest.raises(LineError):
            bus.line.regain()
        flush_log(PATIENCE)
        bus.close()
    first = messages(caplog, "multidrop.line")[0]
    assert first == ("WARNING", f"{tmp_path}/port: not opened: there is no such port")


def test_losing_and_reopening_a_port_is_logged_once(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    """Several requests fail, but the loss of the port is logged only once."""
    link = tmp_path / "port"

    def plugged_in() -> tuple[int, int]:
        master, slave = os.openpty()
        tty.setraw(slave)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(slave))
        return master, slave

    ends = plugged_in()
    with caplog.at_level(logging.INFO, "multidrop"), Bus(str(link)) as bus:
        drive = bus.attach(PatientToy, 1)
        for end in ends:
            os.close(end)
        for _ in range(3):
            with pytest.raises(LineError):
                drive.read(drive.output_current)
        ends = plugged_in()
        bus.line.regain()
        flush_log(PATIENCE)
        for end in ends:
            os.close(end)
    levels = [
        (level, text.split(": ")[1].split(" (")[0]) for level, text in messages(caplog, "multidrop.line")
    ]
    assert levels[:3] == [("INFO", "opened"), ("WARNING", "lost"), ("INFO", "opened again")]


def test_frequent_losses_of_a_port_do_not_fill_the_log(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server may close each connection after a request. The last entry states whether the port is open."""
    now = 0.0
    monkeypatch.setattr(clock, "now_ns", lambda: round(now * 1e9))
    log = LineLog("port")
    with caplog.at_level(logging.INFO, "multidrop"):
        for second in range(100, 280):
            now = float(second)
            log.lost("hung up")
            log.opened("port")
        log.lost("hung up")
        log.unopened("nothing listens there")
        log.opened("port")
        flush_log(PATIENCE)
    told = [text for _, text in messages(caplog, "multidrop.line")]
    assert len(told) == 2 * MOST_LOSSES * 3 + 2
    assert told[:2] == ["port: lost (hung up)", "port: opened again (port)"]
    assert sum("further losses are not logged" in text for text in told) == 3
    assert told[-2:] == ["port: not opened again: nothing listens there", "port: opened again (port)"]


def test_frames_are_logged_only_at_level_debug(caplog: pytest.LogCaptureFixture) -> None:
    with (
        Simulator([Wire([SimulatedDrive(PatientToy(1))], unpaced=True)]) as sim,
        Bus(sim.wires[0].path) as bus,
    ):
        drive = bus.attach(PatientToy, 1)
        with caplog.at_level(logging.INFO, "multidrop"):
            drive.read(drive.output_current)
        assert messages(caplog, "multidrop.line") == []
        with caplog.at_level(logging.DEBUG, "multidrop"):
            drive.read(drive.output_current)
            flush_log(PATIENCE)
    (_, request), (_, reply) = messages(caplog, "multidrop.line")[:2]
    assert request.startswith(f"{bus.line.port} > ")
    frame = checksums.rtu("01 03 00 02 00 01").hex(" ").upper()
    assert f" {frame} Message(address=1, function=3, start=2, count=1" in request
    assert reply.startswith(f"{bus.line.port} < ")
    assert " 01 03 02 " in reply
    assert "Message(address=1, function=3" in reply


def test_every_write_every_refusal_and_every_stop_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    _, drive, _ = one(InvtCHE(1, name="pump-1", maximum_frequency=50))
    bus: Any = drive.bus
    with caplog.at_level(logging.INFO, "multidrop"):
        drive.set_frequency(20)
        with pytest.raises(WriteForbidden):
            drive.write(drive.register("setpoint"), 1e6)
        bus.stop_all()
        flush_log(PATIENCE)
    told = [text for _, text in messages(caplog, "multidrop.control")]
    assert any(text.startswith("pump-1: ") and text.endswith(": done") for text in told)
    assert any(text.startswith("pump-1: stopped after ") for text in told)


class Hanging(logging.Handler):
    """A log handler that blocks until it is released, as if its disk hung."""

    def __init__(self) -> None:
        super().__init__()
        self.has_begun, self.released = threading.Event(), threading.Event()

    def emit(self, record: logging.LogRecord) -> None:
        self.has_begun.set()
        self.released.wait(PATIENCE)


def test_stop_is_repeated_while_a_log_handler_hangs() -> None:
    line, drive, _ = one(InvtCHE(1))
    handler, logger = Hanging(), logging.getLogger("multidrop.control")
    line.answers = lambda request: b"" if len(line.frames) < 6 else None
    logger.addHandler(handler)
    stop = threading.Thread(target=drive.stop)
    try:
        stop.start()
        assert handler.has_begun.wait(PATIENCE)
        stop.join(PATIENCE)
        assert not stop.is_alive()
    finally:
        handler.released.set()
        logger.removeHandler(handler)
        stop.join(PATIENCE)


def test_log_queue_stays_bounded_while_a_handler_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    aside = aside_log.AsideThread("log")
    monkeypatch.setattr(aside_log, "_log_thread", aside)
    handler, logger = Hanging(), logging.getLogger("multidrop.line")
    logger.addHandler(handler)
    try:
        aside_log.log_aside(logger, logging.WARNING, "the first record")
        assert handler.has_begun.wait(PATIENCE)
        for number in range(2 * aside_log.MOST_WAITING):
            aside_log.log_aside(logger, logging.WARNING, "%d", number)
        assert aside._work.qsize() == aside_log.MOST_WAITING
    finally:
        handler.released.set()
        logger.removeHandler(handler)
        assert aside.flush(PATIENCE)  # so that no record appears during a later test
