"""Libraries that the package's optional extras install."""

from __future__ import annotations

import importlib.util


def require_extra(library: str, extra: str, command: str) -> None:
    """Raise ValueError, with what to install, when the library is missing."""
    if importlib.util.find_spec(library) is None:
        raise ValueError(
            f"`multidrop {command}` needs {library}, which is not installed: pip install 'multidrop[{extra}]'"
        )
