"""`multidrop sniff` in a process of its own."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from commands import MULTIDROP


class Sniffer:
    """`multidrop sniff` under way; its objects are there when the block is left."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.told: list[dict[str, Any]] = []
        self.process = process

    @property
    def exchanges(self) -> list[dict[str, Any]]:
        return [record for record in self.told if record.get("result") == "ok"]

    @property
    def summary(self) -> dict[str, int]:
        return dict(self.told[-1]["summary"])


@contextmanager
def sniffing(port: str, *words: object) -> Iterator[Sniffer]:
    command = [*MULTIDROP, "sniff", port, "--json", *map(str, words)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stderr.readline() == f"listening on {port}, Ctrl-C ends\n"
        sniffer = Sniffer(process)
        out = process.stdout
        reader = threading.Thread(target=lambda: sniffer.told.extend(map(json.loads, out)))
        reader.start()
        try:
            yield sniffer
        finally:
            process.send_signal(signal.SIGINT)
            reader.join(timeout=60)
            process.kill()
