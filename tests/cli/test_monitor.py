"""The monitor: its values, its pictures at any terminal size, and its keys, which can only stop drives."""

from __future__ import annotations

import math
import re
import string
import termios
import threading
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from commands import Run, plant_file
from lines import PATIENCE
from tables import table
from terminals import Terminal, on_terminal

from multidrop.cli.monitor import PAGE, Monitor, pause_s
from multidrop.cli.monitor_screen import LEAST_HEIGHT, LEAST_WIDTH, Position, SideRead, overview, page
from multidrop.cli.support.polling import LivePlant, Moment, PollingSession, Triggering
from multidrop.cli.support.signals import Interruption
from multidrop.cli.support.terminal import (
    BLOCKS,
    DOWN,
    ENTER,
    KEYS,
    PAGE_DOWN,
    PAGE_UP,
    PLAIN_BLOCKS,
    UP,
    Screen,
    sparkline,
)
from multidrop.cli.support.values import columns_of
from multidrop.control.outcome import Seen, Stopped
from multidrop.core import Counters, Status
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant
from multidrop.polling.batch import Row
from multidrop.recording import open_recording
from multidrop.recording.rows import from_rows
from multidrop.transport.statistics import LineStatistics, line_statistics

SECOND = 1_000_000_000
NOW = 1_795_253_400 * SECOND
CHE = ("output_frequency", "output_current", "status", "fault")
MISSES = Counter({Status.NO_REPLY: 3, Status.BAD_CHECKSUM: 9})


def a_plant(tmp_path: Path, drives: int = 3) -> Plant:
    path = tmp_path / "hall.toml"
    text = '[[line]]\nname = "hall-1"\nport = "/dev/nowhere"\n'
    for at in range(1, drives + 1):
        text += (
            f'[[line.drive]]\nname = "drive-{at}"\nmodel = "invt-che"\naddress = {at}\npoll = {list(CHE)}\n'
        )
    path.write_text(text)
    return load_plant(path)


def after(ns: int) -> Moment:
    return Moment(NOW + ns, NOW + ns)


def row(drive: str, register: str, value: float | None, status: str = "ok", ago: float = 0.5) -> Row:
    at = NOW - round(ago * SECOND)
    return Row(at, at, None if value is None else 1000, drive, register, value, status)


def told(seconds: float, exchanges: int, utilisation: float, drives: int = 3) -> dict[str, LineStatistics]:
    """Return statistics of a line with exchanges of the first drive only."""
    busy = Counters(
        sent=exchanges,
        ideal_ns=round(utilisation * seconds * SECOND),
        missed=MISSES,
        late=2,
        stray_bytes=17,
        longest_ns=31_000_000,
        delays=Counter({56: 99, 64: 1}),  # bins of 8.4 to 9.4 ms and of 16.8 to 18.9 ms
    )
    counters_by_drive = {f"drive-{at}": busy if at == 1 else Counters() for at in range(1, drives + 1)}
    return {"hall-1": line_statistics(seconds, counters_by_drive, None)}


@pytest.fixture
def watched(tmp_path: Path) -> LivePlant:
    """Return a plant with one drive that runs, one with a fault, and one that never answered."""
    live = LivePlant(a_plant(tmp_path))
    rows = [
        row("drive-1", "output_frequency", 42.5),
        row("drive-1", "output_current", 2.5),
        row("drive-1", "status", 1.0),
        row("drive-1", "fault", 0.0),
        row("drive-2", "output_frequency", 0.0, ago=9),
        row("drive-2", "fault", 4.0, ago=9),
        row("drive-2", "output_frequency", None, "bad checksum"),
        *(row("drive-3", register, None, "no reply") for register in CHE),
    ]
    live.add(from_rows(rows))
    for second in (0, 1):
        live.tick(100.0 + second, told(10 + second, 1000 + 50 * second, 0.9))
        live.remember()
    return live


def texts(lines: list[Any]) -> list[str]:
    return [line.plain for line in lines]


def test_the_monitor_derives_a_drives_state_from_polled_registers(watched: LivePlant) -> None:
    assert [(drive.state, drive.fault, drive.why_silent) for drive in watched.drives] == [
        ("running", "", ""),
        ("fault", "oc1_overcurrent_accelerating", ""),
        ("silent", "", "no reply"),
    ]
    assert [drive.age(after(0)) for drive in watched.drives] == [0.5, 9.0, None]
    assert [drive.so_far.misses.total() for drive in watched.drives] == [12, 0, 0]


def test_a_skipped_poll_keeps_the_reason_why_a_drive_is_silent(watched: LivePlant) -> None:
    watched.add(from_rows([row("drive-3", name, None, "not asked: drive is silent", ago=0) for name in CHE]))
    assert watched.drives[2].why_silent == "no reply"


def test_a_frequency_of_0_is_not_shown_as_stopped(tmp_path: Path) -> None:
    live = LivePlant(a_plant(tmp_path, 1))
    live.add(from_rows([row("drive-1", "output_frequency", 0.0)]))
    assert live.drives[0].state == ""
    live.add(from_rows([row("drive-1", "output_frequency", 3.0)]))
    assert live.drives[0].state == "turns"


def test_a_status_register_without_set_bits_names_no_state(tmp_path: Path) -> None:
    path = tmp_path / "hall.toml"
    path.write_text(
        '[[line]]\nname = "hall-1"\nport = "/dev/nowhere"\n'
        '[[line.drive]]\nname = "drive-1"\nmodel = "yd1000"\naddress = 1\npoll = ["status"]\n'
    )
    live = LivePlant(load_plant(path))
    live.add(from_rows([row("drive-1", "status", 0.0)]))
    assert live.drives[0].state == ""


def test_the_monitor_measures_rates_over_the_last_seconds(watched: LivePlant) -> None:
    recent = watched.recent["hall-1"]
    assert recent.exchanges_per_second == pytest.approx(50)
    assert recent.utilisation == pytest.approx(0.9)
    assert recent.misses == {}
    assert watched.so_far["hall-1"].misses == {"no reply": 3, "bad checksum": 9}
    for second in range(2, 12):
        watched.tick(100.0 + second, told(10 + second, 1050, 0.0))
    assert watched.recent["hall-1"].exchanges == 0
    assert watched.drives[0].recent.exchanges == 0


def test_the_monitors_history_of_values_has_a_gap_for_a_miss(watched: LivePlant) -> None:
    assert [list(drive.history) for drive in watched.drives] == [[42.5, 42.5], [None, None], [None, None]]
    assert sparkline([0, 1, 2, None, 7], 10) == "▁▂▃ █"
    assert sparkline([50, 50, 50], 2) == "██"
    assert sparkline([0, 0], 5) == "▁▁"
    assert sparkline([0, 7], 5, PLAIN_BLOCKS) == "_@"
    assert sparkline([1, 2], 0) == ""
    assert sparkline([0, math.inf, -math.inf, 1e300, 7], 5) == "▁   █"
    assert sparkline([0, 5e-324], 5) == "▁█"


def test_the_monitors_history_has_values_of_one_register_only(tmp_path: Path) -> None:
    live = LivePlant(a_plant(tmp_path, 1))
    for name, value in (("status", 3.0), ("output_frequency", 50.0)):
        live.add(from_rows([row("drive-1", name, value)]))
        live.remember()
    assert list(live.drives[0].history) == [None, 50.0]


def test_the_overview_shows_states_in_words(watched: LivePlant) -> None:
    lines = texts(overview(watched, Position(), (80, 24), after(0), BLOCKS))
    assert lines[0].startswith(" multidrop monitor  hall.toml")
    assert lines[0].endswith("09:30:00 UTC ")
    assert lines[1].startswith(" hall-1   90% of the wire used  50.0 exchanges/s  12 missed: bad checksum")
    assert lines[3].split() == [">drive-1", "running", "42.50", "Hz", "2.5", "A", "0.5", "s", "12", "██"]
    assert lines[4].startswith("!drive-2 ?fault")
    assert lines[4].split()[2:5] == ["?0.00", "Hz", "?oc1_overc~"]
    assert lines[-2] == " ? old value"
    assert lines[5].split()[:5] == ["drive-3", "silent", "no", "reply", "never"]
    assert lines[-1].startswith(" up/down choose")
    assert "start" not in " ".join(lines).lower()


def test_an_old_value_is_marked_if_other_values_are_new(watched: LivePlant) -> None:
    for drive in watched.drives:
        drive.cycle = 1.0  # in s; a value is current for three such cycles
    watched.add(from_rows([row("drive-1", "output_frequency", None, "exception 02", ago=0)]))
    at = Position()
    shown = [texts(overview(watched, at, (80, 24), after(wait), BLOCKS))[3] for wait in (0, SECOND)]
    assert [" 42.50 Hz " in line for line in shown] == [
        True,
        False,
    ]  # one missed value does not make the last value old
    assert shown[1].split()[1:8] == ["running", "?42.50", "Hz", "2.5", "A", "1.5", "s"]


def test_a_slowly_polled_value_is_marked_old_after_three_periods(tmp_path: Path) -> None:
    path = tmp_path / "hall.toml"
    a_plant(tmp_path, 1)
    path.write_text(path.read_text().replace("address = 1\n", 'address = 1\nevery = "1 min"\n'))
    plant = load_plant(path)
    (drive,) = LivePlant(plant).drives
    drive.add(row("drive-1", "output_frequency", 42.5))
    ages = [drive.is_old("output_frequency", after(seconds * SECOND)) for seconds in (100, 170, 190)]
    assert ages == [False, False, True]
    # the line has so many drives that a bus cycle takes 100 s
    planned = plant.metadata()["planned"] | {"hall-1": {"cycle_ms": 100_000.0}}
    (drive,) = LivePlant(plant, planned).drives
    drive.add(row("drive-1", "output_frequency", 42.5))
    assert [drive.is_old("output_frequency", after(seconds * SECOND)) for seconds in (290, 310)] == [
        False,
        True,
    ]


def test_an_old_value_is_marked_although_the_clock_is_set_back(watched: LivePlant) -> None:
    now = Moment(NOW - 3600 * SECOND, NOW + 100 * SECOND)
    (first, *_) = watched.drives
    assert (first.age(now), first.is_old("output_frequency", now)) == (100.5, True)
    slept = Moment(NOW + 3600 * SECOND, NOW)  # CLOCK_MONOTONIC has stopped for an hour
    assert (first.age(slept), first.is_old("output_frequency", slept)) == (3600.5, True)


def test_unpolled_registers_are_read_in_at_most_5_percent_of_the_time(tmp_path: Path) -> None:
    for utilisation, share in ((0.2, 0.05), (0.97, 0.03), (1.0, 0.01), (3.0, 0.01)):
        assert 0.03 / (0.03 + pause_s(0.03, utilisation)) == pytest.approx(share)
    assert pause_s(0.001, 0.2) == 0.1  # a fast read is followed by the minimum pause
    plant = a_plant(tmp_path, 1)
    (drive,) = LivePlant(plant, plant.metadata()["planned"]).drives
    assert drive.line_utilisation == 1.0  # this drive is polled as fast as the line allows


@pytest.mark.long
@table("size", [(60, 12), (80, 24), (200, 50), (500, 100)])
@table("drives", [1, 31, 247])
def test_the_monitor_screen_fits_every_terminal_size(
    tmp_path: Path, size: tuple[int, int], drives: int
) -> None:
    live = LivePlant(a_plant(tmp_path, min(drives, 247)))
    live.add(from_rows([row("drive-1", register, 4.0) for register in CHE]))
    live.tick(1.0, told(1, 1, 1.0, drives))
    for chosen in (0, drives - 1):
        failed = [f"drive-{number}: " + "why " * 40 for number in range(30)]
        for at in (
            Position(chosen),
            Position(chosen, question="Stop?"),
            Position(chosen, message="m" * 300),
            Position(chosen, failures=failed),
            Position(chosen, question="Leave?", failures=["x" * 5000]),
        ):
            for lines in (
                overview(live, at, size, after(0), BLOCKS),
                page(live.drives[chosen], {}, at, size, after(0)),
            ):
                assert len(lines) == size[1]
                assert max(len(line) for line in texts(lines)) <= size[0]
        shown = texts(overview(live, Position(chosen), size, after(0), BLOCKS))
        assert any(line.startswith(f">drive-{chosen + 1} ") for line in shown)


@pytest.mark.parametrize("name", ["pump", "a-drive-of-a-long-name", "主泵电机三号线北侧冷却水循环"])
def test_the_narrowest_monitor_screen_shows_the_age_and_the_help_line(tmp_path: Path, name: str) -> None:
    live = LivePlant(a_plant(tmp_path, 1))
    live.drives[0].polled.drive.name = name
    size = LEAST_WIDTH, LEAST_HEIGHT
    shown = texts(overview(live, Position(), size, after(0), BLOCKS))
    assert shown[2].split()[-1] == "AGE"
    assert shown[3].rstrip().endswith(" never")
    assert columns_of(shown[3]) <= LEAST_WIDTH
    # the age is right-aligned below its heading
    assert columns_of(shown[3].rstrip()) == len(shown[2].rstrip())
    for lines in (shown, texts(page(live.drives[0], {}, Position(), size, after(0)))):
        assert lines[-1].endswith("s stop   S stop all   q quit")


def test_no_heading_of_the_overview_is_cut(watched: LivePlant) -> None:
    widths = range(LEAST_WIDTH, 160)
    headings = [texts(overview(watched, Position(), (width, 24), after(0), BLOCKS))[2] for width in widths]
    assert [heading for heading in headings if "~" in heading] == []


def test_a_wide_overview_shows_long_names_in_full(tmp_path: Path) -> None:
    live = LivePlant(a_plant(tmp_path, 1))
    live.drives[0].polled.drive.name = name = "conveyor-of-the-bottling-hall-south-12"
    assert texts(overview(live, Position(), (200, 50), after(0), BLOCKS))[3].split()[0] == f">{name}"


def test_the_overview_shows_the_last_trigger_if_the_screen_has_room(watched: LivePlant) -> None:
    curves = [f"a.{name}  __##  0 to 4 A" for name in "iuft"] + ["       ^ from -1 s to 2 s"]
    at = Position(trigger=curves)
    for height, shown in ((13, curves), (12, [])):
        lines = texts(overview(watched, at, (80, height), after(0), BLOCKS))
        assert len(lines) == height
        assert [line[1:] for line in lines[6:-2] if line.strip()] == shown
        assert all(any(drive.name in line for line in lines) for drive in watched.drives)


def test_the_page_of_a_drive_shows_every_register(watched: LivePlant) -> None:
    live = watched.drives[1]
    others = {"motor_speed": SideRead("0 rpm", NOW - 14 * SECOND)}
    lines = texts(page(live, others, Position(1, page=True), (80, 40), after(0)))
    assert lines[0].startswith(" drive-2  INVT CHE  address 2  9600 8N1 rtu")
    rows = {line.split()[0]: line for line in lines[3:-2] if line.strip()}
    readable = {name for name, register in live.polled.drive.registers.items() if register.readable}
    assert set(rows) == readable
    assert rows["output_frequency"].split()[1:] == ["0.00", "Hz", "9.0", "s", "bad", "checksum"]
    assert rows["status"].split()[1:3] == ["not", "yet"]
    assert rows["motor_speed"].split()[1:] == ["0", "rpm", "14", "s", "not", "polled"]
    assert rows["device"].split()[1] == "..."


def test_the_page_of_a_drive_shows_full_reasons_for_missing_values(watched: LivePlant) -> None:
    why = "not asked: drive is silent"
    watched.add(from_rows([row("drive-1", name, None, why) for name in CHE]))
    lines = texts(page(watched.drives[0], {}, Position(page=True), (80, 24), after(0)))
    assert [line.endswith(why) for line in lines[3:7]] == [True] * 4


@pytest.mark.parametrize(
    ("seconds", "age"), [(9, "9.5 s"), (50, "50 s"), (600, "10 min"), (7199, "120 min"), (36000, "10 h")]
)
def test_the_monitor_shows_ages_in_readable_units(watched: LivePlant, seconds: int, age: str) -> None:
    lines = texts(overview(watched, Position(), (80, 24), after(seconds * SECOND), BLOCKS))
    assert " ".join(lines[3].split()[6:8]) == age


def test_a_wide_overview_shows_response_delays(watched: LivePlant) -> None:
    lines = texts(overview(watched, Position(), (200, 50), after(0), BLOCKS))
    assert lines[2].split()[-3:] == ["DELAY", "LAST", "MINUTE"]
    assert " 8.9 ms " in lines[3]
    assert " ms " not in lines[4]


def test_the_page_of_a_drive_shows_its_response_delays(watched: LivePlant) -> None:
    lines = texts(page(watched.drives[0], {}, Position(0, page=True), (100, 40), after(0)))
    assert lines[1] == " running      12 missed: bad checksum 9, no reply 3"
    assert lines[2] == " 50.0 exchanges/s  delay 8.9 ms, p99 8.9, max 31.0  2 late  17 bytes skipped"
    silent = texts(page(watched.drives[2], {}, Position(2, page=True), (100, 40), after(0)))
    assert silent[2] == " 0.0 exchanges/s"


def test_the_page_of_a_drive_scrolls_to_its_last_row(watched: LivePlant) -> None:
    at = Position(0, page=True, scrolled=1000)
    lines = texts(page(watched.drives[0], {}, at, (80, 12), after(0)))
    assert lines[9].strip()
    registers = watched.drives[0].polled.drive.registers.values()
    assert f"of {len([register for register in registers if register.readable])}" in lines[-2]


class Poller:
    """A poller that records which methods of its bus are called."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def bus(self, line: str) -> Poller:
        return self

    def stop_all(self, *, seconds: float | None = None) -> dict[str, Stopped]:
        self.asked.append("stop all")
        return {
            "drive-1": Stopped("drive-1", Seen.STOPPED, 0.1),
            "drive-2": Stopped("drive-2", Seen.FAILED, 0.2, "no reply"),
        }

    def mark(self, text: str, *, kind: str) -> None:
        self.asked.append(f"{kind}: {text}")

    def perform(self, name: str, script: Any) -> None:
        step = next(script)
        self.asked.append(f"{name} {step.register.name} {step.value.name}")


class Screened(NamedTuple):
    """A monitor whose stops are carried out in this thread, and its poller."""

    monitor: Any
    poller: Poller

    def press(self, keys: Iterable[str]) -> None:
        for key in keys:
            self.monitor._obey(key)

    @property
    def text(self) -> str:
        """The text on the screen."""
        return "\n".join(line.rstrip() for line in texts(self.monitor._picture()))


@pytest.fixture
def screened(tmp_path: Path) -> Screened:
    poller = Poller()
    plant = a_plant(tmp_path)
    for polled in plant.lines[0].drives:
        polled.drive.perform = lambda script, name=polled.drive.name: poller.perform(name, script)
    anyone: Any = poller
    session = PollingSession(anyone, Interruption(), lambda: None)
    monitor: Any = Monitor(LivePlant(plant), session, Screen())
    monitor._begin = lambda what, work: False
    monitor._side_reader.read = lambda chosen: {}
    return Screened(monitor, poller)


def test_the_monitor_sends_a_stop_only_after_a_yes(screened: Screened) -> None:
    for keys, asked in (
        (["s", "n"], []),
        (["s", ENTER], []),
        (["s", "Y"], ["drive-1 control STOP"]),  # Y with caps lock on
        (["s", "S", "y"], ["stop all"]),  # S replaces the question that s asked
        (["y"], []),
        ([DOWN, "s", "y"], ["drive-2 control STOP"]),
        (["S", "n"], []),
        (["S", "y"], ["stop all"]),
    ):
        screened.poller.asked.clear()
        screened.press(keys)
        assert screened.poller.asked == asked


def test_the_monitor_sends_a_stop_even_if_no_thread_can_be_started(
    screened: Screened, monkeypatch: pytest.MonkeyPatch
) -> None:
    monitor, poller = screened

    def none(thread: object) -> None:
        raise RuntimeError("can't start new thread")

    del monitor._begin
    monkeypatch.setattr("threading.Thread.start", none)
    screened.press("Sy")
    assert poller.asked == ["stop all"]
    assert not monitor._is_stopping


def test_the_monitor_sends_all_stops_before_waiting_if_no_thread_starts(screened: Screened) -> None:
    monitor, poller = screened
    asked: list[tuple[str, float | None]] = []

    class LineBus:
        def __init__(self, line: str) -> None:
            self.line = line

        def stop_all(self, *, seconds: float | None = None) -> dict[str, Stopped]:
            asked.append((self.line, seconds))
            if (self.line, seconds) == ("hall-2", 0.0):
                # this failure must not delay the stops on other lines
                raise OSError("the ledger cannot be kept")
            return {self.line: Stopped(self.line, Seen.STOPPED, 0.1)}

    (line,) = monitor._plant.plant.lines
    lines = tuple(replace(line, name=f"hall-{number}") for number in (1, 2, 3))
    monitor._plant.plant = replace(monitor._plant.plant, lines=lines)
    poller.bus = LineBus  # type: ignore[method-assign, assignment]
    screened.press("Sy")
    names = [line.name for line in lines]
    assert asked == [(name, 0.0) for name in names] + [(name, None) for name in names]
    assert monitor._at.message == "3 of 3 drives stopped"
    assert monitor._at.failures == []


def test_the_monitor_shows_a_failed_stop_until_it_is_acknowledged(screened: Screened) -> None:
    monitor, poller = screened
    monitor._plant.tick(0.0, told(1, 1, 0.5))
    screened.press("Sy")
    failure = "drive-2: failed after 0.2 s: no reply"
    assert failure in screened.text
    assert "1 of 2 drives stopped" in screened.text
    assert "a acknowledge FAILURES" in screened.text
    stopped = {"drive-2": Stopped("drive-2", Seen.STOPPED, 0.1)}
    poller.stop_all = lambda: stopped  # type: ignore[method-assign]
    # the message stays on a drive's page, and after a successful stop
    for key in ("x", DOWN, "S", "y", ENTER, "s", "n", ENTER):
        screened.press([key])
        assert failure in screened.text
    assert monitor.await_stops() == monitor._at.failures
    screened.press(["a"])
    assert failure not in screened.text
    assert "q quit" in screened.text
    assert monitor.await_stops() == []


def test_the_monitor_counts_stopped_drives_and_lines(screened: Screened) -> None:
    monitor = screened.monitor
    (line,) = monitor._plant.plant.lines
    both = (line, replace(line, name="hall-2"))
    monitor._plant.plant = replace(monitor._plant.plant, lines=both)
    messages = [monitor._stop_all(line.name)[0] for line in both]
    assert messages == ["1 of 2 drives stopped, on 1 of 2 lines so far", "2 of 4 drives stopped"]


def test_acknowledging_failed_stops_reveals_further_failed_stops(watched: LivePlant) -> None:
    at = Position(failures=[f"drive-{number}: no reply" for number in range(31)])
    shown: list[str] = []
    for more in (24, 17, 10, 3, 0):
        lines = texts(overview(watched, at, (80, 24), after(0), BLOCKS))
        told = [line.strip(" !") for line in lines if line.startswith(" ! drive-")]
        assert any(f"... and {more} more; acknowledge these" in line for line in lines) == bool(more)
        shown += told
        del at.failures[: at.failures_shown]
    assert shown == [f"drive-{number}: no reply" for number in range(31)]


@pytest.mark.parametrize("failure", [OSError("the ledger cannot be kept"), KeyError("odd"), RuntimeError()])
def test_the_monitor_shows_any_exception_of_a_stop_as_a_failure(
    screened: Screened, monkeypatch: pytest.MonkeyPatch, failure: Exception
) -> None:
    monitor, poller = screened
    monitor._plant.tick(0.0, told(1, 1, 0.5))

    def fail(*details: object) -> None:
        raise failure

    monkeypatch.setattr(poller, "stop_all", fail)
    monkeypatch.setattr(poller, "perform", fail)
    screened.press("Sysy")
    words = str(failure) or "RuntimeError"
    assert f"stopping all drives on hall-1 failed: {words}" in screened.text
    assert f"stopping drive-1 failed: {words}" in screened.text


def test_a_failed_stop_is_not_shown_as_repeated(screened: Screened, monkeypatch: pytest.MonkeyPatch) -> None:
    monitor, poller = screened

    def fail(*details: object) -> None:
        monitor._show_message("the stop is repeated for 30 s at least")
        raise OSError("no such port")

    monkeypatch.setattr(poller, "perform", fail)
    screened.press("sy")
    assert monitor._at.message == "stopping drive-1 failed"


def test_the_monitor_quits_only_after_a_running_stop_ends(
    screened: Screened, capsys: pytest.CaptureFixture[str]
) -> None:
    monitor = screened.monitor
    stands = threading.Event()
    del monitor._begin  # restores the real method, which starts a thread
    monitor._stop = lambda chosen: (str(stands.wait(PATIENCE)), [])
    for key in ("s", "y", "q", "n"):
        screened.press([key])
        assert not monitor._has_left
    screened.press(("q", "y"))
    assert monitor._has_left
    # While the monitor waits, it calls `hand_out` to record rows. Here this call also completes the stop.
    monitor._session = monitor._session._replace(hand_out=stands.set)
    assert monitor.await_stops() == []
    assert not any(thread.is_alive() for thread in monitor._stops)
    assert "waiting for a stop in progress" in capsys.readouterr().err
    assert monitor.await_stops() == []
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "keys", ["joksy", "\u043e\u0442\u043b\u044b\u043d", "\u043e\u0442\u043b\u0456\u043d"]
)
def test_the_monitor_keys_work_in_a_cyrillic_keyboard_layout(screened: Screened, keys: str) -> None:
    screened.press(keys)  # down (j), a key without a function (o), up (k), stop (s), yes (y)
    assert screened.poller.asked == ["drive-1 control STOP"]


@pytest.mark.parametrize("key", ["t", "\u0435"])
def test_the_key_t_is_ignored_unless_triggers_are_recorded(screened: Screened, key: str) -> None:
    monitor, poller = screened
    screened.press([key])
    assert poller.asked == []
    monitor._how = Triggering(1.0, 1.0, {}, {})
    screened.press([key])
    assert poller.asked == ["trigger: key t"]


def test_page_keys_scroll_a_drives_page_or_choose_a_drive(screened: Screened) -> None:
    monitor = screened.monitor
    screened.press([PAGE_DOWN])
    assert (monitor._at.chosen, monitor._at.scrolled) == (2, 0)
    screened.press([ENTER])
    for key, scrolled in ((PAGE_DOWN, PAGE), (PAGE_DOWN, 2 * PAGE), (PAGE_UP, PAGE), (UP, 0), (PAGE_UP, 0)):
        screened.press([key])
        assert monitor._at.scrolled == scrolled
    assert monitor._at.chosen == 1


def test_monitor_keys_can_only_stop_motors(screened: Screened) -> None:
    for key in [*string.printable, *KEYS.values()]:
        for answer in "yY\r ":
            screened.press([key, answer])
    assert set(screened.poller.asked) <= {"stop all", *(f"drive-{at} control STOP" for at in (1, 2, 3))}


def leave(terminal: Terminal) -> None:
    terminal.press(b"q")
    assert terminal.process.wait(timeout=60) == 0


def await_both(terminal: Terminal) -> None:
    """Wait until the screen shows that pump-9 is silent, and the age of a value of pump-1."""
    terminal.wait_for_match(r"pump-9 .*silent")
    terminal.wait_for_match(r"\d\.\d s ")


@pytest.mark.long
def test_the_monitor_restores_its_terminal(plant: Path) -> None:
    with on_terminal("monitor", plant) as terminal:
        await_both(terminal)
        terminal.press(b"\r")
        terminal.wait_for("TOY T1  address 1")
        terminal.wait_for("acceleration_time")
        terminal.press(b"\x1bs")
        terminal.wait_for("Stop pump-1? y stops it")
        terminal.press(b"n")
        terminal.wait_for("nothing was sent")
        leave(terminal)
        assert termios.tcgetattr(terminal.slave) == terminal.before


@pytest.mark.long
def test_the_monitor_redraws_its_screen_without_scrolling(plant: Path) -> None:
    """If a picture scrolled the screen, the terminal would show parts of two pictures."""
    with on_terminal("monitor", plant) as terminal:
        await_both(terminal)
        pictures = homes = 0
        while pictures < 4:
            terminal.press(b"\x1b[B")  # also discards the output so far, which may end within a picture
            terminal.wait_for("q quit")
            terminal.wait_for("multidrop monitor")
            pictures += len(re.findall(rb".{5} multidrop monitor", terminal.written, re.DOTALL))
            homes += len(re.findall(rb"\x1b\[H(?:\x1b\[[0-9;]*m)* multidrop monitor", terminal.written))
        assert pictures == homes
        leave(terminal)


@pytest.mark.long
def test_a_stop_by_key_is_carried_out_and_reported(plant: Path) -> None:
    with on_terminal("monitor", plant) as terminal:
        await_both(terminal)
        terminal.press(b"sy")
        terminal.wait_for("pump-1 has stopped")
        terminal.press(b"\x1b[Bsy")
        terminal.wait_for("the stop is repeated for 30 s at least: pump-9")


@pytest.mark.long
def test_the_page_of_a_drive_shows_why_an_unpolled_value_is_missing(plant: Path) -> None:
    with on_terminal("monitor", plant) as terminal:
        await_both(terminal)
        terminal.press(b"\x1b[B\r")
        terminal.wait_for("TOY T1  address 9")
        terminal.wait_for("  no reply  ")
        leave(terminal)


@pytest.mark.long
def test_the_monitor_records_the_displayed_values(plant: Path, tmp_path: Path) -> None:
    out = tmp_path / "seen.arrows"
    with on_terminal("monitor", plant, "--out", out) as terminal:
        await_both(terminal)
        leave(terminal)
    rows = [row for batch in open_recording(out) for row in batch]
    assert {row.drive for row in rows} == {"pump-1", "pump-9"}
    with on_terminal("monitor", plant, "--out", out) as terminal:
        terminal.wait_for("seen.arrows")  # waits until the recording exists
        assert terminal.process.wait(timeout=60) == 2


@pytest.mark.long
def test_the_monitor_shows_the_curves_around_a_trigger(plant: Path, tmp_path: Path) -> None:
    condition = "integral(pump-1.output_current >= 0) > 0.3"
    options = ("--trigger", condition, "--pre", "100 ms", "--post", "200 ms", "--out", tmp_path / "a.arrows")
    with on_terminal("monitor", plant, *options, size=(100, 24)) as terminal:
        terminal.wait_for("^ from -0.1 s to 0.2 s")
        leave(terminal)
    assert open_recording(tmp_path / "a.00000001.arrows").metadata["trigger"]["condition"] == condition


@pytest.mark.long
def test_the_monitor_creates_no_recording_if_no_port_opens(tmp_path: Path) -> None:
    plant, out = tmp_path / "hall.toml", tmp_path / "seen.arrows"
    plant.write_text(
        '[[line]]\nname = "hall"\nport = "/dev/not-there"\n'
        '[[line.drive]]\nname = "pump"\nmodel = "invt-che"\naddress = 1\n'
    )
    with on_terminal("monitor", plant, "--out", out) as terminal:
        terminal.wait_for("there is no such port")
        assert terminal.process.wait(timeout=60) == 1
    assert not out.exists()


@pytest.mark.long
def test_the_monitor_works_without_colours_or_utf_8(plant: Path) -> None:
    environment = {"NO_COLOR": "1", "PYTHONIOENCODING": "ascii"}
    with on_terminal("monitor", plant, size=(200, 50), **environment) as terminal:
        terminal.wait_for(">pump-1")
        await_both(terminal)
        leave(terminal)
        assert not re.search(rb"\x1b\[[0-9;]*3[0-9]m", terminal.written)
        assert terminal.written.isascii()


@pytest.mark.long
def test_the_monitor_uses_no_escape_codes_on_a_dumb_terminal(plant: Path) -> None:
    with on_terminal("monitor", plant, TERM="dumb") as terminal:
        terminal.wait_for(">pump-1")
        terminal.wait_for("q quit")
        assert b"\x1b" not in terminal.written
        picture = terminal.text[terminal.text.index(" multidrop monitor") :].partition("q quit")[0]
        assert len(picture.splitlines()) == 23
        await_both(terminal)
        leave(terminal)


@pytest.mark.long
def test_the_monitor_refuses_a_terminal_that_is_too_small(plant: Path) -> None:
    with on_terminal("monitor", plant, size=(40, 10)) as terminal:
        terminal.wait_for("the terminal has 40 x 10")
        assert terminal.process.wait(timeout=60) == 2


def test_the_monitor_suggests_other_commands_without_a_terminal(run: Run, tmp_path: Path) -> None:
    status, _, err = run("monitor", plant_file(tmp_path))
    assert status == 2
    assert err.startswith("multidrop: `multidrop monitor` needs a terminal on Linux or macOS; ")
