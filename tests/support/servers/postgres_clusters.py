"""Run PostgreSQL clusters in temporary folders, as the user postgres."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import psycopg
import pytest
from free_ports import free_ports
from peers import require_program

PATIENCE_S = 30.0
PROGRAMS = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)


class Postgres:
    """A PostgreSQL cluster that can be killed and restarted; local connections only, no password."""

    def __init__(self) -> None:
        self._programs = PROGRAMS[0] if PROGRAMS else Path(require_program("postgres")).parent
        self._user = self._owner()
        self.folder = Path(mkdtemp(prefix="multidrop-postgres-"))
        if self._user:
            os.chown(self.folder, self._user.pw_uid, self._user.pw_gid)
        (self.port,) = free_ports(1)
        self._run("initdb", "-D", str(self.folder / "data"), "-U", "multidrop", "--auth=trust", "--no-sync")
        self.start()
        self.wait()

    @staticmethod
    def _owner() -> pwd.struct_passwd | None:
        """Return the user that runs PostgreSQL, which refuses to run as root."""
        if os.geteuid():
            return None
        try:
            return pwd.getpwnam("postgres")
        except KeyError:
            pytest.skip("root cannot run PostgreSQL, and there is no user postgres")

    @property
    def where(self) -> str:
        return f"host=127.0.0.1 port={self.port} user=multidrop dbname=postgres"

    def start(self) -> None:
        details = f"-c port={self.port} -c listen_addresses=127.0.0.1 -c unix_socket_directories="
        words = [*details.split(), "-c", "fsync=on", "-D", str(self.folder / "data")]
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(
                [str(self._programs / "postgres"), *words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=self.folder,
                start_new_session=True,
                **self._as_owner(),
            )

    def wait(self) -> None:
        ends = time.monotonic() + PATIENCE_S
        while True:
            try:
                psycopg.connect(self.where, connect_timeout=2).close()
            except psycopg.Error:
                assert time.monotonic() < ends, (self.folder / "log").read_text()
                time.sleep(0.05)
            else:
                return

    def kill(self) -> None:
        """Kill the server with all its child processes, like a power cut."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def close(self) -> None:
        if self.process.poll() is None:
            self.kill()
        shutil.rmtree(self.folder, ignore_errors=True)

    def ask(self, query: str) -> list[tuple[object, ...]]:
        with psycopg.connect(self.where) as connection:
            cursor = connection.execute(query.encode())
            return cursor.fetchall() if cursor.description else []

    def _run(self, program: str, *words: str) -> None:
        subprocess.run(
            [str(self._programs / program), *words],
            check=True,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            cwd=self.folder,
            **self._as_owner(),
        )

    def _as_owner(self) -> dict[str, Any]:
        if not self._user:
            return {}
        return {"user": self._user.pw_uid, "group": self._user.pw_gid, "extra_groups": []}


@contextmanager
def postgres() -> Iterator[Postgres]:
    with closing(Postgres()) as running:
        yield running
