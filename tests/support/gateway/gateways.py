"""Run a gateway with a simulated plant in a thread, and send HTTP requests to it."""

from __future__ import annotations

import asyncio
import http.client
import json
import os
import subprocess
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import uvicorn.server
from commands import MULTIDROP, BoundProcess
from lines import PATIENCE, until

from multidrop import InvtCHE, Plant
from multidrop.gateway import gateway as gateway_module
from multidrop.gateway import parts, reload
from multidrop.gateway import settings as settings_module
from multidrop.gateway.gateway import Gateway
from multidrop.gateway.http.rights import Right, Token, new_token
from multidrop.gateway.live import frames
from multidrop.gateway.settings import ServeSettings, read_plant
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated

for module, name in (  # timeouts for a busy machine
    *((parts, "BUILD_S"), (reload, "READ_S")),
    *((settings_module, "AUDIT_S"), (gateway_module, "AUDIT_S"), (reload, "AUDIT_S")),
):
    setattr(module, name, PATIENCE)

NAMES = {Right.LOOK: "looker", Right.STOP: "stopper", Right.WRITE: "writer"}
POLL = '["status", "output_frequency", "output_current", "fault"]'


class Answer(NamedTuple):
    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Served:
    """A running gateway, its simulated drives by name, and a token's secret for each right."""

    def __init__(
        self,
        gateway: Gateway,
        sims: Mapping[str, SimulatedDrive],
        secrets: Mapping[Right, str],
        loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        self.gateway = gateway
        self._loop = loop
        self.sims = sims
        self.secrets = secrets
        self._seen = -1  # number of the newest frame that `frame_number` has returned

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        assert self._loop is not None
        return self._loop

    def request(self, method: str, path: str, body: object = None, **headers: str) -> Answer:
        """Send a request on a new connection; return the response. In header names _ becomes -."""
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        data = None
        if method == "POST":
            data = body if isinstance(body, bytes) else json.dumps(body if body is not None else {})
            sent.setdefault("content-type", "application/json")
        to = http.client.HTTPConnection("127.0.0.1", self.gateway.port, timeout=PATIENCE)
        with closing(to) as connection:
            connection.request(method, path, data, sent)
            response = connection.getresponse()
            return Answer(response.status, {k.lower(): v for k, v in response.getheaders()}, response.read())

    def get(self, path: str, **headers: str) -> Answer:
        return self.request("GET", path, **headers)

    def post(self, path: str, body: object = None, **headers: str) -> Answer:
        return self.request("POST", path, body, **headers)

    def command(self, path: str, body: Mapping[str, object], **headers: str) -> Answer:
        """Send a write or a verb, with the number of the newest frame as a page does."""
        return self.post(path, {**body, "seen": self.frame_number()}, **headers)

    @property
    def writer(self) -> dict[str, str]:
        """The headers of a caller with the right to write."""
        return {"authorization": self.bearer(Right.WRITE)}

    def write(self, drive: str, register: str, value: object) -> Any:
        """Write a value with the right to write; return the JSON of the answer."""
        body = {"drive": drive, "register": register, "value": value}
        return self.command("/api/write", body, **self.writer).json

    def act(self, drive: str, verb: str, **options: object) -> Any:
        """Carry out a verb with the right to write; return the JSON of the answer."""
        body = {"drive": drive, "verb": verb, "options": options}
        return self.command("/api/act", body, **self.writer).json

    def reload(self, serve: str | None = None) -> Any:
        """Reload the plant file, and wait for a frame of it; return the JSON of the answer.

        If `serve` is given, it first replaces the `[serve]` tables of the file.
        """
        if serve is not None:
            path = self.gateway.plant.path
            path.write_text(path.read_text().partition("[serve")[0] + serve)
        answer = self.post("/api/reload", {"confirm": True}, **self.writer)
        assert answer.status == 200
        looker = self.writer
        until(lambda: self.get("/api/frame", **looker).json["revision"] == self.gateway.revision)
        return answer.json

    def start(self, *drives: str) -> None:
        for drive in drives:
            assert self.write(drive, "setpoint", 50.0)["done"] is True
            assert self.act(drive, "start")["text"] == f"{drive}: start is done"
            assert not self.stands(drive)

    def stands(self, drive: str) -> bool:
        return not self.sims[drive].motor.goal  # type: ignore[attr-defined]

    def frame_number(self) -> int:
        """Wait for a new frame; return its number."""
        self._seen = int(self.get(f"/api/frame?after={self._seen}", **self.writer).json["n"])
        return self._seen

    def bearer(self, right: Right) -> str:
        return f"Bearer {self.secrets[right]}"

    def frame(self) -> Any:
        return self.get("/api/frame").json

    def await_state(self, drive: str, *states: str) -> None:
        """Wait until a frame shows the drive in one of the states."""
        until(lambda: self.frame()["drives"][drive]["state"] in states)


def certificate(folder: Path, name: str) -> None:
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1"),
            *("-nodes", "-days", "2"),
            *("-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"),
            *("-keyout", f"{folder}/{name}.key", "-out", f"{folder}/{name}.pem"),
        ],
        check=True,
        capture_output=True,
    )


def tokens() -> tuple[dict[Right, str], tuple[Token, ...]]:
    """Return a secret for each right, and the tokens that have these secrets."""
    made = {right: new_token(name, right) for right, name in NAMES.items()}
    return {right: secret for right, (secret, _) in made.items()}, tuple(token for _, token in made.values())


def plant_text(port: str, drives: Sequence[str], serve: str = "") -> str:
    text = f'[[line]]\nname = "hall"\nport = "{port}"\nbaudrate = 38400\n'
    for address, name in enumerate(drives, 1):
        text += (
            f'[[line.drive]]\nname = "{name}"\nmodel = "invt-che"\naddress = {address}\n'
            f'every = "100 ms"\npoll = {POLL}\n'
        )
    return f"{text}{serve}"


def written(folder: Path, serve: str = "", *drives: str, port: str = "/dev/ttyUSB0") -> Plant:
    """Write a plant file with this `[serve]` table; return the plant, with no port opened."""
    path = folder / "plant.toml"
    path.write_text(plant_text(port, drives or ("pump-1", "pump-2"), serve))
    return Plant.load(path)


def gateway_of(path: Path, environment: Mapping[str, str] | None = None, **settings: Any) -> Gateway:
    """Return a gateway that can reload its plant file; `settings` override those of the file."""

    def read() -> tuple[Plant, ServeSettings]:
        plant, found = read_plant(lambda: Plant.load(path), environment or {})
        return plant, replace(found, **{"port": 0, **settings})

    return Gateway(*read(), read=read)


@contextmanager
def served(
    folder: Path, serve: str = "", *drives: str, environment: Mapping[str, str] | None = None, **settings: Any
) -> Iterator[Served]:
    """Run a gateway with simulated INVT CHE drives and tokens; `settings` override those of the file."""
    names = drives or ("pump-1", "pump-2")
    sims = {name: simulated(InvtCHE(n, name=name, baudrate=38400)) for n, name in enumerate(names, 1)}
    secrets, known = tokens()
    (folder / "tokens").write_text("".join(f"{token.line}\n" for token in known))
    with Simulator([Wire(list(sims.values()), unpaced=True)]) as simulator:
        path = written(folder, serve, *names, port=simulator.wires[0].path).path
        gateway = gateway_of(path, environment, **{"tokens": known, **settings})
        with running(gateway) as loop:
            yield Served(gateway, sims, secrets, loop)


@contextmanager
def running(gateway: Gateway) -> Iterator[asyncio.AbstractEventLoop]:
    """Run a gateway in a thread, with a tenth of the usual pauses; yield its event loop.

    An exception in the gateway is raised when the block ends.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frames, "LEAST_S", 0.02)
        patch.setattr(gateway_module, "TAKE_S", 0.01)
        patch.setattr(gateway_module, "LOOK_S", 0.02)
        quick = SimpleNamespace(**{**vars(asyncio), "sleep": lambda seconds: asyncio.sleep(seconds / 10)})
        # when uvicorn's server ends, it pauses for 0.1 s several times
        patch.setattr(uvicorn.server, "asyncio", quick)
        with _running(gateway) as loop:
            yield loop


@contextmanager
def _running(gateway: Gateway) -> Iterator[asyncio.AbstractEventLoop]:
    ready = threading.Event()
    failures: list[BaseException] = []
    loops: list[asyncio.AbstractEventLoop] = []

    async def live() -> None:
        task = asyncio.current_task()
        assert task is not None
        task.set_name("main of the test")
        loops.append(asyncio.get_running_loop())
        await gateway.run(ready.set)

    def work() -> None:
        try:
            asyncio.run(live())
        except BaseException as failure:
            failures.append(failure)
        finally:
            ready.set()

    thread = threading.Thread(target=work, name="gateway under test", daemon=True)
    thread.start()
    assert ready.wait(PATIENCE)
    try:
        if not failures:
            yield loops[0]
    finally:
        if thread.is_alive():
            loops[0].call_soon_threadsafe(gateway.end)
        thread.join(PATIENCE)
        assert not thread.is_alive()
    if failures:
        raise failures[0]


@contextmanager
def simulated_plant(folder: Path, serve: str) -> Iterator[Path]:
    """Write a plant file and simulate its line during the block; yield the file's path."""
    drives = [simulated(InvtCHE(address, name=f"pump-{address}", baudrate=38400)) for address in (1, 2)]
    with Simulator([Wire(drives, unpaced=True)]) as simulator:
        path = folder / "plant.toml"
        path.write_text(plant_text(simulator.wires[0].path, ("pump-1", "pump-2"), serve))
        yield path


@contextmanager
def serving(path: Path, *options: str, **environment: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run the command; yield the process and its printed address once it is ready."""
    words = [*MULTIDROP, "serve", str(path), *options]
    with BoundProcess(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | environment
    ) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert process.stderr is not None
            assert line.startswith("ready "), process.stderr.read()
            yield process, line.removeprefix("ready ").strip()
        finally:
            process.kill()


def get(connection: http.client.HTTPConnection, path: str) -> bytes:
    connection.request("GET", path)
    return connection.getresponse().read()
