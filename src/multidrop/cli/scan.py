"""`multidrop scan`: which drives are on a line, at which address and settings; writes a plant file."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from multidrop.cli.support.arguments import add_json_argument
from multidrop.cli.support.files import check_writable
from multidrop.cli.support.output import print_text
from multidrop.drive.family import Drive
from multidrop.drives import MODELS
from multidrop.drives.registry import find_model
from multidrop.scan import (
    ADDRESSES,
    Crowd,
    Finding,
    Found,
    Noise,
    Progress,
    Sweep,
    Untried,
    one_of_each_framing,
    plant_text,
    scan,
    sweeps,
)
from multidrop.transport.line import Line

_CLEAR_LINE = "\r\x1b[K"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port", metavar="PORT", help="device such as /dev/ttyUSB0, or pyserial URL")
    parser.add_argument("--model", action="append", default=[], help="only these; all families without it")
    parser.add_argument(
        "--addresses",
        metavar="1-31",
        type=_addresses,
        default=list(ADDRESSES),
        help=f"such as 1-247 or 1,5,9; {ADDRESSES[0]}-{ADDRESSES[-1]} without it",
    )
    parser.add_argument(
        "--baudrates", metavar="N,N", type=_baudrates, default=[], help="only these; all without it"
    )
    parser.add_argument(
        "--formats", metavar="8N1,8E1", type=_formats, default=[], help="only these; all without it"
    )
    parser.add_argument(
        "--quick", action="store_true", help="do not ask again for drives that answer later than usual"
    )
    parser.add_argument("--out", metavar="PLANT.toml", type=Path, help="write a plant file of what is found")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    if arguments.out:
        check_writable(arguments.out)
    families = _families(arguments.model)
    planned = _planned(arguments, list(families.values()))
    found: list[Finding] = []
    finished = False
    begun = time.monotonic()
    line = Line(arguments.port)
    try:
        found.extend(_shown(scan(line.carry_out, planned, list(families.values())), arguments.json))
        finished = True
    except KeyboardInterrupt:
        pass
    finally:
        line.close()
    plant = _write(arguments.out, arguments.port, found, families)
    told = {"port": arguments.port, "seconds": round(time.monotonic() - begun, 3), "finished": finished}
    if arguments.json:
        print_text(json.dumps(told | _as_json(found) | {"plant": plant}, indent=2))
    else:
        print_text(_summary(found, told["seconds"], arguments.addresses))
        if plant:
            print_text(f"{plant} is ready: multidrop poll {plant}")
    if not finished:
        raise KeyboardInterrupt
    return 0 if any(isinstance(it, Found) for it in found) else 1


def _families(models: Sequence[str]) -> dict[str, type[Drive]]:
    """By what a plant file calls them: a file's path is made absolute, because it may lie anywhere."""
    named = {}
    for text in models or MODELS:
        path, colon, name = text.rpartition(":")
        whole = f"{Path(path).resolve()}:{name}" if colon and path.endswith(".py") else text
        named[whole] = find_model(text)
    return named


def _planned(arguments: argparse.Namespace, families: Sequence[type[Drive]]) -> list[Sweep]:
    fixed = arguments.port.startswith("socket://")
    if fixed and len(arguments.baudrates) != 1:
        raise ValueError(
            f"{arguments.port} has a baud rate of its own, which its server knows alone: "
            "name it, such as --baudrates 9600"
        )
    planned = sweeps(
        families, addresses=arguments.addresses, baudrates=arguments.baudrates, formats=arguments.formats
    )
    if arguments.quick:
        planned = planned[: len(planned) // 2]
    return one_of_each_framing(planned) if fixed else planned


# ---- while it runs ----


def _shown(findings: Iterator[Finding], silent: bool) -> Iterator[Finding]:
    """Findings as they come, told at once; progress on stderr."""
    said = ""
    for finding in findings:
        if isinstance(finding, Progress):
            said = _tell(finding, said, sys.stderr)
            continue
        if said and sys.stderr.isatty():
            print(_CLEAR_LINE, end="", file=sys.stderr, flush=True)
        if not silent:
            print_text(sentence(finding), flush=True)
        yield finding
    if said and sys.stderr.isatty():
        print(_CLEAR_LINE, end="", file=sys.stderr, flush=True)


def _tell(progress: Progress, said: str, stream: TextIO) -> str:
    """On a terminal one line, always the same; into a file a line for every setting."""
    setting = f"{progress.settings} {progress.framing}"
    if stream.isatty():
        text = f"{setting}, address {progress.address}; {_duration(progress.left)} left"
        print(f"{_CLEAR_LINE}{text}", end="", file=stream, flush=True)
    elif setting != said:
        print_text(f"{setting}; {_duration(progress.left)} left", file=stream, flush=True)
    return setting


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02} s" if minutes else f"{rest} s"


def sentence(finding: Finding) -> str:
    """What a person is told of it."""
    at = f"{finding.settings} {finding.framing}"
    match finding:
        case Found():
            what = " or ".join(finding.models) or "an unknown Modbus device"
            text = (
                f"address {finding.address}: {what} at {at}, {finding.response_delay * 1e3:.1f} ms to answer"
            )
            return f"{text} ({finding.doubt})" if finding.doubt else text
        case Crowd():
            return (
                f"address {finding.address}: garbage instead of replies at {at}: several drives seem to have "
                "this address; leave one of them on and give it another"
            )
        case Noise():
            return (
                f"noise at {at}: garbage instead of silence at {finding.garbled} of {finding.asked} "
                "addresses; look at wiring, termination and shield"
            )
        case Untried():
            return f"not asked at {at}: {finding.reason}"
        case Progress():
            return at


# ---- afterwards ----


def _write(
    out: Path | None, port: str, found: Sequence[Finding], families: Mapping[str, type[Drive]]
) -> str | None:
    """The plant file's path, where one was wanted and there is something to write."""
    drives = [it for it in found if isinstance(it, Found)]
    if out is None or not any(it.models for it in drives):
        return None
    out.write_text(plant_text(port, drives, families), "utf-8")
    return str(out)


def _summary(found: Sequence[Finding], seconds: float, addresses: Sequence[int]) -> str:
    drives = sum(isinstance(it, Found) for it in found)
    text = f"{drives or 'no'} drive{'s' * (drives != 1)} found in {_duration(seconds)}"
    if addresses == list(ADDRESSES):
        text += f"; addresses above {ADDRESSES[-1]} were not asked (--addresses 1-247 does)"
    return text


def _as_json(found: Sequence[Finding]) -> dict[str, Any]:
    return {
        "drives": [
            _place(it)
            | {
                "models": list(it.models),
                "response_delay_ms": round(it.response_delay * 1e3, 3),
                "doubt": it.doubt or None,
            }
            for it in found
            if isinstance(it, Found)
        ],
        "crowds": [_place(it) for it in found if isinstance(it, Crowd)],
        "noise": [
            _setting(it) | {"garbled": it.garbled, "asked": it.asked} for it in found if isinstance(it, Noise)
        ],
        "untried": [_setting(it) | {"reason": it.reason} for it in found if isinstance(it, Untried)],
    }


def _place(it: Found | Crowd) -> dict[str, Any]:
    return {"address": it.address} | _setting(it)


def _setting(it: Finding) -> dict[str, Any]:
    return {
        "baudrate": it.settings.baudrate,
        "format": it.settings.format,
        "framing": str(it.framing),
    }


# ---- arguments ----


def _addresses(text: str) -> list[int]:
    spans: list[tuple[int, int]] = []
    try:
        for part in text.split(","):
            first, _, last = part.partition("-")
            spans.append((int(first), int(last or first)))
    except ValueError:
        spans = []
    if not spans or not all(1 <= first <= last <= 247 for first, last in spans):
        raise argparse.ArgumentTypeError(f"{text!r} is not addresses from 1 to 247, such as 1-31 or 1,5,9")
    return list(dict.fromkeys(address for first, last in spans for address in range(first, last + 1)))


def _baudrates(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not baud rates such as 9600,19200") from None


def _formats(text: str) -> list[str]:
    return [part.strip().upper() for part in text.split(",")]
