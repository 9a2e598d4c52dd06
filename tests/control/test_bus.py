"""A bus and its drives on simulated lines: frames, results and failures."""

from __future__ import annotations

import logging
import re
import threading
from collections.abc import Callable
from itertools import chain, repeat
from typing import Any, cast

import checksums
import pytest
from lines import PATIENCE, Faulty, patient, proof, until
from tables import table, usually
from toy import Fault, Toy

from multidrop.bus import Bus
from multidrop.core import Framing, Message
from multidrop.drive import Drive, Script
from multidrop.drive.register import HOLDING, Kept, command, reading, setting
from multidrop.drive.verbs import verb
from multidrop.errors import BadReply, BusError, LineError, NoReply, NotAttached, Unconfirmed, WriteForbidden
from multidrop.families import YD1000, DelixiModbus, DelixiNative, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.families.innovert_ibd import IBDControl
from multidrop.plant.model import Plant, PlantLine, PolledDrive
from multidrop.poller import Poller
from multidrop.sim import EncodedDrive, SimulatedDrive, Simulator, Wire, simulated
from multidrop.transport import drive_records
from multidrop.transport.drive_reads import make_exchange
from multidrop.transport.exchange import READ_ATTEMPTS


class Rig(Drive):
    """A family for tests, with one register of each kind."""

    response_timeout = 0.1
    most_registers = {HOLDING: 4}
    options = {}

    speed = reading(0x00, "rpm")
    torque = reading(0x01, "%", step=0.1)
    fault = reading(0x02, Fault)
    gain = setting(0x10, step=0.01, span=(0, 10), kept=Kept.RAM)
    limit = setting(0x11, "A", step=0.1, span=(0, 50), kept=Kept.EEPROM)
    sealed = setting(0x12, never="it is the maker's", kept=Kept.RAM)
    target = command(0x20, "rpm", span=(0, 3000), moves=False)

    @verb
    def identify(self) -> Script[None]:
        yield from ()


def unpaced(*drives: SimulatedDrive) -> Simulator:
    return Simulator([Wire(drives, unpaced=True)])


def faulty(drive: SimulatedDrive, fate: Callable[[bytes], bytes]) -> Simulator:
    return Simulator([Faulty([drive], fate, unpaced=True)])


def path(sim: Simulator) -> str:
    return sim.wires[0].path


def sent(drive: SimulatedDrive) -> dict[int, int]:
    """Return the number of requests that reached the drive, by function code."""
    return dict(drive.counters.functions)


def losing(*functions: int) -> Callable[[bytes], bytes]:
    """Return a fault that loses all replies to these function codes."""
    return lambda reply: b"" if reply[1] in functions else reply


@patient
def test_a_read_returns_the_scaled_value() -> None:
    rig = simulated(Rig(1))
    rig["torque"] = 33.3
    with unpaced(rig) as sim, Bus(path(sim)) as bus:
        ours = bus.attach(Rig, 1)
        assert ours.read(ours.torque) == 33.3
        assert ours.read(ours.fault) is Fault.NONE
        rig["fault"] = Fault.OVERCURRENT
        assert ours.read(ours.fault) is Fault.OVERCURRENT


@patient
def test_read_many_returns_values_in_the_requested_order() -> None:
    with unpaced(EncodedDrive(Rig(1))) as sim, Bus(path(sim)) as bus:
        ours = bus.attach(Rig, 1)
        asked = [ours.gain, ours.speed, ours.limit, ours.torque, ours.gain]
        found = ours.read_many(asked)
        assert list(found) == ["gain", "speed", "limit", "torque"]
        assert found == {register.name: proof(ours, register) for register in asked}


REQUESTS = {  # requests for all readings, from the manuals' register maps and limits
    ErmanERG220: 2,  # two reads: 1 to 12, including unused addresses, and 0400H to 0403H
    InvtCHE: 4,  # four reads: 1001H, 3000H to 3016H in two parts, and 5000H together with 5001H
    InnovertIBD: 2,  # two reads: PrA.03 together with PrA.04, and PrA.22
    DelixiModbus: 32,  # one register per request
    DelixiNative: 33,
    YD1000: 16,
}


@pytest.mark.long
@patient
@pytest.mark.parametrize("family", REQUESTS)
def test_all_readings_take_as_few_requests_as_the_family_allows(family: type[Drive]) -> None:
    there = EncodedDrive(family(1))
    with unpaced(there) as sim, Bus(path(sim)) as bus:
        ours = bus.attach(family, 1)
        ours.read(ours.readings()[0])  # a new bus reads its first value twice: not counted
        before = bus.peer(ours).counters()
        requests = there.counters.requests
        found = ours.read_many(ours.readings())
        counters = bus.peer(ours).counters()
    assert found == {register.name: proof(ours, register) for register in ours.readings()}
    assert counters.answered - before.answered == REQUESTS[family]
    assert there.counters.requests - requests == counters.exchanges - before.exchanges == REQUESTS[family]
    assert there.counters.refusals == 0


@pytest.mark.slow
@patient
def test_drives_with_different_baud_rates_and_formats_share_one_bus() -> None:
    drives = [
        ErmanERG220(1),
        InvtCHE(2, baudrate=19200, format="8E1"),
        InnovertIBD(3),
        InnovertIBD(4, framing=Framing.ASCII, baudrate=38400, format="8O1"),
        DelixiModbus(5),
        DelixiModbus(6, framing=Framing.ASCII),
        DelixiNative(7, baudrate=4800),
        YD1000(8),
    ]
    with Simulator([Wire([EncodedDrive(drive) for drive in drives])]) as sim, Bus(path(sim)) as bus:
        for ours in [bus.attach(drive) for drive in drives] * 2:
            register = ours.readings()[-1]
            assert ours.read(register) == proof(ours, register)


def test_a_drive_uses_the_line_settings_of_the_bus_by_default() -> None:
    with unpaced(simulated(Toy(1))) as sim, Bus(path(sim), baudrate=19200, format="8N2") as bus:
        assert str(bus.attach(Toy, 1).settings) == "19200 8N2"
        assert str(bus.attach(Toy, 2, baudrate=9600).settings) == "9600 8N2"
        assert str(bus.attach(Toy(3)).settings) == "19200 8N2"
        assert str(bus.attach(Toy(4, format="8E1")).settings) == "19200 8E1"


def test_a_drive_without_settings_uses_those_of_its_present_bus() -> None:
    drive = Toy(1)
    with unpaced(simulated(Toy(1))) as sim:
        for line, expected in ((19200, "19200 8N1"), (None, "9600 8N1")):
            with Bus(path(sim), baudrate=line) as bus:
                assert str(bus.attach(drive).settings) == expected


def test_a_bus_does_not_change_the_settings_of_a_drive_that_it_refuses() -> None:
    drive = Toy(1)
    with unpaced(simulated(Toy(1, baudrate=19200))) as sim, Bus(path(sim), baudrate=19200) as bus:
        bus.attach(drive)
        other = Bus.awaiting("tcp://127.0.0.1:1")
        other.baudrate = 9600
        with other, pytest.raises(ValueError, match="toy@1 is on the bus at"):
            other.attach(drive)
        PlantLine("hall", "/dev/ttyUSB0", baudrate=9600, drives=[PolledDrive(drive)])
        assert (drive.framing, str(drive.settings)) == (Framing.RTU, "19200 8N1")
        assert drive.read("status") == 0


def test_a_drive_can_be_attached_after_a_line_with_unsupported_settings() -> None:
    drive = Toy(1)
    with unpaced(simulated(Toy(1))) as sim:
        for wrong in ({"baudrate": 300}, {"format": "7E1"}, {"baudrate": 19200, "silence": 1e-6}):
            with (
                Bus(path(sim), **cast(Any, wrong)) as bus,
                pytest.raises(ValueError, match=r"300|7E1|silence"),
            ):
                bus.attach(drive)
            assert (str(drive.settings), drive.agreed_silence) == ("9600 8N1", None)


def test_a_drive_cannot_be_attached_to_a_closed_bus() -> None:
    with unpaced(simulated(Toy(1))) as sim, Bus(path(sim)) as bus:
        bus.close()
        with pytest.raises(LineError, match="the bus is closed: attach toy@1 to a new Bus"):
            bus.attach(Toy, 1)


@patient
def test_drives_use_the_silence_of_the_bus_by_default() -> None:
    """One bit time is added to the silence of the bus, as to the standard's t3.5."""
    drives = [simulated(ErmanERG220(at, silence=600e-6)) for at in (1, 2)]
    with Simulator([Wire(drives)]) as sim, Bus(sim.wires[0].path, silence=600e-6) as bus:
        for at in (1, 2):
            drive = bus.attach(ErmanERG220, at)
            assert drive.needed_silence() == 600e-6
            assert make_exchange(drive, Message(at, 4, 1, 1), bus.peer(drive)).c.silence_ns == 626042
            drive.read(drive.output_current)
        assert bus.attach(ErmanERG220, 3, silence=1e-3).needed_silence() == 1e-3
        assert bus.attach(ErmanERG220, 4, silence=None).needed_silence() == 1.75e-3
        with pytest.raises(ValueError, match=r"^silence 300 us is too short at 38400 8N1"):
            bus.attach(ErmanERG220, 5, silence=300e-6)


@patient
def test_a_write_is_skipped_if_the_eeprom_holds_the_value() -> None:
    rig = simulated(Rig(1))
    rig["limit"] = 10.0
    with unpaced(rig) as sim, Bus(path(sim)) as bus:
        ours = bus.attach(Rig, 1)
        assert ours.write(ours.limit, 10.0) == 10.0
        assert not rig.counters.writes
        assert ours.write(ours.limit, 12.5) == 12.5
        assert ours.write(ours.limit, 12.5) == 12.5
    assert rig.counters.eeprom_writes == {"limit": 1}


class Meter(Drive):
    """A device without a motor."""

    has_motor = False
    voltage = reading(0, "V", step=1)


def test_no_watchdog_is_logged_for_a_device_without_a_motor(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "multidrop.control")
    with unpaced(simulated(Meter(1))) as sim, Bus(path(sim)) as bus:
        bus.check_identity(bus.attach(Meter, 1))
    assert [record.getMessage() for record in caplog.records] == []


MISTAKES: dict[type[Exception], list[tuple[Callable[[Bus, Any], Any], str]]] = {
    WriteForbidden: [
        (lambda bus, rig: rig.write(rig.speed, 1), "speed of pump is not written: it is a reading"),
        (lambda bus, rig: rig.write(rig.sealed, 1), "sealed of pump is not written: it is the maker's"),
        (lambda bus, rig: bus.broadcast(rig.target, 0), "target = 0 cannot be broadcast"),
    ],
    ValueError: [
        (lambda bus, rig: rig.write(rig.target, 3001), "target = 3001 is outside 0 to 3000 rpm"),
        (lambda bus, rig: rig.write(rig.gain, float("nan")), "gain takes a finite number, not nan"),
        (lambda bus, rig: rig.read(rig.target), "target of pump cannot be read: it is declared as a command"),
        (
            lambda bus, rig: rig.read(rig.speed, rig.target),
            "target of pump cannot be read: it is declared as a command",
        ),
        (lambda bus, rig: bus.attach(Toy, 1), "address 1 is already used by pump"),
        (lambda bus, rig: bus.attach(rig), "address 1 is already used by pump"),
        (lambda bus, rig: bus.attach(Toy, 32), "address 32 is not supported by TOY T1; choose 1 to 31"),
        (lambda bus, rig: Toy(5).read(Toy.status), "toy@5 is not attached to a bus: use bus.attach(...)"),
        (
            lambda bus, rig: rig.read(InvtCHE.output_current),
            "this output_current is not a register of pump, which is a Rig",
        ),
        (
            lambda bus, rig: rig.write(YD1000.acceleration_time, 5.0),
            "this acceleration_time is not a register of pump, which is a Rig",
        ),
        (
            lambda bus, rig: bus.attach(Toy, 2, name=cast(Any, 5)),
            "the name 5 must be one line of printable characters",
        ),
        (lambda bus, rig: rig.read("targets"), "Rig has no register 'targets'; did you mean target?"),
        (lambda bus, rig: rig.write("targets", 5.0), "Rig has no register 'targets'; did you mean target?"),
    ],
    TypeError: [
        (lambda bus, rig: rig.write(rig.gain, "1"), "gain takes a number, not '1'"),
        (lambda bus, rig: rig.write(rig.gain, True), "gain takes a number, not True"),
        (lambda bus, rig: bus.attach(Toy), "attach(Toy, address=...): the address is missing"),
        (
            lambda bus, rig: rig.read(5),
            "5 is not a Register of pump: pass attributes of the drive, or drive.register(NAME)",
        ),
        (
            lambda bus, rig: rig.read([rig.target]),
            "is not a Register of pump: pass attributes of the drive, or drive.register(NAME)",
        ),
        (
            lambda bus, rig: rig.read(),
            "read() of pump needs registers or their names; read_all() reads all",
        ),
        (lambda bus, rig: bus.watchdog([rig]), "is not a drive: pass the drive that bus.attach() returned"),
        (
            lambda bus, rig: bus.check_identity([rig]),
            "is not a drive: pass the drive that bus.attach() returned",
        ),
        (lambda bus, rig: rig.send_raw(16, 0, 5), r"data = 5: it must be bytes, such as b'\x00\x01'"),
        (lambda bus, rig: rig.register(5), "5 is not a register's name, such as 'speed'"),
        (
            lambda bus, rig: bus.attach("innovert-ibd", 2),
            "attach needs a family such as YD1000, or a drive such as YD1000(1), not 'innovert-ibd'",
        ),
        (
            lambda bus, rig: bus.attach(Toy(3, name="pump"), name="fan"),
            "attach takes no address or options with a drive object; write them in Toy(…)",
        ),
        (
            lambda bus, rig: bus.attach(Toy(3, name="pump"), 2),
            "attach takes no address or options with a drive object; write them in Toy(…)",
        ),
        (
            lambda bus, rig: bus.detach(cast(Any, "pump")),
            "'pump' is not a drive: pass the drive that bus.attach() returned",
        ),
        (
            lambda bus, rig: bus.attach(dict, 2),
            "attach needs a family such as YD1000, or a drive such as YD1000(1), not <class 'dict'>",
        ),
        (
            lambda bus, rig: Bus(cast(Any, None)),
            "a port is a device such as '/dev/ttyUSB0' or a pyserial URL, not None",
        ),
        (
            lambda bus, rig: Poller(cast(Any, 5)),
            "Poller takes a Plant or a plant file such as 'plant.toml', not 5",
        ),
        (lambda bus, rig: rig.read(["speed", "gain"]), "drive.register(NAME), as separate arguments"),
        (
            lambda bus, rig: Plant(cast(Any, "plant.toml")),
            "Plant takes lines; to load a plant file, write Plant.load('plant.toml')",
        ),
        (
            lambda bus, rig: Plant(cast(Any, PlantLine("a", "/dev/a"))),
            "Plant takes lines as a list of PlantLine objects, not PlantLine(",
        ),
        (
            lambda bus, rig: PlantLine("a", "/dev/a", drives=cast(Any, [rig])),
            "PlantLine takes drives as a list of PolledDrive objects, not [<Rig",
        ),
        (
            lambda bus, rig: PlantLine("a", "/dev/a", baudrate=cast(Any, "9600")),
            "a line's baud rate is a whole number, not '9600'",
        ),
        (
            lambda bus, rig: PolledDrive(cast(Any, Rig)),
            "PolledDrive takes a drive such as YD1000(1), not <class",
        ),
        (
            lambda bus, rig: PolledDrive(rig, "speed"),
            "PolledDrive takes a list of registers, such as ['output_current'], not a single register",
        ),
    ],
}


def test_an_invalid_argument_raises_before_any_frame_is_sent() -> None:
    rig = simulated(Rig(1))
    with unpaced(rig) as sim, Bus(path(sim)) as bus:
        ours = bus.attach(Rig, 1, name="pump")
        for kind, calls in MISTAKES.items():
            for call, sentence in calls:
                with pytest.raises(kind, match=re.escape(sentence)):
                    call(bus, ours)
    assert rig.counters.requests == rig.counters.broadcasts == 0


@pytest.fixture
def half_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait half a second for each reply of a fast drive, because the computer may be busy."""
    monkeypatch.setattr(drive_records, "LEAST_TIMEOUT", 0.5)
    monkeypatch.setattr(Rig, "response_timeout", 0.5)


@pytest.mark.slow
def test_a_write_to_a_write_only_register_is_unconfirmed_without_a_reply() -> None:
    rig = simulated(Rig(1))
    with faulty(rig, losing(0x06)) as sim, Bus(path(sim)) as bus:
        ours = bus.attach(Rig, 1)
        with pytest.raises(Unconfirmed) as caught:
            ours.write(ours.target, 1500)
    assert str(caught.value) == "Rig@1: it is not known whether target = 1500 rpm took effect: no reply"
    assert (caught.value.drive, caught.value.what) == ("Rig@1", "target = 1500 rpm")
    assert sent(rig)[0x06] == 1
    assert rig["target"] == 1500  # the write took effect, although no reply confirmed it


@pytest.mark.slow
def test_a_read_of_a_silent_drive_is_retried_a_few_times() -> None:
    rig = simulated(Rig(1))
    with faulty(rig, losing(0x03)) as sim, Bus(path(sim)) as bus:
        ours = bus.attach(Rig, 1, name="pump")
        with pytest.raises(NoReply) as caught:
            ours.read(ours.speed)
        until(lambda: rig.counters.requests >= READ_ATTEMPTS)
    assert str(caught.value).startswith(
        "pump does not answer at address 1 with 9600 8N1: check its address, "
    )
    assert caught.value.drive == "pump"
    assert isinstance(caught.value, TimeoutError)
    assert rig.counters.requests == READ_ATTEMPTS


@pytest.mark.slow
@pytest.mark.usefixtures("half_a_second")
def test_the_error_shows_the_bytes_of_a_damaged_reply() -> None:
    rig = simulated(Rig(1))
    with faulty(rig, lambda reply: reply[:-1] + b"\0") as sim, Bus(path(sim)) as bus:
        ours = bus.attach(Rig, 1, name="pump")
        with pytest.raises(BadReply) as caught:
            ours.read(ours.speed)
    good = checksums.rtu("01 03 02 00 00")
    assert caught.value.reason == "bad checksum"
    assert caught.value.frame == good[:-1] + b"\0"
    assert str(caught.value) == f"pump: bad checksum (received {caught.value.frame.hex(' ').upper()})"
    assert rig.counters.requests == READ_ATTEMPTS


@pytest.mark.slow
@pytest.mark.usefixtures("half_a_second")
def test_a_read_is_repeated_after_noise() -> None:
    fates = chain([lambda reply: b"", lambda reply: reply[:-1]], repeat(lambda reply: reply))
    rig = simulated(Rig(1))
    rig["speed"] = 1480
    with faulty(rig, lambda reply: next(fates)(reply)) as sim, Bus(path(sim)) as bus:
        ours = bus.attach(Rig, 1)
        assert ours.read(ours.speed) == 1480


WRONG = {  # wrong replies; pymodbus, libmodbus and minimalmodbus each accept some
    "another address": checksums.rtu("02 03 02 00 07"),
    "another function": checksums.rtu("01 04 02 00 07"),
    "too many registers": checksums.rtu("01 03 04 00 07 00 07"),
    "too few registers": checksums.rtu("01 03 00"),
    "bad checksum": b"\x01\x03\x02\x00\x07\x00\x00",
}


@pytest.mark.slow
@pytest.mark.parametrize("wrong", usually(*WRONG))
def test_a_wrong_reply_is_never_returned_as_data(wrong: str) -> None:
    with faulty(simulated(Rig(1)), lambda reply: WRONG[wrong]) as sim, Bus(path(sim)) as bus:
        ours = bus.attach(Rig, 1)
        with pytest.raises((BadReply, NoReply)):  # NoReply if this computer reads the reply too late
            ours.read(ours.speed)


WRONG_ECHOES = {
    "another register": "01 06 00 21 05 DC",
    "another value": "01 06 00 20 05 DD",
    "another address": "02 06 00 20 05 DC",
    "another function": "01 05 00 20 05 DC",
}


@pytest.mark.long
@pytest.mark.parametrize("wrong", WRONG_ECHOES)
def test_a_write_is_unconfirmed_if_the_reply_does_not_match(wrong: str) -> None:
    echo = checksums.rtu(WRONG_ECHOES[wrong])

    def fate(reply: bytes) -> bytes:
        return echo if reply[1] == 0x06 else reply

    rig = simulated(Rig(1))
    with faulty(rig, fate) as sim, Bus(path(sim)) as bus:
        ours = bus.attach(Rig, 1)
        with pytest.raises(Unconfirmed):
            ours.write(ours.target, 1500)
    assert sent(rig)[0x06] == 1


@table(
    ("drive", "least_ms", "most_ms"),
    [
        (InvtCHE(1), 20, 400),
        (YD1000(1), 110, 500),  # the drive takes 24 characters of 11 bits to answer
        (YD1000(1, baudrate=2400), 440, 500),
        (YD1000(1, baudrate=1200), 500, 500),
    ],
)
def test_the_timeouts_of_a_drive_follow_its_manual(drive: Drive, least_ms: int, most_ms: int) -> None:
    with unpaced(simulated(drive)) as sim, Bus(path(sim)) as bus:
        known = bus.peer(bus.attach(drive)).c
    assert (known.least_timeout_ns, known.most_timeout_ns) == (least_ms * 1_000_000, most_ms * 1_000_000)


@patient
def test_a_broadcast_stop_stops_all_drives_of_one_family() -> None:
    drives = [simulated(InnovertIBD(address)) for address in (1, 2)]
    with unpaced(*drives) as sim, Bus(path(sim)) as bus:
        for drive in drives:
            bus.attach(drive.drive)
        bus.broadcast(InnovertIBD.control, IBDControl.STOP)
    assert [drive.counters.broadcasts for drive in drives] == [1, 1]


@pytest.mark.slow
@patient
def test_two_threads_can_use_one_bus() -> None:
    drives = [EncodedDrive(Toy(address)) for address in (1, 2, 3)]
    wrong: list[Any] = []
    with unpaced(*drives) as sim, Bus(path(sim)) as bus:
        ours = [bus.attach(Toy, address) for address in (1, 2, 3)]

        def read(drive: Toy) -> None:
            truth = {register.name: proof(drive, register) for register in drive.readings()}
            for _ in range(15):
                try:
                    found = drive.read_many(drive.readings())
                except BusError as failure:
                    wrong.append(failure)
                else:
                    wrong.extend([found] if found != truth else [])

        threads = [threading.Thread(target=read, args=(drive,)) for drive in ours]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert wrong == []


def read_for_ever(bus: Bus, rig: Rig) -> None:
    while True:
        rig.read(rig.speed)


def read_until_closed(bus: Bus, rig: Rig) -> None:
    with pytest.raises(LineError):
        read_for_ever(bus, rig)


@pytest.mark.slow
@patient
def test_a_read_ends_with_an_error_if_another_thread_closes_the_bus() -> None:
    """Each round has a new line, because the old line may still get late replies."""
    for _ in range(20):
        with unpaced(simulated(Rig(1))) as sim:
            bus = Bus(path(sim))
            ours = bus.attach(Rig, 1)

            threads = [threading.Thread(target=read_until_closed, args=(bus, ours)) for _ in range(3)]
            for thread in threads:
                thread.start()
            ours.read(ours.speed)
            bus.close()
            for thread in threads:
                thread.join()


class Single(Toy):
    """A drive that is read one register at a time."""

    most_registers = {HOLDING: 1}


class Successor(Single):
    """A drive of another family at the same address."""

    model = "successor"


def when_asked(bus: Bus, act: Callable[[], object]) -> None:
    """Call `act` once, when a thread is about to carry out its next exchange."""
    carry_out = bus.line.carry_out

    def act_and_carry_out(*arguments: Any, **details: Any) -> Any:
        vars(bus.line)["carry_out"] = carry_out
        act()
        return carry_out(*arguments, **details)

    vars(bus.line)["carry_out"] = act_and_carry_out


def test_detaching_a_drive_ends_a_read_that_needs_several_requests() -> None:
    with Simulator([Wire([simulated(Single(1))], unpaced=True)]) as sim, Bus(sim.wires[0].path) as bus:
        pump = bus.attach(Single, 1)
        peer = bus.peer(pump)
        when_asked(bus, lambda: bus.detach(pump))
        with pytest.raises(NotAttached):
            pump.read(Single.output_frequency, Single.output_current, Single.fault)
        assert peer.exchanges == 1  # no second request: another drive may have the address now


def test_a_new_drive_at_a_used_address_expects_late_replies_of_the_old_drive() -> None:
    """Otherwise the late reply to the old drive's request could be taken for the new drive's reply."""
    sim = simulated(Single(1))
    with Simulator([Wire([sim], unpaced=True)]) as simulator, Bus(simulator.wires[0].path) as bus:
        pump = bus.attach(Single, 1)
        pump.read(Single.output_current)
        sim.deaf_until = float("inf")
        taken: list[Drive] = []
        taking = threading.Thread(target=lambda: taken.append(bus.attach(Successor, 1)))

        def exchange_it() -> None:
            bus.detach(pump)
            taking.start()
            taking.join(0.1)  # `attach` must wait for the pending exchange
            assert not taken

        when_asked(bus, exchange_it)
        with pytest.raises((NoReply, NotAttached)):
            pump.read(Single.mystery)
        taking.join(PATIENCE)
        assert bus.peer(taken[0]).late_until_ns


@pytest.mark.parametrize("wrong", ["audit", "ledger"])
def test_the_port_is_closed_if_the_bus_arguments_are_invalid(wrong: str) -> None:
    with Simulator([Wire([simulated(Toy(1))])]) as simulator:
        port = simulator.wires[0].path
        with pytest.raises(TypeError) as kept:
            Bus(port, **cast("dict[str, Any]", {wrong: 5.5}))
        assert kept.tb
        Bus(port).close()
