"""`multidrop.read`: a recording as a table; in a script, the step that reads a register."""

from __future__ import annotations

import os
from typing import Any, TypeVar, overload

from multidrop.drive import Script
from multidrop.drive import read as read_step
from multidrop.drive.register import Register
from multidrop.drive.text import Text
from multidrop.recording import open_reader
from multidrop.recording.format import RecordingReader

T = TypeVar("T", bound=float)


@overload
def read(source: str | os.PathLike[str]) -> RecordingReader: ...
@overload
def read(source: Register[T]) -> Script[T]: ...
@overload
def read(source: Text) -> Script[str]: ...
def read(source: Any) -> Any:
    """Open a recording: `read("run.arrows").to_pandas()`, `.to_polars()`, `.wide()`, or batch after batch.

    It is `open_reader` under a short name. Given a register or a text it is the step of a script that reads
    it, as `multidrop.drive.read` is. Raises as `open_reader`, and TypeError for anything else.
    """
    if isinstance(source, (Register, Text)):
        return read_step(source)
    if not isinstance(source, (str, os.PathLike)):
        raise TypeError(
            f"read takes a recording such as 'run.arrows', or in a script a register: not {source!r}"
        )
    return open_reader(source)
