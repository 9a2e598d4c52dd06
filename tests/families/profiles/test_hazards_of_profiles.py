"""Dangerous situations with motor commands, tested on a simulated drive of every profile."""

from __future__ import annotations

from contextlib import suppress

import pytest
from profile_families import ALL, MAKE, STARTS
from simulated_bus import is_write, one
from tables import table

from multidrop.control.ramp import ramp
from multidrop.core import Framing, Message, build_reply
from multidrop.drive import Condition, Direction, Drive
from multidrop.errors import NotVerified, Unconfirmed, WriteForbidden
from multidrop.families.profiles.command_codes import InvtControl

FAULT = 4


@pytest.fixture(params=MAKE)
def model(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def line(model: str) -> Line:
    return Line(model)


class Line:
    """A simulated bus with one drive. `starts` has the sent requests that start the motor."""

    def __init__(self, model: str) -> None:
        self.is_start = STARTS[model]
        self.bus, self.drive, self.sim = one(ALL[model](1))
        self.set_ramps(1.0)

    def set_ramps(self, seconds: float) -> None:
        for name in ("acceleration_time", "deceleration_time"):
            setattr(self.sim.motor, name, seconds)
            if name in self.drive.registers:
                self.sim[name] = seconds

    @property
    def starts(self) -> list[Message]:
        return [request for request, _ in self.bus.frames if self.starts_it(request)]

    def starts_it(self, request: Message) -> bool:
        return is_write(request) and self.is_start(request)

    @property
    def writes(self) -> list[Message]:
        return [request for request, _ in self.bus.frames if is_write(request)]

    def runs(self) -> None:
        self.drive.set_frequency(20)
        self.drive.start()
        self.bus.sleep(2)
        assert self.drive.state().condition is Condition.RUNNING


def test_a_start_runs_the_motor_until_a_stop(line: Line) -> None:
    line.runs()
    assert len(line.starts) == 1
    assert abs(line.sim.motor.target) == pytest.approx(20, abs=0.01)
    line.drive.stop()
    assert not line.sim.motor.energised
    assert line.drive.state().condition is Condition.STOPPED
    line.drive.start()  # the drive still has the setpoint from before
    assert len(line.starts) == 2
    assert line.sim.motor.energised


def test_a_stop_waits_until_the_motor_is_at_rest(line: Line) -> None:
    line.runs()
    line.set_ramps(20.0)
    before = line.bus.seconds
    line.drive.stop()
    assert line.bus.seconds - before > 5
    assert line.sim.motor.frequency == 0


def test_a_trip_during_a_start_is_reported(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    line.drive.set_frequency(20)
    monkeypatch.setattr(line.sim.motor, "run", lambda direction: line.sim.trip(FAULT))
    with pytest.raises(NotVerified, match="tripped"):
        line.drive.start()
    assert len(line.starts) == 1
    assert line.drive.state().condition is Condition.FAULT
    with pytest.raises(WriteForbidden, match="reset_fault"):
        line.drive.start()
    assert len(line.starts) == 1


def test_a_fault_reset_never_starts_the_motor(line: Line) -> None:
    """The run command may still be set at the trip, and the drive may obey its level."""
    line.runs()
    line.sim.trip(FAULT)
    begun = len(line.writes)
    line.drive.reset_fault()
    assert line.sim.motor.fault == 0
    assert not any(line.starts_it(request) for request in line.writes[begun:])
    line.bus.sleep(5)
    assert line.drive.state().condition is Condition.STOPPED
    assert not line.sim.motor.energised
    line.sim.trip(FAULT)  # the reset bit was cleared, so the later fault stays
    line.bus.sleep(1)
    assert line.drive.state().condition is Condition.FAULT
    line.drive.reset_fault()  # the later fault can be reset too
    line.drive.start()
    assert line.sim.motor.energised


@pytest.mark.parametrize("lost", range(4))
def test_a_fault_reset_with_lost_replies_never_starts_the_motor(line: Line, lost: int) -> None:
    line.runs()
    line.sim.trip(FAULT)
    begun = len(line.writes)
    line.bus.loses = lambda request: is_write(request) and len(line.writes) == begun + 1 + lost
    with suppress(Unconfirmed):
        line.drive.reset_fault()
    line.bus.loses = lambda request: False
    assert not any(line.starts_it(request) for request in line.writes[begun:])
    where, word = line.drive.register(line.drive.reset_role).address, line.drive.reset_word
    resets = [write for write in line.writes if write.start == where and write.data == word.to_bytes(2)]
    assert len(resets) == 1
    line.sim.motor.reset()
    line.sim.trip(FAULT)
    line.bus.sleep(1)
    line.drive.state()
    assert line.sim.motor.fault == FAULT  # the reset bit was cleared, so the new fault stays


def test_reset_fault_sends_no_write_without_a_fault(line: Line) -> None:
    line.drive.reset_fault()
    assert line.writes == []


def test_reset_fault_of_a_running_motor_is_refused(line: Line) -> None:
    line.runs()
    sent = len(line.writes)
    with pytest.raises(WriteForbidden, match="it has no fault to reset"):
        line.drive.reset_fault()
    assert len(line.writes) == sent


def test_a_fault_reset_raises_if_the_fault_remains(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    line.sim.trip(FAULT)
    monkeypatch.setattr(line.sim.motor, "reset", lambda: None)
    with pytest.raises(NotVerified, match="the fault remains"):
        line.drive.reset_fault()
    assert not line.starts


def test_a_start_without_a_setpoint_is_refused(line: Line) -> None:
    with pytest.raises(WriteForbidden, match="set_frequency"):
        line.drive.start()
    assert line.writes == []
    line.drive.set_frequency(0)
    with pytest.raises(WriteForbidden, match=r"setpoint .* is 0"):
        line.drive.start()
    assert not line.starts


def test_a_start_after_a_power_cycle_requires_a_new_setpoint(line: Line, model: str) -> None:
    """The motor stays off. The next start is refused, unless the drive's setpoint cannot be read."""
    line.runs()
    line.sim.power_cycle()
    line.bus.sleep(5)
    assert not line.sim.motor.energised
    assert line.drive.state().condition is Condition.STOPPED
    begun = len(line.writes)
    if model == "danfoss-fc51":  # the setpoint of this drive cannot be read
        line.drive.start()
        return
    with pytest.raises(WriteForbidden, match="set_frequency"):
        line.drive.start()
    assert line.writes[begun:] == []
    line.runs()
    assert line.sim.motor.energised


LOCAL = {
    "abb-acs355": "local control",
    "siemens-v20": "local control",
    "schneider-atv320": "from the line",
    "danfoss-fc51": "hand mode",
    "delta-vfd-el": "from the line",
    "yaskawa-a1000": "from the line",
}


@table("model", LOCAL)
def test_a_start_is_refused_while_the_keypad_is_in_control(model: str) -> None:
    line = Line(model)
    line.drive.set_frequency(20)
    line.sim.is_local = True
    begun = len(line.writes)
    with pytest.raises(WriteForbidden, match=LOCAL[model]):
        line.drive.start()
    assert line.writes[begun:] == []


NO_DIRECTION = ("abb-acs355", "siemens-v20", "optidrive-e3")


def test_a_reverse_start_turns_the_motor_backward_or_is_refused(line: Line, model: str) -> None:
    line.drive.set_frequency(20)
    if model in NO_DIRECTION:
        with pytest.raises(WriteForbidden, match="direction"):
            line.drive.start(Direction.REVERSE)
        assert not line.starts
        return
    line.drive.start(Direction.REVERSE)
    line.bus.sleep(2)
    assert line.drive.state().condition is Condition.RUNNING
    assert line.sim.motor.frequency == pytest.approx(-20, abs=0.01)
    if model in ("danfoss-fc51", "schneider-atv320"):  # the status of both models shows no direction
        with pytest.raises(WriteForbidden, match="cannot report its direction"):
            line.drive.start()
    else:
        line.drive.start()  # without a direction, the drive keeps its present direction
        line.bus.sleep(3)
        line.drive.state()
        assert line.sim.motor.frequency == pytest.approx(-20, abs=0.01)
    assert line.drive.state().condition is Condition.RUNNING


def test_writing_a_start_word_to_the_control_register_is_refused(line: Line) -> None:
    control = line.drive.control
    requests = {count: Message(1, 6, control.address, data=count.to_bytes(2)) for count in range(0x900)}
    starts = [count for count, request in requests.items() if line.is_start(request)]
    assert starts
    for count in starts:
        with pytest.raises((WriteForbidden, TypeError)):
            line.drive.write(control, control.decode(count))
    assert line.writes == []


def test_control_words_declared_harmless_never_start_the_motor(line: Line) -> None:
    line.drive.set_frequency(20)
    control = line.drive.control
    for before in control.harmless:
        for count in control.harmless:
            line.drive.write(control, control.decode(before))
            line.drive.write(control, control.decode(count))
            line.bus.sleep(1)
            assert not line.sim.motor.energised


def test_setpoint_outside_the_frequency_limits_is_refused(line: Line) -> None:
    for hz in (-1, 5000):
        with pytest.raises(ValueError, match="Hz"):
            line.drive.set_frequency(hz)
    assert line.writes == []


def test_a_ramp_continues_from_the_setpoint_in_force(line: Line) -> None:
    """The ramp is computed in Hz, even if the setpoint register holds a percentage that cannot be read."""
    line.drive.set_frequency(20)
    begun = len(line.writes)
    ramp(line.drive, 22, rate=1, every=1)
    assert len(line.writes) - begun == 2
    assert line.sim.motor.target == pytest.approx(22, abs=0.01)


def test_a_stop_also_ends_a_jog_that_ignores_the_stop_word() -> None:
    line = Line("invt-goodrive")
    line.sim.jog_needs_own_stop = True
    line.drive.option["stop_time"] = 3.0
    line.drive.jog()
    assert line.sim.motor.energised
    line.drive.stop()
    assert not line.sim.motor.energised
    line.drive.set_frequency(20)
    line.drive.start()
    assert len(line.starts) == 2


@pytest.mark.parametrize("is_refused", [False, True], ids=["not heard", "refused"])
def test_the_command_stop_jog_is_sent_after_an_unconfirmed_stop(is_refused: bool) -> None:
    """The replies to the stop are lost, as with a broken wire, or the drive refuses a stop during a jog."""
    line = Line("invt-goodrive")
    line.sim.jog_needs_own_stop = True
    line.drive.jog()
    assert line.sim.motor.goal

    def refuse(request: Message) -> int:
        is_stop = is_write(request) and request.data[-1] == InvtControl.STOP
        return 4 if is_stop and line.sim.motor.goal else 0

    if is_refused:
        line.bus.refuses = refuse
        line.drive.stop()
    else:
        line.bus.loses = lambda request: True
        with pytest.raises(Unconfirmed):
            line.drive.stop(seconds=20)
    line.sim.pass_time(line.bus.seconds + 5)
    assert not line.sim.motor.energised


def test_stop_jog_is_not_sent_to_a_drive_of_another_family(monkeypatch: pytest.MonkeyPatch) -> None:
    line = Line("invt-goodrive")
    checked: list[Drive] = []

    def withhold(drive: Drive, *word: object) -> None:
        checked.append(drive)
        raise WriteForbidden("another family is there")

    monkeypatch.setattr(line.bus.bus._writer.identity_check, "check_before_stop", withhold)
    with pytest.raises(WriteForbidden, match="another family"):
        line.drive.stop()
    assert checked == [line.drive]
    assert line.writes == []


def test_a_cia402_start_without_mains_raises_not_verified() -> None:
    line = Line("schneider-atv320")
    line.drive.set_frequency(20)
    line.sim.stays_off = True
    with pytest.raises(NotVerified, match="not switched on"):
        line.drive.start()
    assert line.starts == []


@pytest.mark.parametrize("name", ["off2", "off3"])
def test_a_profidrive_start_during_off2_or_off3_is_refused(name: str) -> None:
    line = Line("abb-acs355")
    line.drive.set_frequency(20)
    setattr(line.sim, name, True)
    with pytest.raises(WriteForbidden, match=f"another source holds {name.upper()} .* active"):
        line.drive.start()
    assert line.starts == []
    setattr(line.sim, name, False)
    line.drive.start()
    assert line.sim.motor.energised


def test_a_coast_word_stops_a_running_siemens_v20() -> None:
    line = Line("siemens-v20")
    line.runs()
    line.drive.write(line.drive.control, line.drive.control.decode(0x047C))
    assert not line.sim.motor.energised
    assert line.drive.state().condition is Condition.STOPPED


def test_a_reset_of_a_locked_trip_is_refused_until_a_power_cycle() -> None:
    line = Line("danfoss-fc51")
    line.sim.trip(FAULT)
    line.sim.is_locked = True
    with pytest.raises(WriteForbidden, match="switch off its mains"):
        line.drive.reset_fault()
    assert line.writes == []
    line.sim.power_cycle()
    line.runs()


def test_an_optidrive_with_swapped_status_bytes_cannot_be_started() -> None:
    line = Line("optidrive-e3")
    line.sim.is_first_reading = True
    line.drive.set_frequency(20)
    with pytest.raises(WriteForbidden, match="not ready to run"):
        line.drive.start()
    line.sim.motor.run(1)  # the motor was started on the keypad
    line.bus.sleep(2)
    assert line.drive.state().condition is not Condition.STOPPED
    line.drive.stop()
    assert not line.sim.motor.energised
    assert line.starts == []


# Register values that show another make. One value is not proof: a drive of the declared make may also have
# it, for example before a restart.
OF_ANOTHER = {
    "status": 0x0241,  # this status does not exist in PROFIdrive
    "station": 7,
    "signature": 1,
}


@table("first", OF_ANOTHER)
@table("second", OF_ANOTHER)
def test_a_stop_is_refused_only_if_two_registers_show_another_family(first: str, second: str) -> None:
    """One make's stop word may run another make's motor. One value, or two settings, are not proof."""
    line = Line("abb-acs355")
    shown = {line.drive.register(name).address: OF_ANOTHER[name] for name in (first, second)}

    def show(request: Message) -> bytes | None:
        if request.function != 3 or request.start not in shown:
            return None
        return build_reply(Framing.RTU, Message(1, 3, data=shown[request.start].to_bytes(2, "big")))

    line.bus.answers = show
    if first == second or "status" not in (first, second):
        with suppress(Unconfirmed):
            line.drive.stop(seconds=1)
        assert line.writes
    else:
        with pytest.raises(WriteForbidden, match="no stop was sent"):
            line.drive.stop(seconds=1)
        assert line.writes == []


def test_an_identified_drive_is_stopped_although_the_device_code_changes() -> None:
    line = Line("invt-goodrive")
    line.runs()
    line.sim["device"] = 0
    line.drive.stop()
    assert not line.sim.motor.energised
