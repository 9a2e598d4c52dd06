"""SocketPort: a connection to a serial server or a Modbus TCP gateway, closed at once."""

from __future__ import annotations

import socket
from contextlib import suppress

from serial.urlhandler.protocol_socket import Serial


class SocketPort(Serial):
    """pyserial's port behind socket://, whose own `close` sleeps for 300 ms."""

    _socket: socket.socket | None = None

    def close(self) -> None:
        """End the connection, so that the far end is free for another one at once."""
        connection, self._socket, self.is_open = self._socket, None, False
        if connection:
            with suppress(OSError):  # it may have ended already
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def reset_input_buffer(self) -> None:
        """Discard what has come; pyserial asks `select` for it, which bears no descriptor above 1023."""
        with suppress(BlockingIOError):
            while self._socket and self._socket.recv(4096):
                pass
