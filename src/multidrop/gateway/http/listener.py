"""The listening socket."""

from __future__ import annotations

import errno
import socket

from multidrop.gateway.http.connections import CountingSocket

BACKLOG = 64  # connections that wait, and that are taken at once: their descriptors are not bounded yet

_WHY = {
    errno.EADDRINUSE: "another program listens there",
    errno.EACCES: "this user may not",
    errno.EADDRNOTAVAIL: "it is no address of this machine",
}


def listen(host: str, port: int) -> CountingSocket:
    """Return a listening socket. Raises OSError with a sentence where the port cannot be had."""
    try:
        family, _, _, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except socket.gaierror as failure:
        raise OSError(f"listen: {host} is no address of this machine: {failure.strerror}") from failure
    # With its protocol named asyncio sets TCP_NODELAY: else each frame waits 40 ms.
    listener = CountingSocket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(BACKLOG)
        listener.setblocking(False)
    except OSError as failure:
        listener.close()
        reason = _WHY.get(failure.errno or 0, failure.strerror)
        raise OSError(f"listen: {host}:{port} cannot be had: {reason}") from failure
    return listener
