"""Detect when Modbus TCP (tcp://) and RTU over TCP (socket://) were confused in a port's name.

A gateway is set to one of these protocols. To requests of the other protocol it is silent, or replies with
junk.
"""

from __future__ import annotations

from urllib.parse import urlsplit

from multidrop.core import crc16
from multidrop.drive.line_settings import MODBUS_PORT

_HEAD = 6  # bytes of Modbus TCP's header before the unit id
_LEAST, _MOST_RTU = 5, 256  # bytes of an RTU reply; the shortest reply is an exception
_OTHER = {"socket": "tcp", "tcp": "socket"}
_SPOKEN = {"socket": "RTU over TCP", "tcp": "Modbus TCP"}


def other_port(port: str) -> str:
    """Return the URL for the other protocol at the same host and port; "" for other kinds of ports."""
    url = urlsplit(port)
    if url.scheme not in _OTHER:
        return ""
    place = url.netloc if url.port else f"{url.netloc}:{MODBUS_PORT}"
    return f"{_OTHER[url.scheme]}://{place}"


def spoken_on(port: str) -> str:
    """Return the name of the protocol that multidrop speaks on a tcp:// or socket:// port."""
    return _SPOKEN[urlsplit(port).scheme]


def mixed_up(port: str, received: bytes) -> str:
    """Return a hint for the user if bytes received on this port look like the other protocol, else ""."""
    other = other_port(port)
    is_shaped = other and (_is_tcp(received) if other.startswith("tcp") else _is_rtu(received))
    if not is_shaped:
        return ""
    return f"; this looks like {spoken_on(other)}: name the port {other} in place of {port}"


def silence_hint(port: str) -> str:
    """Return a hint for the user of a silent tcp:// or socket:// port; "" for other kinds of ports."""
    other = other_port(port)
    if not other:
        return ""
    return (
        f", and whether the far end speaks {spoken_on(port)}: else name the port {other} "
        "(`multidrop doctor` tries)"
    )


def _is_tcp(received: bytes) -> bool:
    """Return True if the bytes are exactly one Modbus TCP frame."""
    announced = int.from_bytes(received[4:6])
    return len(received) > _HEAD + 2 and received[2:4] == b"\0\0" and announced == len(received) - _HEAD


def _is_rtu(received: bytes) -> bool:
    """Return True if the bytes start with an RTU frame."""
    ends = range(_LEAST, min(len(received), _MOST_RTU) + 1)
    return any(crc16(received[:end], end) == 0 for end in ends)
