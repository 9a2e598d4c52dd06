"""Rows that a poller adds to those of registers: values of channels, comments and outages."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from weakref import ref

import pytest
from lines import line, patient, plant, rows_of, until
from peers import preloaded
from recordings import recorded
from toy import Toy

from multidrop.channels import Channel
from multidrop.core import STATUSES, Message
from multidrop.families import InvtCHE
from multidrop.plant.loader import PlantError
from multidrop.plant.model import Plant, PolledDrive
from multidrop.poller import Poller
from multidrop.polling.added_rows import AddedRow, AddedRows, JoinedColumns, TotalsFile, totals_path
from multidrop.polling.batch import Batch, Row
from multidrop.polling.jobs import RowNames
from multidrop.recording import open_writer
from multidrop.sim import EncodedDrive, Simulator, Wire, proof, simulated
from multidrop.transport.aside_log import flush_log

CURRENT = Toy.registers["output_current"]
DOUBLE = Channel("double", "output_current * 2", "A")
CHARGE = Channel("charge", "integral(output_current)", "A*s")


@pytest.fixture
def port() -> Iterator[str]:
    with Simulator([Wire([EncodedDrive(Toy(1))], unpaced=True)]) as simulator:
        yield simulator.wires[0].path


def pump(*channels: Channel) -> PolledDrive:
    return PolledDrive(Toy(1, name="pump-1"), [CURRENT], every=0.005, channels=channels)


def polled_rows(made: Plant, least: int = 20, *marks: str) -> list[Row]:
    """Poll this plant until there are `least` rows, with the comments `marks`; return all rows."""
    rows: list[Row] = []
    with Poller(made) as poller:
        for text in marks:
            poller.mark(text)
        until(lambda: rows.extend(rows_of(poller)) or len(rows) >= least)
    return rows + rows_of(poller)


def of(rows: list[Row], register: str) -> list[Row]:
    return [row for row in rows if row.register == register]


def test_a_computed_channel_has_a_row_for_each_row_of_its_register(port: str) -> None:
    rows = polled_rows(plant(line(port, pump(DOUBLE))))
    inputs, doubles = of(rows, "output_current"), of(rows, "double")
    value = proof(Toy(1), CURRENT)
    assert {row.value for row in doubles if row.value is not None} == {2 * value}
    assert [row._replace(register="", value=None) for row in doubles] == [
        row._replace(register="", value=None) for row in inputs
    ]


def test_batches_of_the_core_stay_unchanged_in_a_plant_without_channels(port: str) -> None:
    with Poller(plant(line(port, pump()))) as poller:
        assert not poller._added
        until(lambda: (batch := poller.take()) and type(batch.parts()[0]).__name__ == "Columns")


@pytest.mark.parametrize("suffix", [".arrows", ".csv", ".parquet"])
def test_rows_of_channels_and_comments_are_recorded(port: str, tmp_path: Path, suffix: str) -> None:
    made = plant(line(port, pump(DOUBLE)))
    path = tmp_path / f"run{suffix}"
    with Poller(made) as poller, open_writer(path, made.metadata()) as writer:
        poller.mark("bearing\tchanged ")
        until(lambda: [writer.write(batch) for batch in iter(poller.take, None)] and writer.rows > 20)
    rows = recorded(path)
    (comment,) = [row for row in rows if row.drive == "event"]
    assert (comment.register, comment.value, comment.status) == ("comment", None, "bearing changed")
    assert len(of(rows, "double")) == len(of(rows, "output_current"))


def test_a_comment_is_delivered_even_if_no_drive_is_polled(port: str) -> None:
    with Poller(plant(line(port))) as poller:
        poller.mark("nothing is polled", ago=2.0)
        rows: list[Row] = []
        until(lambda: rows.extend(rows_of(poller)) or rows)
    assert [row.status for row in rows] == ["nothing is polled"]


@pytest.mark.parametrize("text", ["", " \n", "x" * 501, "a\x1b[2Jb"])
def test_an_invalid_comment_is_refused(port: str, text: str) -> None:
    with Poller(plant(line(port, pump()))) as poller, pytest.raises(ValueError, match="1 to 500 printable"):
        poller.mark(text)


@pytest.mark.long
@patient
def test_channel_totals_continue_exactly_after_a_restart(port: str, tmp_path: Path) -> None:
    made = replace(plant(line(port, pump(CHARGE))), totals=tmp_path / "totals.json")
    rows = polled_rows(made)
    assert of(rows, "outage")[0].status == "pump-1.charge starts at 0"
    first = [row.value for row in of(rows, "charge") if row.value is not None]
    kept = json.loads((tmp_path / "totals.json").read_text())["pump-1.charge"]
    assert kept["totals"] == [[first[-1]]]
    rows = polled_rows(made)
    assert "starts at 0" not in "".join(row.status for row in of(rows, "outage"))
    second = [row.value for row in of(rows, "charge") if row.value is not None]
    assert second[0] == first[-1] > 0
    assert second[-1] > second[0]
    rows = polled_rows(replace(made, totals=tmp_path / "of another gateway.json"))
    assert of(rows, "outage")[0].status == "pump-1.charge starts at 0"


def test_channel_totals_continue_after_a_change_to_another_plant(port: str) -> None:
    with Poller(plant(line(port, pump(CHARGE, DOUBLE)))) as poller:
        rows: list[Row] = []
        until(lambda: rows.extend(rows_of(poller)) or len(of(rows, "charge")) > 5)
        poller.adopt(plant(line(port, pump(CHARGE))))
        before = len(rows)
        until(lambda: rows.extend(rows_of(poller)) or len(rows) > before + 20)
    totals = [row.value for row in of(rows, "charge") if row.value is not None]
    assert totals == sorted(totals)
    assert of(rows[-5:], "double") == []


@pytest.mark.long
@patient
def test_a_channel_ignores_values_of_an_earlier_drive_with_the_same_name() -> None:
    change = Channel("change", "derivative(output_current)", "A/s")
    values = [proof(Toy(address), CURRENT) for address in (1, 2)]
    assert values[0] != values[1]
    with Simulator([Wire([EncodedDrive(Toy(1)), EncodedDrive(Toy(2))], unpaced=True)]) as simulator:
        path, rows = simulator.wires[0].path, list[Row]()
        with Poller(plant(line(path, pump(change, CHARGE, DOUBLE)))) as poller:
            until(lambda: rows.extend(rows_of(poller)) or len(of(rows, "change")) > 5)
            time.sleep(0.05)  # rows of the first drive are still queued when it is replaced
            second = PolledDrive(
                Toy(2, name="pump-1"), [CURRENT], every=0.005, channels=(change, CHARGE, DOUBLE)
            )
            poller.adopt(plant(line(path, second)))
            since_ns = poller.polled_since["pump-1"]
            until(lambda: rows.extend(rows_of(poller)) or rows[-1].monotonic_ns > since_ns + 10**8)
    assert {row.value for row in of(rows, "change") if row.value is not None} == {0.0}
    assert [row.status for row in of(rows, "outage")][-1].startswith("pump-1.charge: ")
    doubles = [row for row in of(rows, "double") if row.value is not None]
    assert {row.value for row in doubles if row.monotonic_ns >= since_ns} == {2 * values[1]}
    assert {row.value for row in doubles if row.monotonic_ns < since_ns} == {2 * values[0]}


def test_a_channel_accepts_older_values_of_a_slowly_polled_register(port: str) -> None:
    with Poller(plant(line(port, pump(CHARGE)))) as poller:
        poller.set_rate("pump-1", "output_current", 60)
        assert poller._added._channels.holds_s == {("pump-1", "charge"): 180}


def test_channel_totals_of_a_removed_line_continue_when_it_is_added_again(port: str, tmp_path: Path) -> None:
    made = replace(plant(line(port, pump(CHARGE))), totals=tmp_path / "totals.json")
    with Poller(made) as poller:
        rows: list[Row] = []
        until(lambda: rows.extend(rows_of(poller)) or len(of(rows, "charge")) > 5)
        poller.remove_line("line")
        rows += rows_of(poller)
        before = [row.value for row in of(rows, "charge") if row.value is not None][-1]
        poller.add_line(line(port, pump(CHARGE)))
        after: list[Row] = []
        until(lambda: after.extend(rows_of(poller)) or any(row.value for row in of(after, "charge")))
    assert before <= next(row.value for row in of(after, "charge") if row.value)


def test_a_plant_with_a_mistake_in_a_channel_is_refused(port: str) -> None:
    wrong = plant(line(port, pump(Channel("power", "output_curent", "A"))))
    with pytest.raises(PlantError, match='drive "pump-1", channel "power": value: column 1: pump-1 has no'):
        Poller(wrong)
    with Poller(plant(line(port, pump(DOUBLE)))) as poller, pytest.raises(PlantError, match="column 1"):
        poller.adopt(wrong)


def test_a_channel_is_not_computed_if_its_register_is_not_polled(
    port: str, caplog: pytest.LogCaptureFixture
) -> None:
    other = Channel("other", "pump-1.output_current", "A")
    made = plant(line(port, pump(), PolledDrive(Toy(2, name="pump-2"), [CURRENT], channels=[other])))
    with Poller(made) as poller, caplog.at_level(logging.WARNING):
        poller.remove("line", "pump-1")
        until(lambda: "a channel is not computed" in caplog.text)
    assert 'drive "pump-2", channel "other"' in caplog.text


@pytest.mark.long
@patient
def test_the_totals_start_at_0_if_their_file_is_damaged(port: str, tmp_path: Path) -> None:
    for content in ("", "[", "[]", '{"pump-1.charge": {"totals": [[1e999]]}}'):
        (tmp_path / "totals.json").write_text(content)
        made = replace(plant(line(port, pump(CHARGE))), totals=tmp_path / "totals.json")
        assert next(row.value for row in of(polled_rows(made), "charge") if row.value is not None) == 0.0
        if content in ("", "["):
            assert (tmp_path / "totals.json.damaged").read_text() == content


def test_channel_totals_are_saved_when_the_poller_is_closed(port: str, tmp_path: Path) -> None:
    made = replace(plant(line(port, pump(CHARGE))), totals=tmp_path / "totals.json")
    charges: list[float] = []

    def take_charges() -> None:
        charges.extend(row.value for row in of(rows_of(poller), "charge") if row.value is not None)

    with Poller(made) as poller:
        until(lambda: take_charges() or len(charges) > 20)
    kept = json.loads((tmp_path / "totals.json").read_text())["pump-1.charge"]
    assert kept["totals"] == [[charges[-1]]]


def test_a_slow_disk_gets_only_the_newest_totals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, queued = TotalsFile(tmp_path / "totals.json"), list[Callable[[], object]]()
    monkeypatch.setattr(file._thread, "put", queued.append)
    file.write({"a": 1})
    file.write({"a": 2})
    first, second = queued
    first()
    assert file.read() == {"a": 2}
    file.path.unlink()
    second()
    assert not file.path.exists()


def test_an_outage_is_logged_without_a_row_if_no_status_code_is_free(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("multidrop.polling.batch.MOST_STATUSES", 0)
    names = RowNames()
    added = AddedRows(names)
    added.adopt(plant(line("/dev/ttyUSB0", pump(CHARGE))), {})
    codes = names.drives.number("pump-1"), names.registers.number("output_current")
    # No other test has an outage of 343 s, so this status text has no code yet.
    rows = [AddedRow(ns, ns, 0, *codes, 0, 1.0) for ns in (10**9, 344_000_000_000)]
    with caplog.at_level(logging.WARNING):
        batch = added.added_to(Batch(JoinedColumns(None, rows), names.drives, names.registers))
        flush_log(5)
    assert batch is not None
    assert [row.register for row in batch] == ["output_current"] * 2 + ["charge"] * 2
    assert "343 s without values" in caplog.text


def test_the_memory_of_a_removed_drive_is_freed() -> None:
    """The memory of a poller does not grow if its drives change for years."""
    added = AddedRows(RowNames())
    removed = pump(CHARGE)
    known = ref(removed.drive)
    added.adopt(plant(line("/dev/ttyUSB0", removed)), {})
    added.adopt(plant(), {})
    del removed
    assert known() is None


def test_outages_that_end_at_the_same_row_have_different_times() -> None:
    """InfluxDB keeps only one row for each pair of series and time."""
    names = RowNames()
    added = AddedRows(names)
    added.adopt(plant(line("/dev/ttyUSB0", pump(CHARGE, replace(CHARGE, name="more")))), {})
    codes = names.drives.number("pump-1"), names.registers.number("output_current")
    rows = [AddedRow(ns, ns, 0, *codes, 0, 1.0) for ns in (10**9, 123_456_000_000)]
    batch = added.added_to(Batch(JoinedColumns(None, rows), names.drives, names.registers))
    assert batch is not None
    outages = [(row.status, row.time_ns) for row in batch if row.register == "outage"]
    assert outages == [
        ("pump-1.charge: 122 s without values are not counted", 123_456_000_000),
        ("pump-1.more: 122 s without values are not counted", 123_456_000_001),
    ]


def test_channel_totals_of_simulated_drives_are_saved_in_a_separate_file(
    port: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "plant.toml"
    assert totals_path(replace(plant(line("/dev/ttyUSB0")), path=path)) is None
    path.touch()
    assert totals_path(replace(plant(line("/dev/ttyUSB0")), path=path)) == tmp_path / "plant.totals.json"
    (tmp_path / "link").symlink_to(port)
    simulated = totals_path(replace(plant(line(str(tmp_path / "link"))), path=path))
    assert simulated == tmp_path / "plant.simulated.totals.json"
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/hall:/other")
    assert (
        str(totals_path(replace(plant(line("/dev/ttyUSB0")), path=path))) == "/var/lib/hall/plant.totals.json"
    )


def test_the_text_of_a_comment_is_stored_in_the_status_column(port: str) -> None:
    rows = polled_rows(plant(line(port, pump())), 20, "a comment")
    assert "a comment" not in STATUSES
    assert "a comment" in {row.status for row in rows}


HOUR_NS = 3600 * 10**9
PLANT = """
[[line]]
name = "hall"
port = "{}"
baudrate = 38400
[[line.drive]]
name = "pump-1"
model = "invt-che"
address = 1
poll = ["output_frequency"]
"""
CLIENT = """
import json, sys, time
from multidrop import Plant, Poller
rows = []
with Poller(Plant.load(sys.argv[1])) as poller:
    while sum(row.status == "ok" and row.time_ns > int(sys.argv[2]) for row in rows) < 300:
        rows += poller.take() or ()
        time.sleep(0.001)
print(json.dumps([[row.time_ns, row.monotonic_ns] for row in rows if row.status == "ok"]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="CLOCK_BOOTTIME is Linux's")
@pytest.mark.long
@pytest.mark.slow
def test_rows_have_the_time_of_their_exchange_although_the_computer_slept(tmp_path: Path) -> None:
    sim = simulated(InvtCHE(1, baudrate=38400))
    answer, slept, asked_ns = sim.answer, tmp_path / "slept", list[int]()

    def answer_and_sleep(request: Message, now: float) -> Message | None:
        asked_ns.append(time.monotonic_ns())
        if len(asked_ns) == 50:
            slept.touch()
        return answer(request, now)

    sim.answer = answer_and_sleep  # type: ignore[method-assign]
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        (tmp_path / "plant.toml").write_text(PLANT.format(simulator.wires[0].path))
        ahead_ns = time.time_ns() - time.monotonic_ns()
        ran = subprocess.run(
            [sys.executable, "-c", CLIENT, str(tmp_path / "plant.toml"), str(time.time_ns() + HOUR_NS)],
            env=os.environ | {"LD_PRELOAD": preloaded("sleeping_clock", tmp_path), "SLEPT": str(slept)},
            capture_output=True,
            text=True,
            check=False,
        )
    assert ran.returncode == 0, ran.stderr
    # difference of UTC and monotonic time in hours, by whether the row is from before the sleep
    slept_for = {True: set[int](), False: set[int]()}
    # the request at `unsure_ns` may be before or after the sleep
    before_ns, unsure_ns = asked_ns[48], asked_ns[49]
    for time_ns, monotonic_ns in json.loads(ran.stdout):
        if not before_ns < monotonic_ns <= unsure_ns:
            slept_for[monotonic_ns <= before_ns].add(round((time_ns - monotonic_ns - ahead_ns) / HOUR_NS))
    assert slept_for == {True: {0}, False: {8}}
