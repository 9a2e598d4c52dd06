"""What an extra brings: without it a command says in one sentence how to get it."""

from __future__ import annotations

import importlib.util


def need(library: str, extra: str, command: str) -> None:
    """Raise ValueError when the extra's library is not there."""
    if importlib.util.find_spec(library) is None:
        raise ValueError(
            f"`multidrop {command}` needs {library}, which is not installed: pip install 'multidrop[{extra}]'"
        )
