"""Files that commands create, and checks for optional libraries. No command replaces a file."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from multidrop.printable import install_command
from multidrop.recording.format import AppendFile, already_there, new_file, writing


def refuse_overwriting(path: Path) -> None:
    if path.is_file():
        raise already_there(path)


def check_writable(path: Path) -> None:
    """Raise ValueError or OSError if no new file can be written at this path.

    The check creates a file and removes it.
    """
    refuse_overwriting(path)
    # a command writes to an existing device or pipe, and creates nothing
    if path.exists() and not path.is_dir():
        return
    new_file(path).close()
    path.unlink()


def write_new(path: Path, content: str | bytes) -> None:
    """Write a new file completely, or leave none.

    Raises ValueError if the file exists, OSError if it cannot be written completely, as on a full disk.
    """
    with writing(path):
        file = AppendFile(path)
        try:
            file.append(content.encode() if isinstance(content, str) else content)
        except BaseException:
            if path.is_file():  # only a file is removed, not a device
                path.unlink()
            raise
        finally:
            file.close()


def check_capture(path: Path) -> None:
    if path.suffix != ".pcapng":
        raise ValueError(f"{path}: a capture's name must end in .pcapng")
    refuse_overwriting(path)


def require_extra(library: str, extra: str, command: str) -> None:
    """Raise ValueError if the library is missing; the message says how to install it."""
    if importlib.util.find_spec(library) is None:
        raise ValueError(
            f"`multidrop {command}` needs {library}, which is not installed: {install_command(extra)}"
        )
