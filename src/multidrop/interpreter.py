"""Check that this is the main interpreter of its process; sub-interpreters are not supported."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_MODULES = ("_interpreters", "_xxsubinterpreters")  # the module's names: since Python 3.13, and before


def refuse_other_interpreters() -> None:
    """Raise ImportError in a sub-interpreter.

    The compiled module keeps its engine, types and callbacks for the whole process. After a sub-interpreter
    ended, its callbacks would still be called.
    """
    for name in _MODULES:
        try:
            interpreters: Any = import_module(name)
        except ImportError:
            continue
        if interpreters.get_current() != interpreters.get_main():
            raise ImportError(
                "multidrop works in a process's main interpreter only, and this is a sub-interpreter: "
                "use it there, or in a process of its own"
            )
        return
