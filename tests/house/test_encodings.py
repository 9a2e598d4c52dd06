"""Check portability: every opened text file has an encoding, and every module imports without POSIX."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from peers import require_module
from tables import table

import multidrop

pytestmark = pytest.mark.long  # concerns only the package's authors

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


def test_opened_text_has_an_encoding() -> None:
    found = [
        f"{path.relative_to(SOURCE)}:{line}"
        for path in sorted(SOURCE.rglob("*.py"))
        for line in lacking(path.read_text("utf-8"))
    ]
    assert found == []


@table(
    "call",
    ["p.read_text()", "p.write_text(text)", "open(name)", 'p.open("w")', "subprocess.run([], text=True)"],
)
def test_call_without_encoding_is_detected(call: str) -> None:
    assert list(lacking(call)) == [1]


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
def test_call_with_encoding_is_not_reported(call: str) -> None:
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
def test_every_module_can_be_imported_without_posix() -> None:
    require_module("matplotlib")
    ran = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    count, *failed = ran.stdout.splitlines()
    assert failed == []
    assert int(count) > 200
