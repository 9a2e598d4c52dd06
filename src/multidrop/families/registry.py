"""Find a family by name: a built-in family, a file of this package, or a user's file.

The shipped families are TOML files of this package, untested on hardware. A TOML file is data. A Python
file is a program: it is run once per process, with all rights of the caller, after its name is logged to
`multidrop.families.registry`. Like a script, it may import modules of its own directory by name. Files in
other directories do not see these modules: `sys.path` and the names in `sys.modules` stay unchanged, so two
directories may have modules of the same name. Modules of the standard library, and multidrop itself, are
never imported from that directory.
"""

from __future__ import annotations

import builtins
import importlib.util
import logging
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from threading import RLock
from types import ModuleType
from typing import TYPE_CHECKING

from multidrop.drive import Drive
from multidrop.families import MODELS
from multidrop.printable import did_you_mean

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

# entry point group in which other packages offer families; built-in names take precedence
GROUP = "multidrop.families"
_SHIPPED = Path(__file__).parent / "shipped"
# names of the family files in this package; each file is read when it is needed
SHIPPED = tuple(sorted(path.stem for path in _SHIPPED.glob("*.toml")))

# Shipped family files that a scan tries. Other registers besides the status identify their drives.
RECOGNISABLE = ("delixi-e", "invt-chf100a", "invt-goodrive", "powtran-pi130", "yaskawa-a1000")


def shipped_family(name: str) -> type[Drive]:
    """Return the family from a file of this package, with this name as its `model`."""
    family = _family_of(_SHIPPED / f"{name}.toml")
    family.model = family.declared_in = name
    return family


def find_model(text: str, relative_to: Path | None = None) -> type[Drive]:
    """Return the family called `text`: one of MODELS or SHIPPED, "path/to/file.toml", or "file.py:Class".

    A relative path starts at `relative_to`, or at the working directory. A Python file is run, but only once
    per process. Raises ValueError for an unknown name and for any error in the file.
    """
    if text in MODELS:
        return MODELS[text]
    if text in SHIPPED:
        return shipped_family(text)
    if text.endswith(".toml"):
        return _family_of((relative_to or Path()) / text)
    path, colon, name = text.rpartition(":")
    if not colon and text.endswith(".py"):
        path = text
    if not path.endswith(".py"):
        # only for names, not for paths: the search reads the list of all installed packages
        if found := installed_family(text):
            return found
        known = (*MODELS, *SHIPPED, *installed_models())
        hint = did_you_mean(text.lower(), known)
        raise ValueError(f"there is no model {text!r}; {hint} (or write path/to/file.toml or file.py:Class)")
    return _drive(_load((relative_to or Path()) / path), path, name if colon else "")


def installed_models() -> list[str]:
    """Return the names of the families in other installed packages, except names of built-in families."""
    names = {point.name for point in _entry_points()}
    return sorted(names - {*MODELS, *SHIPPED})


def installed_family(name: str) -> type[Drive] | None:
    """Return the family that another installed package offers under this name; None if there is none.

    Raises ValueError if two packages offer the name, or if the family cannot be loaded.
    """
    points = [point for point in _entry_points() if point.name == name]
    if not points:
        return None
    packages = [point.dist.name if point.dist else point.value for point in points]
    if len(points) > 1:
        raise ValueError(
            f"model {name!r} is in several packages, {' and '.join(packages)}: uninstall all but one"
        )
    try:
        found = points[0].load()
    except Exception as failure:  # code of another package may raise any exception
        why = f"{type(failure).__name__}: {failure}"
        raise ValueError(f"model {name!r} of package {packages[0]} cannot be loaded: {why}") from failure
    if not (isinstance(found, type) and issubclass(found, Drive) and found.registers):
        raise ValueError(
            f"model {name!r} of package {packages[0]} is not a subclass of multidrop.Drive with registers"
        )
    if found.model != name:
        raise ValueError(
            f"model {name!r} of package {packages[0]} has model = {found.model!r}: rename its entry "
            f"point to {found.model!r}"
        )
    return found


def _entry_points() -> Iterable[EntryPoint]:
    from importlib.metadata import entry_points  # imported only here, because it takes 2 MB of memory

    return entry_points(group=GROUP)


def is_users_own(family: type[Drive]) -> bool:
    """Return True if the family is a user's own class that extends no family of this package."""
    return family.model not in SHIPPED and not any(base in MODELS.values() for base in family.__mro__)


def _family_of(path: Path) -> type[Drive]:
    from multidrop.families.files.loader import load_family  # imported only here, because the import is slow

    return load_family(path)


def _drive(module: ModuleType, path: str, name: str) -> type[Drive]:
    found = getattr(module, name, None)
    if isinstance(found, type) and issubclass(found, Drive) and found.registers:
        return found
    drives = [
        f"{path}:{key}"
        for key, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, Drive) and value.registers
    ]
    choices = f"write {' or '.join(drives)}" if drives else "the file declares no drive class"
    if not name:
        raise ValueError(f"{path} needs the name of a class after a colon; {choices}")
    if found is None:
        raise ValueError(f"{path} has no class {name!r}; {choices}")
    raise ValueError(f"{path}:{name} is not a subclass of multidrop.Drive with registers; {choices}")


def _load(path: Path) -> ModuleType:
    try:
        is_there = path.is_file()
    except OSError as failure:
        raise ValueError(f"the model file {path} cannot be read: {failure.strerror}") from failure
    if not is_there:
        raise ValueError(f"the model file {path} does not exist")
    return load_model_file(path)


# modules that are never imported from the folder of a model file
_KEPT = {*sys.stdlib_module_names, "multidrop"}
_running = RLock()  # held while a model file runs

_log = logging.getLogger("multidrop.families.registry")


def load_model_file(path: Path) -> ModuleType:
    """Return the module of a Python file. It is run once per process, so that its classes stay the same.

    Raises ValueError with file and line for any error in the file.
    """
    path = path.resolve()
    try:
        return _module(path)
    except _NotPython as mistake:
        raise ValueError(str(mistake)) from mistake
    except (Exception, SystemExit) as mistake:
        raise ValueError(f"{_place(mistake, path)}: {type(mistake).__name__}: {mistake}") from mistake


class _NotPython(Exception):
    """Raised if the name does not end in a Python file's suffix."""


def _module(path: Path) -> ModuleType:
    name = f"multidrop_models.{path.stem}_{abs(hash(path)):x}"
    with _running:
        # the module is loaded, or is being loaded because two files import each other
        if name in sys.modules:
            return sys.modules[name]
        spec = importlib.util.spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise _NotPython(f"{path} cannot be loaded as Python: its name must end in .py")
        _log.info("%s is run as Python: a user's model is a program", path)
        module = importlib.util.module_from_spec(spec)
        vars(module)["__builtins__"] = {**vars(builtins), "__import__": _import_beside(path.parent)}
        sys.modules[name] = module  # dataclasses look up the module by its name
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
        return module


def _import_beside(directory: Path) -> Callable[..., object]:
    """Return a replacement for `__import__` that searches this directory first."""

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
    """Return the module if the program has already imported it from this file, else None."""
    module = sys.modules.get(name)
    file = getattr(module, "__file__", None)
    return module if file and Path(file).exists() and path.samefile(file) else None


def _place(mistake: BaseException, path: Path) -> str:
    """Return the file and, if known, the line in which an error was raised.

    The file is `path`, or a file in its directory that it imports.
    """
    if isinstance(mistake, SyntaxError):
        return str(path)  # the message already has file and line
    frames = [
        frame
        for frame in traceback.extract_tb(mistake.__traceback__)
        if Path(frame.filename).parent == path.parent
    ]
    return f"{frames[-1].filename}, line {frames[-1].lineno}" if frames else str(path)
