"""A stop always wins: no call that started before a stop moves a motor after the stop.

The ports and threads are real, and the far ends record every frame. A line keeps the order of frames, so any
frame after a stop's first frame was sent after the call of the stop. Threads that start motors are paused
during their checks until the stop is called. A longer run:
`STOP_EXAMPLES=100 pytest -m '' tests/control/test_stop_wins.py`.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from lines import line as declared_line
from lines import plant, polled
from motors import quick
from responder import Responder, ResponderLine
from responder_drives import KINDS, ResponderDrive
from tables import usually

from multidrop.bus import Bus
from multidrop.control.ramp import start_staggered
from multidrop.drive import Drive
from multidrop.errors import BusError
from multidrop.poller import Poller

EXAMPLES = int(os.environ.get("STOP_EXAMPLES", "2"))
EXPIRY = 60.0  # s; long enough for a busy computer
DRIVES = 2
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Signalled(Exception):
    """Raised by the signal handlers of the test, instead of ending the process."""


def _signalled(number: int, frame: object) -> None:
    raise Signalled(number)


class Stops(RuleBasedStateMachine):
    """A state machine: one line with two drives of one family, and the rules that start and stop them.

    An episode is the time from one stop to the next.
    """

    kind = ""

    @initialize(polling=st.booleans(), on_exit=st.booleans())
    def begin(self, polling: bool, on_exit: bool) -> None:
        self._stack = ExitStack()
        directory = Path(self._stack.enter_context(TemporaryDirectory()))
        self._ledger = directory / "ledger"
        self.polling, self.on_exit = polling, on_exit
        self.responders = [ResponderDrive(KINDS[self.kind], address) for address in range(1, DRIVES + 1)]
        self.line = ResponderLine(self.responders)
        self.far = self._stack.enter_context(Responder([self.line], directory))
        for number in SIGNALS:
            self._stack.callback(signal.signal, number, signal.signal(number, _signalled))
        self.threads: list[threading.Thread] = []
        self._open()

    # ---- the client ----

    def _open(self) -> None:
        """Open a new client, write the setpoints, and start the first episode."""
        self.line.troubles.clear()
        family, options = quick(self.kind), KINDS[self.kind].makes
        self.drives = [
            family(responder.address, name=f"drive-{responder.address}", **options)
            for responder in self.responders
        ]
        if self.polling:
            asked = [polled(each, each.readings()[:2]) for each in self.drives]
            self.poller: Poller | None = Poller(
                plant(declared_line(self.far.ports[0], *asked)), ledger=self._ledger
            )
            self.poller.__enter__()
            self.bus = self.poller.bus("line")
        else:
            self.poller = None
            self.bus = Bus(self.far.ports[0], ledger=self._ledger, expiry=EXPIRY)
            for drive in self.drives:
                self.bus.attach(drive)
        if self.on_exit:
            self.bus.stop_on_exit()
        if self.kind != "fan":
            for drive in self.drives:
                drive.set_frequency(20)
        self._mark()

    def _mark(self, drive: Drive | None = None) -> None:
        """Start an episode: send a read, which marks the end of all earlier frames in the log."""
        drive = drive or self.drives[0]
        self.line.troubles.clear()
        begun = len(self.line.log)
        with suppress(BusError):
            drive.read(drive.register(KINDS[self.kind].mark))
        assert len(self.line.log) > begun
        self.begun = len(self.line.log)
        self.staggered = False
        self.connection = self.line.connection

    def _close(self) -> None:
        (self.poller or self.bus).close()

    # ---- rules ----

    @rule(troubles=st.lists(st.sampled_from(["mute", "deaf", "late", 1, 2, 3, 4, 6, 0x11, ""]), max_size=6))
    def have_trouble(self, troubles: list[str | int]) -> None:
        """Set the faults that happen to the next requests."""
        self.line.troubles[:] = troubles

    @precondition(lambda self: len(self.threads) < 3 and not self.staggered)
    @rule(
        number=st.integers(0, DRIVES - 1),
        name=st.sampled_from(["start", "start", "jog", "staggered"]),
        after=st.integers(0, 12),
    )
    def start_and_hold(self, number: int, name: str, after: int) -> None:
        """Start a motor in a thread; after `after` requests, hold replies until a stop is called.

        A staggered start that fails stops both drives, so other starts of this episode end too.
        """
        self.staggered = name == "staggered"
        self.line.hold(after)
        thread = self._thread(
            (lambda: start_staggered(self.drives, 0.05))
            if self.staggered
            else getattr(self.drives[number], name)
        )
        while thread.is_alive() and not self.line.held.wait(0.01):
            pass

    @rule(number=st.integers(0, DRIVES - 1))
    def started_by_hand(self, number: int) -> None:
        self.responders[number].turn()

    @rule(
        how=st.sampled_from(["verb", "verb", "stop_all", "leave", "signal", "signal"]),
        verbs=st.lists(st.tuples(st.integers(0, DRIVES - 1), st.integers(0, 2)), min_size=1, max_size=2),
        signals=st.lists(st.sampled_from(SIGNALS), min_size=1, max_size=2),
    )
    def stop(self, how: str, verbs: list[tuple[int, int]], signals: list[signal.Signals]) -> None:
        """Call a stop, and release the held replies at that moment."""
        if how in ("leave", "signal") and not self.on_exit:
            how = "stop_all"
        stopped = {number for number, _ in verbs} if how == "verb" else set(range(DRIVES))
        failures: list[BaseException] = []
        calls: list[Callable[[], object]] = []
        if how == "verb":
            halts = KINDS[self.kind].halts
            calls = [getattr(self.drives[number], halts[which % len(halts)]) for number, which in verbs]
        elif how == "stop_all":
            calls = [self.bus.stop_all]
        stopping = [self._thread(call, failures) for call in calls]
        releasing = threading.Thread(target=self._release)
        releasing.start()
        if how == "leave":
            self._close()
        elif how == "signal":
            self._signal(signals)
        for thread in (releasing, *stopping, *self.threads):
            thread.join()
        self.threads.clear()
        self.judge(stopped, failures)
        if how in ("leave", "signal"):
            self._close()
            self._judge_order(range(DRIVES))
            for number in SIGNALS:
                signal.signal(number, _signalled)
            self._open()
        else:
            self._mark()

    def _release(self) -> None:
        """Wait a moment, so that a wrong frame would have time to appear, and release the held replies."""
        time.sleep(0.005)
        self.far.release(self.line)

    def _signal(self, signals: list[signal.Signals]) -> None:
        """Raise the first signal; once its stops are on the wire, send the second signal."""

        def again() -> None:
            while not self._received("stops") and not over.is_set():
                over.wait(0.001)
            for number in signals[1:]:
                os.kill(os.getpid(), number)

        over = threading.Event()
        second = threading.Thread(target=again)
        try:
            second.start()
            signal.raise_signal(signals[0])
            while True:  # the signal's effect is delayed until the stops are over
                time.sleep(0.01)
        except Signalled:
            over.set()
        while not self._is_deaf_to_signals():
            pass
        second.join()

    def _is_deaf_to_signals(self) -> bool:
        """Ignore SIGNALS from now on; return False if a signal arrived before all SIGNALS were ignored."""
        try:
            for number in SIGNALS:
                signal.signal(number, signal.SIG_IGN)
        except Signalled:
            return False
        return True

    @precondition(lambda self: self.threads)
    @rule(detaches=st.booleans())
    def part(self, detaches: bool) -> None:
        """Close the bus or detach the first drive; check that earlier calls then move no motor."""
        releasing = threading.Thread(target=self._release)
        releasing.start()
        if detaches and self.poller:
            self.poller.remove("line", self.drives[0].name)
        elif detaches:
            self.bus.detach(self.drives[0])
        else:
            self._close()
            releasing.join()  # a held reply must not reach the next client, which could misattribute it
            self._open()
        self._mark(self.drives[1])
        for thread in (releasing, *self.threads):
            thread.join()
        self.threads.clear()
        begun = self.begun
        self._mark(self.drives[1])
        late = [at for at in self._received("moves", 1 if detaches else None, begun) if at < self.begun]
        assert [str(self.line.log[at]) for at in late] == [], self._story()
        if detaches:
            self._close()
            self._open()

    @precondition(lambda self: self.threads and not self.staggered)
    @rule()
    def lose_the_port(self) -> None:
        """Unplug the adapter and plug it in again; check that earlier calls then move no motor."""
        self.far.lose(self.line)
        failures: list[BaseException] = []
        stopping = self._thread(self.drives[0].stop, failures)
        for thread in self.threads:
            thread.join()
        self.threads.clear()
        self.far.bring_back(self.line)
        stopping.join()
        self._close()
        back = [each for each in self.line.log if each.connection == self.line.connection]
        assert [str(each) for each in back if each.what == "moves"] == []
        assert failures or not self.responders[0].runs
        for drive in self.responders:
            drive.switch_on()  # a restart, which also ends runs that were not stopped
        self._open()

    @precondition(lambda self: not self.threads and not self.polling)
    @rule(number=st.integers(0, DRIVES - 1))
    def start(self, number: int) -> None:
        """Check that after a stop a motor can be started again."""
        if self.responders[number].runs:
            return
        self.line.troubles.clear()
        self.drives[number].start()
        assert self.responders[number].runs

    # ---- checks ----

    def _thread(
        self, call: Callable[[], object], failures: list[BaseException] | None = None
    ) -> threading.Thread:
        def run() -> None:
            try:
                call()
            except (BusError, ValueError, OSError) as failure:
                if failures is not None:
                    failures.append(failure)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        if failures is None:
            self.threads.append(thread)
        return thread

    def _received(self, what: str, address: int | None = None, begun: int | None = None) -> list[int]:
        """Return the log's indices of frames of kind `what`, from `begun` or from the episode's start on."""
        begun = self.begun if begun is None else begun
        return [
            at
            for at, each in enumerate(list(self.line.log))
            if at >= begun
            and each.what == what
            and each.asked is not None
            and (address is None or each.asked.address in (0, address))
        ]

    def _judge_order(self, numbers: Any) -> None:
        for number in numbers:
            stops, moves = (self._received(what, number + 1) for what in ("stops", "moves"))
            if stops:
                late = [str(self.line.log[at]) for at in moves if at > stops[0]]
                assert not late, f"after {self.line.log[stops[0]]} came {late}\n{self._story()}"

    def judge(self, numbers: set[int], failures: list[BaseException]) -> None:
        self._judge_order(numbers)
        for number in numbers:
            assert self._received("stops", number + 1), f"no stop was sent: {failures}\n{self._story()}"
            if not failures:
                assert not self.responders[number].runs, f"{number + 1} was left running\n{self._story()}"

    def _story(self) -> str:
        return "\n".join(str(each) for each in self.line.log[self.begun :])

    @invariant()
    def no_frame_of_ours_is_damaged(self) -> None:
        assert [
            str(each) for each in getattr(self, "line", ResponderLine([])).log if each.what == "damaged"
        ] == []

    def teardown(self) -> None:
        if not hasattr(self, "_stack"):
            return
        failure = sys.exc_info()[1]
        if isinstance(failure, Exception):  # a failure may not be reproducible
            print(f"{type(failure).__name__}: {failure}\n{self._story()}\n")
        self.line.troubles.clear()
        self.far.release(self.line)
        with suppress(AttributeError, Signalled):
            self._close()
        for thread in self.threads:
            thread.join()
        self._stack.close()


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("kind", usually(*KINDS))
def test_no_earlier_call_moves_a_motor_after_a_stop(kind: str) -> None:
    machine = type(f"StopsOf{kind}", (Stops,), {"kind": kind})
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=EXAMPLES,
            stateful_step_count=12,
            derandomize=not os.environ.get("STOP_EXAMPLES"),
            phases=[Phase.generate],
            deadline=None,
            suppress_health_check=list(HealthCheck),
        ),
    )


@pytest.mark.parametrize("kind", usually(*KINDS))
def test_a_start_is_cancelled_by_a_stop_during_the_first_exchanges(kind: str) -> None:
    """The stop is called after 0 to 5 exchanges of the start; the test calls the machine's rules itself."""
    machine = type(f"StopsOf{kind}", (Stops,), {"kind": kind})()
    machine.begin(polling=False, on_exit=False)
    try:
        for after in range(6):
            machine.start_and_hold(number=0, name="start", after=after)
            machine.stop(how="verb", verbs=[(0, 0)], signals=[])
    finally:
        machine.teardown()


@pytest.mark.parametrize("kind", usually(*KINDS))
def test_a_start_without_a_stop_turns_the_motor(kind: str) -> None:
    """Without this test, the tests above could pass although no start is ever sent."""
    machine = type(f"StopsOf{kind}", (Stops,), {"kind": kind})()
    machine.begin(polling=False, on_exit=False)
    try:
        machine.drives[0].start()
        assert machine.responders[0].runs
    finally:
        machine.teardown()
