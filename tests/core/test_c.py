"""The C core's own test programs, built by the system's compiler with its sanitizers, and run."""

import sys
from pathlib import Path

import pytest
from c_programs import ROOT, SANITIZERS, build_and_run
from examples import usually


@pytest.mark.slow
def test_core(tmp_path: Path) -> None:
    line = ("line", "listen", "line_end", "reply", "tcp", "echo", "owed", "late", "delay", "counters")
    core = ("checksum", "body", "frame", "reason", "tap", *line, "columns")
    build_and_run(tmp_path / "test_core", *core, arguments=["tests/data/frames.csv"])


@pytest.mark.slow
def test_rows(tmp_path: Path) -> None:
    build_and_run(tmp_path / "test_rows", "columns", "tap", "body", "frame", "checksum", "reason")


@pytest.mark.slow
def test_the_time_of_day_is_asked_for_again_and_again(tmp_path: Path) -> None:
    build_and_run(tmp_path / "test_row_queue", "row_queue", "columns", "body", "frame", "checksum", "reason")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="others wait by poll")
@pytest.mark.parametrize(
    "sanitizers", usually(["-fsanitize=thread"], [*SANITIZERS]), ids=["threads", "memory"]
)
def test_ports_come_and_go_on_threads_of_their_own(tmp_path: Path, sanitizers: list[str]) -> None:
    core = [path.stem for path in (ROOT / "csrc").glob("*.c") if path.stem != "waiter_poll"]
    build_and_run(tmp_path / "test_engine", *core, sanitizers=sanitizers)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="others wait by poll")
def test_a_client_that_is_back_soon_wakes_nobody(tmp_path: Path) -> None:
    replaced = ("waiter_poll", "wakeup")
    core = [path.stem for path in (ROOT / "csrc").glob("*.c") if path.stem not in replaced]
    build_and_run(tmp_path / "test_wakings", *core)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="others wait by poll")
def test_a_port_is_read_once_for_an_exchange(tmp_path: Path) -> None:
    replaced = ("waiter_poll", "port_io")
    core = [path.stem for path in (ROOT / "csrc").glob("*.c") if path.stem not in replaced]
    build_and_run(tmp_path / "test_looks", *core)


@pytest.mark.skipif(sys.platform != "linux", reason="others wait by poll")
@pytest.mark.parametrize("program", ["test_waiter", "test_waiter_refused"])
def test_no_wait_is_rounded(tmp_path: Path, program: str) -> None:
    build_and_run(tmp_path / program, "waiter_epoll")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="masterships are Linux's")
def test_nothing_is_sent_but_by_a_look_at_the_deadline(tmp_path: Path) -> None:
    replaced = ("waiter_poll", "port_io", "mastership")
    core = [path.stem for path in (ROOT / "csrc").glob("*.c") if path.stem not in replaced]
    build_and_run(tmp_path / "test_mastership", *core)
