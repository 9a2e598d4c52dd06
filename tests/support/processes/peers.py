"""Require other authors' programs and modules, and build C programs; if one is missing, skip the test.

In CI, only a missing C compiler skips a test. If another program or module is missing, the test fails.
"""

from __future__ import annotations

import fcntl
import importlib
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import NoReturn

import pytest


def require_program(name: str) -> str:
    """Return the path of an installed program, on PATH or beside the interpreter."""
    path = shutil.which(name) or shutil.which(name, path=str(Path(sys.executable).parent))
    if path is None:
        _missing(f"the program {name} is not installed")
    return path


def build_with_libmodbus(source: Path, built: Path) -> Path:
    """Compile a C program with libmodbus into the directory `built`; return the program's path."""
    require_program("pkg-config")
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "libmodbus"], capture_output=True, text=True, check=False
    )
    if flags.returncode:
        _missing("the library libmodbus is not installed")
    program = built / source.stem
    subprocess.run(["cc", source, "-o", program, *flags.stdout.split()], check=True)
    return program


def require_module(name: str) -> ModuleType:
    """Import and return a module; the name may be dotted."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        _missing(f"the Python module {name} is not installed")


def require_installed(name: str) -> None:
    """Skip the test file, or fail in CI, unless this module is installed. The module is not imported."""
    if find_spec(name) is None:
        _missing(f"the Python module {name} is not installed")


def require_built(variable: str, tool: str) -> Path:
    """Return the folder that an environment variable names, and that `tool` has filled."""
    folder = os.environ.get(variable)
    if not folder:
        _missing(f"{variable} names no folder made by {tool}")
    return Path(folder).resolve()


def _missing(reason: str) -> NoReturn:
    if os.environ.get("CI"):
        pytest.fail(f"{reason}, and CI must have it")
    pytest.skip(reason, allow_module_level=True)


# ---- build C test programs together with files of the core, with sanitizers, and run them ----


ROOT = Path(__file__).parents[3]
OPTIONS = ["-std=c11", "-D_DEFAULT_SOURCE"]
STRICT = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
CC = os.environ.get("CC", "cc")
SKIPPED = 77  # exit status of a test program that cannot run on this machine, and prints the reason


def build_and_run(
    program: Path,
    *core: str,
    objects: Path,
    arguments: Sequence[str] = (),
    sanitizers: Sequence[str] = SANITIZERS,
) -> None:
    """Build a test program with these C files of the core, and run it.

    `objects` is the cache folder of compiled files, shared by all programs and test workers.
    """
    if shutil.which(CC) is None:
        pytest.skip(f"no C compiler ({CC})")
    sources = [f"csrc/{name}.c" for name in core]
    random.shuffle(sources)  # concurrent workers compile different files first
    parts = [compiled(source, objects, sanitizers) for source in (f"tests/c/{program.name}.c", *sources)]
    _run([CC, *sanitizers, *parts, "-lm", "-o", program])
    run = subprocess.run([program, *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    if run.returncode == SKIPPED:
        pytest.skip(run.stdout.strip())
    assert run.returncode == 0, run.stdout + run.stderr


def compiled(source: str, objects: Path, sanitizers: Sequence[str]) -> Path:
    """Compile a source file, or wait for the worker that compiles it; return the object file's path."""
    name = f"{Path(source).stem}{''.join(sanitizers)}".translate({ord(","): "-", ord("="): "-"})
    made = objects / f"{name}.o"
    with (objects / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            half = made.with_suffix(".half")
            # -O0 compiles twice as fast as -O2; .ci/run also builds with -O2
            _run([CC, *OPTIONS, "-g", "-O0", *STRICT, *sanitizers, "-Icsrc", "-c", source, "-o", half])
            half.rename(made)
    return made


def preloaded(name: str, folder: Path) -> str:
    """Build the shared library of this name; return its path for LD_PRELOAD."""
    if shutil.which(CC) is None:
        pytest.skip(f"no C compiler ({CC})")
    library = folder / f"{name}.so"
    source = ROOT / f"tests/support/programs/{name}.c"
    _run([CC, "-std=c11", "-shared", "-fPIC", "-O1", *STRICT, "-o", library, source])
    loaded = [sys.executable, "-c", "print(open('/proc/self/maps').read())"]
    loaded_libraries = subprocess.check_output(
        loaded, env=os.environ | {"LD_PRELOAD": str(library)}, text=True
    )
    if library.name not in loaded_libraries:
        pytest.skip("this interpreter is started with libraries of its own alone")
    return str(library)


def _run(command: Sequence[str | Path]) -> None:
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
