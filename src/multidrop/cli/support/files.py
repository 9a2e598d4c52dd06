"""A recording is never put in the place of another file, which may hold months of data."""

from __future__ import annotations

from pathlib import Path

from multidrop.recording.append_file import already_there, new_file


def refuse_overwriting(path: Path) -> None:
    """Raise ValueError when there is a file at this path."""
    if path.is_file():
        raise already_there(path)


def check_writable(path: Path) -> None:
    """Raise ValueError or OSError when no new file can be written there, which only trying tells."""
    refuse_overwriting(path)
    if path.exists() and not path.is_dir():  # a device or a pipe
        return
    new_file(path).close()
    path.unlink()


def check_capture(path: Path) -> None:
    """Raise ValueError when no capture can be written there."""
    if path.suffix != ".pcapng":
        raise ValueError(f"{path}: a capture's name ends in .pcapng")
    refuse_overwriting(path)
