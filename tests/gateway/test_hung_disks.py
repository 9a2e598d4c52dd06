"""File systems that hang: polling and stops continue, /health reports it, and the gateway can end."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from errno import ENOSPC
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import pytest
from commands import BoundProcess
from gateways import Served, served, serving, simulated_plant
from lines import PATIENCE, until

from multidrop import History
from multidrop.gateway import gateway as gateway_module
from multidrop.gateway import historian, parts, reload, settings
from multidrop.gateway.http import files
from multidrop.gateway.http import routes as web
from multidrop.gateway.live import views
from multidrop.history import writer as writer_module

SERVE = '[serve]\nlisten = "127.0.0.1:0"\n[serve.may]\nstop = "anyone"\nwrite = ["pump-1.setpoint"]\n'
HISTORY = '[serve.history]\nfolder = "kept"\n'
SHORT_S = 0.1
COMING = "it is not ready: the disk with its files does not answer"
UNAUDITED = "audit log: not done within 0.1 s; does the disk answer? Restart to try again"
HANGING = """
import sys, threading
from multidrop.cli import main

threading.Thread(target=threading.Event().wait).start()
main(["serve", sys.argv[1]])
"""
SETPOINT = "pump-1", "setpoint", 10.0


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the time limits for starting and closing gateway parts."""
    for module, name in ((parts, "BUILD_S"), (reload, "QUICK_S")):
        monkeypatch.setattr(module, name, SHORT_S)
    monkeypatch.setattr(historian, "CLOSING_S", SHORT_S)
    monkeypatch.setattr(gateway_module, "GRACE_S", SHORT_S)


class Fifos:
    """Replaces files by named pipes, so that opening them hangs until the test releases them."""

    def __init__(self) -> None:
        self._made: list[Path] = []

    def put(self, path: Path) -> None:
        path.parent.mkdir(exist_ok=True)
        path.unlink(missing_ok=True)
        os.mkfifo(path)
        self._made.append(path)

    def let_go(self) -> None:
        for path in self._made:
            os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK))
            path.unlink()
        self._made.clear()


@pytest.fixture
def fifos() -> Iterator[Fifos]:
    made = Fifos()
    yield made
    made.let_go()


def health(gateway: Served) -> Any:
    return gateway.get("/health").json


def assert_stops_and_polls(gateway: Served) -> None:
    gateway.await_state("pump-1", "stands")
    assert [one["done"] for one in gateway.post("/api/stop").json.values()] == [True, True]
    newest = health(gateway)["newest_row"]
    until(lambda: health(gateway)["newest_row"] > newest)


def test_the_history_starts_when_a_hanging_disk_answers(tmp_path: Path, fifos: Fifos) -> None:
    fifos.put(tmp_path / "kept" / "rows.00000001.arrows")
    with served(tmp_path, SERVE + HISTORY) as gateway:
        assert_stops_and_polls(gateway)
        found = health(gateway)
        assert (found["status"], found["parts"]) == ("degraded", {"history": COMING})
        assert list(found["hung"]) == ["history"]
        assert gateway.get("/api/history?series=pump-1.status&from=0&to=1").status == 404
        fifos.let_go()
        until(lambda: health(gateway)["status"] == "ok")
        assert gateway.get("/api/history?series=pump-1.status&from=0&to=1").status == 200


def test_reload_continues_while_the_history_disk_hangs(tmp_path: Path, fifos: Fifos) -> None:
    fifos.put(tmp_path / "kept" / "rows.00000001.arrows")
    with served(tmp_path, SERVE) as gateway:
        assert gateway.reload(SERVE + HISTORY)["done"] is True
        assert_stops_and_polls(gateway)
        assert health(gateway)["parts"] == {"history": COMING}
        assert gateway.reload(SERVE)["done"] is True
        assert health(gateway)["parts"] == {}
        fifos.let_go()
        until(lambda: health(gateway)["status"] == "ok")
        assert gateway.gateway.feeds == {}  # the second plant file has no [serve.history]


def test_health_reports_a_failed_start_of_the_history_after_a_disk_hang(tmp_path: Path, fifos: Fifos) -> None:
    fifos.put(tmp_path / "kept" / "rows.00000001.arrows")
    with served(tmp_path, SERVE + HISTORY) as gateway, pytest.MonkeyPatch.context() as patch:
        patch.setattr(historian, "History", fail)
        fifos.let_go()
        until(lambda: health(gateway)["dead"] == {"history": "the disk is broken"})
        assert_stops_and_polls(gateway)


def fail(*arguments: object) -> NoReturn:
    raise OSError("the disk is broken")


def test_a_hanging_history_query_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()
    with served(tmp_path, SERVE + HISTORY) as gateway:
        monkeypatch.setattr(historian, "QUERY_S", SHORT_S)
        monkeypatch.setattr(History, "buckets", lambda *given: go_on.wait(PATIENCE))
        until(lambda: health(gateway)["status"] == "ok")
        for _ in range(3):  # more queries than MOST_QUERIES
            answer = gateway.get("/api/history?series=pump-1.status&from=0&to=1")
            assert (answer.status, answer.json["error"][:16]) == (503, "history queries:")
        assert list(health(gateway)["hung"]) == ["history queries"]
        assert_stops_and_polls(gateway)
        go_on.set()
        until(lambda: health(gateway)["status"] == "ok")


@pytest.mark.long
def test_a_hanging_disk_of_the_history_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()
    with served(tmp_path, SERVE + HISTORY) as gateway:
        until(lambda: health(gateway)["status"] == "ok")
        part: Any = gateway.gateway.feeds["history"]
        monkeypatch.setattr(writer_module, "HANGING_S", 0.0)
        monkeypatch.setattr(part._writer._segments, "write", lambda rows: go_on.wait(PATIENCE))
        until(lambda: "the disk has not answered for" in health(gateway)["parts"]["history"])
        assert_stops_and_polls(gateway)
        go_on.set()


def test_the_gateway_ends_although_an_export_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, begun = threading.Event(), threading.Event()

    def pieces() -> Iterator[bytes]:
        yield b"PAR1"
        begun.set()
        go_on.wait(PATIENCE)

    with served(tmp_path, SERVE + HISTORY) as gateway:
        monkeypatch.setattr(History, "csv", lambda *given: pieces())
        address = "127.0.0.1", gateway.gateway.port
        with socket.create_connection(address, PATIENCE) as client:
            client.sendall(b"GET /api/export?from=0&to=1 HTTP/1.1\r\nhost: localhost\r\n\r\n")
            assert begun.wait(PATIENCE)
            assert_stops_and_polls(gateway)
            gateway.loop.call_soon_threadsafe(gateway.gateway.end)
            until(lambda: gateway.loop.is_closed())
    go_on.set()


def test_only_the_reload_fails_if_reading_the_plant_file_hangs(
    tmp_path: Path, fifos: Fifos, monkeypatch: pytest.MonkeyPatch
) -> None:
    with served(tmp_path, SERVE) as gateway:
        path, good = gateway.gateway.plant.path, gateway.gateway.plant.path.read_text()
        fifos.put(path)
        with monkeypatch.context() as patch:
            patch.setattr(reload, "READ_S", SHORT_S)
            told = gateway.reload()
        assert (told["done"], told["mistakes"]) == (
            False,
            ["reload: not done within 0.1 s; does the disk answer?"],
        )
        assert health(gateway)["status"] == "degraded"
        assert_stops_and_polls(gateway)
        fifos.let_go()
        path.write_text(good)
        assert gateway.reload()["done"] is True
        until(lambda: health(gateway)["status"] == "ok")


def test_a_reload_works_while_an_earlier_reload_hangs(tmp_path: Path, fifos: Fifos) -> None:
    with served(tmp_path, SERVE) as gateway:
        path, good = gateway.gateway.plant.path, gateway.gateway.plant.path.read_text()
        fifos.put(path)
        gateway.loop.call_soon_threadsafe(gateway.gateway.reload.begin)
        until(lambda: "multidrop reload" in {thread.name for thread in threading.enumerate()})
        path.rename(tmp_path / "hangs")
        path.write_text("not TOML [")
        gateway.loop.call_soon_threadsafe(gateway.gateway.reload.begin)
        until(lambda: "is not TOML" in str(health(gateway)["mistakes"]))
        path.write_text(good)
        gateway.loop.call_soon_threadsafe(gateway.gateway.reload.begin)
        until(lambda: health(gateway)["status"] == "ok")
        (tmp_path / "hangs").rename(path)


def test_stops_are_sent_while_the_audit_log_hangs(
    tmp_path: Path, fifos: Fifos, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (settings, gateway_module):
        monkeypatch.setattr(module, "AUDIT_S", SHORT_S)
    fifos.put(tmp_path / "audit.jsonl")
    with served(tmp_path, SERVE) as gateway:
        assert_stops_and_polls(gateway)
        found = health(gateway)
        assert (found["status"], found["audit"]) == ("degraded", UNAUDITED)
        told = gateway.write(*SETPOINT)
        assert (told["done"], told["text"]) == (False, f"pump-1.setpoint = 10.0 was not sent: {UNAUDITED}")
        assert gateway.frame()["troubles"][0].startswith("audit log: ")


def test_a_reload_fails_without_changes_if_the_audit_log_hangs(
    tmp_path: Path, fifos: Fifos, monkeypatch: pytest.MonkeyPatch
) -> None:
    with served(tmp_path, SERVE) as gateway:
        until(lambda: health(gateway)["status"] == "ok")
        (tmp_path / "audit.jsonl").rename(tmp_path / "before")
        fifos.put(tmp_path / "audit.jsonl")
        for module in (settings, reload):
            monkeypatch.setattr(module, "AUDIT_S", SHORT_S)
        told = gateway.reload(SERVE)
        assert told["mistakes"] == ["audit log: not done within 0.1 s; does the disk answer?"]
        assert_stops_and_polls(gateway)


def test_hanging_reads_of_the_eeprom_ledger_and_audit_log_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()

    def wait(*given: object) -> list[Any]:
        assert go_on.wait(PATIENCE)
        return []

    with served(tmp_path, SERVE) as gateway:
        gateway.await_state("pump-1", "stands")
        monkeypatch.setattr(views, "LEDGER_S", SHORT_S)
        monkeypatch.setattr(web, "AUDIT_S", SHORT_S)
        monkeypatch.setattr(gateway.gateway.ledger, "at", wait)
        monkeypatch.setattr(web, "newest_records", wait)
        assert gateway.get("/api/drive/pump-1").json["ledger"] == []
        assert gateway.get("/api/audit").status == 503
        assert set(health(gateway)["hung"]) == {"ledger", "audit queries"}
        assert_stops_and_polls(gateway)
        go_on.set()
        until(lambda: health(gateway)["status"] == "ok")


@pytest.mark.long
def test_other_requests_are_answered_while_reads_of_page_files_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, read = threading.Event(), Path.read_bytes

    def read_bytes(path: Path) -> bytes:
        assert files.PAGE not in path.parents or go_on.wait(PATIENCE)
        return read(path)

    monkeypatch.setattr(files, "READ_S", SHORT_S)
    with served(tmp_path, SERVE) as gateway:
        monkeypatch.setattr(Path, "read_bytes", read_bytes)
        # five requests, because at most four reads of files may hang at once
        for path in ("/", "/page/app.js", "/", "/page/app.js", "/page/boot.js"):
            answer = gateway.get(path)
            assert (answer.status, answer.json["error"][:11]) == (503, "page files:")
        assert list(health(gateway)["hung"]) == ["page files"]
        assert_stops_and_polls(gateway)
        go_on.set()
        until(lambda: health(gateway)["status"] == "ok")
        until(lambda: gateway.get("/page/app.js").status == 200)


@pytest.mark.long
def test_sigterm_ends_the_gateway_while_disks_hang(tmp_path: Path, fifos: Fifos) -> None:
    fifos.put(tmp_path / "kept" / "rows.00000001.arrows")
    with simulated_plant(tmp_path, SERVE + HISTORY) as path, serving(path) as (process, _):
        fifos.put(path)
        process.send_signal(signal.SIGHUP)
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=PATIENCE)
        assert process.returncode == 0
    assert "history is still running at shutdown, and is abandoned" in errors


@pytest.mark.long
def test_sigterm_ends_a_gateway_although_a_thread_never_ends(tmp_path: Path) -> None:
    """Python would wait for the thread, such as one of a library, and not exit by itself."""
    script = tmp_path / "hangs.py"
    script.write_text(HANGING)
    with (
        simulated_plant(tmp_path, SERVE) as path,
        BoundProcess([sys.executable, script, path], stdout=subprocess.PIPE, text=True) as process,
    ):
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready ")
        process.terminate()
        assert process.wait(PATIENCE) == 1


# ---- a full disk on its own file system: polling and stops continue, and /health reports the disk ----


ON_DISK = """
[serve]
audit = "disk/audit.jsonl"
[serve.may]
stop = "anyone"
[serve.history]
folder = "disk/history"
"""
FULL = "No space left on device"


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """Mount a file system of 1 MB in the plant file's folder."""
    path = tmp_path / "disk"
    path.mkdir()
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("only root may mount a file system of its own")
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "none", path], capture_output=True, text=True
    )
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.strip()}")
    yield path
    subprocess.run(["umount", "--lazy", path], check=True)


def fill(disk: Path) -> Path:
    """Fill the free space of the disk with a file, and return its path."""
    path = disk / "filler"
    with path.open("wb", buffering=0) as file:
        while has_room(file):
            pass
    return path


def has_room(file: BinaryIO) -> bool:
    try:
        file.write(bytes(4096))
    except OSError as failure:
        if failure.errno != ENOSPC:
            raise
        return False
    return True


def disk_health(gateway: Served) -> tuple[str, str, str]:
    """Return the status of /health, and its entries about the history and the audit log."""
    found = gateway.get("/health").json
    return found["status"], found["parts"]["history"], found["audit"]


def stop(gateway: Served) -> None:
    told = gateway.post("/api/stop").json
    assert [one["done"] for one in told.values()] == [True, True]


def dropped(gateway: Served) -> float:
    lines = gateway.get("/metrics").body.decode().splitlines()
    (line,) = [line for line in lines if line.startswith("multidrop_history_dropped_total ")]
    return float(line.split()[1])


@pytest.mark.long
def test_polling_and_stops_continue_while_the_disk_is_full(disk: Path, tmp_path: Path) -> None:
    with served(tmp_path, ON_DISK) as gateway:
        gateway.await_state("pump-2", "stands")
        history = gateway.gateway.feeds["history"]
        until(lambda: history.state.rows > 0)
        stop(gateway)
        until(lambda: gateway.get("/api/audit").json["entries"])
        assert disk_health(gateway) == ("ok", "ok", "ok")

        filler = fill(disk)
        until(lambda: FULL in disk_health(gateway)[1])
        noted = len(gateway.get("/api/audit").json["entries"])
        sent = [sim.counters.requests for sim in gateway.sims.values()]
        # the last block of the audit log may still have room for some records
        while FULL not in disk_health(gateway)[2]:
            stop(gateway)
            assert len(gateway.get("/api/audit").json["entries"]) < noted + 40
        status, recorded, audit = disk_health(gateway)
        assert status == "degraded"
        assert recorded.startswith("nothing is recorded: ")
        assert audit.startswith("the newest write is missing in the audit log: ")
        until(lambda: len(gateway.frame()["troubles"]) == 2)
        assert all(FULL in trouble for trouble in gateway.frame()["troubles"])
        until(lambda: dropped(gateway) > 40)
        now = [sim.counters.requests for sim in gateway.sims.values()]
        assert all(after > before + 10 for before, after in zip(sent, now, strict=True))
        assert gateway.gateway.poller is not None
        assert gateway.gateway.poller.summary()["dropped"] == 0

        rows = history.state.rows
        filler.unlink()
        until(lambda: history.state.rows > rows and disk_health(gateway)[1] == "ok")
        stop(gateway)
        until(lambda: disk_health(gateway) == ("ok", "ok", "ok"))
        until(lambda: gateway.frame()["troubles"] == [])
        assert len(gateway.get("/api/audit").json["entries"]) > noted
        assert list(gateway.gateway.failures.values()) == []
