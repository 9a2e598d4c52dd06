"""Hazards: dangerous frames that a naive client would send, and the frames that this library sends instead.

The table has a row for each address that families use differently, and for each error or omission in a
document that concerns a client. The frame `naive`, printed in the document if possible, must never be sent.
`sends` has all frames that are sent instead, except reads. Both are without checksums.

A code such as E1 is an erratum of one document: E of the ERMAN ER-G-220, I of the INVT CHE, N of the INNOVERT
IBD, D of the Delixi, Y of the YD1000. A code such as 0.1 concerns several documents.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import checksums
import pytest
from simulated_bus import SimulatedBus, one, text
from tables import table

from multidrop.core import Framing, Message, NumberFormat, build_reply, build_request, parse_reply
from multidrop.drive import Condition, Direction, Drive
from multidrop.drive.register import HOLDING, Kept
from multidrop.errors import BadReply, DriveException, NoReply, Unconfirmed, Unsupported, WriteForbidden
from multidrop.families import YD1000, DelixiModbus, DelixiNative, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.families.delixi import DelixiNativeStatus
from multidrop.families.erman_er_g_220 import ErmanFault, ErmanStatus, Modes
from multidrop.families.innovert_ibd import FrequencySource
from multidrop.families.invt_che import parameter
from multidrop.families.yd1000 import YD1000Control


def erman(**options: Any) -> Drive:
    return ErmanERG220(1, **options)


def che() -> Drive:
    return InvtCHE(1, maximum_frequency=50)


def ibd(**options: Any) -> Drive:
    return InnovertIBD(1, **options)


def delixi() -> Drive:
    return DelixiModbus(1)


def native() -> Drive:
    return DelixiNative(1)


def yd() -> Drive:
    return YD1000(1)


@dataclass(frozen=True)
class Hazard:
    """A dangerous action of a user, `do(line, drive, sim)`.

    Before the action, the simulated drive gets the register values `shows`.
    """

    drive: Callable[[], Drive]
    do: Callable[[SimulatedBus, Any, Any], object]
    naive: str
    sends: tuple[str, ...] = ()
    refuses: str = ""  # text of the error that refuses the action
    error: type[Exception] = WriteForbidden
    shows: Mapping[str, Any] = field(default_factory=dict)
    turning: bool = False  # whether the motor turns for a second before the action


def start(line: SimulatedBus, drive: Any, sim: Any) -> None:
    drive.start()


def run(line: SimulatedBus, drive: Any, sim: Any) -> None:
    drive.set_frequency(20)
    drive.start()


def stop(line: SimulatedBus, drive: Any, sim: Any) -> None:
    drive.stop()


def reset(line: SimulatedBus, drive: Any, sim: Any) -> None:
    drive.reset_fault()


def direct(direction: Direction) -> Callable[[SimulatedBus, Any, Any], None]:
    return lambda line, drive, sim: drive.start(direction)


def frequency(hz: float) -> Callable[[SimulatedBus, Any, Any], None]:
    return lambda line, drive, sim: drive.set_frequency(hz)


def write(name: str, value: Any) -> Callable[[SimulatedBus, Any, Any], object]:
    return lambda line, drive, sim: drive.write(drive.register(name), value)


def broadcast(name: str, value: Any) -> Callable[[SimulatedBus, Any, Any], object]:
    return lambda line, drive, sim: line.bus.broadcast(drive.register(name), value)


HAZARDS = {
    # ---- section 0: one address with several meanings ----
    "0.1: 2000H, Delixi's run forward is run and fault reset on an IBD": Hazard(
        ibd, run, naive="01 06 20 00 00 12", sends=("01 06 20 01 07 D0", "01 06 20 00 00 02")
    ),
    "0.1: 2000H, IBD's fault reset is a direction on a Delixi": Hazard(
        delixi, reset, naive="01 06 20 00 00 10", refuses="no fault reset", error=Unsupported
    ),
    "0.1: 1000H, YD1000's words are no command of a CHE": Hazard(
        che, stop, naive="01 06 10 00 80 00", sends=("01 06 10 00 00 05", "01 06 10 00 00 08"), turning=True
    ),
    "0.1: 1000H, CHE's stop does not stop a YD1000": Hazard(
        yd, stop, naive="01 06 10 00 00 05", sends=("01 06 10 00 C0 00",), turning=True
    ),
    "0.1: 2000H, Goodrive's control is CHE's setpoint: identity first": Hazard(
        che, frequency(25), naive="01 06 20 00 13 88", refuses="010AH", shows={"device": 0x010A}
    ),
    "0.1: stop is 5 and coast 6 on a CHE, and elsewhere the other way round": Hazard(
        che,
        lambda line, drive, sim: drive.coast(),
        naive="01 06 10 00 00 05",
        sends=("01 06 10 00 00 06",),
        turning=True,
    ),
    "0.1: 0001H and 0002H are EEPROM parameters of a YD1000": Hazard(
        yd, frequency(28.5), naive="01 06 00 02 01 1D", sends=("01 06 10 01 0B 22",)
    ),
    "0.2: change of direction is a toggle (IBD, bits 2 and 3)": Hazard(
        ibd, direct(Direction.REVERSE), naive="01 06 20 00 00 0E", refuses="does not say"
    ),
    "0.6: reset and start in one frame (YD1000)": Hazard(
        yd,
        write("control", YD1000Control.COMMAND_VALID | YD1000Control.RESET | YD1000Control.RUN),
        naive="01 06 10 00 A4 00",
        refuses="never written together",
    ),
    "0.7: only a stop and a setpoint of zero are broadcast": Hazard(
        ibd, broadcast("frequency", 50.0), naive="00 06 20 01 13 88", refuses="the manual does not allow it"
    ),
    # ---- 1: ERMAN ----
    "E3: the example of 06 writes the setpoint to 0001H": Hazard(
        erman, frequency(28.5), naive="01 06 00 01 01 1D", sends=("01 06 00 02 01 1D",)
    ),
    "E3: 0001H is the control register": Hazard(
        erman,
        write("control_register", Modes.CONTROL_TYPE),
        naive="01 06 00 01 00 10",
        refuses="never|not written",
    ),
    "E4, E6: the example of 0F resets and starts, and sets a reserved coil": Hazard(
        erman,
        reset,
        naive="01 0F 00 00 00 09 02 01 01",
        sends=("01 05 00 00 00 00", "01 05 00 09 FF 00", "01 05 00 09 00 00"),
    ),
    "E5: the order of bytes in a reply to 01 is doubtful, so a read covers one byte at most": Hazard(
        erman,
        lambda line, drive, sim: drive.read(drive.start_held, drive.fault_reset_held),
        naive="01 01 00 00 00 0C",
    ),
    "E11: the last fault may be past or present: no start before a reset": Hazard(
        erman,
        run,
        naive="01 05 00 00 FF 00",
        sends=("01 06 00 02 00 C8",),
        refuses=r"overheat.*reset_fault",
        shows={"last_fault": ErmanFault.OVERHEAT},
    ),
    "E17: a start first clears both stop coils, and sets one coil": Hazard(
        erman,
        run,
        naive="01 0F 00 00 00 0A 02 01 02",
        sends=("01 06 00 02 00 C8", "01 05 00 01 00 00", "01 05 00 02 00 00", "01 05 00 00 FF 00"),
    ),
    "E17: a stop sets STOP and clears START, and is verified": Hazard(
        erman, stop, naive="01 05 00 01 00 00", sends=("01 05 00 01 FF 00", "01 05 00 00 00 00"), turning=True
    ),
    "E17: a motor that runs on after its ramp is stopped by the emergency stop": Hazard(
        erman,
        stop,
        naive="01 05 00 00 FF 00",
        sends=("01 05 00 01 FF 00", "01 05 00 00 00 00", "01 05 00 02 FF 00"),
        refuses="does not report a stop within",
        error=Unconfirmed,
        shows={"status": ErmanStatus.RUNNING},
    ),
    "E18: nothing is broadcast, because drives may reply": Hazard(
        erman, broadcast("frequency", 0.0), naive="00 06 00 02 00 00", refuses="the manual does not allow it"
    ),
    # ---- 2: INVT CHE ----
    "I1: no ordinal is computed: P0.07 has no address here": Hazard(
        che,
        lambda line, drive, sim: drive.register("acceleration_time"),
        naive="01 06 80 0C 00 C8",
        refuses="no register",
        error=ValueError,
    ),
    "I5: the address of RAM keeps its bit 15": Hazard(
        lambda: Mine(1),
        write("acceleration_time", 20.0),
        naive="01 06 00 0C 00 C8",
        sends=("01 06 80 0C 00 C8",),
    ),
    "2.7: the setpoint is per cent of the maximum frequency: 50 Hz of 50 Hz is not 5000": Hazard(
        che, frequency(50), naive="01 06 20 00 13 88", sends=("01 06 20 00 27 10",)
    ),
    "2.7: a negative setpoint likely reverses": Hazard(
        che, write("setpoint", -50.0), naive="01 06 20 00 EC 78", refuses="outside 0 to 100"
    ),
    "2.7: the setpoint goes before the start": Hazard(
        che, start, naive="01 06 10 00 00 01", refuses="set_frequency"
    ),
    # ---- 3: INNOVERT IBD ----
    "N1: what Prb.01 means is contradictory": Hazard(
        ibd,
        write("frequency_source", FrequencySource.LINE),
        naive="01 06 00 65 00 05",
        refuses="contradictory",
    ),
    "N1: a drive that does not follow the line is not started": Hazard(
        ibd,
        run,
        naive="01 06 20 00 00 02",
        sends=("01 06 20 01 07 D0",),
        refuses=r"Prb\.01 to 5",
        shows={"frequency_source": 3},
    ),
    "N2: which bit is forward is ambiguous": Hazard(
        ibd, direct(Direction.FORWARD), naive="01 06 20 00 00 0A", refuses="does not say"
    ),
    "N7: the setpoint's range ignores the drive's maximum": Hazard(
        lambda: ibd(maximum_frequency=60),
        frequency(60.01),
        naive="01 06 20 01 17 71",
        refuses="above maximum_frequency",
    ),
    "N8: 2000H and 2001H may only be written": Hazard(
        ibd,
        lambda line, drive, sim: drive.read(drive.control),
        naive="01 03 20 00 00 01",
        refuses="cannot be read",
        error=ValueError,
    ),
    "N10: a run word has no direction bit": Hazard(
        ibd, run, naive="01 06 20 00 00 0A", sends=("01 06 20 01 07 D0", "01 06 20 00 00 02")
    ),
    # ---- 4: Delixi ----
    "D4, D5: the only setpoint is in EEPROM: on change, and once a minute": Hazard(
        delixi,
        lambda line, drive, sim: [drive.set_frequency(50), drive.set_frequency(50), drive.set_frequency(49)],
        naive="01 06 00 02 13 24",
        sends=("01 06 00 02 13 88",),
        refuses="only one write in 60 s",
    ),
    "D5: no start when the setpoint is not taken from P00.02": Hazard(
        delixi,
        run,
        naive="01 06 20 00 00 12",
        sends=("01 06 00 02 07 D0",),
        refuses=r"P00\.01",
        shows={"frequency_source": 0},
    ),
    "D12: standard Modbus has no fault reset, and reserved bits are not tried": Hazard(
        delixi, reset, naive="01 06 20 00 00 04", refuses="no fault reset", error=Unsupported
    ),
    "D14: a run word has a direction, and never the toggle": Hazard(
        delixi, run, naive="01 06 20 00 00 32", sends=("01 06 00 02 07 D0", "01 06 20 00 00 12")
    ),
    "D14: run without a direction may keep the old one or not": Hazard(
        delixi,
        direct(Direction.REVERSE),
        naive="01 06 20 00 00 02",
        sends=("01 06 20 00 00 22",),
        shows={"frequency": 20.0},
    ),
    "D17: a stored write is not broadcast": Hazard(
        native,
        broadcast("stored_frequency", 0.0),
        naive=":0006000200000000",
        refuses="the manual does not allow it",
    ),
    "4.4: the setpoint in RAM, not the stored one": Hazard(
        native, frequency(50), naive=":0106000200001388", sends=(":0104000100001388",)
    ),
    # ---- 5: YD1000 ----
    "Y1: register numbers are hex digits: DEC is 0010H, not 000AH": Hazard(
        yd, write("deceleration_time", 20.0), naive="01 06 00 0A 00 C8", sends=("01 06 00 10 00 C8",)
    ),
    "Y1: a drive whose 0802H is not its address is not a YD1000": Hazard(
        yd, run, naive="01 06 10 00 C4 00", refuses="0802H", shows={"address_setting": 7}
    ),
    "Y7: 0007H initialises": Hazard(
        yd, write("initialisation", 1), naive="01 06 00 07 00 01", refuses="panel only"
    ),
    "Y10: 0000H gives the command back to the panel, which may run it": Hazard(
        yd, stop, naive="01 06 10 00 00 00", sends=("01 06 10 00 C0 00",), turning=True
    ),
    "Y10: 0000H is refused as a plain write": Hazard(
        yd, write("control", YD1000Control(0)), naive="01 06 10 00 00 00", refuses="commands the motor"
    ),
    "Y11: a reset never runs, is sent once and followed by the stop": Hazard(
        yd, reset, naive="01 06 10 00 E4 00", sends=("01 06 10 00 E0 00", "01 06 10 00 C0 00")
    ),
    "Y13: 0802H acts on the line at once": Hazard(
        yd, write("address_setting", 2.0), naive="01 06 08 02 00 02", refuses="drive's end of the line"
    ),
    "0008H may be changed while the motor runs, and has the panel's direction": Hazard(
        yd,
        write("panel_direction", 1.0),
        naive="01 06 00 08 00 01",
        refuses="decides what commands the motor",
    ),
    "the selected preset speed is verified before the motor is started": Hazard(
        lambda: YD1000(1, preset_speed=4),
        start,
        naive="01 06 10 00 C4 01",
        sends=("01 06 10 00 C0 00", "01 06 10 00 C0 02", "01 06 10 00 C0 00"),
        refuses="preset speed 4 was selected, its frequency command did not become 12.5 Hz",
        shows={"preset_speed_4": 12.5, "reference_frequency": 0.0},
    ),
    "Y14: the emergency stop is not broadcast": Hazard(
        yd,
        broadcast("control", YD1000Control.COMMAND_VALID | YD1000Control.EMERGENCY_STOP),
        naive="00 06 10 00 90 00",
        refuses="the manual does not allow it",
    ),
}


class Mine(InvtCHE):
    """A user's family with parameters from the drive's manual."""

    acceleration_time = parameter(12, "s", step=0.1, place="P0.07")


@pytest.mark.parametrize("hazard", HAZARDS.values(), ids=HAZARDS)
def test_hazardous_commands_send_safe_frames_or_are_refused(hazard: Hazard) -> None:
    line, drive, sim = one(hazard.drive())
    for name, value in hazard.shows.items():
        sim[name] = value
    if hazard.turning:
        run(line, drive, sim)
        line.sleep(1)
        line.frames.clear()
    if hazard.refuses:
        with pytest.raises(hazard.error, match=hazard.refuses):
            hazard.do(line, drive, sim)
    else:
        hazard.do(line, drive, sim)
    assert tuple(map(body, line.written)) == hazard.sends
    assert hazard.naive not in [body(frame) for _, frame in line.frames]


def body(frame: str) -> str:
    """Return a frame without its checksum."""
    return frame[:-2] if frame.startswith(":") else frame[:-6]


def test_low_byte_of_a_yd1000_checksum_is_sent_first() -> None:
    """Erratum Y2."""
    line, drive, sim = one(YD1000(1))
    run(line, drive, sim)
    assert line.written[-1] == "01 06 10 00 C4 00 DF CA"


def reply_to(request: Message, frame: str) -> tuple[int, Message | None]:
    return parse_reply(Framing.RTU, bytes.fromhex(frame), request)


def test_erman_checksum_differs_from_the_wrong_example() -> None:
    """Erratum E1."""
    line, drive, _ = one(ErmanERG220(1))
    drive.read(drive.output_frequency, drive.output_current, drive.dc_bus_voltage)
    assert [frame for _, frame in line.frames] == ["01 04 00 01 00 05 61 C9"]


def test_erman_reply_with_another_byte_count_is_rejected() -> None:
    """Erratum E2."""
    printed = "01 04 10 01 F4 00 00 00 D6 00 00 02 32 0A 03"
    line, drive, _ = one(ErmanERG220(1))
    line.answers = lambda request: bytes.fromhex(printed)
    with pytest.raises(BadReply):
        drive.read(drive.output_frequency, drive.output_current, drive.dc_bus_voltage)


@table("code", [2, 3, 4])
def test_erman_address_exception_is_not_reported_as_a_device_failure(code: int) -> None:
    """Erratum E12."""
    assert "address" in ErmanERG220(1).exception(code)
    assert "fail" not in ErmanERG220(1).exception(code)


def test_erman_state_is_decoded_from_either_of_two_words() -> None:
    """Errata E9, E10."""
    assert ErmanERG220.status.number_format is NumberFormat.U32_EITHER
    assert [ErmanERG220.status.decode(number) for number in range(4)] == list(ErmanStatus)[:4]


def test_erman_has_no_registers_for_diagnostics_or_at_unknown_addresses() -> None:
    """Errata E13, E16."""
    assert {register.table.read for register in ErmanERG220.registers.values()} <= {1, 3, 4}
    assert max(register.address for register in ErmanERG220.registers.values()) == 0x0402
    assert all(
        register.address <= 0x58 for register in ErmanERG220.registers.values() if register.table.read == 3
    )


def test_a_request_is_repeated_if_an_invt_che_reports_a_checksum_error() -> None:
    """Erratum I4."""
    line, drive, _ = one(InvtCHE(1))
    line.refuses = lambda request: 0x11 if len(line.frames) == 1 else 0
    assert drive.read(drive.output_frequency) == 0
    assert len(line.frames) == 2


def test_erman_identity_check_refuses_the_models_03_and_04() -> None:
    """Erratum I2. These models lack function 04; the exception makes `identify` refuse them."""
    line, drive, _ = one(ErmanERG220(1))
    line.refuses = lambda request: 1 if request.function == 4 else 0
    with pytest.raises(WriteForbidden, match="not an ER-G-220"):
        drive.set_frequency(20)
    assert line.written == []


def test_erman_byte_count_of_coils_is_rounded_up() -> None:
    """Erratum E7."""
    request = Message(1, 1, 0, 12)
    # the printed reply has 2 data bytes for 12 coils
    assert reply_to(request, "01 01 02 00 01 78 3C")[0] > 0
    # a reply with only 1 data byte, 12 / 8 rounded down, is rejected
    assert reply_to(request, checksums.rtu("01 01 01 00").hex())[0] <= 0


def test_erman_reserved_state_registers_are_not_declared() -> None:
    """Erratum E8."""
    state = {register.address for register in ErmanERG220.registers.values() if register.table.read == 4}
    assert not state & set(range(0x0007, 0x000C))


def test_erman_function_08_has_a_subfunction_of_two_bytes() -> None:
    """Erratum E14."""
    printed = "01 08 00 00 A5 37 DA 8D"
    assert build_request(Framing.RTU, Message(1, 8, 0x0000, data=b"\xa5\x37")).hex(" ").upper() == printed


def test_user_can_choose_parity_and_stop_bits_of_an_invt_che() -> None:
    """Erratum I3."""
    assert {"8N1", "8N2", "8E1", "8E2"} <= set(InvtCHE.formats[Framing.RTU])
    assert InvtCHE(1, format="8E2").settings.format == "8E2"


def test_unexplained_example_of_the_invt_che_manual_cannot_be_sent() -> None:
    """Erratum I6."""
    assert not [register for register in InvtCHE.registers.values() if register.address == 0x0008]


def test_at_most_four_innovert_ibd_registers_are_read_at_once() -> None:
    """Errata N3, N6."""
    line, drive, _ = one(InnovertIBD(1))
    drive.read_many([register for register in drive.registers.values() if register.readable])
    assert max(request.count for request, _ in line.frames) <= 4
    assert reply_to(Message(1, 3, 0x16, 1), "01 03 02 18 00 B2 44")[1] is not None


def test_innovert_ibd_with_unprogrammed_outputs_never_reports_stopped() -> None:
    """Erratum N9."""
    _, drive, sim = one(InnovertIBD(1))
    sim["output_m01"] = 0
    assert drive.state().condition is Condition.UNKNOWN


def test_delixi_states_2_and_3_are_running() -> None:
    """Erratum D2."""
    _, drive, sim = one(DelixiNative(1))
    for status in (DelixiNativeStatus.FORWARD, DelixiNativeStatus.REVERSE):
        sim["status"] = status
        assert drive.state().condition is Condition.RUNNING


def test_delixi_reply_with_swapped_bytes_is_rejected() -> None:
    """Erratum D15."""
    request = Message(1, 4, 1, data=b"\0\0\x13\x88")
    swapped = build_reply(Framing.DELIXI, Message(1, 4, 1, data=b"\0\0\x88\x13"))
    assert text(swapped)[-2:] == "A1"  # the checksum does not detect that two bytes were swapped
    assert parse_reply(Framing.DELIXI, swapped, request)[0] < 0


def test_delixi_line_settings_correct_the_misprints() -> None:
    """Errata D1, D3, D6, D9."""
    assert 4800 in DelixiModbus.baudrates
    assert 3800 not in DelixiModbus.baudrates
    assert DelixiModbus.formats[Framing.ASCII][0] == "7N2"
    assert DelixiNative.formats[Framing.DELIXI][0] == "8N1"
    assert 0xF0 in DelixiNative.exceptions
    assert DelixiModbus.response_timeout >= 0.08


def test_delixi_fault_04_is_an_overvoltage() -> None:
    """Erratum D8."""
    (ou,) = {drive.fault.decode(4) for drive in (DelixiModbus, DelixiNative)}
    assert ou.name == "OU_OVERVOLTAGE"


@pytest.mark.parametrize("code", [1, 2, 0x42])
def test_any_exception_code_raises_drive_exception(code: int) -> None:
    """Errata D13, Y15."""
    for make in (delixi, yd):
        line, drive, _ = one(make())
        line.refuses = lambda request: code
        with pytest.raises(DriveException) as raised:
            drive.read(drive.output_frequency)
        assert raised.value.code == code


def test_delixi_faults_10_to_14_are_decoded_in_decimal_and_hex() -> None:
    """Erratum D7."""
    assert [DelixiNative.fault.decode(0x0A + at) for at in range(5)] == [
        DelixiNative.fault.decode(0x10 + at) for at in range(5)
    ]


def test_yd1000_uses_only_functions_03_and_06_and_never_address_0() -> None:
    """Errata Y5, Y6."""
    assert {(register.table.read, register.table.write) for register in YD1000.registers.values()} == {(3, 6)}
    assert YD1000.most_registers == {HOLDING: 1}
    with pytest.raises(ValueError, match="1 to 63"):
        YD1000(0)


def test_yd1000_frames_have_modbus_lengths_despite_the_manual() -> None:
    """Errata Y3, Y4."""
    assert len(build_request(Framing.RTU, Message(1, 6, 0x1001, data=b"\x1f\x40"))) == 8
    request = Message(1, 3, 0x1100, 1)
    used, reply = reply_to(request, checksums.rtu("01 03 02 13 88").hex())
    assert (used, reply and reply.data) == (7, b"\x13\x88")


def test_a_yd1000_trip_is_reported_although_the_status_is_frozen() -> None:
    """Erratum Y8."""
    line, drive, sim = one(YD1000(1))
    run(line, drive, sim)
    line.sleep(2)
    drive.state()
    sim.pass_time(line.seconds)
    sim.trip(5)
    assert drive.read(drive.status)  # the frozen register still shows that the motor runs
    assert drive.state().condition is Condition.FAULT
    drive.stop()


def test_factory_value_of_the_yd1000_watchdog_is_unknown() -> None:
    """Erratum Y12."""
    assert "the factory value is not stated" in YD1000.watchdog
    assert YD1000.communication_timeout.default is None


def test_yd1000_registers_outside_ram_are_declared_as_eeprom() -> None:
    """Erratum 0.8."""
    for register in YD1000.registers.values():
        in_ram = 0x1000 <= register.address <= 0x12FF
        assert (register.kept is Kept.EEPROM) == (not in_ram) or register.access.value == "reading"


def test_echo_of_an_adapter_is_not_accepted_as_a_drive() -> None:
    """Erratum 0.3.

    If only copies of the requests arrive, no read gets a valid reply, and no write is sent.
    """
    line = SimulatedBus()
    drives = [line.attach(make) for make in (InvtCHE(1, maximum_frequency=50), ErmanERG220(2), YD1000(3))]
    for drive in drives:
        for script in (drive.set_frequency.script(20), drive.start.script(), drive.reset_fault.script()):
            with pytest.raises(NoReply):
                drive.perform(script)
    assert line.written == []


FAMILIES = {"E": 18, "I": 6, "N": 10, "D": 17, "Y": 15}
OF_PRINT_ALONE = {
    "E15": "headings, a date, a unit's name: nothing a client sends or reads",
    "N4": "the number of a table, and a table that is missing",
    "N5": "the name of a row",
    "D10": "the texts of two rows; the document's examples show the usual frames, which tests/data holds",
    "D11": "a skipped number, a lost letter, names that run together",
    "D16": "a case that the document does not describe, and that no client can cause",
    "Y9": "references to sections that are missing, and spellings",
}


def test_every_erratum_has_a_test_or_a_stated_reason() -> None:
    tests = [test for name, test in globals().items() if name.startswith("test_")]
    names = [*HAZARDS, *(test.__doc__ or "" for test in tests)]
    for family, last in FAMILIES.items():
        for number in range(1, last + 1):
            erratum = f"{family}{number}"
            shown = [name for name in names if re.search(rf"(^|[^A-Z0-9]){erratum}($|[^0-9])", name)]
            assert bool(shown) != (erratum in OF_PRINT_ALONE), erratum
