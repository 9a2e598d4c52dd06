"""Fixtures and hooks for all tests. No test writes into the EEPROM ledger of the user who runs it."""

import asyncio
import gc
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from inspect import iscoroutinefunction
from itertools import count, islice
from pathlib import Path
from typing import IO, Any

import pytest
from commands import Run
from hypothesis import HealthCheck, settings
from patient import await_turns, be_patient
from peers import require_module
from simulated_bus import real_clock
from tables import examples

from multidrop.cli import main

# Write compiled modules even if the environment forbids that. Otherwise each worker would compile all tests,
# and each program that a test starts would compile its imports. git ignores these folders.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Commands print titles in the user's language, and fit the user's terminal. Tests expect these values.
os.environ |= {"LC_ALL": "C.UTF-8", "COLUMNS": "80", "LINES": "24"}

gc.disable()  # garbage collections would take a fifth of the time in which tests are collected

if not os.environ.get("CI") and not find_spec("pyarrow"):  # in CI a missing pyarrow is an error
    collect_ignore_glob = ["samples/*", "gateway/forward/*"]

ALL_TESTS = sorted(Path(__file__).parent.glob("*/test_*.py"))
COMPILED_BEFORE = any((test.parent / "__pycache__").exists() for test in ALL_TESTS)

# Hypothesis must not report slow examples as failures, because a busy machine is slow.
settings.register_profile(
    "any machine", max_examples=examples(100), deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("any machine")

# A shell's background job ignores SIGINT, and the programs that tests start would inherit this.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(optionalhook=True)  # of xdist
def pytest_xdist_auto_num_workers() -> int:
    """Return the number of workers: two per processor, because many tests wait; at most 12."""
    return min(2 * len(os.sched_getaffinity(0)), 12)


@pytest.hookimpl(optionalhook=True)  # of xdist
def pytest_configure_node(node: Any) -> None:
    """Pass to a worker whether it must write the bytecode of its share of the test modules."""
    node.workerinput["compiles"] = not COMPILED_BEFORE


def pytest_configure(config: pytest.Config) -> None:
    """Compile this worker's share of the test files if none are compiled yet; pytest caches the result.

    Otherwise all workers would compile every test file at the same time.
    """
    given = getattr(config, "workerinput", {})
    if not given.get("compiles"):
        return
    number = int(given["workerid"].removeprefix("gw"))
    for test in ALL_TESTS[number :: given["workercount"]]:
        if str(test.parent) not in sys.path:
            sys.path.insert(0, str(test.parent))
        with suppress(BaseException):  # pytest reports the error when it collects this file
            import_module(test.stem)


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark nightly tests as long too, so that `not long` leaves them out."""
    if item.get_closest_marker("nightly"):
        item.add_marker("long")


@pytest.hookimpl(trylast=True)  # runs after deselected tests were removed
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Distribute the slow tests, so that every worker starts with its share."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    slow = [item for item in items if item.get_closest_marker("slow")]
    others = iter([item for item in items if not item.get_closest_marker("slow")])
    dealt: list[pytest.Item] = []
    for worker in range(workers):
        # the number of tests that pytest-xdist (--dist worksteal) assigns to this worker at the start
        share = (len(items) - len(dealt)) // (workers - worker)
        begins = slow[worker::workers]
        dealt += [*begins, *islice(others, max(0, share - len(begins)))]
    items[:] = [*dealt, *others]


def pytest_collection_finish() -> None:
    """Exclude pytest's permanent objects from garbage collections, here and in forked child processes."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Pause the measurement of coverage during tests that it would slow down by minutes or make fail."""
    coverage = sys.modules.get("coverage")
    counting = coverage.Coverage.current() if coverage else None
    if counting is None or _is_counted(item):
        return (yield)
    kept = {name: os.environ.pop(name) for name in [*os.environ] if name.startswith("COVERAGE_PROCESS_")}
    counting.stop()
    try:
        return (yield)
    finally:
        counting.start()
        os.environ.update(kept)


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run an `async def` test with its module's function `run_test`, or else with `asyncio.run`."""
    if not iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
    getattr(pyfuncitem.module, "run_test", asyncio.run)(pyfuncitem.obj(**arguments))
    return True


def _is_counted(item: pytest.Item) -> bool:
    """Return False for tests marked `story` or `uncounted`, during which no coverage is measured."""
    return not (item.get_closest_marker("story") or item.get_closest_marker("uncounted"))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--kills", type=int, default=5, help="how many clients test_crash.py kills")


@pytest.fixture(scope="module", autouse=True)
def _gathered() -> Iterator[None]:
    """Collect garbage after each test file; exclude the remaining objects, such as imports, from then on."""
    yield
    gc.collect()
    gc.freeze()


@pytest.fixture
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use time-outs that a busy computer never exceeds; not for tests with a silent drive."""
    be_patient(monkeypatch.setattr, monkeypatch.setitem)


@pytest.fixture
def _turns_awaited(monkeypatch: pytest.MonkeyPatch) -> None:
    """Never let a write expire on a busy computer; also for tests with a silent drive."""
    await_turns(monkeypatch.setattr, monkeypatch.setitem)


@pytest.fixture(scope="module")
def _patient_module() -> Iterator[None]:
    """Use the same time-outs as `_patient`, for a line that all tests of a module share."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        be_patient(monkeypatch.setattr, monkeypatch.setitem)
        yield


@pytest.fixture
def _unpainted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write a picture without pixels or layout, to save time in tests of the text beside it."""
    require_module("matplotlib")

    def savefig(figure: object, file: IO[bytes], **options: object) -> None:
        file.write(b"\x89PNG\r\n\x1a\n")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", savefig)


@pytest.fixture
def _laid_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lay out pictures without rendering pixels, which halves the time; texts and places can be checked."""
    require_module("matplotlib")

    def savefig(figure: Any, file: IO[bytes], **options: object) -> None:
        figure.draw_without_rendering()
        file.write(b"\x89PNG\r\n\x1a\n")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", savefig)


@pytest.fixture(scope="session")
def _states(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return paths for new directories; pytest's own `tmp_path` would take as long as a small test."""
    whole = tmp_path_factory.mktemp("states")
    return (whole / str(number) for number in count())


@pytest.fixture(autouse=True)
def _own_state(_states: Iterator[Path]) -> None:
    state = next(_states)
    state.mkdir()
    os.environ["XDG_STATE_HOME"] = str(state)


@pytest.fixture(autouse=True)
def _real_clock() -> Iterator[None]:
    """Restore the clock after a test with a `SimulatedBus`."""
    with real_clock():
        yield


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Return a function that runs a command and returns its exit status, output and errors."""

    def run(*words: object) -> tuple[int, str, str]:
        status = main([str(word) for word in words])
        return status, *capsys.readouterr()

    return run
