"""Exceptions in a poller's threads: a failure affects only its line, and no thread ends silently."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
import serial
from lines import PATIENCE, line, patient, plant, polled, rows_of, until
from tables import usually
from toy import Toy

from multidrop import PollingFailed
from multidrop.core import Port, RowQueue
from multidrop.drive import Drive
from multidrop.poller import Poller
from multidrop.polling import polled_line
from multidrop.polling.batch import Batch, Row
from multidrop.polling.jobs import PortQueue
from multidrop.sim import EncodedDrive, Simulator, Wire, proof, simulated
from multidrop.transport import clock
from multidrop.transport.aside_log import flush_log
from multidrop.transport.network_port import Bridge

FAILED = "not asked: polling failed"
CURRENT = Toy.registers["output_current"]


class Ill(Exception):
    """The exception that tests inject."""


class Two:
    """A poller with the lines "ill" and "well". Each line has one drive, which has the name of its line."""

    def __init__(self, simulator: Simulator, every: float | None) -> None:
        drives = (Toy(1, name="ill"), Toy(1, name="well"))
        self.poller = Poller(
            plant(
                *(
                    line(wire.path, polled(drive, [CURRENT], every), name=drive.name)
                    for wire, drive in zip(simulator.wires, drives, strict=True)
                )
            )
        )

    def until(self, *wanted: tuple[str, str]) -> None:
        """Take new rows until each (drive, status) pair in `wanted` has appeared."""
        rows_of(self.poller)
        missing = set(wanted)

        def is_seen() -> bool:
            missing.difference_update((row.drive, row.status) for row in rows_of(self.poller))
            return not missing

        until(is_seen)

    def fails(self, *details: object) -> None:
        """Raise Ill. Tests put this function in the place of a method."""
        raise Ill("of this line")


@pytest.fixture(params=usually(0.01, None), ids=["at a rate", "as fast as it goes"])
def two(request: pytest.FixtureRequest) -> Iterator[Two]:
    with Simulator([Wire([simulated(Toy(1))]) for _ in range(2)]) as simulator:
        made = Two(simulator, request.param)
        with made.poller:
            yield made


@pytest.fixture(autouse=True)
def _retried_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polled_line, "RETRY_NS", 50_000_000)
    monkeypatch.setattr(polled_line, "STANDBY_NS", 10_000_000)
    monkeypatch.setattr(polled_line, "LONGEST_RETRY_NS", 100_000_000)
    for name in ("LEARN_NS", "RELEARN_NS"):
        monkeypatch.setattr(polled_line, name, 10_000_000)


def of_line(name: str, method: Callable[..., Any], failure: BaseException) -> Callable[..., Any]:
    """Return a version of `method` that raises `failure` for objects of this line."""

    def act(self: Any, *details: Any, **more: Any) -> Any:
        drives = getattr(self, "_present", None) or {job.owner for job in self._schedule.jobs}
        if any(drive.name == name for drive in drives):
            raise type(failure)(*failure.args)  # a new exception, with an empty traceback
        return method(self, *details, **more)

    return act


@pytest.mark.parametrize(
    ("kind", "method"),
    [
        (polled_line.PolledLine, "_observe"),
        (polled_line.PolledLine, "_learn"),
        (PortQueue, "keep_busy"),
        (PortQueue, "conclude"),
    ],
)
@pytest.mark.parametrize("failure", [Ill("of this line"), MemoryError(), SystemExit(1)], ids=repr)
def test_a_failure_on_one_line_does_not_affect_other_lines(
    two: Two,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    kind: type,
    method: str,
    failure: BaseException,
) -> None:
    # short pauses before retries, but long enough for a batch without values in each pause
    for name in ("RETRY_NS", "LONGEST_RETRY_NS"):
        monkeypatch.setattr(polled_line, name, 200_000_000)
    two.until(("ill", "ok"), ("well", "ok"))
    with monkeypatch.context() as broken:
        broken.setattr(kind, method, of_line("ill", getattr(kind, method), failure))
        two.until(("ill", FAILED), ("well", "ok"))
        two.until(("ill", FAILED), ("well", "ok"))
        assert list(two.poller.line_failures) == ["ill"]
        assert two.poller.line_failures["ill"].startswith(type(failure).__name__)
        assert "failing (" in repr(two.poller)
    two.until(("ill", "ok"), ("well", "ok"))
    until(lambda: "line ill: polling failed, and is retried in " in caplog.text)
    assert "Traceback" in caplog.text
    assert "line well" not in caplog.text
    assert two.poller.failure is None


def test_a_recovered_line_is_removed_from_line_failures(two: Two, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as broken:
        broken.setattr(PortQueue, "keep_busy", of_line("ill", PortQueue.keep_busy, Ill()))
        two.until(("ill", FAILED))
    monkeypatch.setattr(polled_line, "SOUND_NS", 0)
    until(lambda: two.poller.line_failures == {})


def test_a_failing_line_is_retried_at_growing_intervals(
    two: Two, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(polled_line, "RETRY_NS", 5_000_000)
    monkeypatch.setattr(PortQueue, "keep_busy", of_line("ill", PortQueue.keep_busy, Ill()))
    until(lambda: caplog.text.count("in 0.1 s") >= 2)
    said = [
        record.getMessage().split(":")[1] for record in caplog.records if record.name == "multidrop.polling"
    ]
    delays = [float(words.split(" in ")[1].removesuffix(" s")) for words in said]
    assert delays[:6] == [0.005, 0.01, 0.02, 0.04, 0.08, 0.1]


def test_a_queued_request_is_sent_after_a_failure_of_the_line(
    two: Two, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If a line fails while it queues requests, the poller does not know how many requests are queued."""
    submit, repeat = Port.submit, Port.repeat
    left = 3

    def fail_behind(act: Callable[..., Any], port: Port, exchanges: Any, *details: Any) -> Any:
        nonlocal left
        done = act(port, exchanges, *details)
        if exchanges and left:
            left -= 1
            raise Ill
        return done

    monkeypatch.setattr(Port, "submit", lambda *details: fail_behind(submit, *details))
    monkeypatch.setattr(Port, "repeat", lambda *details: fail_behind(repeat, *details))
    for name in ("ill", "well"):
        two.poller.set_rate(name, CURRENT, 0.02)
    until(lambda: left == 0)
    two.until(("ill", "ok"), ("well", "ok"))
    assert {row.drive for row in rows_of(two.poller)} <= {"ill", "well"}


def test_a_brief_lack_of_memory_does_not_end_polling(two: Two, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as short:
        left = [MemoryError()] * 3
        awaited = RowQueue.await_calls

        def want(row_queue: RowQueue, seconds: float) -> list[int]:
            if left:
                raise left.pop()
            return awaited(row_queue, seconds)

        short.setattr(RowQueue, "await_calls", want)
        until(lambda: not left)
        two.until(("ill", "ok"), ("well", "ok"))
    assert two.poller.failure is None


def exchanges(two: Two) -> int:
    return two.poller.statistics()["ill"].counters.exchanges


@pytest.fixture
def failed(two: Two, monkeypatch: pytest.MonkeyPatch) -> Two:
    """A poller whose thread has ended with a failure, and that has rows queued."""
    two.until(("ill", "ok"), ("well", "ok"))
    taken = exchanges(two)
    until(lambda: exchanges(two) >= taken + 2)  # leaves rows in the queue
    monkeypatch.setattr(clock, "sleep", lambda seconds: None)
    monkeypatch.setattr(RowQueue, "await_calls", two.fails)
    two.poller._call_thread()
    until(lambda: two.poller.failure and not two.poller._thread.is_alive())
    flush_log(PATIENCE)
    two.poller._is_failure_raised = True  # so that `close` does not raise in the fixture
    return two


def test_every_call_of_a_failed_poller_raises_polling_failed(
    failed: Two, caplog: pytest.LogCaptureFixture
) -> None:
    poller = failed.poller
    assert repr(poller).startswith("<Poller polling has ended on all lines: Ill: of this line;")
    rows: list[Row] = []
    # The exception is raised after all queued rows were taken.
    with pytest.raises(PollingFailed) as raised:
        rows.extend(row for batch in poller.batches() for row in batch)
    assert rows
    assert isinstance(raised.value.__cause__, Ill)
    with pytest.raises(PollingFailed):
        poller.take()
    for act in (partial(poller.adopt, poller.plant), partial(poller.remove_line, "ill")):
        with pytest.raises(PollingFailed):
            act()
    said = [record for record in caplog.get_records("setup") if record.levelno == logging.CRITICAL]
    assert [record.getMessage().splitlines()[0] for record in said] == [str(poller.failure)]
    poller._is_failure_raised = False
    with pytest.raises(PollingFailed, match="Ill: of this line"):
        poller.close()
    poller.close()
    assert not any(bus.is_open for bus in poller.buses.values())


@patient
def test_a_failed_poller_stops_polling_but_sends_commands(failed: Two) -> None:
    before = exchanges(failed)
    bus = failed.poller.bus("ill")
    bus.drives[0].read(CURRENT)
    assert exchanges(failed) - before <= 2  # the read, and an exchange that may have been in flight


def test_a_wait_for_batches_ends_when_polling_fails(two: Two, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = threading.Event()

    def wait() -> None:
        with pytest.raises(PollingFailed):
            for _ in two.poller.batches():
                pass
        ended.set()

    waiting = threading.Thread(target=wait)
    waiting.start()
    monkeypatch.setattr(clock, "sleep", lambda seconds: None)
    monkeypatch.setattr(RowQueue, "await_calls", two.fails)
    until(ended.is_set)
    waiting.join()
    two.poller._is_failure_raised = True


def test_a_failed_reopening_of_a_port_is_logged_and_retried(
    two: Two, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(polled_line, "REOPEN_NS", 10_000_000)
    bus = two.poller.bus("ill")
    regain = type(bus.line).regain
    tried: list[BaseException] = [SystemExit(1), MemoryError()]

    def fail(of_line: Any) -> None:
        if tried:
            raise tried.pop()
        regain(of_line)

    monkeypatch.setattr(type(bus.line), "regain", fail)
    bus.line.drop()
    two.until(("ill", "port lost"))
    two.until(("ill", "ok"), ("well", "ok"))
    assert tried == []
    assert "not opened again\nTraceback" in caplog.text


def test_an_unexpected_exception_from_pyserial_counts_as_a_lost_port(
    two: Two, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(polled_line, "REOPEN_NS", 10_000_000)
    bus = two.poller.bus("ill")
    with monkeypatch.context() as broken:
        broken.setattr(serial.Serial, "open", two.fails)
        bus.line.drop()
        until(lambda: "Ill: of this line" in str(bus.why_lost))
    two.until(("ill", "ok"))


@pytest.mark.parametrize("method", ["_take", "_hand_over"])
def test_a_failure_of_a_pyserial_bridge_counts_as_a_lost_port(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, method: str
) -> None:
    port = serial.serial_for_url("loop://", timeout=0)
    with monkeypatch.context() as broken:
        broken.setattr(Bridge, method, lambda *details: (_ for _ in ()).throw(Ill("of the bridge")))
        bridge = Bridge(port)
        try:
            port.write(b"anything")
            bridge.theirs.setblocking(True)
            until(lambda: bridge.theirs.recv(64) == b"")
        finally:
            bridge.close()
    until(lambda: "of the bridge" in caplog.text)


def test_a_system_exit_in_a_log_handler_does_not_end_the_logging(
    two: Two, caplog: pytest.LogCaptureFixture
) -> None:
    class Exiting(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            raise SystemExit

    handler = Exiting()
    log = logging.getLogger("multidrop.line")
    log.addHandler(handler)
    try:
        polled_line.log_aside(log, logging.ERROR, "first")
        until(lambda: "first" in caplog.text or handler)
    finally:
        log.removeHandler(handler)
    polled_line.log_aside(log, logging.ERROR, "second")
    until(lambda: "second" in caplog.text)


async def wait(batch: object) -> None:
    """Do nothing. A call without `await` only creates a coroutine."""


def give(batch: object) -> Iterator[object]:
    yield batch


async def give_later(batch: object) -> Any:
    yield batch


class Waiting:
    async def __call__(self, batch: object) -> None:
        pass


@pytest.mark.parametrize(
    "function", [wait, give, give_later, Waiting(), partial(wait), partial(partial(give))]
)
def test_on_batch_refuses_async_and_generator_functions(two: Two, function: Any) -> None:
    with pytest.raises(TypeError, match="is async or a generator: a call would not run it"):
        two.poller.on_batch(function)


@pytest.mark.parametrize("function", [wait, give, give_later])
def test_on_batch_fails_if_a_lambda_returns_a_coroutine_or_generator(
    two: Two, function: Callable[[object], Any]
) -> None:
    two.poller.on_batch(lambda batch: function(batch))
    caller = two.poller._caller
    assert caller is not None
    until(lambda: caller._failure)
    with pytest.raises(TypeError, match="is async or a generator"):
        two.poller.close()


def test_an_exception_of_a_users_drive_class_affects_only_its_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """A class that a user wrote may work when the poller is made, and fail during polling."""
    failing = threading.Event()

    class Own(Toy):
        model = "own"

        def needed_silence(self) -> float:
            if failing.is_set():
                raise ZeroDivisionError("a bug of its author")
            return super().needed_silence()

    assert issubclass(Own, Drive)
    monkeypatch.setattr(polled_line, "LEARN_NS", 10_000_000)
    # the poller plans again at each update of the measured delays
    monkeypatch.setattr(polled_line, "MARGIN", -1.0)
    with Simulator([Wire([simulated(Toy(1))], unpaced=True) for _ in range(2)]) as simulator:
        ill, well = (wire.path for wire in simulator.wires)
        poller = Poller(
            plant(
                line(ill, polled(Own(1, name="own"), [Own.registers["output_current"]], 0.01), name="ill"),
                line(well, polled(Toy(1, name="toy"), [CURRENT], 0.01), name="well"),
            )
        )
        with poller:
            failing.set()
            until(lambda: poller.line_failures == {"ill": "ZeroDivisionError: a bug of its author"})
            failing.clear()


@pytest.fixture
def poller() -> Iterator[Poller]:
    """Return a poller of a line with one drive; polling has not started."""
    with Simulator([Wire([EncodedDrive(Toy(1))], unpaced=True)]) as simulator:
        made = Poller(plant(line(simulator.wires[0].path, polled(Toy(1, name="pump-1"), [CURRENT], 0.01))))
        try:
            yield made
        finally:
            made.close()


def counted(poller: Poller) -> int:
    """Return the number of rows that the poller has counted."""
    summary = poller.summary()
    return int(summary["samples"]) + int(summary["misses"])


def test_the_on_batch_function_gets_every_row_before_close_returns(poller: Poller) -> None:
    rows: list[Row] = []
    threads: set[str] = set()

    def keep(batch: Batch) -> None:
        threads.add(threading.current_thread().name)
        rows.extend(batch)

    with poller:
        poller.on_batch(keep, every=0.01)
        until(lambda: len(rows) > 20)
    assert len(rows) == counted(poller)
    assert {row.value for row in rows if row.value is not None} == {proof(Toy(1), CURRENT)}
    sent = [row.monotonic_ns for row in rows if row.value is not None]
    assert sent == sorted(sent)
    assert threads == {"multidrop batches"}
    assert "multidrop batches" not in {thread.name for thread in threading.enumerate()}
    assert rows_of(poller) == []


@pytest.mark.slow
def test_a_slow_on_batch_function_does_not_delay_polling(poller: Poller) -> None:
    go_on, entered = threading.Event(), threading.Event()
    rows: list[Row] = []

    def wait(batch: Batch) -> None:
        entered.set()
        go_on.wait()
        rows.extend(batch)

    with poller:
        poller.on_batch(wait)
        assert entered.wait(60)
        before = poller.summary()["samples"]
        until(lambda: poller.summary()["samples"] > before + 20)
        go_on.set()
    assert len(rows) == counted(poller)


@pytest.mark.slow
def test_an_error_of_the_on_batch_function_is_logged_and_raised_once(
    poller: Poller, caplog: pytest.LogCaptureFixture
) -> None:
    calls: list[int] = []

    def fail(batch: Batch) -> None:
        calls.append(len(batch))
        raise OSError("the disk is full")

    caplog.set_level(logging.ERROR, "multidrop.polling")
    poller.__enter__()
    poller.on_batch(fail, every=0.01)
    until(lambda: bool(caplog.records))
    before = poller.summary()["samples"]
    until(lambda: poller.summary()["samples"] > before + 20)  # polling continues
    with pytest.raises(OSError, match="the disk is full"):
        poller.__exit__(None, None, None)
    assert len(calls) == 1
    (record,) = caplog.records
    assert record.getMessage() == "on_batch: the function failed and is no longer called"
    left = rows_of(poller)
    assert calls[0] + len(left) == counted(poller)  # no row was lost by the failure
    poller.close()  # the failure is raised only once


def test_an_exception_in_the_with_block_hides_the_on_batch_error(
    poller: Poller, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(batch: Batch) -> None:
        raise OSError("the disk is full")

    def interrupted() -> None:
        with poller:
            poller.on_batch(fail)
            until(lambda: bool(caplog.records))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    poller.close()


def test_the_on_batch_function_may_close_the_poller(poller: Poller) -> None:
    rows: list[Row] = []

    def end(batch: Batch) -> None:
        rows.extend(batch)
        poller.close()

    with poller:
        poller.on_batch(end)
        until(lambda: "closed" in repr(poller))

    until(lambda: len(rows) == counted(poller))  # the function gets the last rows after the poller is closed


def test_the_batches_loop_ends_when_the_poller_is_closed(poller: Poller) -> None:
    rows: list[Row] = []

    def take() -> None:
        for batch in poller.batches(every=60.0):
            rows.extend(batch)

    with poller:
        taker = threading.Thread(target=take)
        taker.start()
        until(lambda: poller.summary()["samples"] > 20)
    taker.join(30.0)  # ends long before the 60 s of `every` have passed
    assert not taker.is_alive()
    assert len(rows) == counted(poller)


def test_on_batch_refuses_an_invalid_function(poller: Poller) -> None:
    with pytest.raises(TypeError, match="on_batch takes a function with one argument, the batch, not 3"):
        poller.on_batch(3)  # type: ignore[arg-type]
    with poller:
        poller.on_batch(len)
        with pytest.raises(ValueError, match="already has a function"):
            poller.on_batch(len)
    with pytest.raises(ValueError, match="already has a function"):
        poller.on_batch(len)
    other = Poller(plant())
    other.close()
    with pytest.raises(ValueError, match="polling has ended"):
        other.on_batch(len)
