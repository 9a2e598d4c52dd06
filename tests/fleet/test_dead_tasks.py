"""If a task or thread that a fleet's gateway needs has ended, this is logged and the gateway shuts down."""

from __future__ import annotations

import ast
import asyncio
import json
import threading
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fleets import LINE, desks
from lines import until
from nats_clusters import Cluster
from peers import require_module
from spooled import numbered
from toy import Toy

import multidrop.fleet
from multidrop import Poller, PollingFailed
from multidrop.cli.fleet.views import count_sentence, failing_lines
from multidrop.control import CommandOutcome
from multidrop.core import Mastership
from multidrop.fleet import gateway as fleet_gateway
from multidrop.fleet import metrics
from multidrop.fleet.commands.desk import CommandSubjects
from multidrop.fleet.commands.fleet_commands import FleetCommands
from multidrop.fleet.commands.log import CommandLog
from multidrop.fleet.gateway import CommandedLines, FleetGateway, FleetLines
from multidrop.fleet.samples import hub, samples_stream
from multidrop.fleet.samples.samples_stream import Forwarder
from multidrop.fleet.servers import names
from multidrop.samples import spool as spool_module
from multidrop.samples.message import PolledUnits
from multidrop.samples.spool import Spool
from multidrop.sim import Simulator, Wire, simulated
from multidrop.supervisor import Ended, end_tasks, supervisor

STARTERS = {
    *("Thread", "ThreadPoolExecutor", "TaskGroup", "Timer"),
    *("create_task", "ensure_future", "to_thread", "run_in_executor"),
}
WAITED_FOR = {  # modules that start tasks or threads, and wait for them
    *("connections", "fleet_commands", "followed", "gateway", "hub", "leaders"),
    *("line_keeper", "member", "observer", "page_part", "samples_stream", "shares"),
    "spool",  # this module's thread is checked by the gateway
}
MEMBER = (
    *(f"path {at}" for at in (1, 2, 3)),
    *(f"lease {at}" for at in (1, 2, 3)),
    *(f"records {at}" for at in range(1, 1 + len(names.BUCKETS))),
    *("guard", "leaders", "weak session", "releases", "steps", "lines"),
)
TRIED = ("forwarder", "member", "gw-1: lease 1", "gw-1: lines")  # tasks killed in a short test run
# tasks killed in a long test run
TASKS = ("forwarder", "samples path", "member", "look", *(f"gw-1: {name}" for name in MEMBER))
THREADS = ("multidrop spool", "multidrop poller", "multidrop batches")


class Ill(Exception):
    """An unexpected exception in the tested code."""


async def fail(*details: object) -> None:
    raise Ill("a mistake")


def test_only_listed_modules_of_the_fleet_start_tasks_or_threads() -> None:
    found = set()
    for path in Path(multidrop.fleet.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in STARTERS:
                found.add(path.stem)
    assert found <= WAITED_FOR


@pytest.fixture
def gateway(
    fleet: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[Callable[[FleetGateway], Awaitable[object]]], None]]:
    """Return a function that runs a gateway on real servers, and calls its argument with it when ready."""

    def run(act: Callable[[FleetGateway], Awaitable[object]]) -> None:
        async def main() -> None:
            made = FleetGateway("gw-1", fleet.urls, tmp_path)
            # the kernel's timer would kill the process of the tests
            monkeypatch.setattr(made.mastership, "extend", lambda until_ns: None)
            ready = asyncio.Event()
            running = asyncio.ensure_future(made.run(ready.set))
            await asyncio.wait([running, asyncio.ensure_future(ready.wait())], return_when="FIRST_COMPLETED")
            while not made.member.lease.session and not running.done():
                await asyncio.sleep(0.01)
            await act(made)
            try:
                await asyncio.wait_for(running, 60)
            finally:
                # the session has ended, so other gateways take over immediately
                assert made.member.lease.session == 0
                assert [one.get_name() for one in asyncio.all_tasks() if one.get_name() in TASKS] == []

        asyncio.run(main())

    return run


@pytest.mark.long
def test_a_gateway_runs_exactly_the_listed_tasks_and_threads(gateway: Any) -> None:
    before = {*threading.enumerate()}

    async def look(made: FleetGateway) -> None:
        assert set(supervisor().kept) == set(TASKS)
        assert supervisor().watched == ["spool"]
        names = {thread.name.rstrip("_0123456789") for thread in {*threading.enumerate()} - before}
        # asyncio and the log start these threads only when needed
        assert names - {"asyncio", "multidrop log"} == set(THREADS)
        made.end()

    gateway(look)


@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=[] if one in TRIED else pytest.mark.slow) for one in TASKS]
)
def test_a_killed_task_ends_the_gateway(gateway: Any, name: str, caplog: pytest.LogCaptureFixture) -> None:
    async def kill(made: FleetGateway) -> None:
        task = supervisor().kept[name]
        while not task.done():  # Python 3.11's wait_for may swallow one cancellation
            task.cancel()
            # a second cancellation during the task's cleanup would interrupt it
            await asyncio.wait([task], timeout=5)

    with pytest.raises(Ended, match=f"{name} has ended: it was cancelled"):
        gateway(kill)
    assert f"{name} has ended and is not restarted: it was cancelled" in caplog.text


def test_exception_of_an_ended_task_is_logged_with_the_cause(
    gateway: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def kill(made: FleetGateway) -> None:
        monkeypatch.setattr(made.member, "step", fail)

    with pytest.raises(Ended, match="gw-1: steps has ended: Ill: a mistake"):
        gateway(kill)
    assert "Traceback" in caplog.text


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_gateway_ends_when_the_spool_thread_ends(gateway: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def leave() -> bool:
        raise SystemExit

    async def kill(made: FleetGateway) -> None:
        monkeypatch.setattr(made.spool, "_write_due_rows", leave)
        made.spool.sync(0.01)

    monkeypatch.setattr(fleet_gateway, "FORWARD_S", 0.0)
    with pytest.raises(Ended, match="spool has ended: its thread has ended"):
        gateway(kill)


def test_the_gateway_shuts_down_if_polling_has_failed(gateway: Any) -> None:
    async def kill(made: FleetGateway) -> None:
        made.lines.poller.failure = PollingFailed("polling has ended on all lines: Ill: of the poller")

    with pytest.raises(Ended, match="polling has ended: polling has ended on all lines: Ill: of the poller"):
        gateway(kill)


def test_gateway_ends_if_it_cannot_subscribe_to_commands(
    gateway: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gateway without the subscription would miss stops."""

    async def kill(made: FleetGateway) -> None:
        monkeypatch.setattr(made.paths[1], "subscribe", fail)
        made.commands._change(made.commands._subscribe("stop.hall", made.commands.desk.do))

    with pytest.raises(Ended, match="commands has ended: Ill: a mistake"):
        gateway(kill)


async def test_a_command_client_reports_the_end_of_its_connection(fleet: Cluster, tmp_path: Path) -> None:
    """A commander is a client for commands. The page replaces one whose connection has ended."""
    async with FleetCommands(fleet.urls, by="page", log=tmp_path / "log.jsonl") as commands:
        commands._keeping[1].cancel()
        with pytest.raises(Ended, match="a connection to the fleet has ended"):
            await asyncio.wait_for(commands.stay(), 60)


async def test_forwarder_retries_after_an_unexpected_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(samples_stream, "AGAIN_S", 0.0)
    spool = Spool(tmp_path / "spool", "gw-1")
    nowhere: Any = None
    forwarder = Forwarder(spool, nowhere)
    asked: list[str | None] = []

    async def ask() -> None:
        asked.append(forwarder.trouble)
        raise Ill("a mistake")

    monkeypatch.setattr(forwarder, "_ask", ask)
    running = asyncio.create_task(forwarder.run())
    while len(asked) < 3:
        await asyncio.sleep(0)
    running.cancel()
    spool.close()
    assert asked[:2] == [None, "Ill: a mistake"]
    assert caplog.text.count("samples are not forwarded: Ill: a mistake") == 1
    assert "Traceback" in caplog.text


def test_a_spool_continues_to_write_after_unexpected_failures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(spool_module, "AGAIN_S", 0.0)
    spool = Spool(tmp_path / "spool", "gw-1")
    left = [OSError("no memory"), Ill("a mistake")]
    write = spool._write_due_rows

    def written() -> bool:
        if left:
            raise left.pop()
        return write()

    monkeypatch.setattr(spool, "_write_due_rows", written)
    spool.append(numbered(0, 5))
    assert spool.sync(60.0)
    until(lambda: not left)
    assert (spool.state().written, spool.state().lost) == (50, 0)
    spool.close()
    assert "no memory" in caplog.text


async def test_the_hub_retries_if_the_compaction_process_cannot_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    require_module("duckdb")
    tried: list[object] = []

    async def fail_to_begin(words: object) -> None:
        tried.append(words)
        raise BlockingIOError("no process is left")

    monkeypatch.setattr(hub, "_compact", fail_to_begin)
    merging = asyncio.create_task(hub.compact_for_ever(tmp_path, every=0.0))
    while len(tried) < 3:
        await asyncio.sleep(0)
    merging.cancel()
    assert "no process is left" in caplog.text


def test_an_error_while_metrics_are_computed_gives_status_500(caplog: pytest.LogCaptureFixture) -> None:
    def families() -> Any:
        raise Ill("a mistake")

    head = b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n"
    assert metrics._answer(head, families).startswith(b"HTTP/1.1 500 Internal Server Error\r\n")
    assert "Ill: a mistake" in caplog.text


def test_stop_with_an_unexpected_error_is_answered_as_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with desks(tmp_path) as desk:
        monkeypatch.setattr(desk.stops._repeated, "begin", lambda *details: asyncio.run(fail()))
        answer = asyncio.run(desk.stop())
    assert (answer.outcome, answer.ok) == (CommandOutcome.UNKNOWN, False)
    assert "it is not known whether the stop was sent" in answer.text


class Taken:
    """A gateway's `FleetLines`, and the description of a simulated line that it can poll."""

    def __init__(self, port: str, folder: Path) -> None:
        self.mastership = Mastership()
        self.lines = FleetLines(self.mastership, folder, PolledUnits())
        self.description = {"line": {"name": LINE, "port": port}}

    def close(self) -> None:
        self.lines.poller.close()
        self.mastership.end()


@pytest.fixture
def taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Taken]:
    from lines import line, polled

    with Simulator([Wire([simulated(Toy(1))])]) as simulator:
        path = simulator.wires[0].path
        described = line(path, polled(Toy(1, name="pump"), [Toy.registers["output_current"]]), name=LINE)
        monkeypatch.setattr(fleet_gateway, "line_of", lambda record, folder: described)
        made = Taken(path, tmp_path)
        yield made
        made.close()


@pytest.mark.parametrize("failure", [Ill("amid it"), MemoryError(), SystemExit("of a user")], ids=repr)
async def test_port_is_closed_again_if_opening_a_line_fails(
    taken: Taken, monkeypatch: pytest.MonkeyPatch, failure: BaseException
) -> None:
    """The line's port must be closed again, because another gateway may soon poll the line."""
    add_line = taken.lines.poller.add_line

    def add(described: Any) -> None:
        add_line(described)
        raise failure

    monkeypatch.setattr(taken.lines.poller, "add_line", add)
    with pytest.raises(RuntimeError if isinstance(failure, SystemExit) else type(failure)):
        await taken.lines.take(LINE, taken.description)
    assert taken.lines.poller.buses == {}


async def test_line_is_not_polled_if_the_gateway_cannot_receive_commands(
    taken: Taken, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = CommandLog(tmp_path / "commands.jsonl")
    held: Any = SimpleNamespace(leave=lambda line: None, shut=lambda line: None)
    subjects = CommandSubjects("gw-1", [], held, log)
    monkeypatch.setattr(subjects, "open", lambda *details: asyncio.run(fail()))
    with pytest.raises(RuntimeError):
        await CommandedLines(taken.lines, subjects).take(LINE, taken.description)
    log.close()
    assert taken.lines.poller.buses == {}


async def test_a_line_can_be_closed_after_polling_has_failed(taken: Taken) -> None:
    await taken.lines.take(LINE, taken.description)
    taken.lines.poller.failure = PollingFailed("polling has ended on all lines: Ill: of the poller")
    await taken.lines.let_go(LINE)
    assert not taken.lines.poller.bus(LINE).is_open
    taken.lines.poller._is_failure_raised = True


@pytest.mark.long
async def test_fleet_status_counts_unpolled_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failures = {"hall": "Ill: of its class"}
    monkeypatch.setattr(Poller, "line_failures", property(lambda poller: failures))
    made = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    state = made.state()
    await made._close()
    state = json.loads(json.dumps(state))
    assert (state["failing"], state["troubles"]) == (["hall"], {"hall": "polling fails: Ill: of its class"})
    fleet = {"gateways": {"gw-1": {"says": state}}, "lines": {}}
    assert failing_lines(fleet) == ["hall"]
    assert count_sentence(fleet) == "0 lines, 0 without a master, 1 on which polling fails"


# ---- tasks that ignore cancellations are still ended in finite time ----


PATIENCE_S = 60.0


async def deaf(times: int) -> str:
    """Ignore this many cancellations, as `asyncio.wait_for` may do if a pong arrives at the same moment."""
    for _ in range(times):
        try:
            await asyncio.sleep(3600)
        except asyncio.CancelledError:
            continue
    await asyncio.sleep(3600)
    return "never"


async def _begun(times: int) -> asyncio.Task[str]:
    task = asyncio.create_task(deaf(times))
    await asyncio.sleep(0)
    return task


@pytest.mark.long
async def test_end_tasks_cancels_a_task_repeatedly_until_it_has_ended() -> None:
    tasks = [await _begun(times) for times in (0, 1, 3)]
    found = await asyncio.wait_for(end_tasks(*tasks), PATIENCE_S)
    assert [type(one) for one in found] == [asyncio.CancelledError] * 3
    assert await end_tasks() == []


async def test_end_tasks_returns_the_error_of_a_task_that_has_ended() -> None:
    async def failing() -> None:
        raise OSError("the disk is full")

    failed = asyncio.create_task(failing())
    await asyncio.wait({failed})
    (found,) = await end_tasks(failed)
    assert str(found) == "the disk is full"


async def test_closing_a_command_client_ends_tasks_that_ignore_one_cancellation(tmp_path: Path) -> None:
    fleet = FleetCommands(["nats://127.0.0.1:1"], by="anna", log=tmp_path / "commands.jsonl")
    fleet._keeping = [await _begun(1)]
    await asyncio.wait_for(fleet.close(), PATIENCE_S)
