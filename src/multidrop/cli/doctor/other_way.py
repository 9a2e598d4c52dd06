"""Ask a silent far end in the other framing: Modbus TCP in place of RTU over TCP, or the reverse."""

from __future__ import annotations

from multidrop.cli.doctor.findings import Finding
from multidrop.core import Completion, Exchange, Framing, Message, Peer
from multidrop.drive.network import speaks_tcp
from multidrop.drive.timing import Settings
from multidrop.errors import LineError
from multidrop.transport.line import Line
from multidrop.transport.mixed_up import mixed_up, other_port, spoken_on

TIMEOUT = 2.0  # s: a gateway waits for its drives first


def ask_once(port: str, request: Message, settings: Settings) -> Completion:
    """Send one read in the framing of this network port, and return its outcome. Raises LineError."""
    exchange = Exchange(
        Framing.TCP if speaks_tcp(port) else Framing.RTU,
        request,
        Peer(least_timeout=TIMEOUT, most_timeout=TIMEOUT),
        baudrate=settings.baudrate,
        format=settings.format,
        character=settings.character,
        silence=0.0 if speaks_tcp(port) else settings.t3_5,
    )
    line = Line(port).open()
    try:
        return line.carry_out(exchange)
    finally:
        line.close()


def other_way_finding(port: str, request: Message, settings: Settings) -> Finding:
    """Report whether the far end answers in the other framing."""
    other = other_port(port)
    way = spoken_on(other)
    try:
        found = ask_once(other, request, settings)
    except LineError as failure:
        return Finding("other way", f"{way} was not tried: {failure.reason}")
    if found.result > 0 or mixed_up(port, found.raw):  # any other bytes prove nothing
        return Finding(
            "other way",
            f"the far end speaks {way}, and not {spoken_on(port)}",
            f"name the port {other} in place of {port}, or set the far end to {spoken_on(port)}",
            is_failure=True,
        )
    return Finding("other way", f"{way} was tried too, and not answered either")


def unit_finding(port: str, request: Message, settings: Settings) -> Finding:
    """Report what a port of Modbus TCP says of a unit that nobody should have."""
    try:
        found = ask_once(port, request, settings)
    except LineError as failure:
        return Finding("Modbus TCP", f"it is not spoken: {failure.reason}", is_failure=True)
    asked = f"asked for unit {request.address}, which should be nobody's,"
    if found.result > 0:
        reply = found.reply
        how = f"with exception {reply.exception:02X}" if reply.exception else "with a value"
        return Finding(
            "Modbus TCP",
            f"{asked} it answers {how}",
            "it may be a device that answers for every unit: then a wrong address goes unnoticed",
        )
    if found.raw:
        return Finding("Modbus TCP", f"{asked} the gateway says that it does not answer: as it should")
    return Finding("Modbus TCP", f"{asked} it is silent: a gateway may be, and a far end of another kind is")
