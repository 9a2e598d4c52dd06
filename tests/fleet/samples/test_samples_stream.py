"""The gateway and number of a message in the stream are right, whatever headers its writer has set."""

from __future__ import annotations

import asyncio
import socket
from email.parser import BytesParser
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from nats.aio.client import Client
from nats_clusters import Cluster
from sample_streams import empty_stream

from multidrop.fleet.samples.samples_stream import StreamMessage, read_after

pytestmark = pytest.mark.slow

OTHERS = "Nats-Subject: samples.victim.{0}\r\nNats-Sequence: {1}\r\nNats-Last-Sequence: {2}\r\n"
HOSTILE = {
    "another subject": OTHERS,
    "a line that is no header": OTHERS + "no header\r\n",
    "an empty line": OTHERS + "\r\n",
    "an end of all messages": "Status: 404\r\nno header\r\n",
    "an empty name": ": \r\n",
    "a folded line": " Nats-Sequence: 5\r\n\tNats-Subject: samples.victim.x\r\n",
    "half a line's end": "A: b\nNats-Subject: samples.victim.x\r\n",
    "a name with a space": "Nats-Sequence : 5\r\n",
    "no ASCII": "\xff\xfe: 1\r\n",
}


async def _as_mail(self: Client, headers: bytes | None) -> dict[str, str] | None:
    """Parse headers as nats-py did until 2.14, with Python's e-mail parser."""
    parsed = BytesParser().parsebytes((headers or b"").partition(b"\r\n")[2])
    return {name.strip(): str(value).strip() for name, value in parsed.items()} or None


def say_with(url: str, subject: str, headers: str) -> None:
    """Publish a message with headers that no client library would send."""
    block = b"NATS/1.0\r\n" + headers.encode("latin-1") + b"\r\n"
    address = urlsplit(url)
    with socket.create_connection((address.hostname, address.port)) as link, link.makefile("rb") as answers:
        answers.readline()
        link.sendall(b'CONNECT {"headers": true, "verbose": false}\r\n')
        link.sendall(f"HPUB {subject} {len(block)} {len(block) + 1}\r\n".encode() + block + b"x\r\nPING\r\n")
        assert answers.readline() == b"PONG\r\n"


@pytest.mark.parametrize("parser", [None, _as_mail])
def test_headers_cannot_forge_the_origin_of_samples(
    running: Cluster, parser: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    if parser:
        monkeypatch.setattr(Client, "_process_headers", parser)

    async def live() -> list[StreamMessage]:
        async with empty_stream(running) as path:
            for number, headers in enumerate(HOSTILE.values(), 1):
                text = headers.format(f"log{number}", number, number - 1)
                say_with(running.urls[0], "samples.evil.log", f"{text}Multidrop-Sequence: {number}\r\n")
            say_with(running.urls[0], "samples.good.log", "Multidrop-Sequence: 1\r\nMultidrop-Lost: 7\r\n")
            found: list[StreamMessage] = []
            while more := await read_after(path, found[-1].place if found else 0, 4, 1 << 20):
                found += more
            return found

    found = asyncio.run(live())
    assert [message.place for message in found] == [*range(1, len(HOSTILE) + 2)]
    assert {(message.gateway, message.log) for message in found[:-1]} == {("evil", "log")}
    assert [message.sequence for message in found[:-1]] == [*range(1, len(HOSTILE) + 1)]
    assert found[-1] == StreamMessage(len(HOSTILE) + 1, "good", "log", 1, 7, b"x")
