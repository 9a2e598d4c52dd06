"""The pip command that installs the optional libraries of one or more extras."""

from __future__ import annotations

import shlex


def install_command(*extras: str) -> str:
    """Return the pip command for the libraries of these extras.

    The command names each library, because pip finds `multidrop[extra]` only in the directory of the sources.
    The names of the extras follow as a shell comment.
    """
    # imported here, because most programs never need it
    from importlib.metadata import PackageNotFoundError, requires

    try:
        found = [one.partition(";") for one in requires("multidrop") or ()]
    except PackageNotFoundError:
        found = []
    markers = [f'extra == "{extra}"' for extra in extras]
    wanted = [
        name.strip()
        for name, _, given in found
        if any(marker in given.replace("'", '"') for marker in markers)
    ]
    named = f"multidrop[{','.join(extras)}]"
    return f"pip install {shlex.join(wanted)}  # {named}" if wanted else f"pip install '{named}'"
