"""multidrop: poll every drive on an RS-485 line as fast as the wire allows."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def _refuse_sub_interpreters() -> None:
    """Raise ImportError in a sub-interpreter.

    The compiled module keeps its engine, types and callbacks for the whole process. After
    a sub-interpreter has ended, the engine would still call its callbacks.
    """
    # the module's name since Python 3.13, and its earlier name
    for name in ("_interpreters", "_xxsubinterpreters"):
        try:
            interpreters: Any = import_module(name)
        except ImportError:
            continue
        if interpreters.get_current() != interpreters.get_main():
            raise ImportError(
                "multidrop cannot be imported in a sub-interpreter. Import it in the process's main "
                "interpreter, or in another process"
            )
        return


_refuse_sub_interpreters()


def _homes(stub: str) -> dict[str, str]:
    """Return a map from each public name to the module that defines it, by the imports in the file `stub`.

    A module is imported when one of its names is first used, because importing all takes a fifth of a second.
    """
    with open(stub, encoding="utf-8") as lines:  # noqa: PTH123 (pathlib would take 4 ms more)
        imports = [line.split() for line in lines if line.startswith("from ")]
    return {name: module for _, module, _, name, *_ in imports}


_HOMES = _homes(f"{__file__}i")

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        found = import_module("importlib.metadata").version("multidrop")
    elif name in _HOMES:
        found = getattr(import_module(_HOMES[name]), name)
    else:
        raise AttributeError(f"module 'multidrop' has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
