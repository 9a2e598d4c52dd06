"""Export recordings as HDF5 (.h5), for MATLAB, LabVIEW and Python; needs h5py."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from multidrop.recording.format import Metadata, already_there, dump_metadata, writing
from multidrop.recording.series import Event, ExportedRows, SeriesWriter, unit_of_register

CHUNK_ROWS = 4096  # rows of a dataset that are compressed together
# h5py's arguments for a dataset that can grow
STORED: dict[str, Any] = {
    **{"shape": (0,), "maxshape": (None,), "chunks": (CHUNK_ROWS,)},
    **{"compression": "gzip", "compression_opts": 4, "shuffle": True},
}


class GuardedFile(FileIO):
    """A new file that hides failed writes from HDF5, because HDF5 would crash the process.

    `raise_failure` raises the first failure of a write.
    """

    _failure: OSError | None = None

    def write(self, piece: Any, /) -> int:
        left = memoryview(piece).cast("B")
        size = len(left)
        try:
            while left and not self._failure:
                left = left[super().write(left) :]
        except OSError as failure:
            self._failure = failure
        return size

    def truncate(self, size: int | None = None, /) -> int:
        try:
            return super().truncate(size)
        except OSError as failure:
            self._failure = self._failure or failure
            return size or 0

    def raise_failure(self) -> None:
        if self._failure:
            raise self._failure


class Hdf5Writer(SeriesWriter):
    """Writes a group of datasets for each register; a dataset is one column."""

    def __init__(self, path: Path, metadata: Metadata) -> None:
        super().__init__(path, metadata)
        described = dump_metadata(metadata)
        self._file: Any = None
        self._groups: dict[tuple[str, str], Any] = {}
        self._names: dict[str, str] = {}  # for each group's path: the name of its drive or register
        self._events: list[Event] = []
        with writing(path):
            try:
                self._raw = GuardedFile(path, "x+b")
            except FileExistsError:
                raise already_there(path) from None
            self._open(partial(self._begin, described))

    def _begin(self, described: str) -> None:
        self._file = h5py.File(self._raw, "w")
        self._file["metadata"] = described

    def _append(self, rows: ExportedRows, drive: Mapping[str, Any]) -> None:
        group = self._groups.get(rows[:2])
        columns = {
            "time_ns": rows.time,
            "monotonic_ns": rows.monotonic_ns,
            "uncertainty_ns": rows.uncertainty_ns,
            "value": rows.value,
            "valid": ~np.isnan(rows.value),
            "status": rows.status.astype(np.uint16),
        }
        if group is None:
            group = self._groups[rows[:2]] = self._new_group(rows, drive)
            for name, column in columns.items():
                group.create_dataset(name, dtype=column.dtype, **STORED)
        for name, column in columns.items():
            dataset = group[name]  # opened again for each piece, because an open dataset keeps a buffer
            before = len(dataset)
            dataset.resize(before + len(column), axis=0)
            dataset[before:] = column
        self._raw.raise_failure()

    def _new_group(self, rows: ExportedRows, drive: Mapping[str, Any]) -> Any:
        about = drive.get("registers", {}).get(rows.register, {})
        group = self._file.create_group(self._path(self._path("drives", rows.drive), rows.register))
        group.attrs["drive"], group.attrs["register"] = rows.drive, rows.register
        group.attrs["unit"] = unit_of_register(about)
        if about.get("values"):
            group.attrs["values"] = json.dumps(about["values"], ensure_ascii=False)
        return group

    def _path(self, parent: str, name: str) -> str:
        """Return the path of the group in `parent` that belongs to this drive or register."""
        path = f"{parent}/{_key(name)}"
        while self._names.setdefault(path, name) != name:  # the path is taken by another name
            path += "_"
        return path

    def _add_event(self, event: Event) -> None:
        self._events.append(event)

    def _finish(self) -> None:
        self._file["statuses"] = np.array(self.statuses, dtype=h5py.string_dtype())
        if self._events:
            events = self._file.create_group("events")
            times, *texts = zip(*sorted(self._events), strict=True)
            events["time_ns"] = np.array(times, np.int64)
            for name, column in zip(("kind", "text"), texts, strict=True):
                events[name] = np.array(column, dtype=h5py.string_dtype())

    def _release(self) -> None:
        if self._file is not None:
            self._file.close()
        self._raw.close()
        self._raw.raise_failure()


def _key(name: str) -> str:
    """Return a valid group name for this name: not "", "." or "..", and without a slash."""
    key = name.replace("/", "\N{DIVISION SLASH}")
    return f" {key}" if key in ("", ".", "..") else key


writer = Hdf5Writer
