"""Callers have exactly the rights in TABLE. Requests from web pages of other sites are refused."""

from __future__ import annotations

import asyncio
import http.client
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NoReturn

import pytest
from gateways import Served, served
from lines import PATIENCE, until
from modbus_gateway import plant_of
from tables import table

from multidrop import Drive, InvtCHE, Plant, WriteForbidden
from multidrop.control import CommandOutcome, CommandResult
from multidrop.gateway import commands
from multidrop.gateway.commands import BUSY, STOPPING, VERBS, Commands
from multidrop.gateway.http import rights
from multidrop.gateway.http.rights import (
    MOST_WRONG,
    NEVER_THIS_WAY,
    NOT_ALLOWED,
    NOT_LISTED,
    SCHEMES,
    Caller,
    May,
    OwnNames,
    Right,
    Tokens,
)

MAY = '[serve.may]\nwrite = ["pump-1.setpoint"]\nverbs = ["pump-1.start", "pump-1.reset_fault"]\n'
LOOPBACK_STOPS = MAY.replace("[serve.may]", '[serve.may]\nstop = "anyone"')
CLOSED = MAY.replace("[serve.may]", '[serve]\ntokens = "tokens"\n[serve.may]\nlook = "token"')

TOKENS = MAY.replace("[serve.may]", '[serve]\ntokens = "tokens"\n[serve.may]')
OPEN = TOKENS.replace("[serve.may]", '[serve.may]\nlook = "anyone"')

LOOKS = ("/api/plant", "/api/frame", "/api/lines", "/api/audit", "/api/drive/pump-1", "/health", "/metrics")
STOP = ("/api/stop", {"drives": ["pump-1"]})
WRITE = ("/api/write", {"drive": "pump-1", "register": "setpoint", "value": 50.0})
UNLISTED_WRITE = ("/api/write", {"drive": "pump-2", "register": "setpoint", "value": 50.0})
RESET = ("/api/act", {"drive": "pump-1", "verb": "reset_fault", "options": {}})
UNLISTED_VERB = ("/api/act", {"drive": "pump-1", "verb": "jog", "options": {}})
STOP_VERB = ("/api/act", {"drive": "pump-2", "verb": "stop", "options": {}})
ACTS = (STOP, WRITE, UNLISTED_WRITE, RESET, UNLISTED_VERB, STOP_VERB)

LOCAL, OTHER = "127.0.0.1", "10.0.0.7"  # client addresses that a proxy reports in X-Forwarded-For
# Expected HTTP statuses, by the settings and the caller's address. A row has the right of the caller's token
# (None: no token), the status of all requests in LOOKS, and the status of each request in ACTS.
TABLE = {
    (MAY, LOCAL): [
        (None, 200, (401, 401, 401, 401, 401, 401)),
        (Right.LOOK, 200, (403, 403, 403, 403, 403, 403)),
        (Right.STOP, 200, (200, 403, 403, 403, 403, 200)),
        (Right.WRITE, 200, (200, 200, 403, 200, 403, 200)),
    ],
    (MAY, OTHER): [
        (None, 200, (401, 401, 401, 401, 401, 401)),
        (Right.STOP, 200, (200, 403, 403, 403, 403, 200)),
        (Right.WRITE, 200, (200, 200, 403, 200, 403, 200)),
    ],
    (LOOPBACK_STOPS, LOCAL): [
        (None, 200, (200, 401, 401, 403, 403, 200)),
        (Right.LOOK, 200, (200, 403, 403, 403, 403, 200)),
        (Right.WRITE, 200, (200, 200, 403, 200, 403, 200)),
    ],
    (LOOPBACK_STOPS, OTHER): [
        (None, 200, (401, 401, 401, 401, 401, 401)),
        (Right.STOP, 200, (200, 403, 403, 403, 403, 200)),
    ],
    (CLOSED, LOCAL): [
        (None, 401, (401, 401, 401, 401, 401, 401)),
        (Right.LOOK, 200, (403, 403, 403, 403, 403, 403)),
    ],
    (CLOSED, OTHER): [
        (None, 401, (401, 401, 401, 401, 401, 401)),
        (Right.WRITE, 200, (200, 200, 403, 200, 403, 200)),
    ],
    (TOKENS, LOCAL): [
        (None, 401, (401, 401, 401, 401, 401, 401)),
        (Right.LOOK, 200, (403, 403, 403, 403, 403, 403)),
    ],
    (TOKENS, OTHER): [(None, 401, (401, 401, 401, 401, 401, 401))],
    (OPEN, OTHER): [(None, 200, (401, 401, 401, 401, 401, 401))],
}


@pytest.mark.slow
@pytest.mark.parametrize(("serve", "address"), TABLE)
def test_rights_depend_on_the_token_the_address_and_the_settings(
    tmp_path: Path, serve: str, address: str
) -> None:
    with served(tmp_path, serve, behind_proxy=address is OTHER) as gateway:
        until(lambda: gateway.gateway.hub.taken > 0)
        for right, look, acts in TABLE[serve, address]:
            headers = {} if right is None else {"authorization": gateway.bearer(right)}
            if address is OTHER:
                # a client may send any X-Forwarded-For; the proxy appends the true address
                headers["x_forwarded_for"] = f"127.0.0.1, {address}"
            looks = {path: gateway.get(path, **headers).status for path in LOOKS}
            assert looks == dict.fromkeys(LOOKS, look), right
            assert tuple(gateway.command(path, body, **headers).status for path, body in ACTS) == acts, right
            assert gateway.get("/", **headers).status in (200, 404)  # the files of the web page need no right


@pytest.mark.parametrize("way", ["authorization", "cookie"])
def test_a_wrong_token_is_refused_even_for_requests_that_need_no_token(tmp_path: Path, way: str) -> None:
    wrong = {way: {"authorization": "Bearer wrong", "cookie": "multidrop=wrong"}[way]}
    with served(tmp_path, LOOPBACK_STOPS) as gateway:
        until(lambda: gateway.gateway.hub.taken > 0)
        for path in LOOKS:
            assert gateway.get(path).status == 200
            answer = gateway.get(path, **wrong)
            assert (answer.status, answer.json["error"]) == (401, "the token is wrong")
            assert ("multidrop=" in answer.headers.get("set-cookie", "")) == (way == "cookie")
        for path, body in (WRITE, RESET, UNLISTED_VERB):
            assert gateway.post(path, {**body, "seen": 1}, **wrong).status == 401
        assert gateway.gateway.commands.called == 0
        # Stops are allowed to everyone here, so a wrong token does not prevent them.
        for path, body in (STOP, STOP_VERB):
            assert gateway.post(path, body, **wrong).status == 200
        assert gateway.gateway.commands.called == 2
        for at in range(MOST_WRONG):
            gateway.get("/health", authorization=f"Bearer wrong-{at}")
        # After MOST_WRONG wrong tokens from one address, no token from this address is accepted.
        for path in LOOKS:
            assert gateway.get(path, **wrong).status == 429
            assert gateway.get(path, authorization=gateway.bearer(Right.WRITE)).status == 429
            assert gateway.get(path).status == 200


def test_a_token_is_ignored_if_no_token_file_is_configured(tmp_path: Path) -> None:
    with served(tmp_path, LOOPBACK_STOPS, tokens=()) as gateway:
        until(lambda: gateway.gateway.hub.taken > 0)
        for path in LOOKS:
            assert gateway.get(path, authorization="Bearer any").status == 200
        assert gateway.post(WRITE[0], {**WRITE[1], "seen": 1}, authorization="Bearer any").status == 401


def test_ipv4_clients_of_an_ipv6_socket_count_as_local(tmp_path: Path) -> None:
    with served(tmp_path, LOOPBACK_STOPS, host="::") as gateway:
        assert gateway.post(*STOP).json["pump-1"]["done"] is True


def test_a_repeated_wrong_token_is_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with served(tmp_path) as gateway:
        for _ in range(3):
            assert gateway.get("/api/plant", cookie="multidrop=taken-away").status == 401
    assert caplog.text.count("wrong token from 127.0.0.1") == 1


@pytest.fixture(scope="module")
def open_gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A gateway whose drives may be stopped without a token from this machine."""
    with served(tmp_path_factory.mktemp("open"), LOOPBACK_STOPS, names=("plant.example",)) as gateway:
        until(lambda: gateway.gateway.hub.taken > 0)
        yield gateway


FOREIGN = {
    "another name, such as a rebound one": ({"host": "evil.test"}, 421),
    "another name with our port": ({"host": "evil.test:8750"}, 421),
    "no host name": ({"host": "plant.example/x"}, 421),
    "an empty name": ({"host": ""}, 421),
    "a port that cannot exist": ({"host": "localhost:65536"}, 421),
    "a page of another site": ({"origin": "http://evil.test"}, 403),
    "the same port with TLS, which we have not": ({"host": "localhost", "origin": "https://localhost"}, 403),
    "another port of this machine": ({"origin": "http://localhost:1"}, 403),
    "a file, or a sandboxed frame": ({"origin": "null"}, 403),
    "a script of another site": ({"sec_fetch_site": "cross-site"}, 403),
    "a script of another port": ({"sec_fetch_site": "same-site"}, 403),
    "a form": ({"content_type": "application/x-www-form-urlencoded"}, 415),
    "a form that looks like text": ({"content_type": "text/plain"}, 415),
}


@pytest.mark.parametrize("case", FOREIGN)
def test_a_stop_sent_by_a_web_page_of_another_site_is_refused(open_gateway: Served, case: str) -> None:
    headers, status = FOREIGN[case]
    before = open_gateway.gateway.commands.called
    assert open_gateway.post(*STOP, **headers).status == status
    assert open_gateway.gateway.commands.called == before


# (Origin header, Host header, schemes of the gateway): True if the origin is the gateway's own page
ORIGINS = {
    ("https://plant.example", "plant.example", ("https",)): True,
    ("https://plant.example:443", "plant.example", ("https",)): True,
    ("https://plant.example:8443", "plant.example:8443", ("https",)): True,
    # http means port 80, but the gateway has port 443
    ("http://plant.example", "plant.example", ("https",)): False,
    ("https://plant.example", "plant.example", ("http",)): False,
    ("https://plant.example", "plant.example", SCHEMES): True,  # a proxy in front of the gateway may add TLS
    ("http://plant.example", "plant.example:443", SCHEMES): False,
    ("https://plant.example.evil.test", "plant.example", ("https",)): False,
    ("https://evil.test", "evil.test", ("https",)): False,
    ("https:plant.example", "plant.example", ("https",)): False,
    ("https://anna@plant.example", "plant.example", ("https",)): False,
    ("null", "plant.example", SCHEMES): False,
}


@table("case", ORIGINS)
def test_only_addresses_of_the_gateways_own_page_are_allowed_origins(
    case: tuple[str, str, tuple[str, ...]],
) -> None:
    origin, host, schemes = case
    names = OwnNames(["plant.example"], "0.0.0.0", 443)
    assert names.has_origin(origin, host, schemes) is ORIGINS[case]


def test_a_stop_from_the_gateways_own_page_or_a_program_is_sent(open_gateway: Served) -> None:
    port = open_gateway.gateway.port
    before = open_gateway.gateway.commands.called
    for headers in (
        {},
        {"host": f"localhost:{port}", "origin": f"http://localhost:{port}", "sec_fetch_site": "same-origin"},
        {"host": "plant.example", "origin": "http://plant.example"},
        {"host": f"[::1]:{port}"},
    ):
        assert open_gateway.post(*STOP, **headers).json["pump-1"]["done"] is True
    assert open_gateway.gateway.commands.called == before + 4


def test_a_request_with_two_host_headers_is_refused(open_gateway: Served) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", open_gateway.gateway.port)
    connection.putrequest("GET", "/health", skip_host=True)
    connection.putheader("host", "localhost")
    connection.putheader("host", "evil.test")
    connection.endheaders()
    assert connection.getresponse().status in (400, 421)
    connection.close()


@pytest.mark.parametrize("path", ["/", "/api/plant", "/api/nothing", "/metrics", "/api/stop"])
def test_http_answers_have_the_security_headers(open_gateway: Served, path: str) -> None:
    headers = open_gateway.get(path).headers
    if path == "/":
        policy = "default-src 'self'; base-uri 'none'; form-action 'none'; object-src 'none'"
        assert headers["content-security-policy"] == f"{policy}; frame-ancestors 'none'"
        assert headers["cross-origin-opener-policy"] == "same-origin"
    else:
        assert headers["content-security-policy"] == "default-src 'none'; frame-ancestors 'none'"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert headers["x-content-type-options"] == "nosniff"
    assert "server" not in headers
    assert headers["cache-control"] == ("no-cache" if path == "/" else "no-store")


def test_wrong_http_methods_and_invalid_bodies_are_refused(open_gateway: Served) -> None:
    post, get = open_gateway.post, open_gateway.get
    assert get("/api/stop").status == 405
    assert post("/api/plant").status == 405
    assert open_gateway.request("PUT", "/api/stop").status == 405
    assert open_gateway.request("OPTIONS", "/api/stop").status == 405
    assert open_gateway.request("OPTIONS", "*").status == 405
    assert get("/api/plant", cookie="a/b=c").status == 200  # an invalid cookie counts as none
    assert post("/api/act", b"no json").json == {"error": "the body is not JSON"}
    assert post("/api/act", b"[" * 50_000).status == 400
    assert post("/api/act", b"[]").json == {"error": "the body is not a JSON object"}
    assert post("/api/act", b" " * 70_000).status == 413
    assert get("/api/nothing").json == {"error": "unknown path"}
    assert get("/api/drive/pump-9").status == 404
    assert get("/api/frame?after=x").status == 400
    assert get("/api/history?series=pump-1.setpoint&from=0&to=1").status == 404
    writer = {"authorization": open_gateway.bearer(Right.WRITE)}
    assert (
        post("/api/write", {"drive": "pump-1", "register": "setpoint", "value": True}, **writer).status == 400
    )
    assert post("/api/write", {"drive": "", "register": "setpoint", "value": 1}, **writer).status == 400
    assert post("/api/act", {"drive": "pump-1", "verb": "start", "options": []}, **writer).status == 400


def test_invalid_unicode_names_are_answered_like_unknown_names(open_gateway: Served) -> None:
    post, writer = open_gateway.post, {"authorization": open_gateway.bearer(Right.WRITE)}
    odd = "\ud800"
    assert post("/api/token", {"token": odd}).status == 401
    for named in ({"drive": odd, "register": "setpoint"}, {"drive": "pump-1", "register": odd}):
        answer = open_gateway.command("/api/write", {**named, "value": 1.0}, **writer)
        is_unknown = named["drive"] == odd
        assert answer.status == (404 if is_unknown else 403)
        assert (repr(odd) if is_unknown else odd) in answer.json["error"]
    unknown = open_gateway.command("/api/act", {"drive": odd, "verb": "coast"}, **writer)
    assert repr(odd) in unknown.json["error"]


def test_the_token_of_the_web_page_is_in_a_cookie_hidden_from_scripts(open_gateway: Served) -> None:
    told = open_gateway.post("/api/token", {"token": open_gateway.secrets[Right.WRITE]})
    assert told.json == {"name": "writer", "role": "write"}
    cookie = told.headers["set-cookie"]
    assert {"HttpOnly", "SameSite=strict", "Path=/"} <= {part.strip() for part in cookie.split(";")}
    assert "Secure" not in cookie  # a Secure cookie would not work, because this gateway has no TLS
    kept = cookie.partition(";")[0]
    assert open_gateway.get("/api/plant", cookie=kept).json["may"]["role"] == "write"
    assert open_gateway.command(*WRITE, cookie=kept).status == 200
    gone = open_gateway.post("/api/forget", cookie=kept).headers["set-cookie"]
    assert 'multidrop=""' in gone
    assert "Max-Age=0" in gone


def test_a_client_address_can_only_stop_drives_after_five_wrong_tokens(tmp_path: Path) -> None:
    """A valid token still works from other addresses. From the refused address, it works only for a stop."""
    now = [1000.0]
    with served(tmp_path, CLOSED, behind_proxy=True) as gateway:
        gateway.gateway.guard_clock = lambda: now[0]
        anna = {"x_forwarded_for": "10.0.0.1"}
        wrong = {**anna, "authorization": "Bearer wrong"}
        right = {**anna, "authorization": gateway.bearer(Right.STOP)}
        for at in range(MOST_WRONG):
            assert gateway.get("/api/plant", **anna, authorization=f"Bearer wrong-{at}").status == 401
        assert gateway.get("/api/plant", **wrong).status == 429
        assert gateway.get("/api/plant", **right).status == 429
        assert gateway.post("/api/acknowledge", {"alarm": "1"}, **right).status == 429
        assert gateway.post("/api/token", {"token": gateway.secrets[Right.STOP]}, **anna).status == 429
        assert gateway.post(*STOP, **right).json["pump-1"]["done"] is True
        assert gateway.post(*STOP, **wrong).status == 401
        # sign-in that the page needs before a stop
        signed = {"token": gateway.secrets[Right.STOP], "to": "stop"}
        assert gateway.post("/api/token", signed, **anna).status == 200
        assert gateway.post("/api/token", {**signed, "token": "wrong"}, **anna).status == 401
        elsewhere = {"x_forwarded_for": "10.0.0.2", "authorization": gateway.bearer(Right.STOP)}
        assert gateway.get("/api/plant", **elsewhere).status == 200
        now[0] += 60.0
        assert gateway.get("/api/plant", **right).status == 200


def test_callers_behind_a_proxy_do_not_count_as_local(tmp_path: Path) -> None:
    """The proxy runs on this machine, but its clients may be elsewhere."""
    with served(tmp_path, LOOPBACK_STOPS, behind_proxy=True) as gateway:
        for told in ({}, {"x_forwarded_for": "127.0.0.1"}, {"x_forwarded_for": "10.0.0.7, ::1"}):
            assert gateway.post(*STOP, **told).status == 401, told
            assert gateway.get("/api/plant", **told).json["may"]["role"] == "look", told
        assert gateway.gateway.commands.called == 0


def test_wrong_tokens_of_only_the_newest_addresses_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rights, "MOST_ADDRESSES", 2)
    tokens = Tokens()
    for address in ("10.0.0.1", "10.0.0.2", "10.0.0.3"):
        for at in range(MOST_WRONG):
            tokens.note_wrong(address, f"wrong-{at}", 0.0)
    assert [tokens.is_shut(f"10.0.0.{at}", 0.0) for at in (1, 2, 3)] == [False, True, True]


def test_only_the_sender_of_wrong_tokens_is_blocked_behind_a_proxy(tmp_path: Path) -> None:
    """A proxy such as HAProxy appends its X-Forwarded-For header to the client's own."""
    with served(tmp_path, CLOSED, behind_proxy=True) as gateway:
        for at in range(MOST_WRONG):
            connection = http.client.HTTPConnection("127.0.0.1", gateway.gateway.port, timeout=PATIENCE)
            with closing(connection):
                connection.putrequest("GET", "/api/plant")
                for address in ("10.0.0.1", "10.0.0.66"):
                    connection.putheader("x-forwarded-for", address)
                connection.putheader("authorization", f"Bearer wrong-{at}")
                connection.endheaders()
                assert connection.getresponse().status == 401
        anna = {"x_forwarded_for": "10.0.0.1", "authorization": gateway.bearer(Right.STOP)}
        assert gateway.get("/api/plant", **anna).status == 200
        assert gateway.get("/api/plant", **anna | {"x_forwarded_for": "10.0.0.66"}).status == 429


def test_a_new_token_is_accepted_after_many_requests_with_a_revoked_token(tmp_path: Path) -> None:
    """A browser keeps sending the cookie with the revoked token with each request for new values."""
    with served(tmp_path, CLOSED) as gateway:
        old = {"cookie": "multidrop=taken-away"}
        for _ in range(2 * MOST_WRONG):
            assert gateway.get("/api/frame", **old).status == 401
        assert gateway.post(*STOP, **old).status == 401
        signed = gateway.post("/api/token", {"token": gateway.secrets[Right.STOP]}, **old)
        assert signed.status == 200
        kept = signed.headers["set-cookie"].partition(";")[0]
        assert gateway.post(*STOP, cookie=kept).json["pump-1"]["done"] is True


@pytest.mark.slow
def test_the_audit_log_names_the_sender_and_the_interface_of_a_command(tmp_path: Path) -> None:
    with served(tmp_path, LOOPBACK_STOPS) as gateway:
        until(lambda: gateway.gateway.hub.taken > 0)
        writer = {"authorization": gateway.bearer(Right.WRITE)}
        assert gateway.command(*WRITE, **writer).json["done"] is True
        assert gateway.post(*STOP, origin=f"http://127.0.0.1:{gateway.gateway.port}").status == 200
        records = gateway.get("/api/audit").json["entries"]
        # the audit log has a record of the call and a record of the result
        written = [(one["drive"], one["by"], one["way"]) for one in records[-2:]]
        assert written == [("pump-1", "writer", "http from 127.0.0.1")] * 2
        assert {(one["by"], one["way"]) for one in records[:-2]} == {("anyone", "page from 127.0.0.1")}
        oldest = records[-1]["time"]
        assert gateway.get(f"/api/audit?before={oldest}").json == {"entries": [], "more": False}
        assert gateway.get(f"/api/audit?before={oldest[:10]}").json == {"entries": [], "more": False}
        years = ("300000000000000", "9" * 40, "-" + "9" * 40, "0001-01-01T00:00%2B23:59")
        for wrong in ("tomorrow", "", "2026-11-22T25:30%2B03:00", *years):
            assert gateway.get(f"/api/audit?before={wrong}").status == 400
        assert gateway.get("/api/audit?count=1").json == {"entries": records[:1], "more": True}


# ---- rights checked by Commands, for every interface that sends commands ----


ALL = May(write=frozenset({"mill.setpoint"}), verbs=frozenset(f"mill.{verb}" for verb in VERBS))
WAYS = ("page", "http", "mqtt", "modbus")


class GuardedLines:
    """Fake lines with one drive. Each command must be refused before it needs the drive's bus."""

    plant: Plant = plant_of(("hall", InvtCHE(1, name="mill")), polled=False)

    def bus(self, line: str) -> NoReturn:
        raise AssertionError("a command that nobody may send came to the line")

    @property
    def plant_now(self) -> Plant:
        return self.plant

    plant_coming = None


def rules_of(may: May, way: str, role: Right) -> dict[str, str | None]:
    """Return, for each command, the rule by which it is refused; None if the caller may send it."""
    caller = Caller("anna", way, "10.0.0.7", role)

    async def carried_out() -> dict[str, Any]:
        control = Commands(GuardedLines(), may)  # type: ignore[arg-type]
        told: dict[str, Any] = {verb: await control.act("mill", verb, {}, caller) for verb in VERBS}
        told["write"] = await control.write("mill", "setpoint", 10.0, caller)
        stopped = await control.stop(["mill"], caller)
        return told | {"stop all": stopped["mill"]}

    return {
        what: told.error.rule if isinstance(told.error, WriteForbidden) else None
        for what, told in asyncio.run(carried_out()).items()
    }


@table("way", WAYS)
def test_callers_with_the_role_look_can_send_no_command(way: str) -> None:
    by_verb = NEVER_THIS_WAY if way == "modbus" else NOT_ALLOWED
    expected = dict.fromkeys(VERBS, by_verb) | {"write": NOT_ALLOWED, "stop all": NOT_ALLOWED}
    assert rules_of(ALL, way, Right.LOOK) == expected


@table("way", WAYS)
def test_callers_with_the_role_stop_can_only_stop(way: str) -> None:
    rules = rules_of(ALL, way, Right.STOP)
    moving = [rules[verb] for verb in VERBS if verb not in STOPPING]
    assert {*moving} == {NEVER_THIS_WAY if way == "modbus" else NOT_ALLOWED}
    assert rules["write"] == NOT_ALLOWED
    assert rules["stop all"] not in (NOT_ALLOWED, NOT_LISTED)


@table("way", WAYS)
def test_writes_are_refused_if_the_settings_do_not_list_them(way: str) -> None:
    rules = rules_of(May(), way, Right.WRITE)
    listed = {verb: rules[verb] for verb in VERBS if verb != "stop"}
    assert {*listed.values()} == {NEVER_THIS_WAY if way == "modbus" else NOT_LISTED}
    assert rules["write"] == NOT_LISTED
    assert rules["stop all"] not in (NOT_ALLOWED, NOT_LISTED)


def test_verbs_are_refused_over_modbus_even_if_the_settings_list_them() -> None:
    """Over Modbus, no dialog can ask a person to confirm the verb."""
    rules = rules_of(ALL, "modbus", Right.WRITE)
    assert {rules[verb] for verb in VERBS} == {NEVER_THIS_WAY}


async def test_a_stop_is_sent_when_the_limit_of_concurrent_writes_is_reached(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each write occupies a thread, so a blocked line could otherwise occupy any number of threads."""
    go_on = threading.Event()

    def slow(drive: Drive, **command: object) -> CommandResult:
        assert go_on.wait(PATIENCE)
        return CommandResult(CommandOutcome.DONE, "done")

    for work in ("write_register", "carry_out_verb"):
        monkeypatch.setattr(commands, work, slow)
    try:
        control = Commands(GuardedLines(), ALL)  # type: ignore[arg-type]
        writer = Caller("anna", "http", "10.0.0.7", Right.WRITE)
        some = [asyncio.ensure_future(control.write("mill", "setpoint", at, writer)) for at in range(8)]
        await asyncio.sleep(0)  # lets all writes start
        for further in (
            control.write("mill", "setpoint", 9.0, writer),
            control.act("mill", "start", {}, writer),
        ):
            told = await further
            assert isinstance(told.error, WriteForbidden)
            assert told.error.rule == BUSY
        stopped = await control.stop(["mill"], writer)
        assert not isinstance(stopped["mill"].error, WriteForbidden)
        go_on.set()
        await asyncio.gather(*some)
        # accepted again, because the earlier writes have ended
        assert (await control.write("mill", "setpoint", 9.0, writer)).ok
    finally:
        go_on.set()
