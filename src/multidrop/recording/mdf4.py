"""Export recordings as ASAM MDF 4.10 (.mf4), for the tools of test benches; needs asammdf."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from asammdf import MDF, Signal
from asammdf.blocks.conversion_utils import from_dict
from asammdf.blocks.v4_blocks import EventBlock
from asammdf.blocks.v4_constants import EVENT_TYPE_MARKER, EVENT_TYPE_TRIGGER, FLAG_HD_TIME_OFFSET_VALID

from multidrop.polling.added_rows import TRIGGER
from multidrop.printable import printable
from multidrop.recording.format import Metadata, dump_metadata, new_file, writing
from multidrop.recording.series import Array, Event, ExportedRows, SeriesWriter, unit_of_register

STATUS = 2  # position of the channel "status" in each channel group
UNNAMED = "unnamed"  # text for a number without a name, such as a fault code that the manual does not list


class Mdf4Writer(SeriesWriter):
    """Writes a channel group for each register: its time, value, status and uncertainty.

    If the computer's clock was set back, a register may have several groups.

    Until `close`, asammdf keeps the rows in a temporary file beside `path`.
    """

    def __init__(self, path: Path, metadata: Metadata) -> None:
        super().__init__(path, metadata)
        described = dump_metadata(metadata)
        self._mdf: Any = None
        # for each register: its newest channel group, and the time of that group's last row, in ns UTC
        self._groups: dict[tuple[str, str], tuple[int, int]] = {}
        with writing(path):
            new_file(path).close()
            self._open(partial(self._begin, metadata, described))

    def _begin(self, metadata: Metadata, described: str) -> None:
        self._mdf = MDF(version="4.10", temporary_folder=str(self.path.absolute().parent))
        self._mdf.attach(described.encode(), file_name="metadata.json", mime="application/json")
        header = self._mdf.header
        header.comment = printable(f"multidrop {metadata.get('multidrop', '')}: {metadata.get('plant', '')}")
        header.tz_offset = header.daylight_save_time = 0
        header.time_flags = FLAG_HD_TIME_OFFSET_VALID  # the start time is in UTC

    def _append(self, rows: ExportedRows, drive: Mapping[str, Any]) -> None:
        missed = np.isnan(rows.value)
        time = self._seconds(rows.time)
        status = rows.status.astype(np.uint16)
        uncertainty = rows.uncertainty_ns / 1e9
        group, last_ns = self._groups.get(rows[:2], (None, 0))
        # The time in a group must not decrease, so after a clock was set back, the rows have a new group.
        if group is not None and rows.time[0] >= last_ns:
            self._groups[rows[:2]] = group, int(rows.time[-1])
            channels = (time, None), (rows.value, missed), (status, None), (uncertainty, missed)
            self._mdf.extend(group, channels)
            return
        about = drive.get("registers", {}).get(rows.register, {})
        name, values = f"{rows.drive}.{rows.register}", about.get("values") or {}
        is_named = bool(values) and about.get("bits") is not True
        signals = [
            Signal(
                rows.value,
                time,
                name=name,
                unit=unit_of_register(about),
                conversion=_names({number: text for text, number in values.items()}) if is_named else None,
                comment=json.dumps(about, ensure_ascii=False),
                invalidation_bits=missed,
            ),
            Signal(status, time, name=f"{name}.status"),
            Signal(uncertainty, time, name=f"{name}.uncertainty", unit="s", invalidation_bits=missed),
        ]
        about_drive = f"{drive.get('model', '')}, line {drive.get('line', '')}"
        made = self._mdf.append(
            signals, acq_name=rows.drive, comment=printable(about_drive), common_timebase=True
        )
        self._groups[rows[:2]] = made, int(rows.time[-1])

    def _seconds(self, time: Array) -> Array:
        return np.asarray((time - self.begin_ns) / 1e9)

    def _add_event(self, event: Event) -> None:
        is_trigger = event.kind == TRIGGER
        block = EventBlock(
            event_type=EVENT_TYPE_TRIGGER if is_trigger else EVENT_TYPE_MARKER,
            flags=0,
            sync_base=event.time - (self.begin_ns or 0),
            sync_factor=1e-9,
        )
        block.name, block.comment = event.kind, event.text
        self._mdf.events.append(block)

    def _finish(self) -> None:
        self._mdf.header.abs_time = self.begin_ns or 0
        names = _names(dict(enumerate(self.statuses)))
        for group in self._mdf.groups:
            group.channels[STATUS].conversion = names
        with self.path.open("wb+") as file:
            self._mdf.save(file)

    def _release(self) -> None:
        if self._mdf is not None:
            self._mdf.close()


def _names(texts: Mapping[int, str]) -> Any:
    """Return the asammdf conversion from numbers to these texts; other numbers become UNNAMED."""
    table: dict[str, Any] = {}
    for at, (number, text) in enumerate(texts.items()):
        table |= {f"val_{at}": number, f"text_{at}": text}
    return from_dict(table | {"default_addr": UNNAMED})


writer = Mdf4Writer
