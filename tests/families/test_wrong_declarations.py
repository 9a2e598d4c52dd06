"""Wrong declarations: a drive is declared as a family that commands motors, but is of another family."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from profile_families import COMMANDED, READ_ONLY, shipped
from simulated_bus import SimulatedBus, is_write
from tables import table, usually

from multidrop.core import Framing, Message, build_reply
from multidrop.drive import Drive
from multidrop.errors import ANOTHER_FAMILY, BusError, DriveException, NoReply, Unconfirmed, WriteForbidden
from multidrop.families import MODELS, YD1000, DelixiModbus, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.families.registry import RECOGNISABLE, shipped_family
from multidrop.scan.scanner import identify
from multidrop.scan.sweep import ScanRequest, Sweep
from multidrop.sim import MotorDrive, simulated

BUILT_IN: dict[str, Callable[[int], Drive]] = {
    "erman-er-g-220": ErmanERG220,
    "invt-che": lambda address: InvtCHE(address, maximum_frequency=50),
    "innovert-ibd": InnovertIBD,
    "delixi-modbus": DelixiModbus,
    "yd1000": YD1000,
}
DECLARED = {**BUILT_IN, **{name: partial(shipped, name) for name in COMMANDED}}
every_declaration = pytest.mark.parametrize("declared", [*BUILT_IN, *usually(*COMMANDED)])
THERE: dict[str, Callable[[int], Any]] = {**DECLARED, **{name: shipped_family(name) for name in READ_ONLY}}
# Families with the same registers and control words: each can command drives of the other.
SAME_WORDS = (
    {"delta-vfd-el", "delta-ms300", "delta-cp2000"},
    {"erman-er-g-220", "erman-er-g-220-02"},
    {"innovert-ibd", "innovert-idd-mini-plus"},
    {"yaskawa-a1000", "yaskawa-v1000"},
)
# Families with the same stop. If one is declared as another, it can be stopped, but not started.
SAME_STOP = {"invt-che", "invt-chf100a", "fuling-dzb"}

AT_2000 = ("invt-goodrive", "powtran-pi130")
# Declared families, each with the families whose motors would run if they received its stop. The stop is not
# sent if the drive's registers prove that it is of such a family. See docs/reference/profiles.md.
RUNS_AT_A_STOP = {
    **dict.fromkeys(("innovert-ibd", "innovert-idd-mini-plus", "delixi-modbus"), AT_2000),
    **dict.fromkeys(("delta-vfd-el", "delta-ms300", "delta-cp2000"), AT_2000),
    "powtran-pi130": (
        *("innovert-ibd", "innovert-idd-mini-plus", "delixi-modbus"),
        *("delta-vfd-el", "delta-ms300", "delta-cp2000"),
    ),
}
# Built-in families whose drives are always recognised. They get no stop if another family is declared.
RECOGNISED = {"invt-che", "yd1000"}


def same_words(declared: str, there: str) -> bool:
    return any({declared, there} <= each for each in SAME_WORDS)


class Pair:
    """A declared drive, and a simulated drive of another make at its address, whose motor may turn."""

    def __init__(self, declared: str, there: str, turns: bool) -> None:
        self.sim: Any = simulated(THERE[there](1))
        self.bus = SimulatedBus(self.sim)
        self.drive = self.bus.attach(DECLARED[declared](1))
        if turns and isinstance(self.sim, MotorDrive):
            self.sim.motor.target = 20.0
            self.sim.motor.run(1)
            self.bus.sleep(5)
            self.sim.motor.run_to(self.bus.seconds)

    @property
    def turns(self) -> bool:
        motor = getattr(self.sim, "motor", None)
        return bool(motor and (motor.energised or motor.frequency))


@every_declaration
@table("there", THERE)
def test_no_command_is_sent_to_a_drive_of_another_family(declared: str, there: str) -> None:
    if declared == there or same_words(declared, there):
        return
    pair = Pair(declared, there, turns=False)
    for call in (lambda: pair.drive.set_frequency(20), pair.drive.start, pair.drive.reset_fault):
        with pytest.raises(BusError):
            call()
    assert pair.bus.written == []
    assert not pair.turns


@pytest.mark.parametrize("turns", usually(True, False), ids=["turning", "at rest"])
@every_declaration
@table("there", THERE)
def test_a_stop_never_starts_a_drive_of_another_family(declared: str, turns: bool, there: str) -> None:
    if declared == there or same_words(declared, there):
        return
    pair = Pair(declared, there, turns)
    failure: BusError | None = None
    try:
        pair.drive.stop(seconds=1)
    except BusError as raised:
        failure = raised
    is_withheld = isinstance(failure, WriteForbidden) and failure.rule == ANOTHER_FAMILY
    assert is_withheld == (pair.bus.written == [])
    if is_withheld:
        assert there in RECOGNISED or there in RUNS_AT_A_STOP.get(declared, ())
        assert (
            f"multidrop stop PORT {there}" in str(failure)
            or same_words(there, "delta-vfd-el")
            or (same_words(there, "innovert-ibd"))
        )
    if there in RUNS_AT_A_STOP.get(declared, ()):
        assert is_withheld or not pair.turns or turns
    if not turns:
        assert not pair.turns
    if {declared, there} <= SAME_STOP:
        assert pair.bus.written != []
        return
    assert failure is not None  # registers with the value 0 do not prove that the motor is at rest


@table(("declared", "there"), [(one, other) for one, others in RUNS_AT_A_STOP.items() for other in others])
def test_the_documentation_lists_stops_that_would_start_other_families(declared: str, there: str) -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "profiles.md").read_text("utf-8")
    rows = [row.split("|") for row in page.splitlines() if re.search(r"\| 000[16]H \|", row)]
    assert any(f"`{declared}`" in row[1] and f"`{there}`" in row[3] for row in rows)


@pytest.mark.parametrize("declared", ["delta-vfd-el", "delta-cp2000"])
def test_a_goodrive_declared_as_a_delta_is_recognised(declared: str) -> None:
    """P09.00 of a Goodrive, at 0900H, may be equal to its address. A Delta has its address in 0900H."""
    pair = Pair(declared, "invt-goodrive", turns=False)
    show = pair.sim.answer
    pair.sim.answer = lambda request, now: (
        replace_data(request, 1) if request.start == 0x0900 else show(request, now)
    )
    with pytest.raises(WriteForbidden, match="model = invt-goodrive"):
        pair.drive.set_frequency(20)
    with pytest.raises(WriteForbidden, match="multidrop stop PORT invt-goodrive 1"):
        pair.drive.stop(seconds=1)
    assert pair.bus.written == []


def replace_data(request: Any, value: int) -> Any:
    return type(request)(request.address, request.function, data=value.to_bytes(2))


def test_goodrive_declared_as_a_confirmed_innovert_ibd_does_not_run() -> None:
    """The owner had confirmed the drive as an INNOVERT IBD before a Goodrive replaced it."""
    sim: Any = simulated(shipped("invt-goodrive", 1))
    bus = SimulatedBus(sim)
    drive = bus.attach(InnovertIBD(1, confirmed=1))
    with pytest.raises(WriteForbidden, match="model = invt-goodrive"):
        drive.start()
    with pytest.raises(WriteForbidden, match="multidrop stop PORT invt-goodrive 1"):
        drive.stop(seconds=1)
    assert bus.written == []
    assert not sim.motor.energised


def test_delta_drive_declared_as_a_goodrive_is_stopped_but_gets_no_coast() -> None:
    """The word 5 stops both drives. The word 6 coasts a Goodrive, but would run a Delta."""
    pair = Pair("invt-goodrive", "delta-vfd-el", turns=True)
    with pytest.raises(WriteForbidden, match="multidrop stop PORT delta-vfd-el 1"):
        pair.drive.coast(seconds=1)
    assert pair.bus.written == []
    with pytest.raises(BusError):
        pair.drive.stop(seconds=1)
    assert pair.bus.written != []


def test_the_error_for_a_wrongly_declared_chf100a_names_its_model() -> None:
    pair = Pair("invt-che", "invt-chf100a", turns=True)
    with pytest.raises(WriteForbidden, match="declare model = invt-chf100a"):
        pair.drive.start()
    assert pair.bus.written == []
    pair.drive.stop()
    assert not pair.turns


def test_erman_declared_as_an_optidrive_has_an_unknown_state() -> None:
    pair = Pair("optidrive-e3", "erman-er-g-220", turns=True)
    with pytest.raises(
        Unconfirmed, match=r"All registers read 0, .* another maker's drive: look at the motor"
    ):
        pair.drive.stop()
    assert pair.turns


@table("declared", COMMANDED)
def test_a_stop_is_sent_although_a_gateway_answers_ffff(declared: str) -> None:
    bus = SimulatedBus()
    drive = bus.attach(DECLARED[declared](1))
    bus.answers = lambda request: (
        None
        if is_write(request)
        else build_reply(Framing.RTU, Message(1, request.function, data=b"\xff\xff" * request.count))
    )
    with pytest.raises(BusError):
        drive.stop(seconds=1)
    assert bus.written


SCANNED = [*MODELS.values(), *map(shipped_family, RECOGNISABLE)]


def ask(sim: Any, drive: Drive, request: Message) -> Message:
    reply = sim.answer(request, 1000.0)
    if reply is None:
        raise NoReply(drive.name)
    if reply.exception:
        raise DriveException(drive.name, reply.exception, "")
    return Message(reply.address, reply.function, data=reply.data)


@table("there", [*RECOGNISABLE, "invt-che", "yd1000", "delixi-modbus"])
def test_a_scan_recognises_drives_by_their_identity_registers(there: str) -> None:
    drive = THERE[there](1)
    sweep = Sweep(drive.settings, drive.framing, (), ScanRequest(3, 0, 1), (1,), 0.0, 0.0)
    found, doubt = identify(sweep, 1, SCANNED, partial(ask, simulated(drive)))
    assert [one.model for one in found] == [there]
    assert doubt == ""
