"""A network serial port that prints the bytes received for its line, and replies to them.

Reads return 0. The reply to any other request is a copy of the request, as for a single write.

It prints its TCP port first. Each further line is a connection's number and the bytes for the serial line, in
hexadecimal. If a client sends END, the server prints all received bytes, then closes the connection.
Usage: network_server.py {rfc2217,socket} ADDRESS
"""

from __future__ import annotations

import select
import socket
import sys
from types import SimpleNamespace

from serial import rfc2217

END = b"END"


def manager(client: socket.socket) -> rfc2217.PortManager:
    """Return the server side of RFC 2217, with constant modem status lines."""
    settings = {"baudrate": 9600, "bytesize": 8, "parity": "N", "stopbits": 1}
    modem_lines = {"cts": True, "dsr": True, "ri": False, "cd": True}
    flushes = dict.fromkeys(("reset_input_buffer", "reset_output_buffer"), lambda: None)
    port = SimpleNamespace(**settings, **modem_lines, **flushes)
    return rfc2217.PortManager(port, SimpleNamespace(write=client.sendall))


def with_crc(body: bytes) -> bytes:
    crc = 0xFFFF
    for byte in body:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return body + crc.to_bytes(2, "little")


def answer(request: bytes) -> bytes:
    if len(request) == 8 and request[1] in (3, 4):
        return with_crc(request[:2] + bytes([2 * request[5]]) + bytes(2 * request[5]))
    return request


class Server:
    def __init__(self, kind: str, address: str) -> None:
        self._kind = kind
        self._listener = socket.create_server((address, 0))
        self._clients: dict[socket.socket, tuple[int, rfc2217.PortManager | None]] = {}
        self._accepted = 0
        self.ends = False
        print(self._listener.getsockname()[1], flush=True)

    def listen(self, seconds: float | None) -> bool:
        """Wait up to `seconds` for bytes and receive them; return False if none came."""
        ready, _, _ = select.select([self._listener, *self._clients], [], [], seconds)
        for each in ready:
            if each is self._listener:
                self._accept()
            else:
                self._hear(each)
        return bool(ready)

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        self._accepted += 1
        far = manager(client) if self._kind == "rfc2217" else None
        self._clients[client] = self._accepted, far

    def _hear(self, client: socket.socket) -> None:
        number, far = self._clients[client]
        try:
            received = client.recv(1024)
        except OSError:  # the client broke the connection
            received = b""
        if not received or received == END:
            self.ends = self.ends or received == END
            del self._clients[client]
            client.close()
        elif heard := b"".join(far.filter(received)) if far else received:
            print(number, heard.hex(), flush=True)
            said = answer(heard)
            client.sendall(b"".join(far.escape(said)) if far else said)


def main() -> None:
    server = Server(*sys.argv[1:])
    while not server.ends:
        server.listen(None)
    while server.listen(0):
        pass


if __name__ == "__main__":
    main()
