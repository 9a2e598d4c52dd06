"""Runs scenarios in the guest. Each request of the host, and each result, is one line of JSON."""

from __future__ import annotations

import importlib
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import traceback
from pathlib import Path
from typing import Any

import plug

OUTPUT = Path("/tmp/output")


def scenarios() -> dict[str, Any]:
    """Return the functions of the modules with scenarios, by name."""
    modules = [importlib.import_module(file.stem) for file in Path(__file__).parent.glob("*_scenarios.py")]
    return {name: found for module in modules for name, found in vars(module).items() if callable(found)}


def run(call: Any, arguments: dict[str, Any], limit: float) -> dict[str, Any]:
    """Call a scenario in a child process, and unplug all adapters afterwards."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        with OUTPUT.open("wb") as output:
            for descriptor in (1, 2):
                os.dup2(output.fileno(), descriptor)
        try:
            answer = {"facts": call(**arguments)}
        except BaseException:
            answer = {"failure": traceback.format_exc()}
        with os.fdopen(writing, "w", encoding="utf-8") as pipe:
            print(json.dumps(answer), file=pipe)
        sys.stdout.flush()
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe, selectors.DefaultSelector() as selector:
        selector.register(pipe, selectors.EVENT_READ)
        # read() would block, because other processes may keep the pipe open
        said = pipe.readline() if selector.select(limit) else b""
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    plug.unplug_all()
    answer = json.loads(said) if said else {"failure": f"it did not end within {limit:.0f} s"}
    if "failure" in answer:
        kernel = subprocess.run(["dmesg"], capture_output=True, text=True, check=False).stdout[-2000:]
        answer["output"] = OUTPUT.read_text("utf-8", "replace")[-6000:] + kernel
    return answer


def main() -> None:
    hardware, host = sys.argv[1].split(",")
    plug.HARDWARE = (plug.HOST, int(hardware))
    known = scenarios()  # imported before the first fork
    with socket.create_connection((plug.HOST, int(host))) as connection:
        lines = connection.makefile("rw", encoding="utf-8")
        for line in lines:
            asked = json.loads(line)
            answer = run(known[asked["scenario"]], asked["arguments"], asked["limit"])
            print(json.dumps(answer), file=lines, flush=True)


if __name__ == "__main__":
    main()
