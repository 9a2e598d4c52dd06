"""Names of network ports: tcp://host or tcp://host:port for Modbus TCP, and others with host and port."""

from __future__ import annotations

from urllib.parse import SplitResult, urlsplit

from multidrop.errors import NoSuchPort
from multidrop.printable import masked

MODBUS_PORT = 502  # where a URL names none
SCHEMES = ("tcp", "socket", "rfc2217")  # pyserial has others too: its spy:// writes to any file
URLS = "tcp://10.0.0.7, socket://10.0.0.7:4001 or rfc2217://10.0.0.7:4001"


def check_port(port: str) -> str:
    """Return a port's name from a file or a command line.

    Raises NoSuchPort for a URL of another kind than these three, for one that has a user or a password, and
    for one without its host or port number.
    """
    scheme, is_url, _ = port.partition("://")
    if is_url and scheme.lower() not in SCHEMES:
        raise NoSuchPort(masked(port), f"there is no {scheme}://; a URL is such as {URLS}")
    if is_url and url_of(port).username is not None:
        raise NoSuchPort(masked(port), "it has a user or a password, which no port takes: leave it out")
    url_of(port)
    return port


def speaks_tcp(port: str) -> bool:
    """Return True for a Modbus TCP port."""
    return port.partition("://")[0].lower() == "tcp"


def url_of(port: str) -> SplitResult:
    """Return the parts of a port's name. Raises NoSuchPort for a URL without its host or port number."""
    try:
        url = urlsplit(port)
        host, number = url.hostname, url.port
    except ValueError as mistake:
        raise NoSuchPort(port, str(mistake)) from mistake
    if url.scheme == "tcp" and (not host or number == 0):
        raise NoSuchPort(port, f"it needs a host, such as tcp://10.0.0.7 or tcp://10.0.0.7:{MODBUS_PORT}")
    if url.scheme in ("socket", "rfc2217") and not (host and number):
        raise NoSuchPort(port, f"it needs a host and a port number, such as {url.scheme}://10.0.0.7:4001")
    return url


MOST_SETTLE = 10.0  # s: the end of a process may have to wait for it


def check_settle(settle: float) -> None:
    """Raise ValueError unless this is a time in s that a line may wait after its port is opened."""
    is_number = isinstance(settle, int | float) and not isinstance(settle, bool)
    if not (is_number and 0 <= settle <= MOST_SETTLE):
        raise ValueError(f"settle = {settle!r} is not a number of seconds from 0 to {MOST_SETTLE:g}")
