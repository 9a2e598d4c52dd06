"""A small fake gateway for tests of the web page. A test may set its answers, and may kill it."""

from __future__ import annotations

import contextlib
import json
import math
import socket
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

import fake_plant

from multidrop.gateway.http.files import PAGE, read_files
from multidrop.gateway.live.frames import changes
from multidrop.printable import iso_time

FILES = read_files(PAGE)
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
}
FRAMES_A_SECOND = 5  # limit of messages to the page per second, as in the real gateway
KEPT = 5  # number of messages to the page that are kept
HOLD_S = 20  # seconds until a request that waits for a new message is answered with 304


class FakeGateway:
    """An HTTP server on 127.0.0.1. Tests may change its attributes at any time."""

    def __init__(self, port: int = 0) -> None:
        self.renamed: dict[str, str] = {}
        self.stuck: dict[str, float] = {}  # by drive: time (s) since which it has not been polled
        self.clocked: str | None = None  # drive whose frequency changes with the time
        self.plant_changes: dict[str, Any] = {}  # keys of the plant description to replace
        self.changes: dict[str, Any] = {}  # keys to replace in messages to the page
        self.drive_changes: dict[str, dict[str, Any]] = {}  # keys to replace in a drive's entry, by drive
        self.posts: list[tuple[str, Any]] = []  # path and body of each POST request
        self.seen: list[int] = []  # for each command: the number in its key `seen`
        self.stops: dict[str, int] = {}  # by drive: number of stops called so far
        self.is_held: threading.Event | None = None  # if set, answers to stops wait for this event
        self.confirms = False  # True: send the HTTP head of an answer before the rest is ready
        self.token: str | None = None  # token that POST requests must have; None: any caller may send them
        self.has_history = True
        # by series: keys to add to the answer about its history
        self.recorded: dict[str, dict[str, object]] = {}
        self.triggers: list[dict[str, Any]] = []  # the last triggers, newest first
        self.knows_since = 0  # UTC in ms since which all alarms are known
        self.maximum_hz = 50.0  # maximum frequency of all drives
        self.has_no_alarm = False  # True: an acknowledgement is answered with "there is no such alarm"
        # successive answers about parameters; the last is repeated
        self.parameters: list[dict[str, Any]] = []
        self.fleet: dict[str, Any] = {}  # changed keys of the answer to /api/fleet
        self.fleet_outcomes: dict[str, dict[str, Any]] = {}  # answer to a stop of the fleet
        self.reloaded: dict[str, Any] = {
            "done": True,
            "text": "plant.toml is in effect",
            "mistakes": [],
            "restart": [],
        }
        self.is_silent = False  # True: the page's requests for new values get no answer
        self.stands_still = False  # True: there are no new values
        self.began = time.time()
        self.outcomes: dict[str, dict[str, Any]] = {}
        self._lock = threading.Lock()
        self._made: dict[int, dict[str, Any]] = {}  # kept messages to the page, by their number
        self._sockets: set[socket.socket] = set()
        self._server = _Server(("127.0.0.1", port), _handler(self))
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()
        self.port = self._server.server_address[1]
        self.url = f"http://127.0.0.1:{self.port}/"

    def kill(self) -> None:
        """Close the listener and all connections, as the kernel does for a killed process."""
        self._server.shutdown()
        self._server.server_close()
        for connection in list(self._sockets):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def number(self) -> int:
        """Return the number of the newest message to the page."""
        return 1 if self.stands_still else int((time.time() - self.began) * FRAMES_A_SECOND) + 1

    def encoded(self, after: int) -> bytes:
        """Return the newest message to the page; only its changes if message `after` is still kept."""
        with self._lock:
            number = self.number()
            if number not in self._made:
                told = fake_plant.frame(number, self.began, self.renamed, self.stuck)
                if self.clocked:
                    told["drives"][self.clocked]["values"]["output_frequency"][0] = time.time() % 1000
                for name, drive in told["drives"].items():
                    drive |= {"stops": self.stops.get(name, 0), **self.drive_changes.get(name, {})}
                newest = [*self._made.items()][-KEPT:]
                told |= self.changes
                told["alarms"] = [*map(as_answer, told["alarms"])]
                self._made = dict([*newest, (number, told)])
            told = self._made[number]
            if after in self._made and after != number:
                told = {"n": number, "since": after, **changes(self._made[after], told)}
            return json.dumps(told).encode()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 128


def _handler(gateway: FakeGateway) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True

        def setup(self) -> None:
            super().setup()
            gateway._sockets.add(self.connection)

        def finish(self) -> None:
            gateway._sockets.discard(self.connection)
            with contextlib.suppress(OSError):
                super().finish()

        def handle(self) -> None:
            with contextlib.suppress(OSError):
                super().handle()

        def log_message(self, format: str, *args: object) -> None:
            pass

        def answer(
            self,
            status: int,
            body: bytes,
            kind: str = "application/json",
            held: threading.Event | None = None,
            **headers: str,
        ) -> None:
            self.send_response(status)
            for name, value in {**HEADERS, "Content-Type": kind, **headers}.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if held is not None:
                held.wait()
            self.wfile.write(body)

        def tell(self, value: object, status: int = 200, held: threading.Event | None = None) -> None:
            self.answer(status, json.dumps(value).encode(), held=held)

        def do_GET(self) -> None:
            url = urlsplit(self.path)
            asked = parse_qs(url.query)
            if url.path == "/" or url.path.startswith("/page/"):
                self.file(url.path)
            elif url.path == "/api/frame":
                self.frame(int(asked["after"][0]))
            elif url.path.startswith("/api/drive/"):
                self.tell(drive(unquote(url.path[len("/api/drive/") :]), gateway))
            elif url.path.startswith("/api/parameters/"):
                left = gateway.parameters if "read" in asked or len(gateway.parameters) < 3 else []
                self.tell((left.pop(0) if len(left) > 1 else left[0]) if left else {"state": "none"})
            elif url.path in ANSWERS:
                ANSWERS[url.path](self, gateway, asked)
            else:
                self.tell({"error": "There is no such address."}, 404)

        def file(self, path: str) -> None:
            name = "index.html" if path == "/" else path.removeprefix("/page/")
            if file := FILES.get(name):
                self.answer(200, file.body, file.media_type, **{"Cache-Control": "max-age=3600"})
            else:
                self.tell({"error": f"There is no file {name}."}, 404)

        def frame(self, after: int) -> None:
            end = time.monotonic() + HOLD_S
            while gateway.is_silent or gateway.number() <= after:
                if time.monotonic() > end:
                    return self.answer(304, b"")
                time.sleep(0.01)
            return self.answer(200, gateway.encoded(after))

        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            if self.path == "/api/token":
                right = body["token"] == gateway.token
                self.answer(
                    200 if right else 401,
                    json.dumps({} if right else {"error": "No such token is known."}).encode(),
                    **({"Set-Cookie": "token=1; HttpOnly; SameSite=Strict; Path=/"} if right else {}),
                )
                return
            if gateway.token and "token=1" not in self.headers.get("Cookie", ""):
                self.tell({"error": "This wants a token."}, 401)
                return
            if "seen" in body:
                gateway.seen.append(body.pop("seen"))
            gateway.posts.append((self.path, body))
            if self.path == "/api/reload":
                self.tell(gateway.reloaded)
            elif self.path == "/api/acknowledge":
                self.tell({"error": "there is no such alarm"}, 404) if gateway.has_no_alarm else self.tell({})
            elif self.path == "/api/fleet/stop":
                self.tell(gateway.fleet_outcomes)
            elif self.path == "/api/stop":
                names = body["drives"] or [
                    d["name"] for line in fake_plant.plant(gateway.renamed)["lines"] for d in line["drives"]
                ]
                told = {n: gateway.outcomes.get(n, {"done": True, "text": "stopped"}) for n in names}
                if gateway.is_held is not None and not gateway.confirms:
                    gateway.is_held.wait()
                self.tell(told, held=gateway.is_held)
            else:
                self.tell(gateway.outcomes.get(body["drive"], {"done": True, "text": "held by the drive"}))

    return Handler


def drive(name: str, gateway: FakeGateway) -> dict[str, Any]:
    counts = [[i, int(900 * math.exp(-((i - 4) ** 2) / 3))] for i in range(16)]
    hour = int((gateway.began - 3600) * 1000)
    return {
        "delays": {"p50": 4.1, "p99": 6.1, "longest": 9.3, "counts": counts},
        "misses": {"no reply": 3, "bad CRC": 1},
        "asked": 5120, "ledger": [{"register": "acceleration_time", "year": 2, "budget": 100, "total": 12}],
        "values": {
            "acceleration_time": [20.0, hour, "ok"],
            "run_hours": [4012, int(time.time() * 1000), "ok"],
            "maximum_frequency": [gateway.maximum_hz, int(time.time() * 1000), "ok"],
        },
    }  # fmt: skip


def plant(handler: Any, gateway: FakeGateway, _: object) -> None:
    history = {"history": gateway.has_history}
    handler.tell(fake_plant.plant(gateway.renamed) | history | gateway.plant_changes)


def lines(handler: Any, gateway: FakeGateway, _: object) -> None:
    start = int(gateway.began // 60 * 60 - 3540) * 1000
    noisy = [
        {
            "time": start + 60000 * m, "asked": 1480,
            "misses": {"no reply": 14 if m > 40 else 0, "bad CRC": m % 7 // 5},
        }
        for m in range(60)
    ]  # fmt: skip
    quiet = [{"time": start + 60000 * m, "asked": 6060, "misses": {}} for m in range(60)]
    told = {}
    for n, line in enumerate(fake_plant.plant(gateway.renamed)["lines"]):
        told[line["name"]] = {
            "minutes": noisy if n == 1 else quiet,
            "drives": {
                d["name"]: {
                    "p50": 3 + i % 4, "p99": 6 + i % 5, "asked": 5120,
                    "missed": 3 * (d["name"] == "labeller"),
                }
                for i, d in enumerate(line["drives"])
            },
        }  # fmt: skip
    handler.tell(told)


def fleet(handler: Any, gateway: FakeGateway, _: object) -> None:
    if not fake_plant.plant(gateway.renamed).get("fleet"):
        handler.tell({"error": "this gateway shows no fleet; add [serve.fleet] to the plant file"}, 404)
        return
    handler.tell(fake_plant.fleet(gateway.began) | gateway.fleet)


def history(handler: Any, gateway: FakeGateway, asked: dict[str, list[str]]) -> None:
    start, end, points = (float(asked[key][0]) for key in ("from", "to", "points"))
    step = max(100.0, (end - start) / points)
    names = " ".join(fake_plant.NAMES).split()
    series = {}
    for label in asked["series"]:
        name, _, register = label.rpartition(".")
        number = names.index(name) if name in names else 0
        times = [start + step * i for i in range(int((end - start) / step))]
        mean: list[float | None] = [
            fake_plant.values(names[number], number, t / 1000)[register] for t in times
        ]
        for i in range(len(mean) // 2, len(mean) // 2 + max(1, len(mean) // 40)):
            if i < len(mean):
                mean[i] = None
        series[label] = {
            "time": times, "mean": mean, "missed": [int(v is None) for v in mean],
            "least": [None if v is None else v - 0.2 for v in mean],
            "most": [None if v is None else v + 0.2 for v in mean],
            **gateway.recorded.get(label, {}),
        }  # fmt: skip
    handler.tell({"step_ms": step, "series": series})


def alarms(handler: Any, gateway: FakeGateway, asked: dict[str, list[str]]) -> None:
    start, end = float(asked["from"][0]), float(asked["to"][0])
    found = fake_plant.alarms(gateway.renamed, gateway.began)
    found = gateway.changes.get("alarms", found)
    told = [a for a in found if a["time"] < end and max(a["time"], a["ended"] or math.inf) > start]
    handler.tell({"alarms": [*map(as_answer, told)], "since": iso_time(gateway.knows_since)})


def as_answer(alarm: dict[str, Any]) -> dict[str, Any]:
    """Return an alarm as the gateway sends it, with times as ISO text."""
    return alarm | {
        key: alarm[key] and iso_time(alarm[key]) for key in ("time", "ended", "acknowledged") if key in alarm
    }


def audit(handler: Any, gateway: FakeGateway, _: object) -> None:
    def entry(age: float, **more: object) -> dict[str, object]:
        at = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(gateway.began - age))
        name = gateway.renamed.get("pump-1", "pump-1")
        return {
            "time": f"{at}.123456789Z", "port": "/dev/ttyUSB0", "drive": name, "model": "innovert-ibd",
            "address": 1, "sent": "01 06 20 01 01 F4 D2 1D", **more,
        }  # fmt: skip

    handler.tell({"more": False, "entries": [
        entry(300, write="frequency_setpoint = 38.0", outcome="confirmed", held=38.0,
              by="anna by page from 10.0.0.14"),
        entry(900, write="stop", outcome="confirmed", by="anna by page from 10.0.0.14"),
        *(entry(7200 + n, drive=("labeller", "mixer-2")[n % 2], write="stop", outcome="unconfirmed",
                why="no reply", by="anna by page from 10.0.0.14") for n in range(84)),
        # More than a day ago, so the page shows its date.
        entry(90000, write="start", outcome="unconfirmed", why="no reply", by="scada by http from 10.0.0.2"),
    ]})  # fmt: skip


def export(handler: Any, _: object, asked: dict[str, list[str]]) -> None:
    handler.answer(200, b"time,drive,register,value\n", "text/csv", **{
        "Content-Disposition": f'attachment; filename="history.{asked["format"][0]}"'})  # fmt: skip


def triggers(handler: Any, gateway: FakeGateway, _: object) -> None:
    handler.tell({"triggers": gateway.triggers})


ANSWERS = {
    "/api/plant": plant, "/api/lines": lines, "/api/history": history, "/api/alarms": alarms,
    "/api/audit": audit, "/api/export": export, "/api/fleet": fleet,
    "/api/triggers": triggers,
}  # fmt: skip
