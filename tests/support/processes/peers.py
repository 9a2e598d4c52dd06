"""Require programs and modules by other authors; if one is missing, skip the test, or fail it in CI."""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
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
    """Check that a module is installed, without importing it; for the top of a test file."""
    if find_spec(name) is None:
        _missing(f"the Python module {name} is not installed")


def require_built(variable: str, tool: str) -> Path:
    """Return the folder that an environment variable names and this tool has filled."""
    folder = os.environ.get(variable)
    if not folder:
        _missing(f"{variable} names no folder made by {tool}")
    return Path(folder).resolve()


def _missing(reason: str) -> NoReturn:
    if os.environ.get("CI"):
        pytest.fail(f"{reason}, and CI must have it")
    pytest.skip(reason, allow_module_level=True)
