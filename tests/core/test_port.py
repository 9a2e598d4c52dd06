"""Serial settings on a descriptor, and the thread that drives all ports.

A pty accepts any baud rate, but always has 8 bits without parity.
"""

from __future__ import annotations

import errno
import os
import termios
import threading
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from multidrop.core import REFUSALS, get_settings, set_settings
from multidrop.core import port as port_module


@pytest.fixture
def pty() -> Iterator[int]:
    master, slave = os.openpty()
    yield slave
    os.close(slave)
    os.close(master)


def refused(fd: int, baudrate: int, format: str) -> set[str]:
    mask = set_settings(fd, baudrate, format)
    return {name for bit, name in REFUSALS.items() if mask & bit}


@pytest.mark.parametrize("baudrate", [50, 1200, 9600, 38400, 115200, 12345, 250_000, 3_000_000])
def test_a_port_can_be_set_to_any_baud_rate(pty: int, baudrate: int) -> None:
    assert refused(pty, baudrate, "8N1") == set()
    assert get_settings(pty) == (baudrate, "8N1")


@pytest.mark.parametrize(
    ("format", "not_taken", "taken"),
    [
        ("8N1", set(), "8N1"),
        ("8N2", set(), "8N2"),
        ("8E1", {"parity"}, "8N1"),
        ("8O2", {"parity"}, "8N2"),
        ("7N2", {"data bits"}, "8N2"),
        ("7E1", {"data bits", "parity"}, "8N1"),
    ],
)
def test_settings_a_pty_refuses_are_reported(pty: int, format: str, not_taken: set[str], taken: str) -> None:
    assert refused(pty, 9600, format) == not_taken
    assert get_settings(pty) == (9600, taken)


@pytest.mark.parametrize("format", ["8E1", "7E1"])
def test_the_same_settings_can_be_set_repeatedly(pty: int, format: str) -> None:
    """tcsetattr() would fail from the second time on, because no requested change takes effect."""
    name = os.ttyname(pty)
    first = refused(pty, 9600, format)
    for _ in range(20):
        again = os.open(name, os.O_RDWR | os.O_NOCTTY)
        try:
            assert refused(again, 9600, format) == first
        finally:
            os.close(again)


def test_a_port_is_set_to_raw_mode(pty: int) -> None:
    """Raw mode has no echo, no line editing, no flow control and no signals."""
    set_settings(pty, 9600, "8N1")
    iflag, oflag, cflag, lflag, *_ = termios.tcgetattr(pty)
    assert (iflag, oflag, lflag) == (0, 0, 0)
    assert cflag & (termios.CREAD | termios.CLOCAL) == termios.CREAD | termios.CLOCAL
    assert not cflag & termios.CRTSCTS


def test_every_byte_value_passes_unchanged() -> None:
    master, slave = os.openpty()
    try:
        set_settings(slave, 9600, "8N1")
        every = bytes(range(256))
        os.write(slave, every)
        assert os.read(master, 1024) == every
        os.write(master, every)
        assert os.read(slave, 1024) == every
    finally:
        os.close(slave)
        os.close(master)


def test_bytes_with_parity_errors_are_dropped(pty: int) -> None:
    set_settings(pty, 9600, "8E1")
    assert termios.tcgetattr(pty)[0] == termios.INPCK | termios.IGNPAR


def test_a_descriptor_without_settings_raises() -> None:
    reader, writer = os.pipe()
    try:
        with pytest.raises(OSError, match="no serial settings") as failed:
            set_settings(writer, 9600, "8N1")
        assert failed.value.errno == errno.ENOTTY
        with pytest.raises(OSError, match="no serial settings"):
            get_settings(reader)
    finally:
        os.close(reader)
        os.close(writer)
    with pytest.raises(OSError, match="no serial settings") as failed:
        set_settings(writer, 9600, "8N1")
    assert failed.value.errno == errno.EBADF


@pytest.mark.slow
def test_ports_opened_concurrently_share_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """While one port starts the thread, the other ports wait; otherwise there would be several threads."""
    started: list[str] = []
    is_second = threading.Event()

    def start() -> str:
        started.append(f"engine {len(started)}")
        if len(started) > 1:
            is_second.set()
        is_second.wait(0.5)  # time in which a second port would start a thread if it did not wait
        return started[0]

    monkeypatch.setattr(port_module, "lib", SimpleNamespace(md_engine_start=start))
    engine, found = port_module._Engine(), list[str]()
    threads = [threading.Thread(target=lambda: found.append(engine.c)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert started == ["engine 0"]
    assert found == ["engine 0"] * 4
