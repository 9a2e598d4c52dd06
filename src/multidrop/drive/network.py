"""Names of Modbus TCP's ports: tcp://host or tcp://host:port."""

from __future__ import annotations

MODBUS_PORT = 502  # where a URL names none


def speaks_tcp(port: str) -> bool:
    """Return True for a port that carries Modbus TCP and nothing else."""
    return port.partition("://")[0].lower() == "tcp"
