"""`multidrop sniff` and `decode`: print, capture or record the traffic on a line, and send nothing."""

from __future__ import annotations

import argparse
import json
import os
import select
import sys
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, closing
from importlib.metadata import version
from io import FileIO
from pathlib import Path
from typing import Any, NoReturn

from multidrop.capture import Capture, CaptureWriter, Decoding, Pairing, Side, Sniffed
from multidrop.capture.decoding import ExchangeFormatter, RegisterLookup
from multidrop.capture.decoding import line_of as captured_line
from multidrop.cli.support.arguments import (
    add_json_argument,
    add_line_arguments,
    duration,
    line_of,
    plant_at,
    usual_settings,
    whole,
)
from multidrop.cli.support.files import check_capture, refuse_overwriting
from multidrop.cli.support.output import print_text, warn
from multidrop.cli.support.signals import noting_signals
from multidrop.cli.support.values import counted
from multidrop.core import Kind, Splitter, Stream, must_take, refused_names, set_settings
from multidrop.drive.line_settings import Settings
from multidrop.errors import LineError
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant, PlantLine
from multidrop.recording import FORMATS, open_writer
from multidrop.transport.network_port import PORT_FAILURES
from multidrop.transport.open_port import reason_of, unopened

_SILENT_S = 0.5  # a silence, in s, that is longer than any pause within a frame
_GIVEN_UP_S = 1.5  # silence, in s, after which a request counts as unanswered


def add_arguments(parser: argparse.ArgumentParser) -> None:
    if parser.get_default("command") == "decode":
        parser.add_argument("capture", metavar="FILE", type=Path, help="a capture: pcap or pcapng")
        parser.add_argument("--plant", metavar="PLANT.toml", help="for names and engineering units")
        into = f"a new recording: {', '.join(FORMATS)}; printed as text if not given"
        parser.add_argument("--out", metavar="FILE", type=Path, help=into)
    else:
        add_line_arguments(parser)
        parser.add_argument("--replay", metavar="FILE", type=Path, help="read a capture instead of a port")
        parser.add_argument("--plant", metavar="PLANT.toml", help="for names and engineering units")
        into = "write a capture, for Wireshark too"
        parser.add_argument("--out", metavar="FILE.pcapng", type=Path, help=into)
        parser.add_argument("--baudrate", type=whole, metavar="N", help="default: the plant file's, or 9600")
        parser.add_argument("--format", metavar="8N1", help="default: the plant file's, or 8N1")
        parser.add_argument("--seconds", type=duration, metavar="S", help="how long; default: until Ctrl-C")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    return _decode(arguments) if arguments.command == "decode" else _sniff(arguments)


def _sniff(arguments: argparse.Namespace) -> int:
    if (arguments.port is None) == (arguments.replay is None):
        raise ValueError("name either a PORT to listen to, or a capture with --replay FILE")
    if arguments.out:
        check_capture(arguments.out)
    plant = load_plant(arguments.plant) if arguments.plant else None
    with ExitStack() as stack:
        if arguments.replay:
            source = stack.enter_context(Capture(arguments.replay))
            out = stack.enter_context(CaptureWriter(arguments.out)) if arguments.out else None
            counts = dict(replay(source, plant, as_json=arguments.json, out=out))
        else:
            line = _line(arguments, plant)
            listener = stack.enter_context(closing(Listener(arguments.port, _settings(arguments, line))))
            out = stack.enter_context(CaptureWriter(arguments.out)) if arguments.out else None
            port = arguments.port
            name = line.name if line else port if "://" in port else Path(port).name
            printer = TrafficPrinter(name, line, as_json=arguments.json, out=out)
            _listen(listener, printer, arguments.seconds)
            counts = printer.pairing.counts()
    print_text(json.dumps({"summary": counts}) if arguments.json else summary(counts))
    return 0


def _line(arguments: argparse.Namespace, plant: Plant | None) -> PlantLine | None:
    """Return the plant file's line to listen to; None without a plant file, or if no line fits.

    With PLANT.toml instead of PORT, also set `arguments.port` to the line's port. With --plant, return the
    line with this port, or else the plant's only line.
    """
    named = plant_at(arguments)
    if named is None:
        port = arguments.port
        lines = plant.lines if plant else ()
        return next((line for line in lines if line.port == port), captured_line(plant, port))
    if plant:
        raise ValueError(f"remove --plant: {arguments.port} is a plant file already")
    line = line_of(named, arguments.name)
    arguments.port = line.port
    return line


def _settings(arguments: argparse.Namespace, line: PlantLine | None) -> Settings:
    usual = usual_settings(line)
    baudrate = usual.baudrate if arguments.baudrate is None else arguments.baudrate
    return Settings(baudrate, arguments.format or usual.format)


def _listen(listener: Listener, printer: TrafficPrinter, seconds: float | None) -> None:
    print_text(f"listening on {listener.port}, Ctrl-C ends", file=sys.stderr, flush=True)
    begun = received_at = time.monotonic()
    with noting_signals() as interruption:
        while not interruption.came:
            now = time.monotonic()
            if seconds is not None and now - begun >= seconds:
                break
            if listener.receive():
                received_at = time.monotonic()  # read the clock again, because receiving may have taken long
            listener.stream.end(now - received_at > _SILENT_S)
            printer.show(listener.stream)
            if now - received_at > _GIVEN_UP_S:
                printer.finish()
    listener.stream.end(True)
    printer.show(listener.stream)
    printer.finish()


# ---- a port that is only read ----
#
# A device is opened read-only. A URL is opened by pyserial, and pyserial's `write` is replaced. So a
# socket receives nothing, and an rfc2217 server only the serial settings.


LISTEN_S = 0.05  # longest wait for bytes in one read, in s
_MOST = 4096  # most bytes that one read returns


def _open_device(port: str, settings: Settings) -> FileIO:
    """Open a local device read-only, lock it, and set its baud rate and character format."""
    if sys.platform == "win32":
        raise LineError(port, "serial devices cannot be sniffed on Windows: use socket://")
    import fcntl

    fd = os.open(port, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        refused = set_settings(fd, settings.baudrate, settings.format) & must_take(os.ttyname(fd))
        if refused:
            raise LineError(port, f"the port does not support the {refused_names(refused)} of {settings}")
    except OSError:
        os.close(fd)
        raise
    return FileIO(fd)


def _open_url(url: str, settings: Settings) -> Any:
    """Open a URL with pyserial, and replace `write` by a function that raises."""
    port = unopened(url)
    vars(port)["write"] = _refuse
    port.baudrate = settings.baudrate
    port.bytesize = settings.databits
    port.parity = settings.parity
    port.stopbits = settings.stopbits
    port.timeout = LISTEN_S
    port.open()
    return port


def _refuse(data: bytes) -> NoReturn:
    raise OSError(f"this port only listens: {data.hex(' ')} was not sent")


class Listener:
    """Reads a port or URL into `stream`. Every failure of the port is raised as LineError."""

    def __init__(self, port: str, settings: Settings) -> None:
        self.port = port
        self._character_ns = round(settings.character * 1e9)
        self._pause_ns = round(settings.t3_5 * 1e9)
        self._last_ns = 0
        self.stream = Stream()
        try:
            self._source: Any = (_open_url if "://" in port else _open_device)(port, settings)
        except LineError:
            raise
        except PORT_FAILURES as failure:
            raise LineError(port, reason_of(failure)) from failure

    def receive(self) -> int:
        """Wait up to LISTEN_S for bytes, and add them to the stream; return their number."""
        try:
            received = self._read()
        except PORT_FAILURES as failure:
            raise LineError(self.port, f"the port was lost ({reason_of(failure)})") from failure
        if not received:
            return 0
        now_ns = time.time_ns()
        begun_ns = max(self._last_ns, now_ns - len(received) * self._character_ns)
        after_pause = begun_ns - self._last_ns >= self._pause_ns
        self.stream.put(received, begun_ns, after_pause=after_pause)
        self._last_ns = now_ns
        return len(received)

    def _read(self) -> bytes:
        """Return the bytes received within LISTEN_S. Raises EOFError if the other end has hung up."""
        try:
            fd = self.fileno()
        except OSError:  # the port has no file descriptor, such as loop://
            return bytes(self._source.read(1) + self._source.read_all())
        if not select.select([fd], [], [], LISTEN_S)[0]:
            return b""
        try:
            received = os.read(fd, _MOST)
        except BlockingIOError:
            return b""
        if not received:
            raise EOFError("hung up")
        return received

    def fileno(self) -> int:
        return int(self._source.fileno())

    def close(self) -> None:
        self._source.close()


# ---- traffic ----


_SIDES = {
    Kind.JUNK: Side.EITHER,
    Kind.REQUEST: Side.ASKING,
    Kind.EITHER: Side.ASKING,
    Kind.REPLY: Side.ANSWERING,
    Kind.STRAY: Side.ANSWERING,
}


class TrafficPrinter:
    """Prints the exchanges on one line, and writes the frames into a capture."""

    def __init__(
        self, name: str, line: PlantLine | None, *, as_json: bool, out: CaptureWriter | None
    ) -> None:
        self.name = name
        self.pairing = Pairing()
        self._splitter = Splitter()
        self._formatter = ExchangeFormatter(RegisterLookup(line))
        self._as_json = as_json
        self._out = out

    def show(self, stream: Stream) -> None:
        """Print the complete exchanges of the stream so far."""
        spans = list(self._splitter.spans(stream))
        if self._out:
            for span in spans:
                self._out.write(span.raw, _SIDES[span.kind], span.time_ns, self.name)
        self._print(self.pairing.pair(spans))

    def finish(self) -> None:
        """Print the pending requests as unanswered."""
        self._print(self.pairing.flush())

    def _print(self, traffic: Iterable[Sniffed]) -> None:
        for sniffed in traffic:
            if self._as_json:
                print_text(json.dumps({"line": self.name} | self._formatter.json(sniffed)))
            else:
                print_text(self._formatter.text(sniffed))
        sys.stdout.flush()


def replay(
    capture: Capture, plant: Plant | None, *, as_json: bool, out: CaptureWriter | None = None
) -> Counter[str]:
    """Print the traffic in a capture; return the numbers of exchanges, frames and so on, for `summary`."""
    printers: list[TrafficPrinter] = []
    for _ in capture:
        printers += [
            TrafficPrinter(name, captured_line(plant, name), as_json=as_json, out=out)
            for name in capture.lines[len(printers) :]
        ]
        for printer, stream in zip(printers, capture.streams, strict=True):
            printer.show(stream)
    for printer in printers:
        printer.finish()
    return sum((Counter(printer.pairing.counts()) for printer in printers), Counter())


_COUNTED = {  # the noun for each count, in singular and plural
    "exchanges": ("exchange", "exchanges"),
    "broadcasts": ("broadcast", "broadcasts"),
    "unanswered": ("request without a reply", "requests without a reply"),
    "strays": ("reply without a request", "replies without a request"),
    "unknown_bytes": ("unknown byte", "unknown bytes"),
}
_ALWAYS = ("exchanges", "unknown_bytes")  # counts that are printed even if 0


def summary(counts: Mapping[str, int]) -> str:
    return ", ".join(
        f"{counts.get(name, 0)} {words[counts.get(name, 0) != 1]}"
        for name, words in _COUNTED.items()
        if counts.get(name) or name in _ALWAYS
    )


# ---- captures ----


def _decode(arguments: argparse.Namespace) -> int:
    if arguments.out:
        refuse_overwriting(arguments.out)
    plant = load_plant(arguments.plant) if arguments.plant else None
    with Capture(arguments.capture) as capture:
        if arguments.out:
            counts = _record(capture, plant, arguments.out)
        else:
            counts = dict(replay(capture, plant, as_json=arguments.json))
        if capture.truncated:
            warn(
                f"{capture.path} ends within a packet: "
                f"its last {counted(capture.truncated, 'byte')} were skipped"
            )
    into = f"{counted(counts['rows'], 'row')} in {arguments.out}: " if arguments.out else ""
    print_text(json.dumps({"summary": counts}) if arguments.json else into + summary(counts))
    return 0


def _record(capture: Capture, plant: Plant | None, out: Path) -> dict[str, Any]:
    about = plant.metadata() if plant else {"multidrop": version("multidrop")}
    decoding = Decoding(capture, plant)
    with open_writer(out, {**about, "capture": str(capture.path)}) as writer:
        for batch in decoding:
            writer.write(batch)
    return {**decoding.counts(), "rows": writer.rows}
