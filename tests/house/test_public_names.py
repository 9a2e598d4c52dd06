"""Check the public names: one list, lazy loading, readable repr, strict types. Check portability too."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from importlib.metadata import version
from inspect import signature
from pathlib import Path
from pydoc import plaintext, render_doc
from traceback import format_exception

import pytest
from batches import example
from peers import require_module
from tables import table
from toy import Toy

import multidrop
from multidrop import Bus, Plant, Poller
from multidrop.core import Framing, NumberFormat
from multidrop.drive import DISCRETE, HOLDING, INPUT, Kept

NAMES = [name for name in multidrop.__all__ if name != "__version__"]


def run(*words: str) -> str:
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True).stdout


def test_each_public_name_refers_to_the_object_in_its_module() -> None:
    for name in NAMES:
        home = import_module(multidrop._HOMES[name])
        assert getattr(multidrop, name) is getattr(home, name)
        assert name in dir(multidrop)


def test_no_public_name_is_listed_twice() -> None:
    stub = Path(multidrop.__file__).with_suffix(".pyi").read_text()
    imports = [line for line in stub.splitlines() if line.startswith("from ")]
    assert len(imports) == len(NAMES)
    assert len(set(NAMES)) == len(NAMES)


def test_an_unknown_name_raises_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'multidrop' has no attribute 'Buss'"):
        _ = multidrop.Buss  # type: ignore[attr-defined]


def test_modules_are_imported_when_their_names_are_first_used() -> None:
    code = (
        "import sys, multidrop; print(sorted(name for name in sys.modules if name.startswith('multidrop')))"
    )
    assert run("-c", code).strip() == str(["multidrop"])


def test_the_version_is_that_of_the_distribution() -> None:
    assert multidrop.__version__ == version("multidrop")


def test_the_package_runs_as_a_module() -> None:
    assert "usage: multidrop" in run("-m", "multidrop", "--help")


def test_public_names_suffice_to_declare_a_family() -> None:
    """Declare a user's own family with public names only."""

    class Own(multidrop.Drive):
        speed = multidrop.reading(1, "Hz", step=0.1, table=INPUT, number_format=NumberFormat.I16)
        level = multidrop.setting(2, kept=Kept.RAM, table=HOLDING)
        lamp = multidrop.reading(3, number_format=NumberFormat.BIT, table=DISCRETE)

    assert Own(1, framing=Framing.RTU).speed is Own.speed


# ---- repr in a debugger ----


def test_the_repr_of_a_drive_or_bus_shows_name_address_and_port() -> None:
    drive = Toy(3, name="pump-3")
    assert repr(drive) == "<Toy 'pump-3', address 3, rtu, 9600 8N1, not attached>"
    with Bus("loop://") as bus:
        assert repr(bus) == "<Bus loop://: no drives>"
        bus.attach(drive)
        assert repr(drive) == "<Toy 'pump-3', address 3, rtu, 9600 8N1, on loop://>"
        assert repr(bus) == "<Bus loop://: pump-3>"
    assert repr(bus) == "<Bus loop://, closed: pump-3>"


def test_the_repr_of_a_batch_shows_counts_and_time_span() -> None:
    assert repr(example()) == "<Batch: 5 rows of 3 drives, 3.000 s from 2026-11-21T09:30:00.123+00:00>"


def test_the_repr_of_a_poller_shows_its_state() -> None:
    poller = Poller(Plant((), Path()))
    assert repr(poller) == "<Poller not started; no lines>"
    poller.close()
    assert repr(poller) == "<Poller closed; no lines>"


# ---- completion at a prompt ----


def test_dir_of_the_package_lists_only_its_few_public_names() -> None:
    assert len(NAMES) <= 45
    assert dir(multidrop) == sorted(multidrop.__all__)


def test_the_help_of_a_drive_method_shows_the_signature() -> None:
    shown = render_doc(multidrop.YD1000.start, renderer=plaintext)
    assert "start(self, direction: " in shown
    assert str(signature(Toy(1).stop)) == "(*, seconds: 'float | None' = None)"


def test_a_missing_port_is_reported_in_one_sentence() -> None:
    with pytest.raises(multidrop.LineError, match="/dev/ttyUSB77: there is no such port") as caught:
        Bus("/dev/ttyUSB77")
    lines = "".join(format_exception(caught.value))
    assert "The above exception" not in lines
    assert "During handling" not in lines


# ---- strict typing ----


ROOT = Path(__file__).parents[2]

PAGES = [ROOT / "README.md", ROOT / "docs" / "howto" / "coming-from.md"]

BLOCKS = [
    (page, block)
    for page in PAGES
    for block in re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL)
]

SCRIPTS = {
    **{f"{page.stem.replace('-', '_')}_{number}": block for number, (page, block) in enumerate(BLOCKS)},
    **{path.stem: path.read_text("utf-8") for path in (ROOT / "examples").glob("*.py")},
}

TYPES = """
from multidrop import Bus, InnovertIBD, ModbusDevice

with Bus("/dev/ttyUSB0") as bus:
    pump = bus.attach(InnovertIBD, address=1)
    reveal_type(pump.read(pump.output_current))
    reveal_type(pump.read("output_current", pump.output_frequency))
    reveal_type(pump.write(pump.acceleration_time, 20.0))
    reveal_type(pump.stop(seconds=5).ok)
    reveal_type(pump.state())
    meter = bus.attach(ModbusDevice, address=7)
    reveal_type(meter.read_holding(100, 2))
    reveal_type(meter.read_input(0, format="F32"))
    pump.write(pump.acceleration_time, "fast")
    pump.red("output_current")
"""

FOUND = [
    'note: Revealed type is "float"',
    'note: Revealed type is "dict[str, Any]"',
    'note: Revealed type is "float"',
    'note: Revealed type is "bool"',
    'note: Revealed type is "multidrop.drive.verbs.State"',
    'note: Revealed type is "list[int]"',
    'note: Revealed type is "list[float]"',
    'error: No overload variant of "write" of "RegisterAccess"',
    'error: "InnovertIBD" has no attribute "red"',
]


def mypy(folder: Path) -> str:
    """Return mypy's output for the scripts in a user's folder."""
    words = ["--strict", "--follow-imports=silent", "--config-file=", f"--cache-dir={folder / 'cache'}", "."]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words],
        cwd=folder,
        env={"MYPYPATH": str(ROOT / "src")},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    return done.stdout + done.stderr


@pytest.mark.long
def test_a_script_that_uses_public_names_passes_mypy_strict(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    for name, script in SCRIPTS.items():
        (tmp_path / f"{name}.py").write_text(script, "utf-8")
    found = mypy(tmp_path)
    assert found.startswith("Success"), found


@pytest.mark.long
def test_mypy_infers_the_types_of_register_values(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    (tmp_path / "script.py").write_text(TYPES, "utf-8")
    found = mypy(tmp_path)
    for sentence in FOUND:
        assert sentence in found


# ---- check portability: every opened text file has an encoding, and every module imports without POSIX ----


SOURCE = Path(multidrop.__file__).parent
TEXT_MODES = frozenset("rwaxt+")


def lacks_encoding(call: ast.Call) -> bool:
    """Return True if the call opens text without an encoding. `x.open()` without a mode is not counted."""
    name = ast.unparse(call.func)
    options = {keyword.arg for keyword in call.keywords}
    modes = {
        mode.value for mode in call.args if isinstance(mode, ast.Constant) and isinstance(mode.value, str)
    }
    if "encoding" in options:
        return False
    if name.endswith(".read_text"):
        return not call.args
    if name.endswith(".write_text"):
        return len(call.args) < 2
    if name in ("open", "os.fdopen"):
        return not any("b" in mode for mode in modes)
    is_text = name.endswith(".open") and any(mode and set(mode) <= TEXT_MODES for mode in modes)
    names_text = not options.isdisjoint({"text", "universal_newlines"})
    return is_text or (names_text and not name.endswith("._replace"))


def lacking(source: str) -> Iterator[int]:
    """Return the line numbers of calls that open text without an encoding."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and lacks_encoding(node):
            yield node.lineno


@pytest.mark.long
def test_every_opened_text_file_has_an_explicit_encoding() -> None:
    found = [
        f"{path.relative_to(SOURCE)}:{line}"
        for path in sorted(SOURCE.rglob("*.py"))
        for line in lacking(path.read_text("utf-8"))
    ]
    assert found == []


@pytest.mark.long
@table(
    "call",
    ["p.read_text()", "p.write_text(text)", "open(name)", 'p.open("w")', "subprocess.run([], text=True)"],
)
def test_a_call_that_opens_text_without_encoding_is_detected(call: str) -> None:
    assert list(lacking(call)) == [1]


@pytest.mark.long
@table(
    "call",
    [
        'p.read_text("utf-8")',
        'open(name, "rb")',
        "os.open(name, 0)",
        "port.open()",
        'p.open("w", encoding=e)',
    ],
)
def test_a_call_that_opens_text_with_encoding_is_not_reported(call: str) -> None:
    assert list(lacking(call)) == []


# ---- other systems ----


# Import everything normally first, which loads the dependencies. Then import multidrop again as if on
# Windows.
PROGRAM = """
import importlib, os, pkgutil, select, signal, socket, sys, time
import multidrop

def import_all():
    failed, names = [], []
    for found in pkgutil.walk_packages(multidrop.__path__, "multidrop.", onerror=failed.append):
        if found.name.endswith(("__main__", "._core")):
            continue
        try:
            importlib.import_module(found.name)
            names.append(found.name)
        except Exception as failure:
            if "needs Python" in str(failure):  # an extra that this Python cannot have
                continue
            failed.append(f"{found.name}: {failure!r}")
    return failed, names

failed, names = import_all()
assert not failed, failed
for name in [*names, "multidrop"]:
    del sys.modules[name]
for module in ("fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"):
    sys.modules[module] = None
for module, lacking in {
    os: ("register_at_fork", "fork", "openpty", "ttyname", "getuid", "geteuid", "pread", "statvfs", "killpg",
         "O_CLOEXEC", "O_NOCTTY", "O_NONBLOCK", "uname"),
    time: ("clock_gettime", "clock_gettime_ns", "CLOCK_MONOTONIC", "CLOCK_REALTIME"),
    socket: ("AF_UNIX", "SOCK_SEQPACKET", "SO_REUSEPORT", "TCP_USER_TIMEOUT"),
    signal: ("SIGHUP", "SIGUSR1", "SIGKILL", "pthread_kill", "setitimer"),
    select: ("poll", "epoll"),
}.items():
    for name in lacking:
        if hasattr(module, name):
            delattr(module, name)
sys.platform = "win32"
import multidrop
failed, names = import_all()
print(len(names), *failed, sep="\\n")
"""


@pytest.mark.long
@pytest.mark.slow
def test_every_module_can_be_imported_without_posix_modules() -> None:
    require_module("matplotlib")
    ran = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    count, *failed = ran.stdout.splitlines()
    assert failed == []
    assert int(count) > 200
