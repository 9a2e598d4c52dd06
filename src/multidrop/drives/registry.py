"""Find a family by the name that a person writes: a built-in one, or a class in a file of their own.

Such a file is a program: looking a class up runs it, with all rights of the caller. Each file is logged to
`multidrop.drives.registry` before it is run.
"""

from __future__ import annotations

import difflib
import importlib.util
import logging
import sys
import traceback
from functools import cache
from pathlib import Path
from types import ModuleType

from multidrop.drive import Drive
from multidrop.drives import MODELS


def find_model(text: str, relative_to: Path | None = None) -> type[Drive]:
    """Return the family called `text`: one of MODELS, or "path/to/file.py:Class".

    A relative path begins at `relative_to`, or at the working directory. The file is run, once a process.
    Raises ValueError, also for whatever the file itself does wrong.
    """
    if text in MODELS:
        return MODELS[text]
    path, colon, name = text.rpartition(":")
    if not colon and text.endswith(".py"):
        path = text
    if not path.endswith(".py"):
        near = difflib.get_close_matches(text.lower(), MODELS, n=2)
        hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(MODELS)}"
        raise ValueError(f"there is no model {text!r}; {hint} (or write path/to/file.py:Class)")
    return _drive(_load((relative_to or Path()) / path), path, name if colon else "")


def is_users_own(family: type[Drive]) -> bool:
    """Return True for a class that neither is a built-in family nor derives from one."""
    return not any(base in MODELS.values() for base in family.__mro__)


def _drive(module: ModuleType, path: str, name: str) -> type[Drive]:
    found = getattr(module, name, None)
    if isinstance(found, type) and issubclass(found, Drive) and found.registers:
        return found
    drives = [
        f"{path}:{key}"
        for key, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, Drive) and value.registers
    ]
    choices = f"write {' or '.join(drives)}" if drives else "it declares no drive"
    if not name:
        raise ValueError(f"{path} names no class; {choices}")
    if found is None:
        raise ValueError(f"{path} has no class {name!r}; {choices}")
    raise ValueError(f"{path}:{name} is not a subclass of multidrop.Drive with registers; {choices}")


def _load(path: Path) -> ModuleType:
    try:
        is_there = path.is_file()
    except OSError as failure:
        raise ValueError(f"no model can be taken from {path}: {failure.strerror}") from failure
    if not is_there:
        raise ValueError(f"there is no file {path} to take a model from")
    return _load_once(path.resolve())


@cache
def _load_once(path: Path) -> ModuleType:
    """Run the file once a process, so that its classes stay the same for all their drives."""
    name = f"multidrop_models.{path.stem}_{abs(hash(path)):x}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} cannot be loaded as Python")
    logging.getLogger(__name__).info("%s is run as Python: a model of one's own is a program", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as mistake:
        del sys.modules[name]
        raise ValueError(f"{path}{_line(mistake, path)}: {type(mistake).__name__}: {mistake}") from mistake
    return module


def _line(mistake: BaseException, path: Path) -> str:
    """Return the line of the file in which it happened, where that is known."""
    if isinstance(mistake, SyntaxError):
        return ""  # its text has the line
    lines = [at.lineno for at in traceback.extract_tb(mistake.__traceback__) if at.filename == str(path)]
    return f", line {lines[-1]}" if lines else ""
