"""Recordings: batches on disk, in a format that the file's suffix chooses.

| suffix     | format                            | after a crash              |
|------------|-----------------------------------|----------------------------|
| `.arrows`  | Arrow IPC stream                  | every whole batch is there |
| `.csv`     | text; metadata in `NAME.csv.json` | every whole line is there  |
| `.parquet` | Parquet, needs pyarrow            | nothing can be read        |

A crash is the process's: all of a batch whose `write` has returned is with the system, which has it
on the disk within seconds; only a power cut in between takes it away. A file that was begun and not
yet given its head is no recording.

All three have the same columns, and one row for every sample or miss:

| column           | type               | meaning                                                    |
|------------------|--------------------|------------------------------------------------------------|
| `time`           | timestamp[ns, UTC] | the request was sent; text: `2026-11-21T09:30:00.123456789Z` |
| `monotonic_ns`   | int64              | the same on CLOCK_MONOTONIC, which never steps             |
| `uncertainty_ns` | int64, or null     | the value was taken between time and time + uncertainty_ns |
| `drive`          | utf8               | the drive's name                                           |
| `register`       | utf8               | the register's name                                        |
| `value`          | float64, or null   | in the register's unit                                     |
| `status`         | utf8               | `ok`, or why there is no value: both others are then null  |

In .csv a text that a spreadsheet would take for a formula, because it begins with `=`, `+`, `-`, `@`, a tab
or the end of a line, has an apostrophe in front; so has one that begins with apostrophes and then one of
these. The reader here takes one off.

The metadata is one JSON object. It lies in the schema's metadata under the key `multidrop` (.arrows,
.parquet) or in the file beside (.csv). `multidrop poll` puts into it `plant`, the plant file; `planned`,
for each line's name what it should reach (multidrop.planning.prediction says how); and `drives`: for each
drive's name its line, model, address, settings and framing, and `registers`, for each register's
name its unit and step.

pyarrow.ipc.open_stream and polars.read_ipc_stream open .arrows; a recording whose end is torn they
refuse until `repair` has cut the torn end off. The reader here needs neither, and leaves it out.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any

from multidrop.recording.format import Metadata, RecordingError, RecordingReader, RecordingWriter

__all__ = ["FORMATS", "Metadata", "RecordingError", "RecordingReader", "RecordingWriter"]
__all__ += ["convert", "open_reader", "open_writer", "repair"]

FORMATS = {".arrows": "arrows", ".csv": "csv", ".parquet": "parquet"}  # suffix: module


def open_writer(path: str | os.PathLike[str], metadata: Metadata) -> RecordingWriter:
    """Begin a recording in a new file; what is in another one is never lost.

    Raises ValueError for another suffix or when there is a file at `path`, TypeError for metadata that
    JSON cannot hold, and RecordingError when the file cannot be written.
    """
    writer: RecordingWriter = _format(Path(path)).writer(Path(path), metadata)
    return writer


def open_reader(path: str | os.PathLike[str]) -> RecordingReader:
    """Open a recording, finished or not. Raises ValueError for what is not one, and OSError."""
    reader: RecordingReader = _format(Path(path)).reader(Path(path))
    return reader


def convert(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> int:
    """Write the recording `source` anew as `target`, with all rows and metadata; the number of rows.

    Needs memory for a few batches only. Raises as open_reader and open_writer do, and leaves no target
    then.
    """
    _format(Path(target))
    reader = open_reader(source)
    if Path(target).exists() and Path(source).samefile(target):
        raise ValueError(f"{source} cannot be converted into itself: name another file")
    writer = open_writer(target, reader.metadata)
    try:
        with writer:
            for batch in reader:
                writer.write(batch)
    except BaseException:  # Ctrl-C as well: half a recording would pass for the whole one
        writer.discard()
        raise
    return writer.rows


def repair(path: str | os.PathLike[str]) -> int:
    """Cut the torn end off a recording that nobody is writing; how many bytes that were."""
    torn = open_reader(path).torn
    if torn:
        os.truncate(path, Path(path).stat().st_size - torn)
    return torn


def _format(path: Path) -> Any:
    """The module that has a `writer` and a `reader`."""
    module = FORMATS.get(path.suffix.lower())
    if not module:
        raise ValueError(f"{path}: a recording's name ends in {', '.join(FORMATS)}")
    return importlib.import_module(f"multidrop.recording.{module}")
