"""openapi.json describes all routes; commands have ids; unknown words get 4xx; texts are compressed."""

from __future__ import annotations

import gzip
import json
import logging
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from gateways import Answer, Served, served
from lines import until
from peers import require_program

from multidrop.gateway.commands import VERBS
from multidrop.gateway.http.operations import OPERATIONS, openapi
from multidrop.gateway.http.rights import COMMAND_ID, May, Right

DRIVES = ["pump-1", "pump-2", "pump-9"]  # the last one is unknown
MAY = May("anyone", Right.WRITE, frozenset({"pump-1.setpoint"}), frozenset({"pump-1.start"}))
PHASES = os.environ.get("SCHEMATHESIS_PHASES", "fuzzing")
EXAMPLES = os.environ.get("SCHEMATHESIS_EXAMPLES", "3")  # examples of each route, in each phase
START = {"drive": "pump-1", "verb": "start"}


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A gateway whose callers have all rights."""
    folder = tmp_path_factory.mktemp("open")
    with served(folder, "[serve.history]\n", may=MAY, tokens=(), audit=folder / "audit.jsonl") as gateway:
        until(lambda: gateway.gateway.hub.taken > 0)
        yield gateway


def test_each_route_is_described_with_its_refusals(gateway: Served) -> None:
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
    "id": ("/api/act", {**START, "id": "two words"}, 400, "id is not a text"),
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
def test_unknown_words_of_commands_are_refused(gateway: Served, case: str) -> None:
    path, body, status, sentence = REFUSED[case]
    answer = gateway.command(path, body)
    assert (answer.status, answer.json["error"].startswith(sentence)) == (status, True)


def test_answer_log_and_audit_log_name_the_command(gateway: Served, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    setpoint = {"drive": "pump-1", "register": "setpoint", "value": 40.0}
    written = gateway.command("/api/write", {**setpoint, "id": "order-7"}).json
    stopped = gateway.post("/api/stop", {"drives": ["pump-1", "pump-2"], "id": ["invalid"]}).json
    assert (written["done"], written["id"]) == (True, "order-7")
    (own,) = {one["id"] for one in stopped.values()}
    assert COMMAND_ID.fullmatch(own)
    found = gateway.get("/api/audit").json["entries"]
    assert [one["outcome"] for one in found if one.get("id") == "order-7"] == ["done", "called"]
    # Two records of each drive.
    until(lambda: len([one for one in audit(gateway) if one.get("id") == own]) == 4)
    assert (
        "pump-1.setpoint = 40.0, asked for by anyone by http from 127.0.0.1 (command order-7)" in caplog.text
    )
    assert f"(command {own})" in caplog.text


def audit(gateway: Served) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = gateway.get("/api/audit").json["entries"]
    return found


def test_times_are_iso_text_or_ms(gateway: Served) -> None:
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
    if path != "/metrics":  # metrics change between two requests
        assert gzip.decompress(packed.body) == plain.body


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
def test_schemathesis_finds_no_undeclared_answer(gateway: Served, tmp_path: Path) -> None:
    """Let schemathesis send valid and invalid requests, and check each answer by openapi.json.

    Only one of its checks is left out: a schema cannot express some rules for valid requests, such as that
    `from` is before `to`.
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
    """Return the API's description, narrowed: only the names in DRIVES, and no additional keys in answers."""
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
