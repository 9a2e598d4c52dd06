"""Each verb of every family, in each situation, with each fault on the line: its outcome and its frames.

TABLE is the whole specification. `check` asserts the rules that apply to every cell.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from motors import MAKE, STARTS
from profile_families import MAKE as PROFILES
from profile_families import STARTS as PROFILE_STARTS
from simulated_bus import is_write, one
from tables import table, usually

from multidrop.control import records
from multidrop.control.outcome import Seen
from multidrop.core import Message, build_reply, build_request
from multidrop.drive import Drive
from multidrop.errors import BusError, DriveException, NoReply, Unconfirmed, Unsupported, WriteForbidden

FAMILIES: dict[str, Callable[[int], Drive]] = {**MAKE, **PROFILES}
STARTED_BY = {**STARTS, **PROFILE_STARTS}
NO_EXCEPTIONS = "delixi-native"  # no Modbus exceptions: its error replies have other codes

VERBS: dict[str, Callable[[Any], Any]] = {
    "set_frequency": lambda drive: drive.set_frequency(25),
    "start": lambda drive: drive.start(),
    "jog": lambda drive: drive.jog(),
    "stop": lambda drive: drive.stop(seconds=5),
    "coast": lambda drive: drive.coast(seconds=5),
    "stop_all": lambda drive: drive.bus.stop_all(seconds=5)[drive.name],
    "reset_fault": lambda drive: drive.reset_fault(),
}
TURNING, STOPPING = ("start", "jog"), ("stop", "coast", "stop_all")
OUTCOMES: dict[str, type[BusError]] = {
    "?": Unconfirmed,
    "x": DriveException,
    "-": NoReply,
    "!": WriteForbidden,
    "n": Unsupported,
}
# The outcome of each verb, by situation and fault. ok: done; ?: unconfirmed; x: refused by the drive;
# -: no reply, and no write was sent; !: forbidden. A family without the verb always raises Unsupported.
# In a cell such as ok/?, the second outcome is that of the families in SECOND.
TABLE = """
situation verb          none lost-once lost never damaged exception late silent unreadable deaf echo
fresh     set_frequency ok   ok/?      ok/? ?     ?       x         ok/? ?      ?          -    -
fresh     start         !    !         !    !     !       !         !    !      !          -    -
fresh     stop          ok   ok        ?    ?     ok      ok/x      ok   ?      ?          ?    ?
set       set_frequency ok   ok/?      ok/? ?     ?       x         ok/? ?      ?          ?/-  ?/-
set       start         ok   ?/ok      ?    ?     ?/ok    x         ?/ok ?      ?/-        -    -
set       jog           ok   ?         ?    ?     ?       x         ?    ?      ?          -    -
running   set_frequency ok   ok/?      ok/? ?     ?       x         ok/? ?      ?          ?/-  ?/-
running   stop          ok   ok        ?    ?     ok      x         ok   ?      ?          ?    ?
running   coast         ok   ok        ?    ?     ok      x         ok   ?      ?          ?    ?
running   stop_all      ok   ok        ?    ?     ok      x         ok   ?      ?          ?    ?
running   reset_fault   !    !         !    !     !       !         !    !      !          -    -
tripped   start         !/?  !/?       !/?  !/?   !/?     !/x       !/?  !/?    !/?        -    -
tripped   stop          ok   ok        ?    ?     ok      ok/x      ok   ?      ?          ?    ?
tripped   reset_fault   ok   ok/?      ?    ?     ok/?    x         ?/ok ?      ?          -    -
"""
SEVERAL_WORDS = {"abb-acs355", "siemens-v20", "schneider-atv320"}  # a start takes several control words
SECOND: dict[tuple[str, str], set[str]] = {
    # drives whose setpoints cannot be read back
    ("set_frequency", "?"): {"innovert-ibd", "delixi-native", "danfoss-fc51", "delta-vfd-el"},
    # these drives read a limit or the present value before the write
    ("set_frequency", "-"): {"erman-er-g-220", "delixi-modbus", "yd1000"},
    ("start", "ok"): SEVERAL_WORDS,
    ("start", "-"): SEVERAL_WORDS,
    # this drive's status register does not change while the drive is tripped
    ("start", "?"): {"yd1000"},
    ("start", "x"): {"yd1000"},
    # these drives have no status that shows a motor at rest
    ("stop", "x"): {"erman-er-g-220", "innovert-ibd", "delixi-modbus", "yd1000"},
    ("reset_fault", "?"): {"invt-che", "delixi-native"},  # one write resets the fault
    ("reset_fault", "ok"): {"yaskawa-a1000", "yd1000"},  # a reset takes several control words
}
HEAD, *ROWS = [line.split() for line in TABLE.strip().splitlines()]
REPEATED = (("fresh", "stop"), ("tripped", "stop"), ("running", "coast"), ("running", "set_frequency"))
CELLS = [
    pytest.param(
        (row[0], row[1], fault, outcomes, (nth + number) % 3),
        id=f"{row[0]}-{row[1]}-{fault}",
        marks=pytest.mark.long if (row[0], row[1]) in REPEATED else (),
    )
    for nth, row in enumerate(ROWS)
    for number, (fault, outcomes) in enumerate(zip(HEAD[2:], row[2:], strict=True))
]
NOT_ARRIVING = ("never", "silent", "exception", "deaf", "echo")  # faults with which no write takes effect


class Cell:
    """One drive in a situation of TABLE. A fault affects the line from the verb's first write on."""

    def __init__(self, family: str, situation: str) -> None:
        self.line, self.drive, self.sim = one(FAMILIES[family](1))
        self.sim.motor.acceleration_time = self.sim.motor.deceleration_time = 1.0
        self._is_start = STARTED_BY[family]
        if situation != "fresh":
            self.drive.set_frequency(20)
        if situation == "running":
            self.drive.start()
            self.line.sleep(3)
        if situation == "tripped":
            self.sim.trip(4)
        self._begun = len(self.line.frames)
        self._late: list[bytes] = []

    @property
    def writes(self) -> list[Message]:
        return [request for request, _ in self.line.frames[self._begun :] if is_write(request)]

    @property
    def starts(self) -> list[Message]:
        return [write for write in self.writes if self._is_start(write)]

    def strike(self, fault: str) -> None:
        """Start this fault on the line."""
        line = self.line
        losing: dict[str, Callable[[Message], bool]] = {
            "lost-once": lambda request: is_write(request) and len(self.writes) == 1,
            "lost": is_write,
            "unreadable": lambda request: bool(self.writes) and not is_write(request),
        }
        answering: dict[str, Callable[[Message], bytes | None]] = {
            "damaged": lambda request: b"\x01\x06\0" if is_write(request) and len(self.writes) < 3 else None,
            "exception": lambda request: self._refusal(request) if is_write(request) else None,
            "late": self._answer_of_the_request_before,
            "echo": lambda request: build_request(self.drive.framing, request) if is_write(request) else None,
        }
        line.loses = losing.get(fault, line.loses)
        line.answers = answering.get(fault, line.answers)
        deafening: dict[str, Callable[[Message], bool]] = {
            "never": is_write,
            "silent": lambda request: bool(self.writes),
            "deaf": lambda request: True,
            "echo": lambda request: True,
        }
        line.deafens = deafening.get(fault, line.deafens)

    def _refusal(self, request: Message) -> bytes:
        return build_reply(
            self.drive.framing, Message(request.address, request.function, request.start, exception=4)
        )

    def _answer_of_the_request_before(self, request: Message) -> bytes | None:
        """Return the reply to the previous request, for three requests from the first write on."""
        if not self.writes or len(self._late) == 3:
            return None
        reply = self.sim.answer(request, self.line.seconds)
        self._late.append(build_reply(self.drive.framing, reply) if reply else b"")
        return self._late[-2] if len(self._late) > 1 else b""

    def outcome(self, verb: str) -> str:
        try:
            result = VERBS[verb](self.drive)
        except tuple(OUTCOMES.values()) as failure:
            return next(sign for sign, kind in OUTCOMES.items() if type(failure) is kind)
        if verb == "stop_all":
            return {Seen.STOPPED: "ok", Seen.SENT: "?", Seen.REFUSED: "x"}.get(result.seen, str(result))
        return "ok"

    def runs(self) -> bool:
        self.sim.pass_time(self.line.seconds + 60)
        return bool(self.sim.motor.energised)


def check(cell: Cell, situation: str, verb: str, fault: str, outcome: str) -> None:
    """Check the rules that apply to every cell of TABLE."""
    assert len(cell.starts) <= (verb in TURNING), "a start is sent once, and only by a start"
    if outcome in ("-", "!", "n") and fault != "unreadable":
        assert cell.writes == [], "nothing was sent"
    runs = cell.runs()
    if situation == "running" and (verb not in STOPPING or outcome == "n"):
        assert runs
    elif verb not in TURNING and situation != "running":
        assert not runs, "only a start turns a motor"
    if verb in TURNING and outcome == "ok":
        assert runs
    if (situation, outcome) == ("set", "?") and fault in ("lost-once", "lost", "unreadable"):
        assert runs is bool(cell.starts), "the caller was told that it may run"
    if verb in STOPPING and outcome != "n":
        assert not runs or fault in NOT_ARRIVING
        assert len(cell.writes) > (0 if outcome == "ok" else 3), "a stop is sent until it is confirmed"
        if fault == "lost-once":
            assert cell.writes[0] == cell.writes[1]
    if verb == "set_frequency":
        assert len(cell.writes) <= 1, "a setpoint is sent once"


# The short run tries each cell of TABLE on a third of the built-in families.
@pytest.mark.parametrize("part", usually(0, 1, 2, 3), ids=["a third", "another", "the last", "profiles"])
@pytest.mark.parametrize("cell", CELLS)
def test_verb_outcomes_during_faults_equal_the_table(part: int, cell: tuple[str, str, str, str, int]) -> None:
    situation, verb, fault, expected, first_third = cell
    families = [*PROFILES] if part == 3 else [*MAKE][(first_third + part) % 3 :: 3]
    first, _, second = expected.partition("/")

    @table("family", families)
    def outcome_is_as_expected(family: str) -> None:
        if fault == "exception" and family == NO_EXCEPTIONS:
            return
        with pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.setattr(records, "LEAST_INTERVAL", 0.0)  # seconds between two EEPROM writes
            tried = Cell(family, situation)
            tried.strike(fault)
            outcome = tried.outcome(verb)
            wanted = second if family in SECOND.get((verb, second), ()) else first
            assert outcome == wanted or (outcome == "n" and verb in ("jog", "coast", "reset_fault")), wanted
            check(tried, situation, verb, fault, outcome)

    outcome_is_as_expected()
