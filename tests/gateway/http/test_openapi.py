"""The HTTP API: openapi.json describes all routes, commands have ids, and unknown names are refused."""

from __future__ import annotations

import asyncio
import gzip
import json
import logging
import os
import re
import subprocess
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qs, unquote

import pytest
from gateways import Answer, Served, served
from lines import PATIENCE, until
from peers import require_program
from starlette.requests import Request
from tables import table

from multidrop.gateway.commands import VERBS
from multidrop.gateway.http import files
from multidrop.gateway.http.files import MOST_EXPORTS, Exports
from multidrop.gateway.http.messages import Denied, language_of
from multidrop.gateway.http.operations import OPERATIONS, openapi
from multidrop.gateway.http.rights import COMMAND_ID, May, Right

DRIVES = ["pump-1", "pump-2", "pump-9"]  # pump-9 is unknown
MAY = May("anyone", Right.WRITE, frozenset({"pump-1.setpoint"}), frozenset({"pump-1.start"}))
PHASES = os.environ.get("SCHEMATHESIS_PHASES", "fuzzing")
# examples that schemathesis makes for each route, in each of its phases
EXAMPLES = os.environ.get("SCHEMATHESIS_EXAMPLES", "3")
START = {"drive": "pump-1", "verb": "start"}


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A gateway that gives all rights to every caller."""
    folder = tmp_path_factory.mktemp("open")
    parts = '[serve.history]\n[serve.modbus]\nlisten = "127.0.0.1:0"\n'
    with served(folder, parts, may=MAY, tokens=(), audit=folder / "audit.jsonl") as gateway:
        until(lambda: gateway.gateway.hub.taken > 0)
        yield gateway


def test_openapi_describes_each_route_and_error_status(gateway: Served) -> None:
    told = gateway.get("/openapi.json").json
    assert told == json.loads(json.dumps(openapi(gateway.gateway.version)))
    assert set(told["paths"]) == {one.path for one in OPERATIONS}
    act = told["paths"]["/api/act"]["post"]
    assert {*act["responses"]} >= {"200", "400", "401", "403", "404", "413", "415", "421", "503"}
    kinds = act["requestBody"]["content"]["application/json"]["schema"]["oneOf"]
    assert sorted(verb for kind in kinds for verb in kind["properties"]["verb"]["enum"]) == sorted(VERBS)


REFUSED = {
    "verb": ("/api/act", {"drive": "pump-1", "verb": "dance"}, 400, "there is no verb 'dance'"),
    "option": ("/api/act", {**START, "options": {"hz": 1}}, 400, "start has no option 'hz'"),
    "id": ("/api/act", {**START, "id": "two words"}, 400, "key 'id' must be a string"),
    "drive": ("/api/act", {**START, "drive": "pump-9"}, 404, "there is no drive 'pump-9'"),
    "stop": ("/api/act", {"drive": "pump-9", "verb": "stop"}, 404, "there is no drive 'pump-9'"),
    "drives": ("/api/stop", {"drives": ["pump-9"]}, 404, "there is no drive 'pump-9'"),
    "register": (
        "/api/write",
        {"drive": "pump-9", "register": "setpoint", "value": 1},
        404,
        "there is no drive 'pump-9'",
    ),
    "listed": (
        "/api/write",
        {"drive": "pump-1", "register": "load", "value": 1},
        403,
        "pump-1.load is not in the plant file's list",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_commands_with_unknown_drives_verbs_or_options_are_refused(gateway: Served, case: str) -> None:
    path, body, status, sentence = REFUSED[case]
    answer = gateway.command(path, body)
    assert (answer.status, answer.json["error"].startswith(sentence)) == (status, True)


def test_the_answer_and_the_logs_contain_the_id_of_a_command(
    gateway: Served, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    setpoint = {"drive": "pump-1", "register": "setpoint", "value": 40.0}
    written = gateway.command("/api/write", {**setpoint, "id": "order-7"}).json
    stopped = gateway.post("/api/stop", {"drives": ["pump-1", "pump-2"], "id": ["invalid"]}).json
    assert (written["done"], written["id"]) == (True, "order-7")
    (own,) = {one["id"] for one in stopped.values()}
    assert COMMAND_ID.fullmatch(own)
    found = gateway.get("/api/audit").json["entries"]
    assert [one["outcome"] for one in found if one.get("id") == "order-7"] == ["done", "called"]
    until(lambda: recorded(gateway, own) >= {*product(["called", "stopped"], ["pump-1", "pump-2"])})
    assert (
        "pump-1.setpoint = 40.0, asked for by anyone by http from 127.0.0.1 (command order-7)" in caplog.text
    )
    assert f"(command {own})" in caplog.text


def audit(gateway: Served) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = gateway.get("/api/audit").json["entries"]
    return found


def recorded(gateway: Served, command: str) -> set[tuple[str, str]]:
    """Return the (outcome, drive) pairs in the audit records of a command id."""
    records = [one for one in audit(gateway) if one.get("id") == command]
    return {(one["outcome"], drive) for one in records for drive in one["drive"].split(", ")}


def test_query_times_are_accepted_as_iso_text_or_ms(gateway: Served) -> None:
    def status(begin: str) -> int:
        return gateway.get(f"/api/alarms?from={begin}&to=2100-01-01").status

    assert [status(one) for one in ("0", "2026-11-22", "2026-11-22T09:30:00.5Z")] == [200] * 3
    assert status("2026-11-22T09:30%2B02:00") == 200
    assert [status(one) for one in ("", "now", "2026-13-01")] == [400] * 3
    assert gateway.get("/api/audit?before=").status == 400
    assert gateway.get("/health").json["newest_row"].endswith("Z")


@pytest.mark.parametrize("path", ["/", "/api/plant", "/metrics", "/openapi.json"])
def test_long_answers_are_compressed(gateway: Served, path: str) -> None:
    plain, packed = gateway.get(path), gateway.get(path, accept_encoding="gzip, br")
    assert "content-encoding" not in plain.headers
    assert "accept-encoding" in plain.headers["vary"]
    assert packed.headers["content-encoding"] == "gzip"
    assert len(packed.body) < len(plain.body) / 2
    if path != "/metrics":  # the metrics change from one request to the next
        assert gzip.decompress(packed.body) == plain.body


@pytest.mark.parametrize(
    ("query", "accepted", "title"),
    [
        ("", "ru-RU,ru;q=0.9,en;q=0.8", "выходная частота"),
        ("", "ru;q=0.1, zh-CN;q=0.7, fr", "输出频率"),
        ("", "en-GB, ru;q=0.9", "output frequency"),
        ("", "ru;q=0", "output frequency"),
        ("", ";;q=,=\xff", "output frequency"),
        ("?lang=ru", "zh", "выходная частота"),
        ("?lang=de", "ru", "output frequency"),
    ],
)
def test_register_titles_are_translated(gateway: Served, query: str, accepted: str, title: str) -> None:
    answer = gateway.get(f"/api/plant{query}", accept_language=accepted, accept_encoding="gzip")
    assert answer.headers["vary"] == "accept-language, accept-encoding"
    registers = json.loads(gzip.decompress(answer.body))["lines"][0]["drives"][0]["registers"]
    assert title in [register["title"] for register in registers]
    assert "output_frequency" in [register["name"] for register in registers]


@pytest.mark.parametrize("hostile", ["a" * 10**6, "zh" + " " * 10**6], ids=["letters", "spaces"])
def test_a_long_accept_language_header_is_parsed_in_linear_time(hostile: str) -> None:
    """In quadratic time, a 60 kB header would delay stops for a minute, and this test would take hours."""
    headers = [(b"accept-language", f"{hostile}!, ru".encode())]
    assert language_of(Request({"type": "http", "headers": headers, "query_string": b""})) == "ru"


def test_short_answers_and_answers_to_commands_are_not_compressed(gateway: Served) -> None:
    def encoding(answer: Answer) -> str | None:
        return answer.headers.get("content-encoding")

    assert encoding(gateway.get("/api/alarms?from=0&to=1", accept_encoding="gzip")) is None
    assert encoding(gateway.post("/api/stop", accept_encoding="gzip")) is None


def test_csv_exports_are_compressed(gateway: Served) -> None:
    path = "/api/export?series=pump-1.status&from=0&to=2026-01-01"
    plain, packed = gateway.get(path), gateway.get(path, accept_encoding="gzip")
    assert gzip.decompress(packed.body) == plain.body
    assert "content-encoding" not in gateway.get(f"{path}&format=parquet", accept_encoding="gzip").headers


@pytest.mark.long
@pytest.mark.slow
def test_answers_to_random_requests_agree_with_openapi(gateway: Served, tmp_path: Path) -> None:
    """Let schemathesis send valid and invalid requests, and check each answer by openapi.json.

    One check is excluded: that each request which is valid by its schema is accepted. A schema cannot express
    some rules, such as that `from` is before `to`.
    """
    described = tmp_path / "openapi.json"
    described.write_text(json.dumps(narrowed(gateway.get("/openapi.json").json)))
    command = [require_program("schemathesis"), "run", str(described), "--no-color", "--request-timeout=60"]
    url = f"--url=http://127.0.0.1:{gateway.gateway.port}"
    options = [
        f"--phases={PHASES}",
        f"--max-examples={EXAMPLES}",
        "--exclude-checks=positive_data_acceptance",
        "--suppress-health-check=too_slow",  # the machine may be busy
    ]
    ran = subprocess.run([*command, url, *options], capture_output=True, text=True, cwd=tmp_path)
    print(ran.stdout[ran.stdout.find("= SUMMARY =") :])
    assert ran.returncode == 0, ran.stdout
    (cases,) = re.findall(r"(\d+) generated", ran.stdout)
    assert int(cases) >= len(OPERATIONS)


def narrowed(node: Any, key: str = "", *, is_answer: bool = False) -> Any:
    """Return openapi.json with only the drives in DRIVES, and with no undeclared keys allowed in answers."""
    if isinstance(node, list):
        return [narrowed(one, key, is_answer=is_answer) for one in node]
    if not isinstance(node, dict):
        return node
    if key == "drive" and not is_answer:
        return {"enum": DRIVES}
    is_answer = is_answer or key == "responses"
    found = {name: narrowed(one, name, is_answer=is_answer) for name, one in node.items()}
    if node.get("in") == "path":
        found["schema"] = {"enum": DRIVES}
    is_whole = is_answer and node.get("type") == "object" and "properties" in node
    return found | {"additionalProperties": False} if is_whole else found


# ---- exports over HTTP: their limit, and their effect on other requests ----


EXPORT = "/api/export?from=0&to=1&format={}"


class SlowHistory:
    """A history whose exports wait until the test sets `go_on`."""

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


def test_a_stop_does_not_wait_for_concurrent_exports(tmp_path: Path) -> None:
    with (
        served(tmp_path, '[serve.may]\nstop = "anyone"\n') as gateway,
        ThreadPoolExecutor(MOST_EXPORTS) as clients,
    ):
        part: Any = SlowHistory()
        gateway.gateway.feeds["history"] = part
        try:
            # invalid requests for exports do not count towards the limit of exports
            for wrong in ("xlsx", "csv&series=pump"):
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
def test_the_file_name_of_an_export_has_the_drive_and_the_time_range(asked: str, name: str) -> None:
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


async def test_a_refused_export_does_not_count_as_in_progress() -> None:
    exports, part = Exports(), SimpleNamespace(export=lambda *asked: iter([b""]))
    with pytest.raises(Denied):
        await exports.respond(part, ["\ud800.y"], 0, 1, "csv")
    assert exports.under_way == 0


# ---- the page's files over HTTP: types, ETags, and paths outside the page's folder ----


TYPES = {
    "/": "text/html; charset=utf-8",
    "/page/app.js": "text/javascript; charset=utf-8",
    "/page/style/base.css": "text/css; charset=utf-8",
    "/page/icon.svg": "image/svg+xml",
    "/page/vendor/uPlot-LICENSE": "text/plain; charset=utf-8",
}


@table(("path", "media_type"), TYPES.items())
def test_page_files_have_content_types_and_etags(gateway: Served, path: str, media_type: str) -> None:
    answer = gateway.get(path)
    assert (answer.status, answer.headers["content-type"]) == (200, media_type)
    again = gateway.get(path, if_none_match=answer.headers["etag"])
    assert (again.status, again.body, again.headers["cache-control"]) == (304, b"", "no-cache")
    head = gateway.request("HEAD", path)
    assert (head.status, head.headers["content-length"]) == (200, str(len(answer.body)))


@table("name", ["", "app", "../gateway.py", "%2e%2e/gateway.py", "vendor", "/etc/passwd"])
def test_files_outside_the_folder_of_the_web_page_are_not_served(gateway: Served, name: str) -> None:
    answer = gateway.get(f"/page/{name}")
    assert (answer.status, answer.json) == (404, {"error": "unknown path"})


def test_a_gateway_without_a_web_page_answers_404(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files.PageFiles.__init__, "__defaults__", (tmp_path / "missing",))
    with served(tmp_path) as gateway:
        assert "this installation of multidrop has no web page" in gateway.get("/").json["error"]
        assert gateway.get("/api/plant").status == 200
