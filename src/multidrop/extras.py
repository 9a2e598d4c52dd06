"""Optional libraries: the command that installs those of an extra."""

from __future__ import annotations

import shlex


def install_command(extra: str) -> str:
    """Return the pip command for an extra's libraries.

    The command names each library, because pip finds `multidrop[extra]` only in the directory of the sources.
    The extra's name follows as a shell comment.
    """
    from importlib.metadata import PackageNotFoundError, requires  # most programs never need it

    try:
        found = [one.partition(";") for one in requires("multidrop") or ()]
    except PackageNotFoundError:
        found = []
    wanted = [name.strip() for name, _, marker in found if f'extra == "{extra}"' in marker.replace("'", '"')]
    if not wanted:
        return f"pip install 'multidrop[{extra}]'"
    return f"pip install {shlex.join(wanted)}  # multidrop[{extra}]"
