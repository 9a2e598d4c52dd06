"""Run a user's Python file once a process, with the modules that lie beside it.

A file imports a module of its own directory by name, as a script does. No other file sees that module:
`sys.path` and the names in `sys.modules` stay as they are, so two directories may have modules of one name.
A module of Python's own, or multidrop itself, is never taken from beside a file.
"""

from __future__ import annotations

import builtins
import importlib.util
import logging
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import RLock
from types import ModuleType

_KEPT = {*sys.stdlib_module_names, "multidrop"}  # names that no file beside a model takes
_running = RLock()  # a file that is being run is not run by another thread too

_log = logging.getLogger("multidrop.families.registry")


def load_model_file(path: Path) -> ModuleType:
    """Return the module that the file is; it is run once a process, so that its classes stay the same.

    Raises ValueError, with file and line, for whatever it does wrong.
    """
    path = path.resolve()
    try:
        return _module(path)
    except _NotPython as mistake:
        raise ValueError(str(mistake)) from mistake
    except (Exception, SystemExit) as mistake:
        raise ValueError(f"{_place(mistake, path)}: {type(mistake).__name__}: {mistake}") from mistake


class _NotPython(Exception):
    """A file that is not called as Python files are."""


def _module(path: Path) -> ModuleType:
    name = f"multidrop_models.{path.stem}_{abs(hash(path)):x}"
    with _running:
        if name in sys.modules:  # whole, or under way where two files import each other
            return sys.modules[name]
        spec = importlib.util.spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise _NotPython(f"{path} cannot be loaded as Python")
        _log.info("%s is run as Python: a model of one's own is a program", path)
        module = importlib.util.module_from_spec(spec)
        vars(module)["__builtins__"] = {**vars(builtins), "__import__": _import_beside(path.parent)}
        sys.modules[name] = module  # dataclasses look their module up
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
        return module


def _import_beside(directory: Path) -> Callable[..., object]:
    """Return an `__import__` that finds the modules of this directory first."""

    def import_module(
        name: str,
        globals: Mapping[str, object] | None = None,
        locals: Mapping[str, object] | None = None,
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> object:
        path = directory / f"{name}.py"
        if level == 0 and name.isidentifier() and name not in _KEPT and path.is_file():
            return _imported(name, path) or _module(path.resolve())
        return builtins.__import__(name, globals, locals, fromlist or (), level)

    return import_module


def _imported(name: str, path: Path) -> ModuleType | None:
    """Return the module of this name where the program has imported it, from this very file."""
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None)
    return module if file and Path(file).exists() and path.samefile(file) else None


def _place(mistake: BaseException, path: Path) -> str:
    """Return the file, and the line in which it happened where that is known: its own, or one beside it."""
    if isinstance(mistake, SyntaxError):
        return str(path)  # its text has file and line
    frames = [
        frame
        for frame in traceback.extract_tb(mistake.__traceback__)
        if Path(frame.filename).parent == path.parent
    ]
    return f"{frames[-1].filename}, line {frames[-1].lineno}" if frames else str(path)
