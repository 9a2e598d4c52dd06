"""Build the C core's own test programs with the system's compiler and sanitizers, and run them."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from peers import ROOT, SANITIZERS, build_and_run
from tables import usually

pytestmark = pytest.mark.long
WAITS_BY_EPOLL = pytest.mark.skipif(sys.platform != "linux", reason="others wait by poll")


def core_without(*replaced: str) -> list[str]:
    """Return the names of the core's C files, without those that the test program replaces."""
    csrc = ROOT / "csrc"
    files = [*csrc.glob("*.c"), *csrc.glob("posix/*.c")]
    return [str(path.relative_to(csrc).with_suffix("")) for path in files if path.stem not in replaced]


@pytest.fixture
def build(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., None]:
    """Return a function that builds and runs a C test program. All pytest workers share the object files."""
    shared = tmp_path_factory.getbasetemp()
    shared = (shared.parent if "PYTEST_XDIST_WORKER" in os.environ else shared) / "objects"
    shared.mkdir(exist_ok=True)

    def build(name: str, *core: str, **options: Any) -> None:
        build_and_run(tmp_path / name, *core, objects=shared, **options)

    return build


@pytest.mark.slow
def test_the_c_tests_of_the_core_pass(build: Callable[..., None]) -> None:
    core = ("body", "frame", "tap", "line", "reply", "tcp", "late", "stats", "columns")
    build("test_core", *core, arguments=["tests/data/frames.csv"])


@pytest.mark.slow
def test_the_c_tests_of_columns_and_packets_pass(build: Callable[..., None]) -> None:
    build("test_rows", "columns", "tap", "body", "frame")


@pytest.mark.slow
def test_the_utc_offset_is_read_for_each_batch_of_rows(build: Callable[..., None]) -> None:
    build("test_row_queue", "row_queue", "columns", "body", "frame")


@pytest.mark.slow
@WAITS_BY_EPOLL
@pytest.mark.parametrize(
    "sanitizers", usually([*SANITIZERS], ["-fsanitize=thread"]), ids=["memory", "threads"]
)
def test_threads_can_open_and_close_ports(build: Callable[..., None], sanitizers: list[str]) -> None:
    build("test_engine", *core_without(), sanitizers=sanitizers)


@pytest.mark.slow
@WAITS_BY_EPOLL
def test_core_thread_is_not_woken_by_a_call_during_silence(build: Callable[..., None]) -> None:
    build("test_wakings", *core_without("waiter"))


@pytest.mark.slow
@WAITS_BY_EPOLL
def test_core_thread_sleeps_while_a_caller_waits(build: Callable[..., None]) -> None:
    build("test_spinning", *core_without("clock"))


@pytest.mark.slow
@WAITS_BY_EPOLL
def test_a_port_is_read_once_if_reply_delays_are_constant(build: Callable[..., None]) -> None:
    build("test_looks", *core_without("port"))


@pytest.mark.skipif(sys.platform != "linux", reason="others have no RS-485 mode")
def test_rs485_transceiver_keeps_sending_until_the_last_bit(build: Callable[..., None]) -> None:
    build("test_rs485", "rs485")


@pytest.mark.slow
@WAITS_BY_EPOLL
def test_a_command_that_waits_too_long_for_rts_is_cancelled(build: Callable[..., None]) -> None:
    build("test_stuck_rts", *core_without())


@pytest.mark.skipif(sys.platform != "linux", reason="the driver is Linux's")
def test_a_baud_rate_without_an_integer_divisor_is_refused(build: Callable[..., None]) -> None:
    build("test_divisors", "posix/serial")


@WAITS_BY_EPOLL
@pytest.mark.parametrize("program", ["test_waiter", "test_waiter_refused"])
def test_waits_are_exact_to_the_nanosecond(build: Callable[..., None], program: str) -> None:
    build(program, "posix/waiter")


@pytest.mark.skipif(sys.platform != "linux", reason="masterships are Linux's")
def test_the_mastership_deadline_is_checked_before_each_write(build: Callable[..., None]) -> None:
    build("test_mastership", *core_without("port", "rs485", "mastership"))


@pytest.mark.skipif(sys.platform != "linux", reason="realtime scheduling is limited by Linux's timers")
def test_realtime_scheduling_ends_if_a_thread_uses_too_much_processor_time(
    build: Callable[..., None],
) -> None:
    build("test_realtime", "clock")
