"""A recording whose end is missing is read as far as it goes; that it is not whole must be said."""

from __future__ import annotations

import sys
from pathlib import Path

from multidrop.cli.support.saying import say


def tell_torn(path: Path, rows: int, torn: int) -> None:
    """Say on stderr how much there was, where some bytes at its end were left out."""
    if torn:
        say(
            f"multidrop: the end of {path} is missing: {rows} rows were read, and its last {torn} bytes, "
            "which are no whole rows, were left out",
            file=sys.stderr,
        )
