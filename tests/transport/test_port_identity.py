"""A USB adapter that gets the name of a lost port is not used, because its line has other motors."""

from __future__ import annotations

import errno
import os
import pty
import resource
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
from lines import line, plant, polled, rows_of, until
from serial import Serial
from tables import table
from toy import Toy

from multidrop import Poller
from multidrop.bus import Bus
from multidrop.core import NO_DIVISOR, RS485, Failure, Port, TransactionIds, close_behind, port
from multidrop.errors import LineError, NoReply, PortLost
from multidrop.families import InnovertIBD
from multidrop.sim import EncodedDrive, Simulator, Wire, simulated
from multidrop.transport import clock, open_port, port_identity
from multidrop.transport.line import Line
from multidrop.transport.open_port import CLOSING_S, STALLED, OpenPort, failing_refusals, why_lost
from multidrop.transport.port_identity import USBAdapter, adapter_of, lasting_name

USB = "devices/pci0000:00/0000:00:14.0/usb1"


class Sysfs:
    """A folder that describes serial devices as Linux does in /sys."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        (folder / "class" / "tty").mkdir(parents=True)
        monkeypatch.setattr(port_identity, "TTYS", folder / "class" / "tty")

    def add(self, tty: str, device: str, serial: str = "", port_number: str = "") -> None:
        found = self.folder / device
        found.mkdir(parents=True, exist_ok=True)
        if serial:
            plugged_in = next(part for part in found.parents if ":" not in part.name)
            (plugged_in / "serial").write_text(f"{serial}\n", "ascii")
        if port_number:
            (found / "port_number").write_text(f"{port_number}\n", "ascii")
        (self.folder / "class" / "tty" / tty).mkdir(exist_ok=True)
        link = self.folder / "class" / "tty" / tty / "device"
        link.unlink(missing_ok=True)
        link.symlink_to(found)

    @contextmanager
    def plugged_in(self, link: Path, place: str, serial: str = "") -> Iterator[Wire]:
        """Simulate a line behind a USB adapter. As on Linux, the adapter exists before its device name."""
        port = link.with_name(place)
        with Simulator([wire := Wire([EncodedDrive(InnovertIBD(1))], port=str(port), unpaced=True)]):
            self.add(port.resolve().name, f"{USB}/{place}/{place}:1.0/tty", serial)
            link.symlink_to(port)
            yield wire
            (self.folder / "class" / "tty" / port.resolve().name / "device").unlink()
        link.unlink()


@pytest.fixture
def sysfs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sysfs:
    return Sysfs(tmp_path / "sys", monkeypatch)


@table(
    ("device", "serial", "port_number", "adapter"),
    [
        (f"{USB}/1-1/1-1:1.0/ttyUSB0", "A50285BI", "0", USBAdapter("1-1:1.0.0", "A50285BI:1.0.0")),
        (f"{USB}/1-4/1-4.2/1-4.2:1.3/ttyUSB3", "FT6", "0", USBAdapter("1-4.2:1.3.0", "FT6:1.3.0")),
        # one USB interface has several ports
        (f"{USB}/1-1/1-1:1.0/ttyUSB1", "MX", "1", USBAdapter("1-1:1.0.1", "MX:1.0.1")),
        # a CH340 adapter has no serial number
        (f"{USB}/1-1/1-1:1.0/ttyUSB0", "", "0", USBAdapter("1-1:1.0.0", "")),
        (f"{USB}/1-3/1-3:1.0", "E66", "", USBAdapter("1-3:1.0.0", "E66:1.0.0")),  # ttyACM0
        ("devices/pnp0/00:05", "", "", None),  # ttyS0
    ],
)
def test_an_adapter_is_identified_by_usb_socket_and_serial_number(
    tmp_path: Path, device: str, serial: str, port_number: str, adapter: USBAdapter | None
) -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        sysfs = Sysfs(tmp_path / (device + port_number + serial).replace("/", "_"), monkeypatch)
        sysfs.add("tty", device, serial, port_number)
        assert adapter_of("/dev/tty") == adapter
        assert adapter_of("/dev/other") is None


@table(
    ("before", "now", "is_same"),
    [
        (("1-1", "A1"), ("1-1", "A1"), True),
        (("1-1", "A1"), ("1-2", "A1"), True),  # the same adapter in another USB socket
        (("1-1", "A1"), ("1-2", "B2"), False),  # two adapters came back in another order
        (("1-1", "A1"), ("1-1", "B2"), False),  # another adapter in the same socket may serve another line
        (("1-1", ""), ("1-1", ""), True),
        (("1-1", ""), ("1-2", ""), False),
        (("1-1", "A1"), ("1-2", ""), False),
    ],
)
def test_a_port_is_reopened_only_with_the_same_adapter(
    tmp_path: Path, before: tuple[str, str], now: tuple[str, str], is_same: bool
) -> None:
    folder = tmp_path / "-".join(before + now)
    link = folder / "ttyUSB0"
    with pytest.MonkeyPatch.context() as monkeypatch:
        sysfs = Sysfs(folder / "sys", monkeypatch)
        found = Line(str(link))
        with sysfs.plugged_in(link, *before):
            found.open()
        with sysfs.plugged_in(link, *now):
            if is_same:
                found.reopen()
            else:
                with pytest.raises(LineError, match="this name now belongs to another adapter"):
                    found.reopen()
            assert found.is_lost != is_same
        found.close()


@table(
    ("before", "now", "others", "is_found"),
    [
        (("1-1", "A1"), ("1-1", "A1"), [], True),  # the same adapter in the same socket
        (("1-1", "A1"), ("1-1", "A1"), [("1-2", "A1")], True),  # another adapter has the same serial number
        # in another USB socket: this may be another adapter with the same serial number
        (("1-1", "A1"), ("1-2", "A1"), [], False),
        (("1-1", "A1"), ("1-2", "A1"), [("1-1", "B2")], False),
        (("1-1", ""), ("1-1", ""), [("1-2", "")], True),
        (("1-1", ""), ("1-2", ""), [], False),
        # two adapters with the known serial number, but neither is in the old USB socket
        (("1-1", "A1"), ("1-2", "A1"), [("1-3", "A1")], False),
    ],
)
def test_renamed_adapter_is_found_only_in_the_same_usb_socket(
    tmp_path: Path,
    before: tuple[str, str],
    now: tuple[str, str],
    others: list[tuple[str, str]],
    is_found: bool,
) -> None:
    folder = tmp_path / "-".join(map(str, (*before, *now, *others)))
    with pytest.MonkeyPatch.context() as monkeypatch, ExitStack() as stack:
        sysfs = Sysfs(folder / "sys", monkeypatch)
        monkeypatch.setattr(port_identity, "DEVICES", Path("/dev/pts"))
        found = Line(str(folder / "ttyUSB0"))
        with sysfs.plugged_in(folder / "ttyUSB0", *before):
            found.open()
        for number, place in enumerate([now, *others], 1):
            stack.enter_context(sysfs.plugged_in(folder / f"ttyUSB{number}", *place))
        if is_found:
            found.reopen()
            assert open_port.device_of(found._opened._serial) == str((folder / "ttyUSB1").resolve())
        else:
            with pytest.raises(LineError, match="no such port"):
                found.reopen()
        found.close()


def test_another_adapter_with_the_same_serial_number_is_not_used(tmp_path: Path, sysfs: Sysfs) -> None:
    """Two adapters have one serial number. After a USB reset, the second gets the port name of the first."""
    link, later = tmp_path / "ttyUSB0", tmp_path / "ttyUSB1"
    found = Line(str(link))
    with sysfs.plugged_in(later, "1-2", "A1"), sysfs.plugged_in(link, "1-1", "A1"):
        found.open()
    with (
        sysfs.plugged_in(link, "1-2", "A1"),
        pytest.raises(LineError, match="this name now belongs to another adapter"),
    ):
        found.reopen()
    with sysfs.plugged_in(link, "1-1", "A1"):
        found.reopen()
    found.close()


@pytest.mark.parametrize("is_replaced", [False, True])
def test_a_new_pseudo_terminal_with_a_used_number_is_not_opened(tmp_path: Path, is_replaced: bool) -> None:
    """The new pseudo-terminal may belong to any program. With a replaced link, the port is found again."""
    link = tmp_path / "port"
    ends = pty.openpty()
    device = Path(os.ttyname(ends[1]))
    link.symlink_to(device)
    found = Line(str(link))
    found.open()
    for end in ends:
        os.close(end)
    with pytest.raises(LineError, match="no such port"):
        found.reopen()
    with ExitStack() as stack:
        time.sleep(0.05)  # file times have a resolution of some ms
        later: list[str] = []
        while not (device.exists() and later):
            ends = pty.openpty()
            later.append(os.ttyname(ends[1]))
            for end in ends:
                stack.callback(os.close, end)
        if is_replaced:
            link.unlink()
            link.symlink_to(later[-1])  # usually `device`, whose return ends the loop
            found.reopen()
            found.close()
        else:
            gone = rf"the port's pseudo-terminal is gone, and {device} is now a different one"
            with pytest.raises(LineError, match=gone):
                found.reopen()
            assert found.is_lost


def test_lasting_port_name_contains_the_adapters_serial_number(
    tmp_path: Path, sysfs: Sysfs, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_id, names = tmp_path / "by-id", {}
    by_id.mkdir()
    monkeypatch.setattr(port_identity, "BY_ID", by_id)
    for number, serial in enumerate(("A50285BI", "")):
        device = tmp_path / f"ttyUSB{number}"
        device.touch()
        names[device] = by_id / f"usb-FTDI_{serial}-if00-port0"
        names[device].symlink_to(device)
        sysfs.add(device.name, f"{USB}/1-{number}/1-{number}:1.0/{device.name}", serial)
    named, nameless = names
    assert lasting_name(str(named)) == str(names[named])
    assert lasting_name(str(nameless)) == str(nameless)  # a link without a serial number fits any adapter
    for other in (str(names[named]), "/dev/ttyS0", "socket://127.0.0.1:4001", "COM5"):
        assert lasting_name(other) == other


def test_a_port_named_by_its_usb_socket_opens_with_any_adapter(
    tmp_path: Path, sysfs: Sysfs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(open_port, "BY_PLACE", str(tmp_path))
    link = tmp_path / "pci-0000:00:14.0-usb-0:1:1.0-port0"
    found = Line(str(link))
    for serial in ("A1", "B2"):
        with sysfs.plugged_in(link, "1-1", serial):
            found.reopen()
    found.close()


@pytest.mark.slow
def test_port_leading_to_another_line_gets_neither_polls_nor_stops(
    tmp_path: Path, sysfs: Sysfs, caplog: pytest.LogCaptureFixture
) -> None:
    """The other line's drive would report a standstill while the intended motor keeps running."""
    link = tmp_path / "ttyUSB0"
    pump = InnovertIBD(1, name="pump")
    asked = line(str(link), polled(pump, [InnovertIBD.output_current]))
    statuses: Counter[str] = Counter()
    with ExitStack() as stack:
        with sysfs.plugged_in(link, "1-1", "A1"):
            poller = stack.enter_context(Poller(plant(asked)))

            def seen(status: str) -> bool:
                statuses.update(row.status for row in rows_of(poller))
                return statuses[status] > 0

            until(lambda: seen("ok"))
        with sysfs.plugged_in(link, "1-2", "B2") as another:
            until(lambda: "this name now belongs to another adapter (B2:1.0.0, not A1:1.0.0)" in caplog.text)
            with pytest.raises(PortLost, match="this name now belongs to another adapter"):
                pump.stop(seconds=0.5)
            assert another.drives[0].counters.requests == 0
        statuses.clear()
        with sysfs.plugged_in(link, "1-3", "A1"):
            until(lambda: seen("ok"))
    assert caplog.text.count("not opened again: this name now belongs to another adapter") == 1


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
def test_port_loss_reason_says_unplugged_stalled_or_hung_up(port: str, error: int, why: str) -> None:
    assert why_lost(port, error) == why


@pytest.fixture
def terminal() -> Iterator[str]:
    ends = pty.openpty()
    yield os.ttyname(ends[1])
    for end in ends:
        os.close(end)


@pytest.mark.parametrize("must_discard", [False, True])
def test_stalled_port_closes_at_once_to_discard_a_command(
    must_discard: bool, terminal: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    closed: list[float] = []

    def close(fd: int, other: int, seconds: float) -> None:
        closed.append(seconds)
        os.dup2(other, fd)

    monkeypatch.setattr(open_port, "close_behind", close)
    monkeypatch.setattr(clock, "sleep", lambda seconds: None)
    found = Line(terminal).open()
    monkeypatch.setattr(Serial, "out_waiting", 8)
    found._opened.must_discard = must_discard
    found.close()
    assert closed == [0.0 if must_discard else CLOSING_S]
    assert ("waiting 0.75 s for its adapter" in caplog.text) != must_discard


@contextmanager
def all_descriptors_in_use() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    held: list[int] = []
    try:
        highest = max(int(fd.name) for fd in Path("/proc/self/fd").iterdir())
        resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 1, before[1]))
        with suppress(OSError):
            while True:
                held.append(os.open(os.devnull, os.O_RDONLY))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
        for fd in held:
            os.close(fd)


def test_a_stalled_port_closes_in_time_if_no_descriptor_is_free(
    terminal: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If pyserial closed the port itself, it would wait for the adapter for up to 30 s."""
    closed: list[float] = []

    def close(fd: int, other: int, seconds: float) -> None:
        closed.append(seconds)
        close_behind(fd, other, seconds)
        assert not os.isatty(fd)

    monkeypatch.setattr(open_port, "close_behind", close)
    monkeypatch.setattr(clock, "sleep", lambda seconds: None)
    found = Line(terminal).open()
    port = found._opened._serial
    monkeypatch.setattr(Serial, "out_waiting", 8)
    with all_descriptors_in_use():
        found.close()
    assert closed == [CLOSING_S]
    assert port is not None
    assert not port.is_open


def test_loss_reason_and_another_masters_bytes_are_known_before_reopening(terminal: str) -> None:
    found = Line(terminal).open()
    core = SimpleNamespace(
        lost=True, lost_error=0, called_off=True, is_stalled=False, foreign=7, stop=lambda: None
    )
    found.queue = core  # type: ignore[assignment]
    found.drop()
    assert found.why_lost == f"{terminal}: the port was lost (hung up)"
    assert found._opened.must_discard
    assert found.foreign == 7
    found.close()


def test_read_reopens_a_port_closed_to_discard_a_command() -> None:
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
def test_a_stalled_port_is_not_logged_as_lost_after_an_unsent_command(
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


def test_ctrl_c_during_a_command_closes_the_port(terminal: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the driver could still send the command."""
    found = Line(terminal).open()

    def interrupted(*given: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Port, "called_off", True)
    monkeypatch.setattr(Port, "carry_out", interrupted)
    with pytest.raises(KeyboardInterrupt):
        found.carry_out(SimpleNamespace())  # type: ignore[arg-type]
    assert found.queue is None  # the port is closed
    found.close()


def test_wrong_unsent_byte_count_of_a_driver_is_logged_once(
    terminal: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(Port, "miscounts", True)
    found = Line(terminal).open()
    found.note_news()
    found.note_news()
    found.close()
    assert caplog.text.count("its driver counts unsent bytes although replies came") == 1


def test_no_reply_error_mentions_a_stalled_adapter(terminal: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Line, "is_stalled", True)
    with Bus(terminal) as bus:
        toy = bus.attach(Toy, 1)
        bus.peer(toy).c.most_timeout_ns = bus.peer(toy).c.least_timeout_ns = 20_000_000
        with pytest.raises(NoReply, match=f"but the port is {STALLED}"):
            toy.read(toy.output_current)


def test_a_stalled_port_stays_open_after_an_unsent_read(
    terminal: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = SimpleNamespace(count=-1, result=Failure.STALLED, error=errno.ETIMEDOUT, raw=b"", reply=None)
    with Bus(terminal) as bus:
        toy = bus.attach(Toy, 1)
        monkeypatch.setattr(Port, "carry_out", lambda *given: held)
        with pytest.raises(NoReply, match=f"but the port is {STALLED}"):
            toy.read(toy.output_current)
        assert not bus.line.is_lost


@table(
    ("baudrate", "sentence"),
    [
        (76800, "its UART would run at 57600; the nearest possible baud rates are 57600 and 115200"),
        (12345, "its UART would run at 12800; the nearest possible baud rates are 11520 and 12800"),
        (38400, "its driver replaces 38400 baud by a custom divisor: setserial /dev/ttyS1 spd_normal"),
    ],
)
def test_the_error_of_an_impossible_baud_rate_names_the_nearest_rates(baudrate: int, sentence: str) -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(port, "lib", SimpleNamespace(md_port_baud_base=lambda fd: 115200))
        found = OpenPort("/dev/ttyS1", TransactionIds.MATCH, RS485.OFF, None)
        found._serial = SimpleNamespace(fileno=lambda: 0)  # type: ignore[assignment]
        assert found.refusal(NO_DIVISOR, baudrate).endswith(sentence)


@pytest.mark.parametrize(
    ("driver", "is_checked"),
    [("serial8250", True), ("serial", True), ("dw-apb-uart", False), ("ftdi_sio", False)],
)
def test_baud_rates_are_checked_only_for_uarts_with_integer_divisors(
    driver: str, is_checked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("tty/ttyS1", "drivers", "devices/card"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "drivers" / driver).mkdir()
    (tmp_path / "devices" / "card" / "driver").symlink_to(tmp_path / "drivers" / driver)
    (tmp_path / "tty/ttyS1/device").symlink_to(tmp_path / "devices/card")
    monkeypatch.setattr(port_identity, "TTYS", tmp_path / "tty")
    assert bool(failing_refusals("/dev/ttyS1") & NO_DIVISOR) == is_checked
