"""Web pages of other sites, in Chromium, can neither read data nor make the gateway write to a drive."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from fake_gateway import FakeGateway
from gateways import Served, served
from lines import until as until_here
from watching import AT_ITS_PLACE, LIVE, SIZES, VIEWS, Opener, until, until_settled

pytestmark = pytest.mark.long

MAY = '[serve.may]\nstop = "anyone"\nwrite = ["pump-1.setpoint"]\nverbs = ["pump-1.start"]\n'
# Try all ways by which a page could read or send without permission; return (way, outcome) for each.
ATTACK = """async gateway => {
  const stop = '{"drives": null}', found = [];
  const note = (what, came) => found.push([what, came]);
  const attempt = async (what, path, options) => {
    try {
      const answer = await fetch(gateway + path, { ...options, signal: AbortSignal.timeout(60000) });
      note(what, `${answer.status} ${(await answer.text()).length}`);
    } catch (error) { note(what, error.name); }
  };
  const json = { 'content-type': 'application/json' };
  const post = (headers, mode) => ({ method: 'POST', body: stop, headers, mode, credentials: 'include' });
  await attempt('read', 'api/plant', { credentials: 'include' });
  await attempt('read blindly', 'api/plant', { mode: 'no-cors' });
  await attempt('post', 'api/stop', post(json));
  await attempt('post a text', 'api/stop', post({ 'content-type': 'text/plain' }));
  await attempt('post a text blindly', 'api/stop', post({ 'content-type': 'text/plain' }, 'no-cors'));
  await attempt('start', 'api/act', { ...post(json), body: '{"drive": "pump-1", "verb": "start"}' });
  navigator.sendBeacon(gateway + 'api/stop', stop);
  const loads = (tag, path) => new Promise(done => {
    const element = document.createElement(tag);
    element.onload = () => done('loaded');
    element.onerror = () => done('error');
    element.src = gateway + path;
    document.body.append(element);
  });
  note('script', await loads('script', 'api/plant'));
  note('image', await loads('img', 'page/icon.svg'));
  return found;
}"""
# This form sends JSON as plain text, as a hostile page could. A timer submits it, so that the script can
# return before the browser leaves the page.
FORM = """gateway => {
  const form = document.createElement('form'), field = document.createElement('input');
  Object.assign(form, { method: 'POST', action: gateway + 'api/stop', enctype: 'text/plain' });
  Object.assign(field, { name: '{"drives": null, "x": "', value: '"}' });
  form.append(field);
  document.body.append(form);
  setTimeout(() => form.submit());
}"""


@pytest.fixture
def elsewhere() -> Iterator[int]:
    """Run a web server with an empty page on another port of this machine, and yield the port."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("content-type", "text/html")
            self.end_headers()
            self.wfile.write(b"<!doctype html><title>elsewhere</title><body></body>")

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    yield server.server_address[1]
    server.shutdown()
    server.server_close()


@pytest.fixture
def strange(browser: Any) -> Iterator[Any]:
    """A browser page whose errors do not fail the test."""
    context = browser.new_context()
    yield context.new_page()
    context.close()


def written(gateway: Served) -> list[Any]:
    return [write for sim in gateway.sims.values() for write in sim.counters.writes]


def sent_by_form(page: Any, gateway: str) -> int:
    """Submit FORM, and return the HTTP status of the answer."""
    with page.expect_response("**/api/stop") as answer:
        page.evaluate(FORM, gateway)
    page.wait_for_url("**/api/stop")
    return int(answer.value.status)


def test_web_pages_of_other_sites_cannot_read_or_send_commands(
    strange: Any, elsewhere: int, tmp_path: Path
) -> None:
    with served(tmp_path, MAY) as gateway:
        gateway.await_state("pump-1", "stands")
        port = gateway.gateway.port
        refused = dict.fromkeys(("read", "read blindly", "post", "post a text", "start"), "TypeError")
        refused |= {"post a text blindly": "TypeError", "script": "error", "image": "error"}
        # First a page of another site, then a page of the gateway's host on another port.
        for host, ours in (("evil.example", "127.0.0.1"), ("localhost", "localhost")):
            strange.goto(f"http://{host}:{elsewhere}/")
            own = f"http://{ours}:{port}/"
            assert dict(strange.evaluate(ATTACK, own)) == refused, host
            assert sent_by_form(strange, own) == 403
        # DNS rebinding: the name of another site resolves to this machine, so the browser takes the gateway's
        # answers for answers of that site.
        rebound = f"http://evil.example:{port}/"
        assert strange.goto(rebound).status == 421
        came = dict(strange.evaluate(ATTACK, rebound))
        assert {said.split()[0] for said in came.values()} == {"421", "error"}, came
        assert written(gateway) == []
        assert gateway.get("/api/audit").json["entries"] == []

        strange.goto(f"http://localhost:{port}/")
        until(strange, LIVE)
        send = """async ([path, body]) => (await fetch(path, { method: 'POST', body: JSON.stringify(body),
            headers: { 'content-type': 'application/json' } })).status"""
        setpoint = {"drive": "pump-1", "register": "setpoint", "value": 10.0}
        start = {"drive": "pump-1", "verb": "start"}
        assert strange.evaluate(send, ["api/write", setpoint]) == 401
        # Everyone may send a verb to `api/act`, because it may be a stop. The verb `start` is then refused.
        assert strange.evaluate(send, ["api/act", start]) == 403
        assert strange.evaluate(send, ["api/reload", {"confirm": True}]) == 401
        assert written(gateway) == []
        # the gateway's own page may send the same request
        assert strange.evaluate(send, ["api/stop", {"drives": None}]) == 200
        until_here(lambda: written(gateway))


# ---- names from a plant file are text: they run no code, and move or cover no element ----


MARKUP = '<img src=x onerror="window.hit=1"><script>window.hit=1</script>&amp;'
RIGHT_TO_LEFT = "\u202epots\u202c \u05d0\u05d1\u05d2 \u0645\u0636\u062e\u0629"
LONG = "w" * 300
CYRILLIC = "\u041d\u0430\u0441\u043e\u0441 \u2116 7/\u0430?#%41"
HOSTILE = {"pump-1": MARKUP, "conveyor-2": RIGHT_TO_LEFT, "labeller": LONG, "filler-1": CYRILLIC}


@pytest.fixture
def hostile(gateway: FakeGateway) -> FakeGateway:
    gateway.renamed = HOSTILE
    return gateway


def elements(page: Any) -> list[int]:
    return list(page.evaluate("[document.images.length, document.scripts.length, window.hit ?? 0]"))


@pytest.mark.usefixtures("hostile")
def test_html_in_drive_names_is_shown_as_text(opened: Opener) -> None:
    page = opened()
    shown = page.locator("td.name").all_text_contents()
    assert set(HOSTILE.values()) <= set(shown)
    for width, height in SIZES.values():
        page.set_viewport_size({"width": width, "height": height})
        for view in VIEWS:
            page.evaluate("view => { location.hash = view }", view)
            until_settled(page)
            assert elements(page) == [1, 4, 0], (width, view)
            assert page.evaluate("document.documentElement.scrollWidth") <= width, view
            assert page.evaluate("document.querySelector('main').scrollWidth") <= width, view
            assert page.evaluate(AT_ITS_PLACE)[0], (width, view)


def test_a_drive_with_a_hostile_name_can_be_stopped(opened: Opener, hostile: FakeGateway) -> None:
    page = opened()
    for name in HOSTILE.values():
        page.evaluate("name => { location.hash = `#/drives/${encodeURIComponent(name)}` }", name)
        page.locator("#panel h2", has_text=name[:3]).wait_for()
        assert page.locator("#panel h2").text_content() == name
        page.locator("#panel .danger").click()
        assert page.locator("#ask-title").text_content() == f"Stop {name}?"
        assert page.locator("#ask-title bdi").evaluate("e => getComputedStyle(e).unicodeBidi") == "isolate"
        page.locator("#ask .danger").click()
        page.get_by_role("heading", name="The drive is stopped").wait_for()
        page.keyboard.press("Escape")
    assert hostile.posts == [("/api/stop", {"drives": [name]}) for name in HOSTILE.values()]
    assert elements(page)[2] == 0
