"""`multidrop ports` and `scan`: list the serial ports, and find the drives on a line.

`ports` shows each port's adapter and whether the user may open it. `scan` finds drives with their addresses
and settings, and writes a plant file.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from multidrop.cli.doctor_findings import SYSFS, find_adapter
from multidrop.cli.support.arguments import (
    add_json_argument,
    add_line_arguments,
    add_opening_arguments,
    argument,
    line_of,
    opening_of,
    plant_at,
)
from multidrop.cli.support.files import check_writable, write_new
from multidrop.cli.support.output import print_json, print_text
from multidrop.cli.support.values import counted, wrapped
from multidrop.core import RS485, Framing
from multidrop.drive.declaration_check import UNIT_IDS
from multidrop.drive.family import Drive
from multidrop.drive.line_settings import SERIAL_ADDRESSES, speaks_tcp
from multidrop.families import MODELS
from multidrop.families.registry import RECOGNISABLE, find_model
from multidrop.printable import plain_whole
from multidrop.scan import (
    ADDRESSES,
    Crowd,
    Finding,
    Found,
    Noise,
    Progress,
    Sweep,
    Untried,
    line_setting,
    one_of_each_framing,
    over_tcp,
    plant_text,
    scan,
    sweeps,
)
from multidrop.transport.line import Line
from multidrop.transport.port_identity import lasting_name, of_device

_CLEAR_LINE = "\r\x1b[K"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    if parser.get_default("command") == "scan":
        _add_scan(parser)
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    return _run_ports(arguments) if arguments.command == "ports" else _run_scan(arguments)


# ---- ports ----


NO_PORTS = "no serial port found; plug the adapter in" + (
    ", then see `sudo dmesg | tail`" if sys.platform == "linux" else ""
)


@dataclass(frozen=True)
class SerialPort:
    """A serial port. If its adapter has a serial number, `name` is the device name that contains it."""

    name: str
    device: str
    adapter: str
    may_open: bool
    advice: str = ""  # how the user gets the permission to open the port


def _run_ports(arguments: argparse.Namespace) -> int:
    found = sorted(_linux_ports() if sys.platform == "linux" else _other_ports(), key=lambda port: port.name)
    if arguments.json:
        print_json([asdict(port) for port in found])
    else:
        print_text("\n".join(line for port in found for line in _port_text(port)) or NO_PORTS)
    return 0 if found else 1


def _port_text(port: SerialPort) -> Iterator[str]:
    yield port.name
    now = f"{port.device}: " if port.device != port.name else ""
    yield from wrapped(f"{now}{port.adapter}", "  ", "    ")
    opening = "you may open it" if port.may_open else f"you may not open it: {port.advice}"
    yield from wrapped(opening, "  ", "    ", breaks_words=False)


def _linux_ports(sysfs: Path = SYSFS, devices: Path = Path("/dev")) -> Iterator[SerialPort]:
    """Yield the terminal devices that have hardware. For an absent UART, the kernel reports type 0."""
    for tty in sorted((sysfs / "class/tty").glob("*")):
        device, uart = devices / tty.name, tty / "type"
        if not (tty / "device").exists() or (uart.exists() and uart.read_text("ascii").strip() == "0"):
            continue
        adapter = find_adapter(str(device), sysfs)
        if not adapter.driver or not device.exists():
            continue
        advice = "" if os.access(device, os.R_OK | os.W_OK) else _permission_advice(device)
        yield SerialPort(of_device(str(device)), str(device), str(adapter), not advice, advice)


def _permission_advice(device: Path) -> str:
    import grp
    import pwd

    about = device.stat()
    try:
        owner, user = (pwd.getpwuid(number).pw_name for number in (about.st_uid, os.getuid()))
        group = grp.getgrgid(about.st_gid)
    except KeyError:  # in a container, the number of a user or group may have no name
        return f"start this program, or its container, in group {about.st_gid}"
    if about.st_mode & 0o060 != 0o060 or not about.st_gid:
        return f"only {owner} may; a udev rule can give it to a group"
    if user in group.gr_mem:
        return f"you were added to its group {group.gr_name} after this login: log out and in again"
    return f"sudo usermod -aG {group.gr_name} {user}, then log out and in again"


def _other_ports() -> Iterator[SerialPort]:
    """Yield the ports that pyserial finds on Windows or macOS, where every user may open them."""
    from serial.tools.list_ports import comports

    for port in comports():
        yield SerialPort(port.device, port.device, port.description or "unknown adapter", may_open=True)


# ---- scan ----


def _add_scan(parser: argparse.ArgumentParser) -> None:
    add_line_arguments(parser)
    parser.add_argument("--model", action="append", default=[], help="only these; default: all families")
    parser.add_argument(
        "--addresses",
        metavar="1-31",
        type=argument(_addresses),
        default=list(ADDRESSES),
        help=f"such as 1-247 or 1,5,9, on tcp:// 0-255; default: {ADDRESSES[0]}-{ADDRESSES[-1]}",
    )
    for name, metavar, parse in (("--baudrates", "N,N", _baudrates), ("--formats", "8N1,8E1", _formats)):
        kind = argument(parse)
        parser.add_argument(name, metavar=metavar, type=kind, default=[], help="only these; default: all")
    parser.add_argument("--quick", action="store_true", help="skip the second pass for slow drives")
    add_opening_arguments(parser)
    parser.add_argument(
        "--out", metavar="PLANT.toml", type=Path, help="write a plant file of the drives found"
    )


def _run_scan(arguments: argparse.Namespace) -> int:
    if arguments.out:
        check_writable(arguments.out)
    plant = plant_at(arguments)
    declared = line_of(plant, arguments.name) if plant else None
    arguments.port = declared.port if declared else arguments.port
    rs485, settle = opening_of(arguments, declared)
    families = _families(arguments.model)
    # A scan for all families uses only the settings of the built-in families. The other families' settings
    # would make the scan much longer.
    planned = _planned(arguments, list(families.values() if arguments.model else MODELS.values()))
    begun = time.monotonic()
    found, finished = _scan(arguments, rs485, settle, planned, list(families.values()))
    seconds = round(time.monotonic() - begun, 3)
    drives = [finding for finding in found if isinstance(finding, Found)]
    written = None
    if arguments.out and any(drive.models for drive in drives):
        write_new(arguments.out, plant_text(lasting_name(arguments.port), drives, families, rs485, settle))
        written = str(arguments.out)
    if arguments.json:
        record = {"port": arguments.port, "seconds": seconds, "finished": finished}
        print_json(record | _as_json(found) | {"plant": written})
    else:
        print_text(_summary(len(drives), seconds, arguments.addresses, finished))
        if written:
            print_text(f"wrote {written}; next: multidrop poll {written}")
    if not finished:
        raise KeyboardInterrupt
    return 0 if drives else 1


def _scan(
    arguments: argparse.Namespace,
    rs485: RS485,
    settle: float,
    planned: Sequence[Sweep],
    families: Sequence[type[Drive]],
) -> tuple[list[Finding], bool]:
    """Return the findings, and whether the scan was finished; after Ctrl-C, the findings so far."""
    found: list[Finding] = []
    line = Line(arguments.port, rs485=rs485, settle=settle).open()
    try:
        found.extend(_shown(scan(line.carry_out, planned, families), arguments.json))
    except KeyboardInterrupt:
        return found, False
    finally:
        line.close()
    return found, True


def _families(models: Sequence[str]) -> dict[str, type[Drive]]:
    """Return the families by their names in a plant file. Names of model files contain an absolute path."""
    named = {}
    for text in models or (*MODELS, *RECOGNISABLE):
        path, colon, name = text.rpartition(":")
        whole = f"{Path(path).resolve()}:{name}" if colon and path.endswith(".py") else text
        if text.endswith(".toml"):
            whole = str(Path(text).resolve())
        named[whole] = find_model(text)
    models = [family.model for family in named.values() if family.model]
    if twice := sorted({model for model in models if models.count(model) > 1}):
        raise ValueError(f"two family files declare the model {twice[0]}: name only one of them in a scan")
    return named


def _planned(arguments: argparse.Namespace, families: Sequence[type[Drive]]) -> list[Sweep]:
    unknown = [one for one in arguments.addresses if one not in SERIAL_ADDRESSES]
    if unknown and not speaks_tcp(arguments.port):
        raise ValueError(
            f"--addresses: {unknown[0]} is only valid on tcp:// ports; on {arguments.port} use 1 to 247"
        )
    fixed = arguments.port.startswith("socket://")
    if fixed and len(arguments.baudrates) != 1:
        raise ValueError(
            f"the serial server at {arguments.port} sets the baud rate itself. "
            "Give the server's rate, such as --baudrates 9600"
        )
    planned = sweeps(
        families, addresses=arguments.addresses, baudrates=arguments.baudrates, formats=arguments.formats
    )
    if arguments.quick:
        planned = planned[: len(planned) // 2]
    if speaks_tcp(arguments.port):
        return over_tcp(planned)
    return one_of_each_framing(planned) if fixed else planned


# ---- output during the scan ----


def _shown(findings: Iterator[Finding], silent: bool) -> Iterator[Finding]:
    """Print progress on stderr and, unless `silent`, findings as they come; yield the findings.

    On a terminal, progress is one line that is redrawn. Otherwise, it is a line for every setting.
    """
    redraws = sys.stderr.isatty()
    shown = ""  # the line setting that the progress line shows now
    try:
        for finding in findings:
            if isinstance(finding, Progress):
                setting, left = line_setting(finding.settings, finding.framing), _duration(finding.left)
                if redraws:
                    _redraw(f"{setting}, address {finding.address}; {left} left")
                elif setting != shown:
                    print_text(f"{setting}; {left} left", file=sys.stderr, flush=True)
                shown = setting
                continue
            if shown and redraws:
                _redraw("")
            if not silent:
                print_text(sentence(finding), flush=True)
            yield finding
    finally:  # Ctrl-C must clear the progress line too
        if shown and redraws:
            _redraw("")


def _redraw(text: str) -> None:
    print(f"{_CLEAR_LINE}{text}", end="", file=sys.stderr, flush=True)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02} s" if minutes else f"{rest} s"


def sentence(finding: Finding) -> str:
    at = line_setting(finding.settings, finding.framing)
    match finding:
        case Found():
            what = " or ".join(finding.models) or "an unknown Modbus device"
            delay = f"response delay {finding.response_delay * 1e3:.1f} ms"
            text = f"address {finding.address}: {what} at {at}, {delay}"
            return f"{text} ({finding.doubt})" if finding.doubt else text
        case Crowd() if finding.reply:
            return (
                f"address {finding.address}: valid frames at {at} that do not match the request: "
                f"{finding.reply}"
            )
        case Crowd():
            return (
                f"address {finding.address}: garbage instead of replies at {at}: several drives may have "
                "this address; switch on one of them only, and change its address"
            )
        case Noise():
            return (
                f"noise at {at}: garbage at {finding.garbled} of {finding.asked} addresses; "
                "check wiring, termination and shield"
            )
        case Untried():
            return f"not asked at {at}: {finding.reason}"
        case Progress():
            return at


# ---- output after the scan ----


def _summary(drives: int, seconds: float, addresses: Sequence[int], finished: bool) -> str:
    text = f"{counted(drives, 'drive') if drives else 'no drives'} found in {_duration(seconds)}"
    if not drives and finished:
        text += "; check their power, their addresses and A/B, and run `multidrop doctor` on the port"
    if addresses == list(ADDRESSES):
        text += f"; addresses above {ADDRESSES[-1]} were not tried (use --addresses 1-247)"
    return text


def _as_json(found: Sequence[Finding]) -> dict[str, Any]:
    kinds = {"drives": Found, "crowds": Crowd, "noise": Noise, "untried": Untried}
    return {
        name: [_record(finding) for finding in found if isinstance(finding, kind)]
        for name, kind in kinds.items()
    }


def _record(finding: Finding) -> dict[str, Any]:
    found: dict[str, Any] = {name: value if value != "" else None for name, value in vars(finding).items()}
    settings, framing = found.pop("settings"), found.pop("framing")
    place = {"address": found.pop("address")} if "address" in found else {}
    if isinstance(finding, Found):
        found["response_delay_ms"] = round(found.pop("response_delay") * 1e3, 3)
    line = {"baudrate": settings.baudrate, "format": settings.format, "framing": str(framing)}
    if framing is Framing.TCP:
        line |= {"baudrate": None, "format": None}
    return place | line | found


# ---- arguments ----


def _addresses(text: str) -> list[int]:
    spans: list[tuple[int, int]] = []
    try:
        for part in text.split(","):
            first, _, last = part.partition("-")
            spans.append((plain_whole(first), plain_whole(last or first)))
    except ValueError:
        spans = []
    if not spans or not all(0 <= first <= last <= UNIT_IDS[-1] for first, last in spans):
        raise ValueError(
            f"invalid addresses {text!r}: write 1 to 247 (0 to 255 on a tcp:// port), such as 1-31 or 1,5,9"
        )
    return list(dict.fromkeys(address for first, last in spans for address in range(first, last + 1)))


def _baudrates(text: str) -> list[int]:
    try:
        return [plain_whole(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"invalid baud rates {text!r}: write numbers, such as 9600,19200") from None


def _formats(text: str) -> list[str]:
    return [part.strip().upper() for part in text.split(",")]
