"""Drive classes that a user declares: no command is written by mistake, and a stop is always sent."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path
from typing import ClassVar

import pytest
from simulated_bus import SimulatedBus
from tables import table

from multidrop.control.ramp import ramp, start_staggered
from multidrop.core import Message
from multidrop.drive import Condition, Direction, Drive, Script, State, insist, read, write
from multidrop.drive.register import Kept, command, reading, setting
from multidrop.drive.verbs import verb
from multidrop.errors import DriveException, Unconfirmed, WriteForbidden
from multidrop.plant.loader import load_plant
from multidrop.sim import simulated


class Word(IntEnum):
    STOP = 0
    RUN = 1


class Fan(Drive):
    """The drive class that is declared in README."""

    speed = reading(0x10, "rpm")
    frequency = setting(0x20, "Hz", step=0.1, span=(0, 60))


class Pump(Fan):
    """A drive with verbs. Its control word has no raw counts that are declared harmless."""

    control = command(0x30, Word)
    target = command(0x31, "Hz", step=0.1, span=(0, 60), moves=False)

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        yield from write(self.control, Word.RUN)

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor with a plain `write` instead of `insist`."""
        yield from write(self.control, Word.STOP)

    @verb
    def coast(self) -> Script[None]:
        """Stop the motor with `insist`, which repeats a write."""
        yield from insist(self.control, Word.STOP)

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        yield from write(self.target, hz)

    @verb
    def state(self) -> Script[State]:
        """Return running if the speed is not 0."""
        speed = yield from read(self.speed)
        return State(Condition.RUNNING if speed else Condition.STOPPED)


class Known(Pump):
    """A drive that a register identifies."""

    kind = reading(0x40)
    control = command(0x30, Word, harmless=(Word.STOP,))

    @verb
    def identify(self) -> Script[None]:
        """Check that the register `kind` is 0."""
        if (yield from read(self.kind)) != 0:
            raise WriteForbidden(f"{self.name} is no pump")


STOP, RUN = "01 06 00 30 00 00", "01 06 00 30 00 01"


def written(line: SimulatedBus) -> list[str]:
    return [frame[:17] for frame in line.written]


def test_a_write_to_a_setting_of_a_users_drive_needs_no_confirmation() -> None:
    line = SimulatedBus(simulated(Fan(1)))
    fan = line.attach(Fan(1))
    assert fan.write(fan.frequency, 25.0) == 25.0
    assert "confirmed" not in Fan.options


@table("confirmed", [0, 1])
@table("word", Word)
def test_a_plain_write_to_a_command_register_is_refused_by_default(confirmed: int, word: Word) -> None:
    line = SimulatedBus(simulated(Pump(1)))
    pump = line.attach(Pump(1, name="pump", confirmed=confirmed))
    with pytest.raises(WriteForbidden) as refusal:
        pump.write(pump.control, word)
    assert str(refusal.value) == (
        f"control of pump is not written: {word.name} commands the motor, which only verbs may do: "
        "use start(), stop()"
    )
    assert line.frames == []


def test_error_for_a_missing_verb_names_the_method_to_declare() -> None:
    class Bare(Drive):
        """A drive with a command, but without verbs."""

        level = reading(1)
        run = command(2)

    line = SimulatedBus(simulated(Bare(1)))
    bare = line.attach(Bare(1, confirmed=1))
    with pytest.raises(
        WriteForbidden,
        match=r"its class does not declare it harmless: add harmless = \(…\), moves = False, or",
    ):
        bare.write(bare.run, 1)
    assert line.frames == []


def test_a_write_of_a_harmless_raw_count_needs_no_confirmation() -> None:
    class Stoppable(Pump):
        """A drive whose control word has a stop that is declared harmless."""

        control = command(0x30, Word, harmless=(Word.STOP,))

    line = SimulatedBus(simulated(Stoppable(1)))
    pump = line.attach(Stoppable(1))
    pump.write(pump.control, Word.STOP)
    with pytest.raises(WriteForbidden, match="RUN commands the motor"):
        pump.write(pump.control, Word.RUN)
    assert written(line) == [STOP]


@pytest.mark.parametrize("name", ["start", "set_frequency", "target"])
def test_a_start_needs_confirmation_if_the_drive_cannot_be_identified(name: str) -> None:
    def command_it(line: SimulatedBus, pump: Pump) -> None:
        acts = {
            "start": pump.start,
            "set_frequency": lambda: pump.set_frequency(20.0),
            "target": lambda: pump.write(pump.target, 20.0),
        }
        acts[name]()

    line = SimulatedBus(simulated(Pump(1)))
    pump = line.attach(Pump(1, name="pump"))
    with pytest.raises(WriteForbidden) as refusal:
        command_it(line, pump)
    assert str(refusal.value) == (
        f"{name} is not sent to pump: its class cannot identify a Pump, and the write may start a motor "
        "on a drive of another maker. Read the drive's name plate, then declare confirmed = 1"
    )
    assert line.frames == []
    line.bus.detach(pump)
    command_it(line, line.attach(Pump(1, confirmed=1)))
    assert len(line.written) == 1


@pytest.mark.parametrize("name", ["start_staggered", "ramp", "run_at"])
def test_frequency_ramps_and_combined_verbs_need_confirmation_too(name: str) -> None:
    class Combined(Pump):
        """A drive with a verb that combines two others."""

        setpoint_name = "target"

        @verb
        def run_at(self, hz: float) -> Script[None]:
            """Write the setpoint and start the motor."""
            yield from self.set_frequency.script(hz)
            yield from self.start.script()

    def command_it(pump: Combined) -> None:
        acts = {
            "start_staggered": lambda: start_staggered([pump], 1.0),
            "ramp": lambda: ramp(pump, 20.0, rate=5.0),
            "run_at": lambda: pump.run_at(20.0),
        }
        pump.commanded = 10.0
        acts[name]()

    line = SimulatedBus(simulated(Combined(1)))
    pump = line.attach(Combined(1, name="pump"))
    with pytest.raises(WriteForbidden, match=r"is not sent to pump: .*declare confirmed = 1"):
        command_it(pump)
    assert line.frames == []
    line.bus.detach(pump)
    command_it(line.attach(Combined(1, confirmed=1)))
    assert line.written


@pytest.mark.parametrize("name", ["stop", "coast", "stop_all"])
def test_a_stop_needs_no_confirmation_even_without_identification(name: str) -> None:
    line = SimulatedBus(simulated(Pump(1)))
    pump = line.attach(Pump(1))
    getattr(line.bus if name == "stop_all" else pump, name)()
    assert written(line) == [STOP]


def test_a_start_needs_no_confirmation_if_the_drive_can_be_identified() -> None:
    assert "confirmed" in Pump.options
    line = SimulatedBus(simulated(Known(1)))
    line.attach(Known(1)).start()
    assert written(line) == [RUN]


def acknowledged(request: Message) -> bytes | None:
    """Return exception 05 as the reply to a write, and None for a read."""
    return bytes.fromhex("01 86 05 82 63") if request.function == 6 else None  # checksum computed by pymodbus


def test_write_is_unconfirmed_if_answered_with_exception_05() -> None:
    """Exception 05 means: accepted and being processed (application protocol V1.1b3, section 7)."""
    line = SimulatedBus(simulated(Known(1)))
    drive = line.attach(Known(1))
    line.answers = acknowledged
    with pytest.raises(Unconfirmed, match="its reply is code 05H, acknowledged, still working"):
        drive.start()
    assert written(line) == [RUN]


def test_exception_05_is_a_refusal_if_the_family_gives_it_another_meaning() -> None:
    class Locked(Known):
        """A drive whose manual defines exception 05 differently."""

        exceptions: ClassVar = {5: "locked by its password"}

    line = SimulatedBus(simulated(Locked(1)))
    drive = line.attach(Locked(1))
    line.answers = acknowledged
    with pytest.raises(DriveException, match="code 05H, locked by its password"):
        drive.start()


def test_a_setting_can_be_declared_to_move_the_motor() -> None:
    class Readable(Drive):
        """A drive whose control word can be read."""

        control = setting(1, Word, moves=True, harmless=(Word.STOP,), kept=Kept.RAM)
        mode = setting(2, moves=True, kept=Kept.RAM)

    line = SimulatedBus(simulated(Readable(1)))
    drive = line.attach(Readable(1, confirmed=1))
    for register, value in ((drive.control, Word.RUN), (drive.mode, 1)):
        with pytest.raises(WriteForbidden, match="commands the motor"):
            drive.write(register, value)
    drive.write(drive.control, Word.STOP)
    assert len(line.written) == 1


def test_plant_file_can_set_the_option_confirmed(tmp_path: Path) -> None:
    (tmp_path / "pump.py").write_text(
        "from multidrop import Drive, command, reading\n"
        "class Pump(Drive):\n    speed = reading(1)\n    run = command(2)\n"
    )
    (tmp_path / "plant.toml").write_text(
        '[[line]]\nname = "a"\nport = "/dev/none"\n[[line.drive]]\nname = "p"\nmodel = "pump.py:Pump"\n'
        "address = 1\nconfirmed = 1\n"
    )
    drive = load_plant(tmp_path / "plant.toml").lines[0].drives[0].drive
    assert drive.option == {"confirmed": 1}
