"""Exports over HTTP: their limit, and their effect on other requests."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote

from gateways import served
from lines import PATIENCE, until
from tables import table

from multidrop.gateway.http.exports import MOST_EXPORTS, Exports

EXPORT = "/api/export?from=0&to=1&format={}"


class SlowHistory:
    """A history whose exports wait until the test releases them."""

    def __init__(self) -> None:
        self.begun = 0
        self.go_on = threading.Event()

    def take(self, batch: object) -> None: ...

    def export(self, names: Sequence[str], begin: int, end: int, kind: str) -> Iterator[bytes]:
        if names:
            raise ValueError(f"{names[0]!r} is no series")
        return self._pieces()

    def _pieces(self) -> Iterator[bytes]:
        yield b"PAR1"
        self.begun += 1
        assert self.go_on.wait(PATIENCE)

    async def close(self) -> None: ...


def test_concurrent_exports_are_limited_and_delay_no_stop(tmp_path: Path) -> None:
    with (
        served(tmp_path, '[serve.may]\nstop = "anyone"\n') as gateway,
        ThreadPoolExecutor(MOST_EXPORTS) as clients,
    ):
        part: Any = SlowHistory()
        gateway.gateway.feeds["history"] = part
        try:
            for wrong in ("xlsx", "csv&series=pump"):  # invalid exports do not count towards the limit
                for _ in range(2 * MOST_EXPORTS):
                    assert gateway.get(EXPORT.format(wrong)).status == 400
            paths = [EXPORT.format(("csv", "parquet")[at % 2]) for at in range(MOST_EXPORTS)]
            exports = [clients.submit(gateway.get, path) for path in paths]
            until(lambda: part.begun == MOST_EXPORTS)
            refused = gateway.get(EXPORT.format("csv"))
            assert (refused.status, refused.json["error"][:11]) == (503, "8 exports a")
            assert gateway.post("/api/stop", {"drives": ["pump-1"]}).json["pump-1"]["done"] is True
            assert gateway.get("/page/index.html").status == 200
        finally:
            part.go_on.set()
        assert [done.result(PATIENCE).body for done in exports] == [b"PAR1"] * MOST_EXPORTS
        until(lambda: gateway.get(EXPORT.format("csv")).status == 200)


@table(
    ("asked", "name"),
    [
        ("series=pump-1.speed&", "pump-1.speed 2026-11-21T12-00-00Z to 2026-11-21T12-10-00Z"),
        ("series=pump-1.speed&series=pump-1.current&", "pump-1 2026-11-21T12-00-00Z to 2026-11-21T12-10-00Z"),
        ("series=a.x&series=b.x&series=c.x&", "a and 2 more 2026-11-21T12-00-00Z to 2026-11-21T12-10-00Z"),
        ("", "all drives 2026-11-21T12-00-00Z to 2026-11-21T12-10-00Z"),
        ("series=..%2F%22x%0A.y&", "..__x_.y 2026-11-21T12-00-00Z to 2026-11-21T12-10-00Z"),
        ("series=%D0%BD%D0%B0%D1%81%D0%BE%D1%81.y&", "насос.y 2026-11-21T12-00-00Z to 2026-11-21T12-10-00Z"),
    ],
)
def test_export_file_name_has_drive_and_time_range(asked: str, name: str) -> None:
    noon = 1_795_262_400_000

    class Quick(SlowHistory):
        def export(self, names: Sequence[str], begin: int, end: int, kind: str) -> Iterator[bytes]:
            return iter(())

    async def named() -> str:
        part: Any = Quick()
        names = parse_qs(asked).get("series", [])
        response = await Exports().respond(part, names, noon, noon + 600_000, "csv")
        return response.headers["content-disposition"]

    said = asyncio.run(named())
    plain, _, whole = said.partition("; filename*=UTF-8''")
    assert unquote(whole) == f"{name}.csv"
    assert plain.isascii()
    assert plain.count('"') == 2
