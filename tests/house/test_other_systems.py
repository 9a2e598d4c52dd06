"""Check that every module can be imported without the modules that only POSIX has."""

from __future__ import annotations

import subprocess
import sys

import pytest
from peers import require_module

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
