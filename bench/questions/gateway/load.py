"""How much do many users of `multidrop serve` slow down its polling, and delay a stop of all drives?

A simulated plant has 31 drives with 10 values each at 10 Hz. Measurements of three kinds alternate: a plain
Poller that records, the gateway alone, and the gateway with its users. The users are five viewers, ten more
viewers that do not read, a scraper of metrics, history queries, an MQTT listener and two Modbus masters.

Then all motors are stopped over HTTP many times: without and with the users, and beside hostile clients.
There are three kinds of hostile clients: 300 connections that send 50 requests each and read no answers; such
connections, and 20 new ones each second; 63 Modbus clients that read without pause. Three times are measured
from the request: to the first drive's stop and to the last drive's stop, as the simulator received them, and
to the HTTP answer. `--minutes 60` continues with the users, and prints a row per minute.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import re
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from free_ports import free_ports
from gateway_users import GatewayUsers, Place, gateway_users, place_of, serve_tables
from simulated_pumps import POLLED, SimulatedPumps, simulated_pumps, write_plant

from bench.players.hostile_clients import KINDS
from bench.support import tables
from bench.support.programs import module
from multidrop import Plant, Poller
from multidrop.recording import SegmentWriter

LINES = (8, 8, 8, 7)  # drives on each line, at 115200 bit/s: 78 % utilisation by `multidrop plan`
LOOK_S = 0.05  # interval between readings of counters
SETTLE_S = 3.0  # after a start: time to learn response delays and to connect the users
RUN_S = 1.0  # time for which motors run before a stop
STOPS_IN_A_ROW = 3
TICK_S = 1 / os.sysconf("SC_CLK_TCK")
PATIENCE_S = 60.0
AHEAD = ("chrt", "--rr", "10")
BROKER_CONF = "listener {} 127.0.0.1\nallow_anonymous true\n"


class Counts(NamedTuple):
    """Counters since the start of polling, and the time in s at which they were read."""

    at: float
    exchanges: float
    samples: float
    misses: Mapping[str, float]  # number of missing values, by reason


class Used(NamedTuple):
    """The CPU times of a process and of its children in s, and its resident memory in MB."""

    own: float
    children: float
    resident: float


# ---- processes ----


def used(pid: int) -> Used:
    own, ended = _cpu(pid)
    living = 0.0
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            with suppress(OSError, ValueError):
                living += sum(_cpu(int(child)))
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return Used(own, ended + living, int(found[1]) / 1000)


def _cpu(pid: int) -> tuple[float, float]:
    """Return the CPU time of a process in s, and that of its ended children."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    own, children = (int(fields[at]) + int(fields[at + 1]) for at in (11, 13))
    return own * TICK_S, children * TICK_S


class Polling:
    """A process that polls the plant, and its counters."""

    pid: int

    def counts(self) -> Counts:
        raise NotImplementedError


class PlainPoll(Polling):
    """A process with a Poller that only records."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process, self.pid = process, process.pid

    def counts(self) -> Counts:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(file=self._process.stdin, flush=True)
        return Counts(time.monotonic(), *json.loads(self._process.stdout.readline()))


class Gateway(Polling):
    """The process of `multidrop serve`."""

    def __init__(self, pid: int, place: Place) -> None:
        self.pid, self.place = pid, place

    def ask(self, method: str, path: str, body: str | None = None) -> str:
        connection = http.client.HTTPConnection("127.0.0.1", self.place.http, timeout=PATIENCE_S)
        with closing(connection):
            connection.connect()
            connection.request(method, path, body, {"content-type": "application/json"})
            response = connection.getresponse()
            said = response.read().decode()
        if response.status != 200:
            raise RuntimeError(f"{method} {path}: {response.status} {said[:300]}")
        return said

    def counts(self) -> Counts:
        """Wait until the gateway's counters change, which is once a second; return them."""
        before, now = self._counts(), self._counts()
        while now.exchanges == before.exchanges:
            time.sleep(LOOK_S)
            now = self._counts()
        return now

    def _counts(self) -> Counts:
        text = self.ask("GET", "/metrics")

        def total(name: str) -> float:
            return sum(map(float, re.findall(rf"^{name}_total{{.*}} (\S+)$", text, re.M)))

        misses: dict[str, float] = {}
        for reason, number in re.findall(r'^multidrop_misses_total{.*reason="(.*)"} (\S+)$', text, re.M):
            misses[reason] = misses.get(reason, 0.0) + float(number)
        at = time.monotonic()
        return Counts(at, total("multidrop_line_exchanges"), total("multidrop_line_samples"), misses)


def poll(plant: Path, folder: Path) -> None:
    """Poll and record; print the counters after each line of standard input, until standard input ends."""
    with Poller(Plant.load(plant)) as poller, SegmentWriter(folder / "rows.arrows", {}, every=600) as writer:
        poller.on_batch(writer.write)
        for _ in sys.stdin:
            lines = poller.statistics().values()
            misses = sum((line.misses for line in lines), Counter[str]())
            exchanges, samples = (sum(getattr(one, of) for one in lines) for of in ("exchanges", "samples"))
            print(json.dumps([exchanges, samples, misses]), flush=True)


@contextmanager
def plain_poll(plant: Path, before: Sequence[str]) -> Iterator[PlainPoll]:
    with TemporaryDirectory(dir=plant.parent) as folder:
        words = [*before, *module("bench.questions.gateway.load", "--poll", plant, folder)]
        pipe = subprocess.PIPE
        with subprocess.Popen(words, text=True, stdin=pipe, stdout=pipe) as process:
            yield PlainPoll(process)


@contextmanager
def serving(plant: Path, place: Place, before: Sequence[str]) -> Iterator[Gateway]:
    words = [*before, sys.executable, "-m", "multidrop", "serve", str(plant)]
    with (plant.parent / "serve.log").open("a") as log:
        process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=log, text=True)
        with process:
            try:
                assert process.stdout is not None
                if not process.stdout.readline().startswith("ready"):
                    raise RuntimeError((plant.parent / "serve.log").read_text())
                yield Gateway(process.pid, place)
            finally:
                process.terminate()


@contextmanager
def hostile_clients(kind: str, place: Place) -> Iterator[None]:
    port = place.modbus if "Modbus" in kind else place.http
    words = module("bench.players.hostile_clients", kind, port)
    with subprocess.Popen(words, stdin=subprocess.PIPE):  # the block's end closes standard input
        time.sleep(SETTLE_S)
        yield


@contextmanager
def broker(folder: Path, port: int) -> Iterator[None]:
    path = folder / "mosquitto.conf"
    path.write_text(BROKER_CONF.format(port))
    quiet = subprocess.DEVNULL
    with subprocess.Popen(["mosquitto", "-c", str(path)], stdout=quiet, stderr=quiet) as process:
        try:
            yield
        finally:
            process.terminate()


# ---- measurements ----

HEAD = (
    *("slice", "exchanges/s", "values/s", "missed", "CPU %", "children %", "MB begin", "middle", "end"),
    "simulator late, ms",
)


class Hall:
    """The plant, its simulator and its MQTT broker, with methods that measure."""

    def __init__(self, pumps: SimulatedPumps, plant: Path, place: Place, before: Sequence[str]) -> None:
        self.pumps, self.plant, self.place, self.before = pumps, plant, place, before
        self.failures: Counter[str] = Counter()
        self.missed: Counter[str] = Counter()  # number of missing values, by kind of measurement and reason
        self.counts: dict[str, float] = {}
        self.loaded_s = 0.0

    @contextmanager
    def users(self) -> Iterator[GatewayUsers]:
        begun = time.monotonic()
        with gateway_users(self.place) as users:
            time.sleep(SETTLE_S)
            yield users
            counts, failures = users.counts()
        self.loaded_s += time.monotonic() - begun
        self.failures.update(failures)
        for what, number in counts.items():
            before = self.counts.get(what, 0.0)
            self.counts[what] = max(before, number) if "longest" in what else before + number

    def slice(self, name: str, polling: Polling, seconds: float) -> tuple[object, ...]:
        """Measure for `seconds`; return a row. If the host suspends the simulator, values are missed."""
        self.pumps.late_s()
        counts = polling.counts()
        begun, before = time.monotonic(), used(polling.pid)
        time.sleep(seconds / 2)
        middle = used(polling.pid).resident
        time.sleep(max(0.0, begun + seconds - time.monotonic()))
        after, took = used(polling.pid), time.monotonic() - begun
        now = polling.counts()
        counted = now.at - counts.at
        for why, number in (Counter(now.misses) - Counter(counts.misses)).items():
            self.missed[f"{name}: {why}"] += round(number)
        return (
            name,
            f"{(now.exchanges - counts.exchanges) / counted:.1f}",
            f"{(now.samples - counts.samples) / counted:.0f}",
            f"{sum(now.misses.values()) - sum(counts.misses.values()):.0f}",
            f"{(after.own - before.own) / took * 100:.1f}",
            f"{(after.children - before.children) / took * 100:.1f}",
            *(f"{mb:.1f}" for mb in (before.resident, middle, after.resident)),
            f"{self.pumps.late_s() * 1e3:.0f}",
        )

    def slices(self, number: int, seconds: float) -> Iterator[tuple[object, ...]]:
        for _ in range(number):
            with plain_poll(self.plant, self.before) as polling:
                time.sleep(SETTLE_S)
                yield self.slice("poll", polling, seconds)
            with serving(self.plant, self.place, self.before) as gateway:
                time.sleep(SETTLE_S)
                yield self.slice("serve", gateway, seconds)
                with self.users():
                    yield self.slice("serve, users", gateway, seconds)

    def stops(self, rounds: int) -> Iterator[tuple[object, ...]]:
        """Stop all drives while the gateway has no users, while it has users, and under hostile clients.

        Rounds without and with users alternate. Yields a row for each kind of round.
        """
        found: dict[str, list[tuple[float, float, float]]] = {"alone": [], "users": []}
        with serving(self.plant, self.place, self.before) as gateway:
            time.sleep(SETTLE_S)
            while len(found["users"]) < rounds:
                found["alone"] += [self.stop(gateway) for _ in range(STOPS_IN_A_ROW)]
                with self.users():
                    found["users"] += [self.stop(gateway) for _ in range(STOPS_IN_A_ROW)]
            for kind in KINDS:
                with hostile_clients(kind, self.place):
                    found[kind] = [self.stop(gateway) for _ in range(rounds)]
        for at, what in enumerate(("first stop on the wire", "last stop on the wire", "answer")):
            for name, stops in found.items():
                times = sorted(one[at] * 1e3 for one in stops)
                yield (what, name, len(times), *(f"{ms:.0f}" for ms in _spread(times)))

    def stop(self, gateway: Gateway) -> tuple[float, float, float]:
        """Stop all motors; return the times in s to the first stop, to the last one, and to the answer."""
        self.pumps.run()
        time.sleep(RUN_S)
        begun = time.monotonic()
        told = json.loads(gateway.ask("POST", "/api/stop", "{}"))
        answered = time.monotonic()
        self.failures.update(f"stop: {one['text']}" for one in told.values() if not one["done"])
        stops = self.pumps.stops()
        self.failures.update(f"it turns after a stop: {name}" for name, (_, turns) in stops.items() if turns)
        self.failures.update(f"it was sent no stop: {name}" for name, (at, _) in stops.items() if at is None)
        times = [at for at, _ in stops.values() if at is not None] or [answered]
        return min(times) - begun, max(times) - begun, answered - begun

    def minutes(self, number: int, seconds: float) -> Iterator[tuple[object, ...]]:
        """Yield a row per minute: poll without users, then with users for `number` minutes, then without."""
        with plain_poll(self.plant, self.before) as polling:
            time.sleep(SETTLE_S)
            yield self.slice("poll", polling, seconds)
        with serving(self.plant, self.place, self.before) as gateway, self.users():
            for minute in range(number):
                yield self.slice(f"minute {minute + 1}", gateway, 60.0)
        with plain_poll(self.plant, self.before) as polling:
            time.sleep(SETTLE_S)
            yield self.slice("poll", polling, seconds)


def _spread(times: Sequence[float]) -> tuple[float, float, float]:
    return times[0], statistics.median(times), times[-1]


@contextmanager
def hall(rotate: str, before: Sequence[str]) -> Iterator[Hall]:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="multidrop-load-")))
        place = place_of(sum(LINES), *free_ports(3))
        plant = write_plant(folder, LINES, serve_tables(place, rotate))
        stack.enter_context(broker(folder, place.broker))
        yield Hall(stack.enter_context(simulated_pumps(plant, *before)), plant, place, before)


def show_as_they_come(head: Sequence[str], rows: Iterator[tuple[object, ...]]) -> list[tuple[object, ...]]:
    """Print each row on stderr as soon as it is measured; return all rows."""
    found = []
    for row in rows:
        print(*row, f"load {os.getloadavg()[0]:.1f}", sep="  ", file=sys.stderr, flush=True)
        found.append((*row, f"{os.getloadavg()[0]:.1f}"))
    return found


def medians(rows: Sequence[tuple[object, ...]]) -> Iterator[tuple[object, ...]]:
    """Yield a row with the medians for each kind of measurement."""
    for kind in dict.fromkeys(row[0] for row in rows):
        columns = zip(*(map(float, map(str, row[1:])) for row in rows if row[0] == kind), strict=True)
        yield (f"{kind}, median", *(f"{statistics.median(column):.1f}" for column in columns))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="of a slice")
    parser.add_argument("--slices", type=int, default=5, help="of each kind")
    parser.add_argument("--stops", type=int, default=15, help="stops of all drives, of each kind")
    parser.add_argument("--minutes", type=int, default=0, help="only this, with the users")
    parser.add_argument("--rotate", help="of the history: 1 min, or 10 with --minutes")
    parser.add_argument("--ahead", action="store_true", help="run simulator and polling with SCHED_RR")
    parser.add_argument("--poll", nargs=2, type=Path, metavar=("PLANT", "FOLDER"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.poll:
        poll(*arguments.poll)
        return
    run(arguments)


def run(arguments: argparse.Namespace) -> None:
    tables.heading(f"{sum(LINES)} drives x {len(POLLED)} values x 10 Hz on {len(LINES)} lines at 115200.")
    before = AHEAD if arguments.ahead else ()
    rotate = arguments.rotate or ("10 min" if arguments.minutes else "1 min")
    with hall(rotate, before) as here:
        head = (*HEAD, "load")
        if arguments.minutes:
            rows = show_as_they_come(head, here.minutes(arguments.minutes, arguments.seconds))
            tables.show(head, rows)
        else:
            rows = show_as_they_come(head, here.slices(arguments.slices, arguments.seconds))
            tables.show(head, [*rows, *medians(rows)])
            print("\nall drives stopped over HTTP; ms\n")
            stops = here.stops(arguments.stops) if arguments.stops else iter(())
            tables.show(("until", "beside", "stops", "least", "median", "longest"), [*stops])
        print("\nmissed values")
        for what, missed in sorted(here.missed.items()) or [("none", 0)]:
            print(f"  {what}: {missed}")
        print(f"\nthe users, in {here.loaded_s:.0f} s")
        for what, number in sorted(here.counts.items()):
            print(f"  {what}: {number:.3f}" if " s" in what else f"  {what}: {number:.0f}")
        for failure, number in sorted(here.failures.items()) or [("nothing went wrong", 0)]:
            print(f"  {failure}" + (f": {number}" if number else ""))


if __name__ == "__main__":
    main()
