"""Recordings: batches on disk, in a format that the file's suffix chooses.

| suffix     | format                            | after a crash              |
|------------|-----------------------------------|----------------------------|
| `.arrows`  | Arrow IPC stream                  | every whole batch is there |
| `.csv`     | text; metadata in `NAME.csv.json` | every whole line is there  |
| `.parquet` | Parquet, needs pyarrow            | the file cannot be read    |

The last column describes the file after the writing process has crashed. Once `write` has returned, the
operating system has the whole batch, and only a power cut in the next seconds can lose it. The file's head is
written first; if it is incomplete, the file cannot be read.

`convert` also exports recordings, for other systems: `.mf4` (ASAM MDF 4.10, needs asammdf) and `.h5` (HDF5,
needs h5py).

The recordings of all three formats have the same columns, and one row for every sample or missed value:

| column           | type               | meaning                                                    |
|------------------|--------------------|------------------------------------------------------------|
| `time`           | timestamp[ns, UTC] | the request was sent; text: `2026-11-21T09:30:00.123456789Z` |
| `monotonic_ns`   | int64              | the same on CLOCK_MONOTONIC, which never steps             |
| `uncertainty_ns` | int64, or null     | the value was taken between time and time + uncertainty_ns |
| `drive`          | utf8               | the drive's name                                           |
| `register`       | utf8               | the register's name                                        |
| `value`          | float64, or null   | in the register's unit                                     |
| `status`         | utf8               | `ok`, or why there is no value and no uncertainty          |

A spreadsheet would evaluate a text as a formula if it starts with `=`, `+`, `-`, `@`, a tab or a line end. In
.csv, such a text gets an apostrophe in front. So does a text that starts with apostrophes followed by one of
these characters. The reader removes one apostrophe.

An .arrows file stores `drive`, `register` and `status` as dictionaries of utf8, with unsigned codes of 16, 16
and 8 bits. It stores `uncertainty_ns` as a float32 that is rounded up: exact up to 2^24 ns, and above that
too large by at most 1.2e-7 of the value. A row takes 33 bytes. The reader here returns all columns in the
types of the table, which are also the types in files of earlier versions.

The metadata is one JSON object: under the key `multidrop` of the schema's metadata (.arrows, .parquet) or
in the file NAME.csv.json. `multidrop poll` writes these keys:

- `plant`: the plant file.
- `planned`: the prediction for each line, by name (multidrop.planning.prediction).
- `drives`: each drive's line, model, address, settings and framing, by name; and in `registers` the unit and
  step of each of its registers, by name.

pyarrow.ipc.open_stream and polars.read_ipc_stream open .arrows. Both refuse a recording with a truncated end
until `repair` has removed that end. The reader here needs neither library, and skips a truncated end.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from multidrop.printable import install_command
from multidrop.recording.format import Metadata as Metadata
from multidrop.recording.format import RecordingError as RecordingError
from multidrop.recording.format import RecordingReader as RecordingReader
from multidrop.recording.format import RecordingWriter as RecordingWriter
from multidrop.recording.segments import FileLock as FileLock
from multidrop.recording.segments import SegmentWriter as SegmentWriter
from multidrop.recording.segments import parse_age as parse_age
from multidrop.recording.segments import parse_size as parse_size

# Formats that only `convert` writes. For each suffix: the module, the library it needs, and the extra that
# installs this library.
EXPORTS = {".mf4": ("mdf4", "asammdf", "mdf"), ".h5": ("hdf5", "h5py", "hdf5")}
FORMATS = {".arrows": "arrows", ".csv": "csv", ".parquet": "parquet"}  # each format's module, by suffix


def open_writer(
    path: str | os.PathLike[str], metadata: Metadata, *, overwrite: bool = False
) -> RecordingWriter:
    """Create a recording, and return its writer. With `overwrite`, replace an existing recording at `path`.

    Raises FileExistsError if there is a file at `path`, ValueError if the suffix is not .arrows, .csv or
    .parquet, TypeError for metadata that JSON cannot hold, and RecordingError if the file cannot be written.
    """
    if not isinstance(metadata, Mapping):
        raise TypeError(f"open_writer takes metadata as a dict, such as plant.metadata(), not {metadata!r}")
    place = Path(path)
    module = _format(place)
    if overwrite:
        for old in (place, place.with_name(f"{place.name}.json")):
            if old.is_file():
                old.unlink()
    writer: RecordingWriter = module.writer(place, metadata)
    return writer


def open_recording(path: str | os.PathLike[str]) -> RecordingReader:
    """Return a reader of a recording, which may still be growing: `open_recording("run.arrows").to_pandas()`.

    Iterating over the reader yields batches. Raises ValueError for a file that is not a recording, TypeError
    if `path` is not a path, and OSError.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"open_recording takes a file such as 'run.arrows', not {path!r}")
    reader: RecordingReader = _format(Path(path)).reader(Path(path))
    return reader


def convert(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> int:
    """Write all rows and metadata of the recording `source` to `target`; return the number of rows.

    The suffix of `target` is one of FORMATS, or of EXPORTS for other systems. Only a few batches are in
    memory at a time; an export needs about 200 MB. Raises the errors of open_recording and open_writer; after
    an error there is no file at `target`.
    """
    module = _export(Path(target))
    reader = open_recording(source)
    if Path(target).exists() and Path(source).samefile(target):
        raise ValueError(f"{source} cannot be converted into itself: name another file")
    writer: RecordingWriter = module.writer(Path(target), reader.metadata)
    try:
        with writer:
            for batch in reader:
                writer.write(batch)
    except BaseException:  # also after Ctrl-C, because an incomplete recording would look complete
        writer.discard()
        raise
    return writer.rows


def repair(path: str | os.PathLike[str]) -> int:
    """Remove the truncated end of a finished recording; return the number of bytes removed."""
    truncated = open_recording(path).truncated
    if truncated:
        os.truncate(path, Path(path).stat().st_size - truncated)
    return truncated


def _export(path: Path) -> Any:
    """Return the module that writes an export or a recording at this path.

    Raises RecordingError if its library is missing.
    """
    suffix = path.suffix.lower()
    if suffix not in EXPORTS:
        return _format(path, EXPORTS)
    module, library, extra = EXPORTS[suffix]
    try:
        return importlib.import_module(f"multidrop.recording.{module}")
    except ImportError as failure:
        raise RecordingError(path, f"{suffix} needs {library}: {install_command(extra)}") from failure


def _format(path: Path, others: Iterable[str] = ()) -> Any:
    """Return the module for the path's suffix; its `writer` and `reader` are the format's classes.

    An error lists the suffixes in `others` too.
    """
    module = FORMATS.get(path.suffix.lower())
    if not module:
        raise ValueError(f"{path}: a recording's name must end in {', '.join([*FORMATS, *others])}")
    return importlib.import_module(f"multidrop.recording.{module}")
