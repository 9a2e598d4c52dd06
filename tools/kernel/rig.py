"""Boot the Debian that tools/kernel/build has made, and run scenarios in it.

    python tools/kernel/rig.py FOLDER SCENARIO [NAME=VALUE]...

The command boots the guest once, runs one scenario of tests/system/guest, and prints the facts that the
scenario returns. A value is JSON, such as kind='"ftdi"'. Any number of rigs may run at once.
"""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import multidrop
from multidrop import _core

HERE = Path(__file__).resolve().parent
SCENARIOS = HERE.parents[1] / "tests/system/guest"
BOOT_S = 600.0
PATIENCE_S = 60.0  # s that are added to a scenario's own time limit


class ScenarioFailed(AssertionError):
    """A scenario raised an exception, or did not end in time."""


class Guest:
    """A running guest."""

    def __init__(self, connection: socket.socket, folder: Path) -> None:
        self._connection = connection
        self._lines = connection.makefile("rw", encoding="utf-8")
        self._folder = folder

    def run(self, scenario: str, *, limit: float = 300.0, **arguments: Any) -> Any:
        """Run the function `scenario`, for `limit` s at most; return the facts that it returns.

        Raises ScenarioFailed with the guest's output.
        """
        self._connection.settimeout(limit + PATIENCE_S)
        asked = {"scenario": scenario, "arguments": arguments, "limit": limit}
        try:
            print(json.dumps(asked), file=self._lines, flush=True)
            answer = json.loads(self._lines.readline())
        except (OSError, ValueError) as failure:
            console = (self._folder / "console").read_text("utf-8", "replace")
            raise ScenarioFailed(f"{scenario}: the guest has gone:\n{console[-3000:]}") from failure
        if "facts" not in answer:
            raise ScenarioFailed(f"{scenario}: {answer['failure']}\n{answer['output']}")
        return answer["facts"]


def _job(file: Path) -> None:
    """Write a tar archive of the scenarios, and of this multidrop with its compiled core and its metadata."""
    package = Path(multidrop.__file__).parent
    (metadata,) = Path(str(distribution("multidrop").locate_file(""))).glob("multidrop-*.dist-info")
    with tarfile.open(file, "w") as tar:
        tar.add(package, "multidrop", filter=lambda entry: None if "__pycache__" in entry.name else entry)
        tar.add(metadata, metadata.name)
        compiled = Path(_core.__file__)
        # the package is installed as editable, so its compiled core is elsewhere
        if compiled.parent != package:
            tar.add(compiled, f"multidrop/{compiled.name}")
        for script in [*(HERE / "guest").glob("*.py"), *SCENARIOS.glob("*.py")]:
            tar.add(script, script.name)


@contextmanager
def boot(built: Path) -> Iterator[Guest]:
    """Boot a guest from the folder of tools/kernel/build; it ends with the `with` block."""
    with ExitStack() as ending:
        folder = Path(tempfile.mkdtemp(prefix="rig-"))  # short: a socket's path has at most 107 characters
        ending.callback(shutil.rmtree, folder)
        _job(folder / "job.tar")
        hardware = ending.enter_context(
            subprocess.Popen(
                [sys.executable, HERE / "hardware.py", folder], stdout=subprocess.PIPE, encoding="utf-8"
            )
        )
        ending.callback(hardware.kill)
        assert hardware.stdout
        port = int(hardware.stdout.readline())
        listener = ending.enter_context(socket.create_server(("127.0.0.1", 0)))
        listener.settimeout(1.0)
        ports = f"{port},{listener.getsockname()[1]}"
        with (folder / "qemu.log").open("w") as log:
            qemu = ending.enter_context(subprocess.Popen(_qemu(built, folder, ports), stderr=log))
        ending.callback(qemu.kill)
        connection = _connected(listener, qemu)
        if connection is None:
            said = (folder / "qemu.log").read_text("utf-8") + _console(folder)
            raise RuntimeError(f"the guest did not boot:\n{said}")
        yield Guest(ending.enter_context(connection), folder)


def _connected(listener: socket.socket, qemu: subprocess.Popen[bytes]) -> socket.socket | None:
    """Wait for the agent in the guest; return its connection, or None if the guest does not boot."""
    end = time.monotonic() + BOOT_S
    while time.monotonic() < end and qemu.poll() is None:
        with suppress(TimeoutError):
            return listener.accept()[0]
    return None


def _console(folder: Path) -> str:
    file = folder / "console"
    return file.read_text("utf-8", "replace")[-3000:] if file.exists() else ""


def _qemu(built: Path, folder: Path, ports: str) -> list[str]:
    """Return QEMU's command. It does not use KVM, which may exist without being able to run a guest."""
    words = f"""
    qemu-system-x86_64 -nodefaults -no-user-config -M q35 -accel tcg,thread=multi -smp 2 -m 512 -display none
    -no-reboot -kernel {built}/vmlinuz -initrd {built}/initrd.gz -serial file:{folder}/console
    -drive file={built}/root.img,format=raw,if=virtio,snapshot=on
    -drive file={folder}/job.tar,format=raw,if=virtio,readonly=on
    -netdev user,id=net -device virtio-net-pci,netdev=net -qmp unix:{folder}/qmp,server=on,wait=off
    -chardev socket,id=usb,path={folder}/usb,server=on,wait=off
    -device qemu-xhci,id=xhci -device usb-serial,bus=xhci.0,chardev=usb,serial=QEMU0001
    -chardev socket,id=uart,path={folder}/uart,server=on,wait=off
    -device isa-serial,iobase=0x2f8,irq=3,chardev=uart
    -trace serial_read -trace serial_write -trace serial_update_parameters -D {folder}/registers
    """.split()
    kernel = "console=ttyS0 quiet loglevel=4 mitigations=off panic=1 no_console_suspend"
    # on a busy host, the kernel's timer check would fail
    return [*words, "-append", f"{kernel} no_timer_check rig={ports}"]


def main(words: list[str]) -> None:
    folder, scenario, *given = words
    arguments = {name: json.loads(value) for name, _, value in (word.partition("=") for word in given)}
    with boot(Path(folder).resolve()) as guest:
        json.dump(guest.run(scenario, limit=3600.0, **arguments), sys.stdout, indent=2)


if __name__ == "__main__":
    main(sys.argv[1:])
