"""A poller's callback for batches: its thread, its failures, and its end."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator

import pytest
from lines import line, plant, polled, rows_of, until
from toy import Toy

from multidrop.poller import Poller
from multidrop.polling.batch import Batch, Row
from multidrop.sim import EncodedDrive, Simulator, Wire, proof

CURRENT = Toy.registers["output_current"]


@pytest.fixture
def poller() -> Iterator[Poller]:
    """Return a poller of a line with one drive; polling has not started."""
    with Simulator([Wire([EncodedDrive(Toy(1))], unpaced=True)]) as simulator:
        made = Poller(plant(line(simulator.wires[0].path, polled(Toy(1, name="pump-1"), [CURRENT], 0.01))))
        try:
            yield made
        finally:
            made.close()


def test_on_batch_gets_every_row_once_and_all_before_close_returns(poller: Poller) -> None:
    rows: list[Row] = []
    threads: set[str] = set()

    def keep(batch: Batch) -> None:
        threads.add(threading.current_thread().name)
        rows.extend(batch)

    with poller:
        poller.on_batch(keep, every=0.01)
        until(lambda: len(rows) > 20)
    summary = poller.summary()
    assert len(rows) == summary["samples"] + summary["misses"]
    assert {row.value for row in rows if row.value is not None} == {proof(Toy(1), CURRENT)}
    sent = [row.monotonic_ns for row in rows if row.value is not None]
    assert sent == sorted(sent)
    assert threads == {"multidrop batches"}
    assert "multidrop batches" not in {thread.name for thread in threading.enumerate()}
    assert rows_of(poller) == []


@pytest.mark.slow
def test_a_slow_function_does_not_delay_polling(poller: Poller) -> None:
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
    summary = poller.summary()
    assert len(rows) == summary["samples"] + summary["misses"]


@pytest.mark.slow
def test_a_failure_of_the_function_is_logged_immediately_and_raised_by_close(
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
    summary = poller.summary()
    left = rows_of(poller)
    assert calls[0] + len(left) == summary["samples"] + summary["misses"]  # `left` has all later rows
    poller.close()  # the failure is raised only once


def test_an_exception_of_the_with_block_takes_precedence_over_the_callback_s(
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


def test_the_function_may_close_the_poller(poller: Poller) -> None:
    rows: list[Row] = []

    def end(batch: Batch) -> None:
        rows.extend(batch)
        poller.close()

    with poller:
        poller.on_batch(end)
        until(lambda: "closed" in repr(poller))

    def counted() -> int:
        summary = poller.summary()
        return int(summary["samples"]) + int(summary["misses"])

    until(lambda: len(rows) == counted())  # the last rows come after the poller is closed


def test_batches_end_when_the_poller_is_closed(poller: Poller) -> None:
    rows: list[Row] = []

    def take() -> None:
        for batch in poller.batches(every=60.0):
            rows.extend(batch)

    with poller:
        taker = threading.Thread(target=take)
        taker.start()
        until(lambda: poller.summary()["samples"] > 20)
    taker.join(30.0)  # long before the `every` of 60 s is over
    assert not taker.is_alive()
    summary = poller.summary()
    assert len(rows) == summary["samples"] + summary["misses"]


def test_on_batch_rejects_invalid_callbacks(poller: Poller) -> None:
    with pytest.raises(TypeError, match="on_batch takes a function of one batch, not 3"):
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
