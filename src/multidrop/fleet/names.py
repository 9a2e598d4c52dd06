"""Names that go into subjects, keys and file names."""

from __future__ import annotations

import re


def checked_name(kind: str, name: str) -> str:
    """Return the name. Raises ValueError for one that a subject cannot have."""
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise ValueError(
            f"the {kind}'s name {name!r} may have letters, digits, _ and - alone: write gateway-1"
        )
    return name
