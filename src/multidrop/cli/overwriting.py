"""A recording is never put in the place of another file, which may hold months of data."""

from __future__ import annotations

from pathlib import Path

from multidrop.recording.whole import already_there


def refuse_overwriting(path: Path) -> None:
    """Raise ValueError when there is a file at this path."""
    if path.is_file():
        raise already_there(path)


def check_capture(path: Path) -> None:
    """Raise ValueError when no capture can be written there."""
    if path.suffix != ".pcapng":
        raise ValueError(f"{path}: a capture's name ends in .pcapng")
    refuse_overwriting(path)
