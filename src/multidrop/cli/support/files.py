"""Files that commands read or create, and checks for optional libraries. No command replaces a file."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

from multidrop.cli.support.output import warn
from multidrop.cli.support.values import counted
from multidrop.printable import install_command
from multidrop.recording.format import AppendFile, already_there, new_file, writing
from multidrop.recording.segments import segments_of

if TYPE_CHECKING:
    from multidrop.report.load import Recording


def refuse_overwriting(path: Path) -> None:
    if path.is_file():
        raise already_there(path)


def check_writable(path: Path) -> None:
    """Raise ValueError or OSError if no new file can be written at this path.

    The check creates a file and removes it.
    """
    refuse_overwriting(path)
    if path.exists() and not path.is_dir():  # a device or a pipe is not created
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
            if path.is_file():  # a device must not be removed
                path.unlink()
            raise
        finally:
            file.close()


def check_capture(path: Path) -> None:
    if path.suffix != ".pcapng":
        raise ValueError(f"{path}: a capture's name must end in .pcapng")
    refuse_overwriting(path)


def warn_truncated(path: Path, rows: int, left_out: int) -> None:
    """Warn that a recording ends with `left_out` bytes of an incomplete row, after `rows` complete rows."""
    if left_out:
        warn(
            f"{path} ends within a row: {counted(rows, 'row')} read, "
            f"and the last {counted(left_out, 'byte')} skipped"
        )


def check_no_segments(path: Path) -> None:
    """Raise ValueError if the path is a folder, or names a recording that was split into segments."""
    if path.is_dir():
        kept = [*sorted(path.glob("rows/*.parquet")), *sorted(path.glob("rows.*.arrows"))]
        if not kept:
            raise _is_folder(path)
        raise ValueError(
            f"{path} is the folder of a history: name one of its files, such as {kept[-1]}, or read it from "
            "Python with `multidrop.History`"
        )
    if not path.exists() and path.parent.is_dir() and (segments := segments_of(path)):
        raise ValueError(f"{path} was recorded in segments: name one, such as {segments[-1][1]}")


def _is_folder(path: Path) -> ValueError:
    return ValueError(f"{path} is a folder: name the recording in it")


def beside(recording: Path, suffix: str) -> Path:
    """Return a recording's path with another suffix. Raises ValueError if the path does not name a file."""
    if not recording.name:
        raise _is_folder(recording)
    return recording.with_suffix(suffix)


def load_recording(path: Path, out: Path, command: str) -> Recording:
    """Load a recording for a command that draws it into the new file `out`.

    Raises ValueError if `out` exists, or if `path` is a folder or names segments.
    """
    require_extra("matplotlib", "plot", command)
    refuse_overwriting(out)
    check_no_segments(path)
    from multidrop.report import load

    recording = load(path)
    warn_truncated(recording.path, recording.rows, recording.truncated)
    return recording


def require_extra(library: str, extra: str, command: str) -> None:
    """Raise ValueError if the library is missing. Its message has the command that installs the extra."""
    if importlib.util.find_spec(library) is None:
        raise ValueError(
            f"`multidrop {command}` needs {library}, which is not installed: {install_command(extra)}"
        )
