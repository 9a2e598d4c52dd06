"""Find a family by the name that a person writes: built-in, shipped as a file, or in a file of their own.

The shipped ones are TOML files of this package, which nobody has tried on hardware. A TOML file is data. A
Python file is a program: looking its class up runs it, with all rights of the caller. It may import modules
that lie beside it. Each of these is logged to `multidrop.families.registry` before it is run.
"""

from __future__ import annotations

import difflib
from pathlib import Path
from types import ModuleType

from multidrop.drive import Drive
from multidrop.families import MODELS
from multidrop.families.model_file import load_model_file

_SHIPPED = Path(__file__).parent / "shipped"
SHIPPED = tuple(sorted(path.stem for path in _SHIPPED.glob("*.toml")))  # each is read when it is asked for


def shipped_family(name: str) -> type[Drive]:
    """Return the family of SHIPPED that has this name; it is called so, and not by its file."""
    family = _family_of(_SHIPPED / f"{name}.toml")
    family.model = family.declared_in = name
    return family


def find_model(text: str, relative_to: Path | None = None) -> type[Drive]:
    """Return the family called `text`: one of MODELS or SHIPPED, "path/to/file.toml", or "file.py:Class".

    A relative path begins at `relative_to`, or at the working directory. A Python file is run, once a
    process. Raises ValueError, also for whatever the file itself does wrong.
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
        known = (*MODELS, *SHIPPED)
        near = difflib.get_close_matches(text.lower(), known, n=2)
        hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(known)}"
        raise ValueError(f"there is no model {text!r}; {hint} (or write path/to/file.toml or file.py:Class)")
    return _drive(_load((relative_to or Path()) / path), path, name if colon else "")


def is_users_own(family: type[Drive]) -> bool:
    """Return True for a family that is not of this package, and derives from none that is."""
    return family.model not in SHIPPED and not any(base in MODELS.values() for base in family.__mro__)


def _family_of(path: Path) -> type[Drive]:
    from multidrop.families.files.loader import load_family  # a tenth of what a command imports

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
    return load_model_file(path)
