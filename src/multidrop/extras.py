"""Optional libraries: the command that installs those of an extra."""

from __future__ import annotations

import shlex


def install_command(extra: str) -> str:
    """Return the pip command for an extra's libraries.

    It names the libraries, because `multidrop[extra]` is found only beside the sources. The extra follows as
    the shell's comment.
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
