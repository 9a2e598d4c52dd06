"""Writes with `Bus` and simulated drives: rules, identity, outcomes, EEPROM, stops."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from batches import completed
from motors import MAKE
from simulated_bus import EXCHANGE_TIME, SimulatedBus, is_write, one, starts
from tables import table
from toy import Toy

from multidrop.bus import Bus
from multidrop.control import records
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.outcome import Effect
from multidrop.core import Completion, Exchange, Failure, Message
from multidrop.drive import Condition, Direction, Drive, Script, read, wait, write
from multidrop.drive.register import COIL, Kept, reading, setting
from multidrop.drive.verbs import verb
from multidrop.errors import (
    DriveException,
    Expired,
    NoReply,
    NotMaster,
    NotVerified,
    Unconfirmed,
    WriteForbidden,
)
from multidrop.families import MODELS, YD1000, DelixiModbus, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.families.invt_che import CHEControl, parameter
from multidrop.sim import simulated
from multidrop.transport.exchange import READ_ATTEMPTS

every_family = pytest.mark.parametrize("model", MAKE)


@every_family
def test_a_register_write_cannot_start_a_motor_or_reset_a_fault(model: str) -> None:
    line, drive, sim = one(MAKE[model](1))
    controls = [each for each in drive.registers.values() if each.harmless is not None]
    assert controls
    refusals = 0
    for register in controls:
        values = list(register.values)
        if register.name == "control" and model == "yd1000":
            values = [register.values(word) for word in (0, 0x8400, 0xC400, 0xC100, 0xE000, 0xD000, 0x4000)]
        for value in values:
            if register.encode(value) in register.harmless:
                continue
            refusals += 1
            with pytest.raises(WriteForbidden, match=r"commands the motor.*use start\(\)") as refusal:
                drive.write(register, value)
            assert refusal.value.register == register.name
            assert refusal.value.place
    assert refusals >= 3
    assert line.frames == []
    assert not sim.motor.energised


def test_a_register_write_may_stop_the_motor() -> None:
    _, drive, _ = one(InvtCHE(1))
    assert drive.write(drive.control, CHEControl.STOP) is CHEControl.STOP


@table(
    ("drive", "name", "value", "sentence"),
    [
        (YD1000(1), "initialisation", 1, r"panel only.*TYP"),
        (YD1000(1), "automatic_torque_boost", 1, r"panel only"),
        (YD1000(1), "address_setting", 2, r"changes the drive's end of the line.*F802"),
        (YD1000(1), "communication_timeout", 101, "outside 0 to 100 s .*F803"),
        (YD1000(1), "command_mode", 0, "decides what commands the motor.*CNOD"),
        (YD1000(1), "always_on_function", 2, "decides what commands the motor.*F110"),
        (YD1000(1), "input_3_function", 2, "decides what commands the motor.*F113"),
        (InnovertIBD(1), "frequency_source", 3, r"contradictory.*Prb\.01"),
        (ErmanERG220(1), "control_register", 1, "not stated"),
        (YD1000(1), "output_frequency", 1, "it is a reading"),
        (YD1000(1), "acceleration_time", 3601, r"outside 0\.1 to 3600 s .*ACC"),
        (InvtCHE(1), "setpoint", 101, "outside 0 to 100 %"),
        (YD1000(1), "frequency", 90, r"90\.00 Hz is above maximum_frequency, which is 80 Hz"),
        (YD1000(1), "upper_limit_frequency", 81, r"above maximum_frequency, which is 80 Hz"),
        (YD1000(1), "minimum_frequency", 80.5, r"above upper_limit_frequency, which is 80 Hz"),
        (YD1000(1), "preset_speed_3", 80.5, r"above upper_limit_frequency"),
        (YD1000(1), "maximum_frequency", 79, r"below upper_limit_frequency, which is 80 Hz"),
        (ErmanERG220(1), "frequency", 50.1, r"above maximum_frequency, which is 50 Hz"),
        (ErmanERG220(1), "minimum_frequency", 50.1, r"above maximum_frequency"),
    ],
)
def test_a_forbidden_write_is_not_sent(drive: Drive, name: str, value: float, sentence: str) -> None:
    line, _, _ = one(drive)
    register = drive.register(name)
    with pytest.raises(WriteForbidden, match=sentence) as refusal:
        drive.write(register, value)
    assert isinstance(refusal.value, ValueError)  # like Python's own error for an invalid argument
    assert (refusal.value.register, bool(refusal.value.rule), bool(refusal.value.place)) == (name, True, True)
    assert line.written == []


def test_a_write_allowed_only_at_rest_is_refused_while_the_motor_turns() -> None:
    line, drive, sim = one(YD1000(1))
    drive.set_frequency(20)
    drive.start()
    line.sleep(1)
    before = list(line.written)
    with pytest.raises(WriteForbidden, match=r"maximum_frequency .* only at standstill; state: running.*FH"):
        drive.write(drive.maximum_frequency, 90)
    assert line.written == before
    drive.stop()
    assert drive.write(drive.maximum_frequency, 90) == 90
    assert sim["maximum_frequency"] == 90


def test_a_raw_request_bypasses_the_write_rules() -> None:
    line, drive, _ = one(YD1000(1))
    assert drive.send_raw(6, 0x0000, b"\x00\x01") == b"\x00\x01"
    assert line.written == ["01 06 00 00 00 01 48 0A"]
    line.loses = lambda request: True
    with pytest.raises(Unconfirmed, match="raw request 01 06 00 00 00 01"):
        drive.send_raw(6, 0x0000, b"\x00\x01")
    assert len(line.written) == 2  # each call sent the request once


@every_family
def test_identity_is_checked_once_per_opened_port(monkeypatch: pytest.MonkeyPatch, model: str) -> None:
    monkeypatch.setattr(records, "LEAST_INTERVAL", 0.0)  # seconds between writes of one register to an EEPROM
    line, drive, _ = one(MAKE[model](1))
    drive.set_frequency(20)
    assert line.frames[0][1] not in line.written
    assert line.written
    looks: list[str] = []
    monkeypatch.setattr(type(drive).identify, "_script", lambda drive: iter(looks.append("look") or ()))
    line.sleep(1)
    drive.set_frequency(25)
    assert looks == []
    line.queue = object()  # a new queue, as after the port was reopened, perhaps with other drives
    line.sleep(1)
    drive.set_frequency(30)
    assert looks == ["look"]


def test_writes_to_an_unidentified_innovert_ibd_need_the_option_confirmed() -> None:
    for confirmed in (0, 1):
        line, drive, sim = one(InnovertIBD(1, confirmed=confirmed))
        sim["address_setting"] = 0
        if confirmed:
            drive.set_frequency(20)
            assert line.written == ["01 06 20 01 07 D0 D0 66"]
            assert sim.counters.requests > 1  # a read came first, which shows whether the adapter echoes
            assert line.frames[0][0].function == 3
        else:
            with pytest.raises(WriteForbidden, match="confirmed = 1"):
                drive.set_frequency(20)
            assert line.written == []


def test_try_write_returns_the_outcome_of_each_write() -> None:
    line, drive, _ = one(InnovertIBD(1))
    outcome = drive.try_write(drive.acceleration_time, 20.0)
    assert (outcome.effect, outcome.held) == (Effect.DONE, 20.0)
    assert str(outcome) == "innovert-ibd@1: acceleration_time = 20.0 s: done (read back)"
    outcome = drive.try_write(drive.acceleration_time, 6000.0)
    assert (outcome.effect, outcome.held, outcome.value) == (Effect.TAKEN_AS, 3600.0, 3600.0)
    assert str(outcome) == "innovert-ibd@1: acceleration_time = 6000.0 s: taken as 3600.0 s"
    outcome = drive.try_write(drive.frequency, 20.0)
    assert str(outcome).endswith("frequency = 20.00 Hz: done (cannot be read back)")
    line.loses = lambda request: request.function == 6
    outcome = drive.try_write(drive.frequency, 25.0)
    assert (outcome.effect, outcome.held) == (Effect.UNCONFIRMED, None)
    assert str(outcome).startswith("innovert-ibd@1: frequency = 25.00 Hz: unconfirmed: innovert-ibd@1: ")
    with pytest.raises(Unconfirmed, match="no reply"):
        assert outcome.value
    # the reply is lost, but a read back confirms the write
    assert drive.try_write(drive.acceleration_time, 10.0).effect is Effect.DONE
    line.deafens = line.loses
    outcome = drive.try_write(drive.acceleration_time, 30.0)
    assert (outcome.effect, outcome.held) == (Effect.UNCONFIRMED, 10.0)


@every_family
def test_only_stops_are_sent_without_waiting_for_late_replies(
    monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    line, drive, _ = one(MAKE[model](1))
    insisted: list[bool] = []
    carry_out = line.carry_out

    def watched(exchange: Exchange, **times: Any) -> Completion:
        if is_write(exchange.request):
            insisted.append(bool(exchange.c.insists))
        return carry_out(exchange, **times)

    monkeypatch.setattr(line, "carry_out", watched)
    drive.set_frequency(20)
    drive.start()
    assert not insisted[-1]
    insisted.clear()
    drive.stop()
    assert insisted
    assert all(insisted)


def test_the_error_explains_the_exception_code_of_the_family() -> None:
    line, drive, _ = one(InvtCHE(1))
    line.bus.check_identity(drive)
    line.refuses = lambda request: 0x12 if request.function == 6 else 0
    outcome = drive.try_write(drive.setpoint, 50.0)
    assert outcome.effect is Effect.REFUSED
    with pytest.raises(DriveException, match="code 12H, write not allowed: out of range"):
        assert outcome.value
    assert len(line.written) == 1


def test_an_expired_write_is_not_sent() -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)
    written = list(line.written)
    line.queue_time = 1.5
    with pytest.raises(Expired, match="within 1 s"):
        drive.set_frequency(30)
    with pytest.raises(Expired, match="control = FORWARD was not sent"):
        drive.start()
    assert line.written == written
    drive.stop()  # never expires
    assert len(line.written) == len(written) + 1


class Tidy(Drive):
    """A user's drive whose start reads the motor's state, whatever the result of its write."""

    current = reading(0x0F, "A")  # the register that is read before the first write
    speed = reading(0x10, "rpm")
    run = setting(0x20)

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        with suppress(Expired, NotMaster):
            yield from write(self.run, 1)
        yield from read(self.speed)


@pytest.mark.parametrize("result", [Failure.EXPIRED, Failure.NOT_MASTER])
def test_an_unsent_write_is_not_reported_as_unconfirmed(
    monkeypatch: pytest.MonkeyPatch, result: Failure
) -> None:
    """The write is not reported as unconfirmed even if a later read of the script fails."""
    line = SimulatedBus(simulated(Tidy(1)))
    drive = line.attach(Tidy(1, confirmed=1))
    carry_out = line.carry_out

    def carry_out_reads(exchange: Exchange, **details: Any) -> Completion:
        is_held_back = is_write(exchange.request)
        return (
            completed(result, Message(0, 0), b"", at_ns=0) if is_held_back else carry_out(exchange, **details)
        )

    monkeypatch.setattr(line, "carry_out", carry_out_reads)
    line.loses = lambda request: request.start == Tidy.speed.address
    with pytest.raises(NoReply):
        drive.start()
    assert line.written == []


def test_an_exception_to_a_read_after_a_start_raises_unconfirmed() -> None:
    """Raising DriveException would mean that the drive refused the start."""
    line, drive, sim = one(InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)
    line.refuses = lambda request: 6 if starts(line, "invt-che") and not is_write(request) else 0
    with pytest.raises(Unconfirmed, match=r"control = FORWARD took effect: it was confirmed, but .*code 06H"):
        drive.start()
    assert len(starts(line, "invt-che")) == 1
    assert sim.motor.energised


def test_a_start_succeeds_although_its_first_reads_are_lost() -> None:
    line, drive, sim = one(InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)
    spoilt: list[Message] = []

    def loses(request: Message) -> bool:
        if not starts(line, "invt-che") or len(spoilt) == 2 * READ_ATTEMPTS:
            return False
        spoilt.append(request)
        return not is_write(request)

    line.loses = loses
    drive.start()
    assert len(starts(line, "invt-che")) == 1
    assert len(spoilt) == 2 * READ_ATTEMPTS
    assert sim.motor.energised


def test_a_trip_during_a_start_raises_not_verified(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = one(InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)
    control = sim.write_handlers["control"]
    trips = {"control": lambda sim, raw: sim.trip(4) if raw == 1 else control(sim, raw)}
    monkeypatch.setattr(type(sim), "write_handlers", trips)
    with pytest.raises(NotVerified, match=r"tripped: overcurrent while accelerating .OC1"):
        drive.start()
    assert len(starts(line, "invt-che")) == 1
    with pytest.raises(WriteForbidden, match=r"OC1.*reset_fault"):
        drive.start()
    drive.reset_fault()
    assert len(starts(line, "invt-che")) == 1
    assert drive.state().condition is Condition.STOPPED


def test_a_start_after_a_power_cycle_needs_a_new_setpoint() -> None:
    """The drive loses its setpoint in the power cycle. Its motor stays off, and the next start is refused."""
    line, drive, sim = one(YD1000(1))
    drive.set_frequency(40)
    drive.start()
    line.sleep(1)
    sim.pass_time(line.seconds)
    assert 0 < sim.motor.frequency < 40
    sim.now = line.seconds
    sim._restart()  # keeps only the EEPROM
    line.sleep(5)
    sent = len(line.written)
    assert drive.state().condition is Condition.STOPPED
    with pytest.raises(WriteForbidden, match="set_frequency"):
        drive.start()
    assert len(line.written) == sent
    assert not sim.motor.energised
    drive.set_frequency(40)
    drive.start()
    assert sim.motor.energised


def test_a_start_is_refused_if_another_client_changed_the_setpoint() -> None:
    """Another client changes the setpoint between our write and our start: the start is refused."""
    line, drive, sim = one(YD1000(1))
    drive.set_frequency(10)
    sim["frequency"] = 60.0
    with pytest.raises(WriteForbidden, match=r"holds the setpoint 60\.00 Hz, not the written 10\.00 Hz"):
        drive.start()
    assert starts(line, "yd1000") == []
    assert not sim.motor.energised


def test_an_error_is_raised_if_the_drive_limits_a_setpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, sim = one(ErmanERG220(1))
    accept = type(sim).accept
    monkeypatch.setattr(
        type(sim),
        "accept",
        lambda sim, cell, raw: min(raw, 300) if cell.name == "frequency" else accept(sim, cell, raw),
    )
    with pytest.raises(
        NotVerified, match=r"frequency = 45\.0 Hz did not take effect: the drive holds 30\.0 Hz"
    ):
        drive.set_frequency(45)
    assert line.written == ["01 06 00 02 01 C2 A8 0B"]


@pytest.mark.slow
def test_frequent_setpoint_writes_to_eeprom_are_refused_with_advice() -> None:
    line, drive, sim = one(DelixiModbus(1))
    drive.set_frequency(10.0)
    for step in range(60):  # once a second for a minute
        with pytest.raises(
            WriteForbidden, match=r"only one write in 60 s is allowed; change it less often: .*P00\.02"
        ):
            drive.set_frequency(10.1 + 0.1 * (step % 9))
        line.sleep(1.0 - 0.04)
    assert sim.counters.eeprom_writes["frequency"] == 1
    for _ in range(100):
        drive.set_frequency(10.0)  # not written again: the drive holds the value
    line.sleep(60)
    drive.set_frequency(12.0)
    assert sim.counters.eeprom_writes["frequency"] == 2


def test_a_write_beyond_the_yearly_budget_is_refused(tmp_path: Path) -> None:
    line, drive, sim = one(ErmanERG220(1), ledger=Ledger(tmp_path / "wear", budget=5))
    # The manual does not say whether the frequency is kept in EEPROM. So its writes count in the yearly
    # budget, but may follow each other within a minute.
    for step in range(5):
        drive.set_frequency(10 + step)
    with pytest.raises(WriteForbidden, match=r'written 5 times in a year.*ram = \["frequency"\].*b\.007'):
        drive.set_frequency(45)
    assert sim.counters.eeprom_writes["frequency"] == 5
    line.sleep(366 * 86400)
    drive.set_frequency(45)


def test_writes_to_a_register_declared_as_ram_are_not_counted(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "wear", budget=1)
    line, drive, _ = one(ErmanERG220(1, ram=["frequency"]), ledger=ledger)
    for step in range(20):
        drive.set_frequency(10 + step)
    assert ledger.wear(line.seconds) == []
    with pytest.raises(ValueError, match="cannot be in ram: the manual says it is in EEPROM"):
        DelixiModbus(1, ram=["frequency"])
    with pytest.raises(ValueError, match="no register 'frequenzy'"):
        ErmanERG220(1, ram=["frequenzy"])


def test_writes_to_a_ram_address_are_not_counted_as_eeprom_writes(tmp_path: Path) -> None:
    class Mine(InvtCHE):
        """An INVT CHE with a parameter declared by its owner."""

        acceleration_time = parameter(12, "s", step=0.1, place="P0.07")

    ledger = Ledger(tmp_path / "wear")
    line, drive, sim = one(Mine(1), ledger=ledger)
    drive.write(Mine.acceleration_time, 20.0)
    assert line.written == ["01 06 80 0C 00 C8 61 9F"]
    assert not sim.counters.eeprom_writes
    assert ledger.wear(0) == []


def test_the_watchdog_setting_is_read_from_the_drive_if_readable() -> None:
    line, drive, sim = one(YD1000(1))
    assert not line.frames  # attaching sends no request
    assert line.bus.watchdog(drive) == (
        "its watchdog (communication_timeout) is off: the motor runs on when the client dies"
    )
    sim["communication_timeout"] = 5
    assert line.bus.watchdog(drive) == "its watchdog (communication_timeout) acts 5 s after the last message"
    line.refuses = lambda request: 2
    assert line.bus.watchdog(drive) == drive.watchdog
    line, drive, _ = one(ErmanERG220(1))
    assert "no watchdog" in line.bus.watchdog(drive)
    assert line.written == []


def test_values_declared_harmless_only_stop_a_motor_or_clear_a_command() -> None:
    """A harmless raw count may be written repeatedly, so it may only stop a motor or withdraw a command."""
    for family in MODELS.values():
        for register in family.registers.values():
            if register.harmless is None:
                continue
            names = {str(register.format(register.decode(raw))) for raw in register.harmless}
            if register.table is COIL:
                assert names in ({"ON"}, {"OFF"})
                assert (names == {"ON"}) == (register.name in ("stop_coil", "emergency_stop_coil"))
            else:
                allowed = {"STOP", "COAST", "STOP_JOG", "NOTHING", "COMMAND_VALID", "FREQUENCY_VALID"}
                assert {part for name in names for part in name.split("|")} <= allowed


def test_a_write_to_a_silent_drive_without_identify_is_not_sent() -> None:
    class Mine(Drive):
        """A family without `identify`."""

        speed = setting(5, "rpm", kept=Kept.RAM)

    line = SimulatedBus()
    drive = line.attach(Mine(1))
    with pytest.raises(NoReply):
        drive.write(Mine.speed, 10)
    assert line.written == []


def test_an_identity_check_may_wait_between_its_reads() -> None:
    class Sleepy(Toy):
        """A family whose `identify` waits between two reads."""

        @verb
        def identify(self) -> Script[None]:
            yield from read(Toy.status)
            yield from wait(3.0)
            yield from read(Toy.fault)

    line = SimulatedBus(simulated(Sleepy(1)))
    begun = line.seconds
    line.bus.check_identity(line.attach(Sleepy(1)))
    assert [(each.start, each.count) for each, _ in line.frames] == [(5, 1), (4, 1)]
    assert line.seconds - begun == pytest.approx(3.0 + 2 * EXCHANGE_TIME)


def test_an_identity_check_that_writes_is_refused() -> None:
    class Meddler(Toy):
        """A family whose `identify` writes by mistake."""

        @verb
        def identify(self) -> Script[None]:
            yield from write(Toy.frequency, 10.0)

    line = SimulatedBus(simulated(Meddler(1)))
    drive = line.attach(Meddler(1, name="meddler"))
    with pytest.raises(WriteForbidden, match=r"^meddler: an identity check must not write$"):
        drive.set_frequency(20.0)
    assert line.frames == []


def test_a_write_allowed_only_at_rest_is_refused_if_the_state_is_unreadable() -> None:
    class Mute(Drive):
        """A family without the verb `state`."""

        speed = reading(1, "rpm")
        ratio = setting(2, kept=Kept.RAM, while_running=False)

    line = SimulatedBus(simulated(Mute(1)))
    drive = line.attach(Mute(1, name="mute"))
    with pytest.raises(WriteForbidden) as refusal:
        drive.write(Mute.ratio, 3)
    assert str(refusal.value) == (
        "ratio of mute is not written: it can be written only at standstill, which the family cannot report"
    )
    assert line.written == []


def test_the_eeprom_ledger_is_not_created_before_the_first_write(tmp_path: Path) -> None:
    line, drive, _ = one(ErmanERG220(1), ledger=tmp_path / "none" / "wear")
    assert drive.read(drive.frequency) == 0
    assert not (tmp_path / "none").exists()
    assert isinstance(line.bus, Bus)
