"""A killed writer or a full disk loses only incomplete batches. Files that are not recordings are refused."""

from __future__ import annotations

import os
import random
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet
import pytest
from batches import DRIVES, METADATA, REGISTERS, SECOND, UTC_0, add_rows, block, completion, counting, example
from commands import BoundProcess
from interruptions import full_at, read_only_directory
from recordings import recorded, rows_of
from tables import examples, table, usually
from toy import Toy

from multidrop.core import Columns, Names
from multidrop.polling.batch import Batch, Row, schema
from multidrop.recording import (
    FORMATS,
    RecordingError,
    arrow_decoder,
    open_recording,
    open_writer,
    parquet,
    repair,
)
from multidrop.recording.format import AppendFile
from multidrop.recording.rows import from_rows

growing = pytest.mark.parametrize("suffix", [".arrows", ".csv"])
ROWS = 20  # per batch
SUPPORT = [str(folder) for folder in (Path(__file__).parents[1] / "support").iterdir()]


def record(path: Path, batches: int) -> list[int]:
    """Record batches of increasing numbers; return the file's length before and after each batch."""
    lengths = []
    with open_writer(path, METADATA) as writer:
        lengths.append(path.stat().st_size)
        for at in range(batches):
            writer.write(counting(ROWS, at * ROWS))
            lengths.append(path.stat().st_size)
    return lengths


@pytest.mark.long
def test_an_arrows_file_cut_at_any_byte_loses_only_the_incomplete_batch(tmp_path: Path) -> None:
    path = tmp_path / "a.arrows"
    lengths = record(path, 12)
    whole = path.read_bytes()
    expected = list(counting(12 * ROWS))
    cuts = random.Random(1).sample(range(lengths[0], len(whole) + 1), 200)
    for cut in {*cuts, *lengths}:
        path.write_bytes(whole[:cut])
        batches = sum(length <= cut for length in lengths) - 1
        reader = open_recording(path)
        assert reader.truncated == cut - lengths[batches]
        assert reader.metadata == METADATA
        assert [*chain.from_iterable(reader)] == expected[: batches * ROWS]


@pytest.mark.long
def test_a_file_cut_between_a_dictionary_and_its_batch_is_readable(tmp_path: Path) -> None:
    """Dictionaries precede their batch, so a cut may leave some dictionaries without a batch."""
    polars = pytest.importorskip("polars", reason="needs polars")
    path = tmp_path / "a.arrows"
    lengths, names = [], Names(["pump-0"])
    with open_writer(path, METADATA) as writer:
        lengths.append(path.stat().st_size)
        for batch in range(4):
            columns = Columns(1)
            assert add_rows(columns, block(batch, 0), completion(1, first_ns=2, words=(batch,)), 0)
            writer.write(Batch(columns, names, names))
            lengths.append(path.stat().st_size)
            names.number(f"pump-{batch + 1}")
    whole = path.read_bytes()
    for cut in {*range(lengths[0], len(whole), 24), *lengths, len(whole)}:
        path.write_bytes(whole[:cut])
        batches = sum(length <= cut for length in lengths) - 1
        assert repair(path) == cut - lengths[batches]
        expected = [f"pump-{batch}" for batch in range(batches)]
        assert [row.drive for row in recorded(path)] == expected
        assert pa.ipc.open_stream(path.read_bytes()).read_all().column("drive").to_pylist() == expected
        assert polars.read_ipc_stream(path)["drive"].to_list() == expected


def test_names_of_a_failed_batch_are_written_with_the_next_batch(tmp_path: Path) -> None:
    path = tmp_path / "a.arrows"
    with open_writer(path, METADATA) as writer:
        for room in (0, 100, 700):
            with full_at(path.stat().st_size + room), pytest.raises(RecordingError):
                writer.write(counting(ROWS))
        writer.write(counting(ROWS))
    with pa.ipc.open_stream(path.read_bytes()) as stream:
        assert rows_of(stream.read_all()) == list(counting(ROWS))


def test_a_recording_appended_to_another_is_refused(tmp_path: Path) -> None:
    """The second recording uses the same codes for other names."""
    first, second = tmp_path / "a.arrows", tmp_path / "b.arrows"
    record(first, 2)
    with open_writer(second, METADATA) as writer:
        writer.write(example())
    first.write_bytes(first.read_bytes() + second.read_bytes())
    with pytest.raises(ValueError, match=f"is damaged after row {2 * ROWS}: a message is not"):
        recorded(first)


def test_a_file_whose_names_exceed_the_memory_limit_is_reported_as_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit and the data are both smaller than in practice, by a factor of 256."""
    monkeypatch.setattr(arrow_decoder, "MOST_SPELLED", arrow_decoder.MOST_SPELLED // 256)
    path = tmp_path / "a.arrows"
    row = Row(1, 1, None, "x" * 2**12, "r", None, "no reply")
    with open_writer(path, METADATA) as writer:
        writer.write(from_rows([row] * 300))
    assert path.stat().st_size < 2**14
    with pytest.raises(ValueError, match="the names of a batch of 300 rows are too long"):
        recorded(path)


@pytest.mark.slow
def test_a_csv_file_cut_at_any_byte_loses_only_the_last_line(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    lengths = record(path, 3)
    whole = path.read_bytes()
    expected = list(counting(3 * ROWS))
    for cut in random.Random(2).sample(range(lengths[0], len(whole) + 1), 200):
        path.write_bytes(whole[:cut])
        kept = whole[:cut].rpartition(b"\n")[0] + b"\n"
        reader = open_recording(path)
        assert reader.truncated == cut - len(kept)
        assert [*chain.from_iterable(reader)] == expected[: kept.count(b"\n") - 1]


def test_a_drive_name_with_a_line_end_is_refused() -> None:
    """Otherwise a .csv that is cut off within a name could end with a line that looks complete."""
    with pytest.raises(ValueError, match=r"the name 'pump\\n1' must be one line"):
        Toy(1, name="pump\n1")


def test_a_long_incomplete_line_of_a_csv_file_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    record(path, 1)
    with path.open("ab") as file:
        file.write(bytes(200_000))
    reader = open_recording(path)
    assert (reader.truncated, [*chain.from_iterable(reader)]) == (200_000, list(counting(ROWS)))


def test_a_repaired_recording_is_opened_by_pyarrow_and_polars(tmp_path: Path) -> None:
    path = tmp_path / "a.arrows"
    lengths = record(path, 3)
    os.truncate(path, lengths[3] - 9)
    with pytest.raises((OSError, pa.ArrowInvalid)), pa.ipc.open_stream(path.read_bytes()) as stream:
        stream.read_all()
    assert repair(path) == lengths[3] - 9 - lengths[2]
    assert path.stat().st_size == lengths[2]
    with pa.ipc.open_stream(path.read_bytes()) as stream:
        assert rows_of(stream.read_all()) == list(counting(2 * ROWS))
    polars = pytest.importorskip("polars", reason="needs polars")
    assert len(polars.read_ipc_stream(path)) == 2 * ROWS


@table("suffix", FORMATS)
def test_a_repair_leaves_a_whole_recording_unchanged(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    record(path, 2)
    before = path.read_bytes()
    assert repair(path) == 0
    assert path.read_bytes() == before


def test_arrow_end_marker_does_not_count_as_truncated_data(tmp_path: Path) -> None:
    path = tmp_path / "a.arrows"
    table = pa.table(example())
    with pa.ipc.new_stream(path, table.schema) as stream:
        stream.write_table(table)
    reader = open_recording(path)
    assert (reader.truncated, reader.metadata, [*chain.from_iterable(reader)]) == (0, {}, list(example()))


RECORD_FOR_EVER = """
import sys
sys.path[:0] = sys.argv[2:]
from itertools import chain, count
from batches import METADATA, counting
from multidrop.recording import open_writer
batches = [counting(500, 500 * at) for at in range(100)]
writer = open_writer(sys.argv[1], METADATA)
for at in count():
    writer.write(batches[at % 100])
    print(at, flush=True)
"""


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("suffix", usually(".arrows", ".csv"))
def test_a_killed_writer_keeps_all_written_batches(tmp_path: Path, suffix: str) -> None:
    """Every batch for which `write` had returned can be read."""
    for until in (1, examples(160)):
        path = tmp_path / f"{until}{suffix}"
        command = [sys.executable, "-c", RECORD_FOR_EVER, str(path), *SUPPORT]
        with BoundProcess(command, stdout=subprocess.PIPE, text=True) as writing:
            assert writing.stdout is not None
            while int(writing.stdout.readline()) < until:
                pass
            writing.kill()
            told = [until, *map(int, writing.stdout.read().split())]
            assert writing.wait() == -signal.SIGKILL
        reader = open_recording(path)
        found = [*chain.from_iterable(reader)]
        assert reader.metadata == METADATA
        assert len(found) >= (told[-1] + 1) * 500
        values = (at % 50_000 for at in count())
        expected = (None if value % 10 == 9 else float(value) for value in values)
        assert [row.value for row in found] == [next(expected) for _ in found]


def test_error_says_that_a_parquet_file_was_not_closed(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    with open_writer(path, METADATA) as writer:
        writer.write(example())
        with pytest.raises(ValueError, match=r"not a recording: .* readable only once it is closed"):
            open_recording(path)


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_error_about_a_full_disk_says_how_many_rows_are_saved(tmp_path: Path, suffix: str) -> None:
    path, batch = tmp_path / f"a{suffix}", counting(500)
    full = pytest.raises(RecordingError, match=f"^{path}: cannot be written: File too large")
    with full_at(100_000), full as failure, open_writer(path, METADATA) as writer:
        while True:
            writer.write(batch)
    saved = failure.value.rows
    if suffix == ".parquet":
        assert saved == 0
        assert str(failure.value).endswith("a Parquet file is readable only once it is closed")
        return
    assert saved >= 500
    assert str(failure.value).endswith(f"the {saved} rows before that can be read")
    reader = open_recording(path)
    assert (sum(map(len, reader)), reader.truncated) == (saved, 0)


@pytest.mark.parametrize("suffix", FORMATS)
def test_recording_to_a_full_disk_raises_an_error(tmp_path: Path, suffix: str) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    path = tmp_path / f"a{suffix}"
    path.symlink_to("/dev/full")
    full = pytest.raises(RecordingError, match="cannot be written: No space left on device")
    with full as failure, open_writer(path, METADATA) as writer:
        writer.write(example())
    assert (failure.value.path, failure.value.rows) == (path, 0)


@growing
def test_recording_continues_when_the_disk_has_room_again(tmp_path: Path, suffix: str) -> None:
    """If a batch does not fit on the disk, no part remains between the batches before and after it."""
    path = tmp_path / f"a{suffix}"
    with open_writer(path, METADATA) as writer:
        writer.write(counting(ROWS))
        with (
            full_at(path.stat().st_size + 100),
            pytest.raises(RecordingError, match=f"the {ROWS} rows before"),
        ):
            writer.write(counting(ROWS, 40000))
        writer.write(counting(ROWS, ROWS))
        assert writer.rows == 2 * ROWS
    assert recorded(path) == list(counting(2 * ROWS))


@table("suffix", FORMATS)
def test_a_read_only_directory_raises_a_one_sentence_error(tmp_path: Path, suffix: str) -> None:
    open_writer(
        tmp_path / f"a{suffix}", METADATA
    ).close()  # import the writer's modules now: the user `nobody` may not be allowed to read them
    with read_only_directory() as directory:
        path = directory / f"a{suffix}"
        with pytest.raises(RecordingError) as failure:
            open_writer(path, METADATA)
    assert str(failure.value) == f"{path}: cannot be written: Permission denied"
    assert failure.value.strerror is None  # the message is the library's own, not the system's


@table("suffix", FORMATS)
def test_a_missing_directory_or_file_raises_an_error(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(RecordingError, match="No such file or directory"):
        open_writer(tmp_path / "none" / f"a{suffix}", METADATA)
    with pytest.raises(FileNotFoundError):
        open_recording(tmp_path / f"a{suffix}")


def test_the_next_batch_replaces_an_incomplete_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For a while, the simulated disk can neither write nor truncate files."""
    path = tmp_path / "a.arrows"
    with open_writer(path, METADATA) as writer:
        writer.write(counting(ROWS))
        cut = AppendFile._cut
        monkeypatch.setattr(AppendFile, "_cut", _fail)
        for _ in range(2):
            with full_at(path.stat().st_size + 100), pytest.raises(RecordingError):
                writer.write(counting(ROWS, 40000))
        monkeypatch.setattr(AppendFile, "_cut", cut)
        assert open_recording(path).truncated == 100
        writer.write(counting(ROWS, ROWS))
    assert recorded(path) == list(counting(2 * ROWS))


def _fail(file: AppendFile) -> None:
    raise OSError(5, "Input/output error")


@growing
def test_an_interrupted_write_leaves_the_file_unchanged(tmp_path: Path, suffix: str) -> None:
    """The system writes a batch in two parts, and Ctrl-C comes between the two."""
    path = tmp_path / f"a{suffix}"
    with open_writer(path, METADATA) as writer:
        writer.write(counting(ROWS))
        growing_file = vars(writer)["_file"]
        raw = growing_file._file
        growing_file._file = Halving(raw)
        with pytest.raises(KeyboardInterrupt):
            writer.write(counting(ROWS, 40000))
        growing_file._file = raw
        writer.write(counting(ROWS, ROWS))
    assert recorded(path) == list(counting(2 * ROWS))


class Halving:
    """A file whose first write writes half of the piece, and whose second write raises KeyboardInterrupt."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._writes = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, piece: memoryview) -> int:
        self._writes += 1
        if self._writes == 2:
            raise KeyboardInterrupt
        return int(self._file.write(piece[: len(piece) // 2]))


@pytest.mark.parametrize("room", range(0, 120, 10))
def test_csv_header_is_written_only_after_the_metadata_file(tmp_path: Path, room: int) -> None:
    """The disk becomes full after `room` bytes. If the .csv has a header, its .csv.json must be complete."""
    path = tmp_path / "a.csv"
    whole = {"plant": "p" * 60}
    try:
        with full_at(room), open_writer(path, whole):
            pass
    except RecordingError:
        assert list(tmp_path.iterdir()) == []
    else:
        assert open_recording(path).metadata == whole
    assert not list(tmp_path.glob("*.tmp"))


@table("suffix", FORMATS)
def test_rows_keep_their_order_if_the_clock_is_set_back(tmp_path: Path, suffix: str) -> None:
    """Rows stay in the order of `monotonic_ns`, although `time` jumps back with the clock."""
    path = tmp_path / f"a{suffix}"
    offsets = (UTC_0, UTC_0 - 3600 * SECOND)
    with open_writer(path, METADATA) as writer:
        for at, offset in enumerate(offsets):
            columns = Columns(1)
            assert add_rows(columns, block(0, 0), completion(at + 1, first_ns=at + 2, words=(at,)), offset)
            writer.write(Batch(columns, DRIVES, REGISTERS))
    found = recorded(path)
    assert [row.monotonic_ns for row in found] == [1, 2]
    assert [row.time_ns for row in found] == [UTC_0 + 1, UTC_0 + 2 - 3600 * SECOND]


GARBAGE = {
    "empty": b"",
    "text": b"good morning\n" * 1000,
    "random": random.Random(3).randbytes(100_000),
    "zeros": bytes(1000),
    "marker": b"\xff\xff\xff\xff" + b"\x10\x00\x00\x00" + bytes(16),
    "length": b"\xff\xff\xff\xff" + b"\xff\xff\xff\x7f" + bytes(100),
    "end": b"\xff\xff\xff\xff\x00\x00\x00\x00",
}


@table("suffix", FORMATS)
@table("content", GARBAGE.values(), ids=GARBAGE)
def test_a_file_of_garbage_is_refused_as_a_recording(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    for act in (open_recording, repair):
        with pytest.raises(ValueError, match=r"is not a recording: [^\n]+$"):
            act(path)
    assert path.read_bytes() == content


@pytest.mark.parametrize("suffix", [".arrows", ".parquet"])
def test_a_file_with_other_columns_is_refused_as_a_recording(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    other = pa.table({"time": [1], "value": [0.5]})
    if suffix == ".arrows":
        with pa.ipc.new_stream(path, other.schema) as stream:
            stream.write_table(other)
    else:
        pa.parquet.write_table(other, path)
    with pytest.raises(ValueError, match=r"is not a recording: it is .* with other columns"):
        open_recording(path)


@pytest.mark.parametrize("uses_dictionary", [True, False])
def test_a_parquet_file_that_unpacks_to_gigabytes_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uses_dictionary: bool
) -> None:
    """Limits and data are smaller than in practice by the same factor."""
    monkeypatch.setattr(parquet, "MOST_TEXT", parquet.MOST_TEXT // 1000)
    monkeypatch.setattr(parquet, "MOST_OF_GROUP", parquet.MOST_OF_GROUP // 1000)
    rows, name = (1000, "x" * 3600) if uses_dictionary else (600, "x" * 1000)
    described = pa.schema(schema())
    names = [name if uses_dictionary else f"{name}{at}" for at in range(rows)]
    columns = [[0] * rows, [0] * rows, [0] * rows, names, ["x"] * rows, [1.0] * rows, ["ok"] * rows]
    arrays = [pa.array(column, field.type) for column, field in zip(columns, described, strict=True)]
    path = tmp_path / "a.parquet"
    table = pa.Table.from_arrays(arrays, schema=described)
    pa.parquet.write_table(table, path, compression="zstd", use_dictionary=uses_dictionary)
    assert path.stat().st_size < 20_000
    mistake = (
        "is damaged after row 0: the texts of column drive take more than 67108 bytes"
        if uses_dictionary
        else "is not a recording: one of its row groups has 6[0-9]{5} bytes unpacked; the limit is 536870"
    )
    with pytest.raises(ValueError, match=mistake):
        list(open_recording(path))


def test_arrow_files_with_compressed_batches_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.arrows"
    table = pa.table(counting(2000))
    with pa.ipc.new_stream(path, table.schema, options=pa.ipc.IpcWriteOptions(compression="zstd")) as stream:
        stream.write_table(table)
    with pytest.raises(ValueError, match="compressed: only pyarrow and polars can read it"):
        recorded(path)


def test_the_error_for_a_damaged_csv_line_names_the_line(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    record(path, 1)
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    for damage in ("half a line\n", lines[3].replace("Z", "+", 1), lines[3].replace("Z,", "Z,x", 1)):
        path.write_text("".join([*lines[:3], damage, *lines[4:]]), encoding="utf-8")
        with pytest.raises(ValueError, match=r"a\.csv, line 4: not a row of a recording; [^\n]+$"):
            recorded(path)


def test_the_error_for_damaged_csv_metadata_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    record(path, 1)
    for damage in ("", "{", "[]"):
        (tmp_path / "a.csv.json").write_text(damage)
        with pytest.raises(ValueError, match=r"a\.csv\.json is not a recording: its metadata"):
            open_recording(path)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("suffix", FORMATS)
def test_damage_anywhere_in_a_recording_raises_a_one_sentence_error(tmp_path: Path, suffix: str) -> None:
    """The reader may also return wrong or fewer rows, but it never crashes."""
    path = tmp_path / f"a{suffix}"
    record(path, 2)
    whole = path.read_bytes()
    chance = random.Random(4)
    for _ in range(examples(2500)):
        damaged = bytearray(whole)
        for _ in range(chance.choice((1, 1, 4))):
            damaged[chance.randrange(len(damaged))] = chance.choice((0, 1, 0x7F, 0xFF, chance.randrange(256)))
        path.write_bytes(damaged)
        with suppress_mistake_that_names(path):
            for batch in open_recording(path):
                pa.record_batch(batch).validate(full=True)
                list(batch)


@contextmanager
def suppress_mistake_that_names(path: Path) -> Iterator[None]:
    try:
        yield
    except ValueError as mistake:
        sentence = str(mistake)
    else:
        return
    assert str(path) in sentence
    assert "\n" not in sentence


@pytest.mark.parametrize("rows", [-77, -(1 << 59), 1 << 59])
def test_a_batch_of_impossibly_many_rows_is_reported_as_damage(tmp_path: Path, rows: int) -> None:
    """The number of rows is so large that a size in bytes computed from it would overflow."""
    path = tmp_path / "run.arrows"
    with open_writer(path, METADATA) as writer:
        writer.write(counting(77))
    damaged = path.read_bytes().replace(struct.pack("<q", 77), struct.pack("<q", rows))
    path.write_bytes(damaged)
    with pytest.raises(ValueError, match=f"is damaged after row 0: a batch states {rows} rows"):
        list(open_recording(path))
