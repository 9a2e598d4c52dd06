"""The supervisor of a gateway's permanent tasks and threads: if one ends, /health fails."""

from __future__ import annotations

import ast
import asyncio
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from brokers import end_paho_soon
from gateways import Served, running, served, simulated_plant
from lines import PATIENCE, until
from peers import require_module
from tables import usually

import multidrop.gateway
from multidrop import Plant, Poller
from multidrop.gateway import historian
from multidrop.gateway.forward.forwarder import RowForwarder
from multidrop.gateway.gateway import Gateway
from multidrop.gateway.live.alarms import FAULT, Alarm
from multidrop.gateway.notifications import Sender
from multidrop.gateway.settings import ServeSettings
from multidrop.supervisor import Hung, Supervisor, in_time, supervisor

STARTERS = {
    *("Thread", "ThreadPoolExecutor", "TaskGroup", "Timer"),
    *("create_task", "ensure_future", "to_thread", "run_in_executor"),
}
PARTS = """
[serve.may]
stop = "anyone"
[serve.history]
[serve.modbus]
listen = "127.0.0.1:0"
[serve.mqtt]
broker = "mqtt://127.0.0.1:9"
[serve.fleet]
nats = ["nats://127.0.0.1:9"]
"""
TASKS = {"web", "polling", "statistics", "identities", "alarms", "fleet", "history", "modbus", "mqtt"}
ALARM = Alarm(1_000, "pump-1", "overcurrent", None, FAULT)
THREADS = {"multidrop poller", "multidrop history", "paho-mqtt-client"}


def test_gateway_modules_start_tasks_and_threads_only_through_the_supervisor() -> None:
    root = Path(multidrop.gateway.__file__).parent
    found = set()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in STARTERS:
                found.add(path.relative_to(root).as_posix())
    # This module starts a task in an overridden method of asyncua, which cancels the task itself.
    assert found == {"opcua/server.py"}


@pytest.fixture
def gateway(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    require_module("nats")
    monkeypatch.setattr(historian, "LOOK_S", 0.02)
    with pytest.MonkeyPatch.context() as paho, served(tmp_path, PARTS) as gateway:
        end_paho_soon(paho)
        gateway.await_state("pump-1", "stands")
        until(lambda: gateway.get("/health").json["newest_row"])
        yield gateway


def in_loop(loop: asyncio.AbstractEventLoop, work: Callable[[Supervisor], Any]) -> Any:
    """Call a function in a gateway's event loop with the gateway's supervisor, and return the result."""
    ends: list[Any] = []
    loop.call_soon_threadsafe(lambda: ends.append(work(supervisor())))
    until(lambda: ends)
    return ends[0]


def dead(gateway: Served) -> Any:
    """Return the entry `dead` of /health, which must be empty unless the status is "failed"."""
    answer = gateway.get("/health")
    assert (answer.status == 503) == (answer.json["status"] == "failed") == bool(answer.json["dead"])
    return answer.json["dead"]


@pytest.mark.long
def test_a_gateway_has_exactly_the_expected_tasks_and_threads(gateway: Served) -> None:
    assert in_loop(gateway.loop, lambda found: set(found.kept)) == TASKS
    assert gateway.get("/health").json["dead"] == {}
    names = {thread.name for thread in threading.enumerate() if "multidrop" in thread.name}
    there = {known for known in THREADS for name in names if name.startswith(known)}
    assert there == THREADS


@pytest.mark.parametrize("name", usually("polling", *sorted(TASKS - {"web", "polling"})))
def test_stops_are_sent_after_a_gateway_task_was_cancelled(
    gateway: Served, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert dead(gateway) == {}
    in_loop(gateway.loop, lambda found: found.kept[name].cancel())
    until(lambda: dead(gateway) == {name: "it was cancelled"})
    assert f"{name} has ended and is not restarted: it was cancelled" in caplog.text
    assert all(one["done"] for one in gateway.post("/api/stop").json.values())


def test_stops_are_sent_after_polling_has_failed(gateway: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise ZeroDivisionError("a bug in a user's class")

    monkeypatch.setattr(gateway.gateway.poller, "take", fail)
    until(lambda: dead(gateway) == {"polling": "ZeroDivisionError: a bug in a user's class"})
    assert all(one["done"] for one in gateway.post("/api/stop").json.values())
    monkeypatch.undo()  # ends the poller's failure
    until(lambda: dead(gateway) == {})


@pytest.mark.long
def test_health_reports_the_lines_that_cannot_be_polled(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures = {"hall": "ZeroDivisionError: a bug in a user's class"}
    monkeypatch.setattr(Poller, "line_failures", property(lambda poller: failures), raising=False)
    found = gateway.get("/health").json
    assert (found["status"], found["lines"]) == ("degraded", {"hall": f"polling fails: {failures['hall']}"})
    until(lambda: f"line hall: polling fails: {failures['hall']}" in gateway.frame()["troubles"])


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_health_fails_if_the_history_thread_ends(gateway: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    part: Any = gateway.gateway.feeds["history"]

    def leave() -> None:
        raise SystemExit

    monkeypatch.setattr(part._writer, "_write_waiting", leave)
    until(lambda: dead(gateway) == {"history": "RuntimeError: the thread that writes the history has ended"})
    assert gateway.get("/health").json["parts"]["history"] == dead(gateway)["history"]
    monkeypatch.undo()
    part._writer._segments.close()
    part._writer._compactor.end()


@pytest.mark.long
def test_health_fails_if_the_thread_of_the_broker_connection_ends(gateway: Served) -> None:
    part: Any = gateway.gateway.feeds["mqtt"]
    part._brokers[0]._client.disconnect()  # unexpected, because the gateway did not request it
    until(lambda: dead(gateway) == {"mqtt": "RuntimeError: the thread of the broker's connection has ended"})


@pytest.mark.long
def test_health_fails_if_a_watched_thread_ends(gateway: Served) -> None:
    over = threading.Event()
    in_loop(gateway.loop, lambda found: found.watch("log", lambda: not over.is_set()))
    assert dead(gateway) == {}
    over.set()
    until(lambda: dead(gateway) == {"log": "its thread has ended"})


def test_the_gateway_ends_if_its_web_server_ends(tmp_path: Path) -> None:
    with simulated_plant(tmp_path, "") as path:
        gateway = Gateway(Plant.load(path), ServeSettings(port=0))
        ended = pytest.raises(RuntimeError, match="the web server has ended: it was cancelled")
        with ended, running(gateway) as loop:
            in_loop(loop, lambda found: found.kept["web"].cancel())
            until(lambda: gateway.listener.fileno() < 0)


# ---- a gateway with all parts: no task and no thread is missing in these lists ----

ALL_PARTS = f"""
[[line.drive.channel]]
name = "starts"
value = "count(output_frequency > 1)"
{PARTS}
[serve.opcua]
listen = "127.0.0.1:0"
[serve.notify]
[serve.upload]
url = "http://127.0.0.1:9/rows"
[serve.influx]
url = "http://127.0.0.1:9/write?db=plant"
[serve.postgres]
database = "host=127.0.0.1 port=9 connect_timeout=1"
[serve.tool]
pty = {{ hall = "tool" }}
[serve.trigger]
conditions = {{ trip = "fault" }}
"""
ALL_TASKS = {*TASKS, "opcua", "notify", "upload", "influx", "postgres", "tool", "trigger"}
OTHER_TASKS = {"end", "fleet: ServerPath.keep", "fleet: FleetWatch.run", "main of the test"}
# Threads that end when an exception occurs, and threads that continue.
ENDING = {"alarms", "target", "upload rows", "influx rows", "postgres rows", "opcua server"}
CONTINUING = {"history", "spool", "totals"}
# Threads of libraries and of the poller, which tests/polling/test_failures.py tests.
OTHER_THREADS = {"paho-mqtt-client", "multidrop poller", "multidrop-sim", "gateway under test"}
# not always there: started when something is logged or a host name is looked up
POSSIBLE_THREADS = {"multidrop log", "asyncio"}


def names_of_threads(before: set[threading.Thread]) -> set[str]:
    """Return the names of the threads that were started since `before`, without numbers and addresses."""
    names = {
        re.sub(r"(_\d+| http://.*|-multidrop/.*)$", "", one.name) for one in {*threading.enumerate()} - before
    }
    return names - POSSIBLE_THREADS


def names_of_tasks(loop: asyncio.AbstractEventLoop) -> set[str]:
    """Return the names of a loop's tasks, or of their functions if they have no name."""
    tasks = asyncio.all_tasks(loop)
    return {
        re.sub(r"^Task-\d+$", getattr(task.get_coro(), "__qualname__", ""), task.get_name()) for task in tasks
    }


@pytest.mark.slow
def test_health_reports_each_gateway_thread_or_task_that_ends(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for library in ("paho.mqtt.client", "nats", "asyncua", "psycopg", "pyarrow"):
        require_module(library)
    (tmp_path / "targets").write_text("http://127.0.0.1:9/hook\n")
    for sender_type in (RowForwarder, Sender):
        monkeypatch.setattr(sender_type, "most_pause_s", 0.1)

    def fail(*details: object) -> None:
        raise ZeroDivisionError("a bug")

    before = {*threading.enumerate()}
    with served(tmp_path, ALL_PARTS) as gateway, pytest.MonkeyPatch.context() as broken:
        parts: Any = gateway.gateway.feeds
        until(lambda: parts["opcua"].is_ready)
        listed = {f"multidrop {name}" for name in (*ENDING, *CONTINUING)} | OTHER_THREADS
        until(lambda: names_of_threads(before) == listed)
        assert in_loop(gateway.loop, lambda found: set(found.kept)) == ALL_TASKS
        until(lambda: names_of_tasks(gateway.loop) == ALL_TASKS | OTHER_TASKS)

        totals: Any = gateway.gateway.poller._added._totals  # type: ignore[union-attr]
        with pytest.MonkeyPatch.context() as briefly:
            briefly.setattr(parts["history"]._writer, "_write_waiting", fail)
            briefly.setattr(parts["influx"]._spool, "_write_due_rows", fail)
            parts["influx"]._spool.sync(0.01)
            totals.write({"what JSON does not have": totals})
            sentences = ("the history's thread continues", "writing the spool", "totals are not kept")
            until(lambda: all(sentence in caplog.text for sentence in sentences))
        totals.write({"kept": 1})
        until(lambda: "kept" in totals.read())
        assert parts["influx"]._spool.sync(PATIENCE)
        assert dead(gateway) == {}

        alarms, sender = gateway.gateway.alarm_file, parts["notify"]._senders[0]
        forwarders = {name: parts[name]._forwarder for name in ("upload", "influx", "postgres")}
        broken.setattr(alarms, "_write", fail)
        for one in (sender, *forwarders.values()):
            broken.setattr(one, "step", fail)
        broken.setattr(parts["opcua"]._opened[2], "write", fail)
        for note in (alarms.note, sender.put):  # type: ignore[union-attr]
            note(ALARM)
        killed = {"alarms", "notify", "opcua", *forwarders}
        until(lambda: dead(gateway) == dict.fromkeys(killed, "ZeroDivisionError: a bug"))
        for name in killed:
            assert f"{name} has ended and is not restarted: ZeroDivisionError: a bug" in caplog.text
        newest = gateway.get("/health").json["newest_row"]
        until(lambda: gateway.get("/health").json["newest_row"] > newest)

        others = ALL_TASKS - killed - {"web"}
        in_loop(gateway.loop, lambda found: [found.kept[name].cancel() for name in others])
        until(lambda: dead(gateway).keys() == ALL_TASKS - {"web"})
        assert all(one["done"] for one in gateway.post("/api/stop").json.values())


async def test_a_task_released_by_the_supervisor_is_not_reported_as_dead() -> None:
    supervisor().keep("released", asyncio.sleep(60))
    supervisor().keep("let go of", asyncio.sleep(0))
    await supervisor().release("released", "never there")
    task = supervisor().let_go("let go of")
    assert task is not None
    await task
    assert supervisor().dead == {}


@pytest.mark.parametrize("failure", [None, OSError("the disk is broken")])
def test_only_failed_work_is_logged_after_the_end_of_the_gateway(
    failure: Exception | None, caplog: pytest.LogCaptureFixture
) -> None:
    """The log has no handler then. Python would write to stderr, and wait for a reader that has halted."""
    go_on = threading.Event()

    def work() -> None:
        go_on.wait(PATIENCE)
        if failure is not None:
            raise failure

    async def begin() -> None:
        supervisor().thread("late work", PATIENCE, work)

    asyncio.run(begin())
    [thread] = [one for one in threading.enumerate() if one.name == "multidrop late work"]
    go_on.set()
    thread.join(PATIENCE)
    logged = ["late work failed after the end of the gateway: the disk is broken"]
    assert caplog.messages == (logged if failure else [])


async def test_a_dead_task_is_no_longer_reported_after_a_new_start() -> None:
    await asyncio.wait([supervisor().keep("part", asyncio.sleep(0))])
    await asyncio.sleep(0)
    assert supervisor().dead == {"part": "it returned"}
    supervisor().keep("part", asyncio.sleep(60))
    assert supervisor().dead == {}
    await supervisor().release("part")


@pytest.mark.parametrize("failure", [ValueError("no"), SystemExit("no"), StopIteration("no")])
async def test_a_failure_of_a_supervised_function_is_raised_in_its_caller(failure: BaseException) -> None:
    def work() -> None:
        raise failure

    with pytest.raises(ValueError if isinstance(failure, ValueError) else RuntimeError, match="no"):
        await supervisor().within("work", 60, work)


async def test_hanging_work_is_reported_until_later_work_succeeds() -> None:
    go_on = threading.Event()
    threads = supervisor()
    with pytest.raises(Hung, match=r"history: not done within 0.01 s; does the disk answer\?"):
        await threads.within("history", 0.01, go_on.wait)
    assert await threads.within("other", 60, lambda: 3) == 3
    assert list(threads.hung) == ["history"]
    with pytest.raises(Hung, match="history: 1 earlier tasks of this name are not done"):
        await threads.within("history", 0.01, go_on.wait, most=1)
    assert threads.under_way == ["history"]
    assert await threads.within("history", 60, lambda: 4) == 4  # as if the disk answered again
    assert threads.hung == {}
    go_on.set()
    while threads.under_way:
        await asyncio.sleep(0)


async def test_the_supervisor_raises_an_error_if_no_thread_can_start(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", fail)
    with pytest.raises(RuntimeError, match="can't start new thread"):
        await supervisor().within("work", 60, lambda: 3)
    assert supervisor().under_way == []


def test_supervised_work_raises_hung_only_after_its_time_limit() -> None:
    go_on = threading.Event()

    def fail() -> None:
        raise TimeoutError("its own")

    assert in_time("sum", 60, lambda: 3) == 3
    with pytest.raises(TimeoutError, match="its own"):
        in_time("sum", 60, fail)
    with pytest.raises(Hung, match=r"sum: not done within 0.01 s"):
        in_time("sum", 0.01, go_on.wait)
    go_on.set()
