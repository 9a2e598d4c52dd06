"""The spool: appended rows are on the disk after any failure, and lost rows are counted."""

from __future__ import annotations

import json
import logging
import os
import random
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import spooled
from commands import BoundProcess
from interruptions import full_at, read_only_directory
from lines import until
from spooled import exchanges_in, numbered, rows_in, rows_of
from tables import first_in_ci

from multidrop.samples import spool as spool_module
from multidrop.samples.message import Packed, RowBuffer, unpack
from multidrop.samples.spool import Spool, SpoolError, SpoolFolder

GATEWAY = "gateway-1"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "spool"


@pytest.fixture
def spool(folder: Path) -> Iterator[Spool]:
    opened = Spool(folder, GATEWAY)
    yield opened
    opened.close()


def store(spool: Spool, first: int, exchanges: int) -> None:
    """Append exchanges to the spool, and wait until they are on the disk."""
    spool.append(numbered(first, exchanges))
    assert spool.sync(30.0)


def filled(folder: Path, messages: int, exchanges: int = 5) -> None:
    """Fill a spool's folder with this many messages, each with this many exchanges."""
    spool = Spool(folder, GATEWAY)
    for number in range(messages):
        store(spool, number * exchanges, exchanges)
    spool.close()


def test_appended_rows_are_in_the_spools_files_when_sync_returns(spool: Spool, folder: Path) -> None:
    store(spool, 0, 30)
    assert exchanges_in(rows_in(folder)) == list(range(30))
    state = spool.state()
    assert (state.written, state.lost, state.waiting, state.oldest, state.newest) == (300, 0, 0, 1, 1)
    assert state.stored == sum(file.stat().st_size for file in folder.glob("*.arrows"))


@pytest.mark.slow
def test_the_spool_writes_waiting_rows_as_a_message_after_a_second(spool: Spool, folder: Path) -> None:
    spool.append(numbered(0, 3))
    until(lambda: spool.state().written == 30)
    assert [file.name for file in folder.glob("*.arrows")] == ["000000000001-30.arrows"]


def test_the_spool_writes_16384_waiting_rows_as_a_message_immediately(
    spool: Spool, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spool_module, "ENOUGH_S", 3600.0)
    spool.append(numbered(0, 3))
    assert spool.state().written == 0
    spool.append(numbered(3, 1640))
    until(lambda: spool.state().written == 16430)
    assert len(list(folder.glob("*.arrows"))) == 1


def test_a_reopened_spool_numbers_messages_after_the_newest_one(folder: Path) -> None:
    filled(folder, 3)
    log = json.loads((folder / "spool.json").read_text())["log"]
    spool = Spool(folder, GATEWAY)
    assert (spool.log, spool.state().newest) == (log, 3)
    spool.append(numbered(15, 5))
    spool.close()
    assert sorted(file.name[:12] for file in folder.glob("*.arrows")) == [f"{at:012d}" for at in range(1, 5)]
    assert exchanges_in(rows_in(folder)) == list(range(20))


def test_a_spool_in_a_new_folder_has_a_new_log_id(tmp_path: Path) -> None:
    logs = set()
    for name in ("a", "b"):
        filled(tmp_path / name, 1)
        logs.add(json.loads((tmp_path / name / "spool.json").read_text())["log"])
    assert len(logs) == 2


@pytest.mark.long
@pytest.mark.parametrize("step", first_in_ci(83, 1))
def test_no_earlier_message_is_lost_if_the_newest_file_is_cut(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, step: int
) -> None:
    """A power cut may leave a file without some of its last bytes, or leave a temporary file."""
    whole = tmp_path / "whole"
    filled(whole, 3, exchanges=2)
    newest = max(whole.glob("*.arrows"))
    data = newest.read_bytes()
    before = rows_in(whole)
    ends = [size for size in range(0, len(data), step) if _is_whole(data[:size])]
    # only the last 8 bytes, the end marker, can be lost without losing a row
    assert all(size >= len(data) - 8 for size in ends)
    for size in range(0, len(data), step):
        folder = tmp_path / "cut"
        shutil.copytree(whole, folder)
        (folder / newest.name).write_bytes(data[:size])
        (folder / ".000000000004-20.arrows.tmp").write_bytes(data[:size])
        spool = Spool(folder, GATEWAY)
        spool.append(numbered(6, 2))
        spool.close()
        found = rows_in(folder)
        lost = before[40:] if size not in ends else []
        assert [row for row in before if row not in found] == lost
        assert exchanges_in(found)[-2:] == [6, 7]
        assert not list(folder.glob(".*.tmp"))
        # the next message does not reuse the cut file's number, 3
        assert (folder / "000000000004-20.arrows").exists()
        assert list(folder.glob("*.damaged")) == (
            [] if size in ends else [folder / "000000000003-20.damaged"]
        )
        assert ("000000000003-20.arrows is damaged" in caplog.text) == (size not in ends)
        caplog.clear()
        shutil.rmtree(folder)


def test_the_number_of_a_damaged_message_is_not_reused(folder: Path) -> None:
    """The stream may have the undamaged message, and would refuse a new one of this number as a copy."""
    filled(folder, 2, exchanges=2)
    newest = max(folder.glob("*.arrows"))
    newest.write_bytes(newest.read_bytes()[:100])
    for _ in range(2):
        Spool(folder, GATEWAY).close()
        assert [path.name for path in folder.glob("*.damaged")] == ["000000000002-20.damaged"]
    spool = Spool(folder, GATEWAY)
    assert spool.state().newest == 2
    spool.append(numbered(4, 2))
    spool.close()
    assert sorted(path.name for path in folder.glob("*.arrows")) == [
        "000000000001-20.arrows",
        "000000000003-20.arrows",
    ]


def _is_whole(data: bytes) -> bool:
    try:
        return len(unpack(data)) == 20
    except ValueError:
        return False


def test_a_spool_file_is_synced_before_it_is_renamed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise a power cut could leave an incomplete file."""
    calls: list[str] = []
    fsync, replace = os.fsync, os.replace

    def synced(number: int) -> None:
        path = Path(f"/proc/self/fd/{number}").readlink()
        calls.append(f"{path.name} with {path.stat().st_size} bytes" if path.is_file() else path.name)
        fsync(number)

    def replaced(old: Path, new: Path) -> None:
        calls.append(f"rename to {new.name}")
        replace(old, new)

    files = SpoolFolder(folder, GATEWAY)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", synced)
        patch.setattr(os, "replace", replaced)
        files.write(b"data", 1)
    name = "000000000001-1.arrows"
    assert calls == [f".{name}.tmp with 4 bytes", f"rename to {name}", folder.name]
    files.close()


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(("kills", "longest_s"), first_in_ci((3, 0.2), (12, 0.6)))
def test_rows_reported_as_stored_survive_the_kill_of_the_process(
    folder: Path, kills: int, longest_s: float
) -> None:
    """Each run starts at another number. All reported rows are stored once, in order, without gaps."""
    dice = random.Random(kills)
    support = os.pathsep.join(map(str, Path(spooled.__file__).parents[1].iterdir()))
    told = []
    for run in range(kills):
        words = [sys.executable, spooled.__file__, str(folder), str(run * 1_000_000)]
        here = {**os.environ, "PYTHONPATH": support}
        with BoundProcess(words, stdout=subprocess.PIPE, text=True, env=here) as child:
            child.stdout.readline()
            # the child reports again and again how many rows are on the disk; the second number is above 0
            least = int(child.stdout.readline())
            time.sleep(dice.uniform(0, longest_s))
            child.kill()
            said = child.stdout.read().split("\n")[:-1]
        told.append(int(said[-1]) if said else least)
    found = exchanges_in(rows_in(folder))
    for run, count in enumerate(told):
        numbers = [number % 1_000_000 for number in found if number // 1_000_000 == run]
        assert numbers == list(range(len(numbers)))
        assert len(numbers) >= count
    assert min(told) > 0
    assert not list(folder.glob("*.damaged"))


def test_a_full_spool_removes_its_oldest_messages(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    filled(folder, 1)
    size = next(folder.glob("*.arrows")).stat().st_size
    spool = Spool(folder, GATEWAY, most=size * 5)
    for number in range(1, 4):
        store(spool, number * 5, 5)
    spool.acknowledge(3)
    for number in range(4, 12):
        store(spool, number * 5, 5)
    until(lambda: spool.state().stored <= size * 5)
    spool.close()
    state = spool.state()
    left = sorted(int(file.name[:12]) for file in folder.glob("*.arrows"))
    assert left == list(range(state.oldest, 13))
    assert state.oldest >= 7
    # the first three messages were sent, so their rows are not lost
    assert state.lost == (state.oldest - 1 - 3) * 50
    assert [record.levelno for record in caplog.records] == [logging.ERROR]
    assert "the spool is full at" in caplog.text


@pytest.mark.parametrize(("most", "sent", "lost"), [(1000, 2, 4), (4, 4, 2), (4, 3, 6)])
def test_removed_unsent_rows_are_counted_as_lost_after_acknowledgement(
    folder: Path, monkeypatch: pytest.MonkeyPatch, most: int, sent: int, lost: int
) -> None:
    """If more messages are removed than the spool remembers, it counts whole ranges of messages as lost."""
    monkeypatch.setattr(spool_module, "MOST_UNDECIDED", most)
    filled(folder, 6)
    spool = Spool(folder, GATEWAY, most=1)  # the newest message is kept even beyond the limit
    store(spool, 30, 5)
    until(lambda: spool.state().oldest == 7)
    assert spool.state().lost == 0
    assert len(spool._undecided) <= most
    spool.acknowledge(sent)
    assert spool.state().lost == lost * 50
    spool.acknowledge(7)
    assert spool.state().lost == lost * 50
    spool.close()


def test_rows_appended_to_a_closed_spool_are_lost(spool: Spool, caplog: pytest.LogCaptureFixture) -> None:
    spool.close()
    spool.append(numbered(0, 5))
    assert spool.state().lost == 50
    assert "the spool is closed: 50 rows of the spool" in caplog.text


@pytest.mark.slow
def test_a_full_disk_is_logged_and_does_not_delay_the_poller(
    folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spool_module, "AGAIN_S", 0.01)
    monkeypatch.setattr(spool_module, "MOST_WAITING", 1000)
    spool = Spool(folder, GATEWAY)
    with full_at(100):
        spool.append(numbered(0, 100))
        until(lambda: spool.state().trouble is not None)
        begun = time.monotonic()
        for number in range(1, 6):
            spool.append(numbered(100 * number, 100))
        assert time.monotonic() - begun < 1.0
        assert not spool.sync(0.05)
        state = spool.state()
        assert (state.written, state.lost, state.waiting) == (0, 5000, 1000)
        assert "File too large" in str(state.trouble)
    assert spool.sync(30.0)
    until(lambda: spool.state().trouble is None)
    store(spool, 600, 10)
    spool.close()
    assert exchanges_in(rows_in(folder)) == [*range(100), *range(600, 610)]
    assert not list(folder.glob(".*.tmp"))
    told = [record.getMessage() for record in caplog.records]
    assert [told[0].partition(": ")[0], told[-1]] == [
        f"the spool {folder} cannot be written",
        f"the spool {folder} is written again; 5000 rows were lost so far",
    ]


@pytest.mark.slow
def test_a_full_disk_removes_forwarded_messages_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spool_module, "AGAIN_S", 0.01)
    filled(folder, 3)
    spool = Spool(folder, GATEWAY)
    spool.acknowledge(2)
    with full_at(100):
        spool.append(numbered(15, 5))
        until(lambda: spool.state().oldest == 3)
        until(lambda: spool.state().trouble is not None)
    assert spool.sync(30.0)
    spool.close()
    assert exchanges_in(rows_in(folder)) == list(range(10, 20))
    assert spool.state().lost == 0


@pytest.mark.slow
@pytest.mark.parametrize(("acknowledged", "left"), [(None, [1, 2, 3]), (0, [1, 2, 3]), (1, [2, 3]), (3, [3])])
def test_only_acknowledged_messages_but_the_newest_leave_a_full_disk(
    folder: Path, monkeypatch: pytest.MonkeyPatch, acknowledged: int | None, left: list[int]
) -> None:
    monkeypatch.setattr(spool_module, "AGAIN_S", 0.001)
    filled(folder, 3)
    spool = Spool(folder, GATEWAY)
    if acknowledged is not None:
        spool.acknowledge(acknowledged)
    attempts, really = [0], spool._remove_acknowledged

    def counted() -> None:
        really()
        attempts[0] += 1

    monkeypatch.setattr(spool, "_remove_acknowledged", counted)
    with full_at(100):
        spool.append(numbered(15, 5))
        until(lambda: attempts[0] > 5)
        assert [int(path.name[:12]) for path in sorted(folder.glob("*.arrows"))] == left
    assert spool.sync(30.0)
    spool.close()
    assert (spool.state().newest, spool.state().lost) == (4, 0)


def test_a_hanging_disk_does_not_delay_the_poller(spool: Spool, monkeypatch: pytest.MonkeyPatch) -> None:
    goes_on, stands = threading.Event(), threading.Event()
    really = os.fsync

    def fsync(file: int) -> None:
        stands.set()
        goes_on.wait(30.0)
        really(file)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(spool_module, "MOST_WAITING", 500)
    spool.append(numbered(0, 40))
    assert not spool.sync(0.0)
    assert stands.wait(30.0)
    for number in range(1, 4):
        spool.append(numbered(40 * number, 40))
    assert spool.state().lost == 3 * 400
    assert spool.following(0) is None
    goes_on.set()
    assert spool.sync(30.0)


def test_rows_counted_as_lost_are_not_written_later(
    spool: Spool, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    really = RowBuffer.messages

    def messages(self: RowBuffer, **options: Any) -> Iterator[Packed]:
        yield from really(self, **options)
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(RowBuffer, "messages", messages)
        spool.append(numbered(0, 30))
        spool.sync(0.0)
        until(lambda: spool.state().lost == 300)
    store(spool, 30, 30)
    assert exchanges_in(rows_in(folder)) == list(range(30, 60))


def test_a_second_process_cannot_open_the_same_spool(spool: Spool, folder: Path) -> None:
    with pytest.raises(SpoolError, match=f"the spool {folder} is in use by another process"):
        Spool(folder, GATEWAY)


def test_a_spool_refuses_a_folder_with_other_files(tmp_path: Path) -> None:
    (tmp_path / "report.txt").write_text("mine")
    with pytest.raises(SpoolError, match=r"is not a spool: it holds 'report.txt' and no spool.json"):
        Spool(tmp_path, GATEWAY)
    assert {path.name for path in tmp_path.iterdir()} == {"report.txt", ".spool.lock"}


def test_a_spool_refuses_the_folder_of_another_gateway(folder: Path) -> None:
    filled(folder, 1)
    with pytest.raises(SpoolError, match="is the spool of gateway 'gateway-1', not of 'gateway-2'"):
        Spool(folder, "gateway-2")


@pytest.mark.parametrize(
    "text", ["", "[]", "{", '{"format": "multidrop spool 9"}', '{"format": "multidrop spool 1"}']
)
def test_a_spool_refuses_a_folder_with_an_invalid_spool_json(folder: Path, text: str) -> None:
    folder.mkdir()
    (folder / "spool.json").write_text(text)
    with pytest.raises(SpoolError, match=r"spool.json is damaged, or from another version"):
        Spool(folder, GATEWAY)


def test_spool_refuses_an_unwritable_folder() -> None:
    with (
        read_only_directory() as path,
        pytest.raises(SpoolError, match=f"the spool {path} cannot be written: Permission denied"),
    ):
        Spool(path, GATEWAY)


def test_a_stored_batch_is_read_back_unchanged(spool: Spool, folder: Path) -> None:
    batch = numbered(0, 20)
    spool.append(batch)
    assert spool.sync(30.0)
    wanted = [(*row[:2], row[2] and -(-row[2] // 1000) * 1000, *row[3:], None) for row in batch]
    stored = spool.following(0)
    assert rows_of(unpack(stored.path.read_bytes())) == sorted(wanted, key=lambda row: (row[0], row[3:5]))
