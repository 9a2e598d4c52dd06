"""Names of network ports: tcp://host or tcp://host:port for Modbus TCP, and others with host and port."""

from __future__ import annotations

from urllib.parse import SplitResult, urlsplit

from multidrop.errors import NoSuchPort

MODBUS_PORT = 502  # where a URL names none


def speaks_tcp(port: str) -> bool:
    """Return True for a port that carries Modbus TCP and nothing else."""
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
