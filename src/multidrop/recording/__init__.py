"""Recordings: batches on disk, in a format that the file's suffix chooses.

| suffix     | format                            | after a crash              |
|------------|-----------------------------------|----------------------------|
| `.arrows`  | Arrow IPC stream                  | every whole batch is there |
| `.csv`     | text; metadata in `NAME.csv.json` | every whole line is there  |
| `.parquet` | Parquet, needs pyarrow            | the file cannot be read    |

The last column describes a crash of the writing process. Once `write` has returned, the operating system has
the whole batch, and only a power cut in the next seconds loses it. The file's head is written first; without
it, the file cannot be read.

All three have the same columns, and one row for every sample or miss:

| column           | type               | meaning                                                    |
|------------------|--------------------|------------------------------------------------------------|
| `time`           | timestamp[ns, UTC] | the request was sent; text: `2026-11-21T09:30:00.123456789Z` |
| `monotonic_ns`   | int64              | the same on CLOCK_MONOTONIC, which never steps             |
| `uncertainty_ns` | int64, or null     | the value was taken between time and time + uncertainty_ns |
| `drive`          | utf8               | the drive's name                                           |
| `register`       | utf8               | the register's name                                        |
| `value`          | float64, or null   | in the register's unit                                     |
| `status`         | utf8               | `ok`, or the reason for a miss: the two others are null    |

In .csv a text that a spreadsheet would evaluate as a formula, because it starts with `=`, `+`, `-`, `@`, a
tab or a line end, gets an apostrophe in front; so does a text that starts with apostrophes followed by one of
these characters. The reader removes one apostrophe.

In the file, .arrows has `drive`, `register` and `status` as dictionaries of utf8 with unsigned codes of 16,
16 and 8 bits, and `uncertainty_ns` as a float32 that is rounded up: exact up to 2^24 ns, above that at most
1.2e-7 more. A row takes 33 bytes. The reader here returns all columns in the types above. Files of earlier
versions have these types.

The metadata is one JSON object: under the key `multidrop` of the schema's metadata (.arrows, .parquet) or
in the file NAME.csv.json. `multidrop poll` writes `plant`, the plant file; `planned`, the prediction for
each line by name (multidrop.planning.prediction); and `drives`: by name each drive's line, model, address,
settings and framing, and `registers`, by name each register's unit and step.

pyarrow.ipc.open_stream and polars.read_ipc_stream open .arrows. They refuse a recording with a truncated end
until `repair` has removed that end. The reader here needs neither library, and skips a truncated end.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any

from multidrop.recording.format import Metadata as Metadata
from multidrop.recording.format import RecordingError as RecordingError
from multidrop.recording.format import RecordingReader as RecordingReader
from multidrop.recording.format import RecordingWriter as RecordingWriter
from multidrop.recording.segments import FileLock as FileLock
from multidrop.recording.segments import SegmentWriter as SegmentWriter
from multidrop.recording.segments import parse_age as parse_age
from multidrop.recording.segments import parse_size as parse_size

FORMATS = {".arrows": "arrows", ".csv": "csv", ".parquet": "parquet"}  # by suffix: the format's module


def open_writer(
    path: str | os.PathLike[str], metadata: Metadata, *, overwrite: bool = False
) -> RecordingWriter:
    """Create a recording, and return its writer. With `overwrite`, replace an existing recording at `path`.

    Raises FileExistsError if there is a file at `path`, ValueError for another suffix, TypeError for
    metadata that JSON cannot hold, and RecordingError if the file cannot be written.
    """
    place = Path(path)
    module = _format(place)
    if overwrite:
        for old in (place, place.with_name(f"{place.name}.json")):
            if old.is_file():
                old.unlink()
    writer: RecordingWriter = module.writer(place, metadata)
    return writer


def open_recording(path: str | os.PathLike[str]) -> RecordingReader:
    """Return a reader of a recording, also while it is written: `open_recording("run.arrows").to_pandas()`.

    Iterating over the reader yields batches. Raises ValueError for a file that is not a recording, TypeError
    if `path` is not a path, and OSError.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"open_recording takes a file such as 'run.arrows', not {path!r}")
    reader: RecordingReader = _format(Path(path)).reader(Path(path))
    return reader


def convert(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> int:
    """Write all rows and metadata of the recording `source` to `target`; return the number of rows.

    Needs memory for a few batches only. Raises the errors of open_recording and open_writer; after an error
    there is no file at `target`.
    """
    _format(Path(target))
    reader = open_recording(source)
    if Path(target).exists() and Path(source).samefile(target):
        raise ValueError(f"{source} cannot be converted into itself: name another file")
    writer = open_writer(target, reader.metadata)
    try:
        with writer:
            for batch in reader:
                writer.write(batch)
    except BaseException:  # Ctrl-C as well: an incomplete recording would look complete
        writer.discard()
        raise
    return writer.rows


def repair(path: str | os.PathLike[str]) -> int:
    """Cut the truncated end off a finished recording; return the number of bytes cut."""
    truncated = open_recording(path).truncated
    if truncated:
        os.truncate(path, Path(path).stat().st_size - truncated)
    return truncated


def _format(path: Path) -> Any:
    """Return the module for the path's suffix; it has a `writer` and a `reader`."""
    module = FORMATS.get(path.suffix.lower())
    if not module:
        raise ValueError(f"{path}: a recording's name must end in {', '.join(FORMATS)}")
    return importlib.import_module(f"multidrop.recording.{module}")
