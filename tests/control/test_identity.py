"""Identity checks before starts and stops, and their repetition after silences."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from typing import Any
from unittest.mock import patch

import pytest
from lines import line, plant, polled, until
from motors import MAKE, ReceivedRequests, at_highest_rate
from simulated_bus import STOPS, SimulatedBus, first, is_write, one, writes
from tables import table

from multidrop import Bus, Drive, InnovertIBD, InvtCHE, NoReply, Poller, Unconfirmed, WriteForbidden
from multidrop.control import records
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.outcome import Seen
from multidrop.core import PAUSE_NS, Completion, Exchange, Failure, Framing, Message, Status, build_reply
from multidrop.drive import Script, write
from multidrop.drive.register import Kept, reading, setting
from multidrop.drive.verbs import verb
from multidrop.errors import BusError, CheckAgain, PortLost
from multidrop.families import YD1000, DelixiModbus
from multidrop.families.invt_che import CHEControl
from multidrop.sim import MotorDrive, Simulator, Wire, simulated
from multidrop.transport import clock, drive_records

GOODRIVE = 0x010A  # device code of another INVT series; an INVT CHE has 0101H
GOODRIVE_DEVICE = 0x2103  # register of the device code in a Goodrive (Goodrive200A manual p. 140)


@contextmanager
def known(model: str) -> Iterator[tuple[Bus, Any, ReceivedRequests]]:
    """Yield a bus with one drive whose identity is confirmed, the drive, and the requests it receives."""
    with at_highest_rate(model):
        sim, drive = simulated(MAKE[model](1)), MAKE[model](1)
    assert isinstance(sim, MotorDrive)
    sim.motor.acceleration_time = sim.motor.deceleration_time = 0.1
    received = ReceivedRequests(sim)
    with (
        patch.object(drive_records, "LEAST_TIMEOUT", 1.0),  # s, long enough for a busy computer
        Simulator([Wire([sim], unpaced=True)]) as simulator,
        Bus(simulator.wires[0].path) as bus,
    ):
        bus.attach(drive)
        bus.check_identity(drive)
        yield bus, drive, received


def be_silent(bus: Bus, drive: Any, received: ReceivedRequests) -> None:
    """Lose the replies to one read, with a short timeout; then allow long timeouts for a busy computer."""
    timeouts = bus.peer(drive).c
    timeouts.least_timeout_ns = timeouts.most_timeout_ns = 50_000_000
    received.loses = lambda request: True
    # number of requests that the test has removed from `received.requests`
    earlier = bus.statistics().counters.sent - len(received.requests)
    with pytest.raises(NoReply):
        drive.read(next(register for register in drive.registers.values() if register.readable))
    # wait until the simulator has received the last request
    until(lambda: earlier + len(received.requests) == bus.statistics().counters.sent)
    received.loses = lambda request: False
    received.requests.clear()
    timeouts.least_timeout_ns = timeouts.most_timeout_ns = 1_000_000_000


@pytest.mark.slow
def test_a_replaced_drive_is_not_started() -> None:
    with known("invt-che") as (bus, drive, received):
        drive.set_frequency(10)
        be_silent(bus, drive, received)
        received.sim["device"] = GOODRIVE
        for move in (drive.start, drive.jog, lambda: drive.set_frequency(20)):
            with pytest.raises(WriteForbidden, match="010AH"):
                move()
        assert received.requests
        assert received.writes == []


def test_no_write_is_sent_after_the_drive_was_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    """A locked ledger delays the write. During the delay, another line is plugged in."""
    line, drive, _ = one(YD1000(1))

    def replace(*given: object) -> str:
        line.sims, line.queue = (simulated(DelixiModbus(1)),), object()
        return ""

    monkeypatch.setattr(Ledger, "enter", replace)
    with pytest.raises(NoReply):  # a Delixi does not answer the reads of a YD1000's identity
        drive.write("acceleration_time", 20.0)
    assert line.written == []


@pytest.mark.slow
@pytest.mark.parametrize("model", MAKE)
def test_a_drive_is_identified_before_a_write_if_replies_were_missing(
    model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(records, "LEAST_INTERVAL", 0.0)  # seconds between EEPROM writes of one register
    with known(model) as (bus, drive, received):
        looks: list[str] = []
        monkeypatch.setattr(type(drive).identify, "_script", lambda drive: iter(looks.append("look") or ()))
        before = bus.peers[drive].silences
        drive.set_frequency(10)
        assert looks == [] or bus.peers[drive].silences > before  # no check, unless a reply was late
        looks.clear()
        be_silent(bus, drive, received)
        drive.set_frequency(20)
        assert looks == ["look"]


@pytest.mark.long
@pytest.mark.parametrize("model", MAKE)
@pytest.mark.usefixtures("_patient")
@pytest.mark.parametrize("pause", ["idle", "asleep", "read since"])
def test_a_drive_is_identified_again_after_10_s_of_silence(
    model: str, pause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(records, "LEAST_INTERVAL", 0.0)
    with known(model) as (bus, drive, _received):
        drive.set_frequency(10)
        looks: list[str] = []
        look = type(drive).identify._script
        monkeypatch.setattr(
            type(drive).identify, "_script", lambda drive: looks.append("look") or look(drive)
        )
        if pause == "read since":  # the drive answers a read after the pause, but a read proves no identity
            bus.peer(drive).c.answered_ns -= 2 * PAUSE_NS
            drive.read(next(register for register in drive.registers.values() if register.readable))
        else:
            for name in ("boottime_ns", "now_ns")[: 1 + (pause == "idle")]:
                at_ns = getattr(clock, name)
                monkeypatch.setattr(clock, name, lambda at_ns=at_ns: at_ns() + 2 * PAUSE_NS)
        drive.set_frequency(20)
        assert looks == ["look"]


@pytest.mark.long
@pytest.mark.usefixtures("_turns_awaited")
@pytest.mark.parametrize("model", MAKE)
@pytest.mark.parametrize("is_silent", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_stop_is_sent_before_any_read_after_a_long_pause(model: str, is_silent: bool) -> None:
    with known(model) as (bus, drive, received):
        drive.set_frequency(10)
        drive.start()
        if is_silent:
            be_silent(bus, drive, received)
        else:
            bus.peer(drive).c.answered_ns -= 2 * PAUSE_NS
        received.requests.clear()
        drive.stop()
        assert received.requests[0] == received.writes[0]


def _asleep(bus: Bus, drive: Any, received: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    at_ns = clock.boottime_ns
    monkeypatch.setattr(clock, "boottime_ns", lambda: at_ns() + 2 * PAUSE_NS)


def _idle_and_asleep(bus: Bus, drive: Any, received: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let 0.6 PAUSE_NS pass awake and 0.6 PAUSE_NS asleep: together more than PAUSE_NS."""
    now_ns, boottime_ns = clock.now_ns, clock.boottime_ns
    monkeypatch.setattr(clock, "now_ns", lambda: now_ns() + 6 * PAUSE_NS // 10)
    monkeypatch.setattr(clock, "boottime_ns", lambda: boottime_ns() + 12 * PAUSE_NS // 10)


def _idle(bus: Bus, drive: Any, received: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bus.peer(drive).c.answered_ns -= 2 * PAUSE_NS
    at_ns = clock.now_ns
    monkeypatch.setattr(clock, "now_ns", lambda: at_ns() + 2 * PAUSE_NS)
    _asleep(bus, drive, received, monkeypatch)  # advances the boot-time clock by the same time


def _read_since(bus: Bus, drive: Any, received: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bus.peer(drive).c.answered_ns -= 2 * PAUSE_NS
    drive.read(next(register for register in drive.registers.values() if register.readable))


def _on_another_port(bus: Bus, drive: Any, received: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bus.line.reopen()


def _on_another_bus(bus: Bus, drive: Any, received: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bus.detach(drive)
    bus.attach(drive)


def _silent_then_idle(bus: Bus, drive: Any, received: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    be_silent(bus, drive, received)  # the start now needs an identity check
    bus.peer(drive).c.answered_ns -= 2 * PAUSE_NS


LOSSES = [_asleep, _idle, _idle_and_asleep, _read_since, _on_another_port, _on_another_bus]


@pytest.mark.usefixtures("_turns_awaited")
@pytest.mark.parametrize("model", ["innovert-ibd", "delixi-native"])
@pytest.mark.parametrize("lose", [*LOSSES, pytest.param(_silent_then_idle, marks=pytest.mark.slow)])
def test_a_start_after_a_possible_power_loss_needs_a_new_setpoint(
    model: str, lose: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    with known(model) as (bus, drive, received):
        drive.set_frequency(10)
        lose(bus, drive, received, monkeypatch)
        received.requests.clear()
        with pytest.raises(
            WriteForbidden, match="cannot report its setpoint: call set_frequency before start"
        ):
            drive.start()
        assert received.writes == []
        drive.set_frequency(10)
        drive.start()


@pytest.mark.slow
@pytest.mark.usefixtures("_turns_awaited")
@pytest.mark.parametrize("model", ["innovert-ibd", "delixi-native"])
def test_a_setpoint_is_kept_if_one_reply_was_lost(model: str) -> None:
    with known(model) as (bus, drive, received):
        drive.set_frequency(10)
        be_silent(bus, drive, received)
        drive.start()


@pytest.mark.slow
def test_a_poll_without_a_reply_counts_as_silence() -> None:
    """Missed polls alone, without calls, make the drive's identity uncertain."""
    sim = simulated(MAKE["invt-che"](1))
    assert isinstance(sim, MotorDrive)
    received = ReceivedRequests(sim)
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        drive = InvtCHE(1, maximum_frequency=50)
        hall = line(simulator.wires[0].path, polled(drive, [drive.registers["status"]], 0.02))
        with Poller(plant(hall)) as poller:
            bus = poller.bus(hall.name)
            bus.check_identity(drive)
            received.loses = lambda request: True
            until(lambda: bus.peers[drive].silences > 0)
            received.loses = lambda request: False
            sim["device"] = GOODRIVE
            with pytest.raises(WriteForbidden, match="010AH"):
                drive.start()
    assert received.writes == []


def test_a_reattached_drive_is_identified_again_before_a_start() -> None:
    bus, drive, sim = one(InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(10)
    bus.bus.detach(drive)
    bus.attach(drive)
    sim["device"] = GOODRIVE
    with pytest.raises(WriteForbidden, match="010AH"):
        drive.start()
    assert len(bus.written) == 1


def test_a_reattached_drive_is_identified_again_before_a_stop() -> None:
    """Sending a stop does not confirm the drive's identity for a start."""
    bus, drive, sim = one(InvtCHE(1, maximum_frequency=50))
    odd = [build_reply(Framing.RTU, Message(1, 3, data=bytes([0, device]))) for device in (3, 4)]
    bus.answers = lambda request: odd.pop(0) if odd else None
    drive.stop()  # sent: two different wrong identities prove nothing
    begun = len(bus.written)
    bus.bus.detach(drive)
    bus.attach(drive)
    sim["device"] = GOODRIVE
    with pytest.raises(WriteForbidden, match="no stop was sent"):
        drive.stop()
    assert len(bus.written) == begun


def test_detaching_a_drive_clears_failed_identity_checks() -> None:
    bus, drive, sim = one(InvtCHE(1, maximum_frequency=50))
    sim["device"] = GOODRIVE
    check = bus.bus._writer.identity_check
    for _ in range(2):  # without the detach, the second wrong identity would prevent the stop
        with pytest.raises(CheckAgain):
            check.check_before_stop(drive, drive.control, 5)
        bus.bus.detach(drive)
        bus.attach(drive)


class Mute(Drive):
    """A user's drive class without `identify`."""

    model = "mute"
    title = "OWN 5"
    speed = reading(0x10, "rpm")
    run = setting(0x20, kept=Kept.RAM)

    @verb
    def stop(self) -> Script[None]:
        yield from write(self.run, 0)


@pytest.mark.parametrize("is_lost", [False, True])
def test_a_read_is_sent_immediately_before_the_first_stop(
    monkeypatch: pytest.MonkeyPatch, is_lost: bool
) -> None:
    """The read shows whether the adapter echoes: an echo could be mistaken for the drive's confirmation."""
    bus = SimulatedBus(simulated(Mute(1)))
    drive, carry_out = bus.attach(Mute(1)), bus.carry_out
    asked: list[tuple[bool, bool]] = []

    def note(exchange: Exchange, **times: Any) -> Completion:
        asked.append((is_write(exchange.request), bool(exchange.c.insists)))
        return carry_out(exchange, **times)

    monkeypatch.setattr(bus, "carry_out", note)
    bus.loses = lambda request: is_lost and len(asked) == 1
    drive.stop()
    assert asked[:2] == [(False, True), (True, True)]
    asked.clear()
    if not is_lost:
        drive.stop()
        assert asked[0] == (True, True)
    bus.queue = object()  # a new queue, as after the port was reopened
    drive.read(drive.speed)
    asked.clear()
    drive.stop()
    assert asked[0] == (True, True)  # no read first: the drive has answered since the port was reopened


@pytest.mark.parametrize("is_in_step", [True, False])
def test_identity_is_not_confirmed_while_replies_may_be_late(is_in_step: bool) -> None:
    bus, drive, _ = one(InvtCHE(1, maximum_frequency=50))

    def fall_out_of_step(request: Message) -> bytes | None:
        if not is_in_step:
            bus.bus.peer(drive).c.history.ended[10] = 1
        return None

    bus.answers = fall_out_of_step
    drive.stop()
    assert [is_write(request) for request, _ in bus.frames[:2]] == [False, True]
    assert bus.bus.knows_identity(drive) is is_in_step


def test_a_stop_is_sent_although_the_drive_answers_like_an_innovert_ibd() -> None:
    """The `identify` of InnovertIBD reads registers that its manual does not document."""
    bus = SimulatedBus(simulated(InnovertIBD(1)))
    bus.attach(InvtCHE(1))

    bus.refuses = lambda request: 2 if request.start == InvtCHE.device.address else 0
    (stopped,) = bus.bus.stop_all(seconds=1).values()
    assert stopped.seen is not Seen.FAILED
    assert bus.written[0].startswith("01 06 10 00 00 05")


@pytest.mark.parametrize(("share", "looks"), [(0.6, 0), (1.1, 1)])
def test_identity_is_not_checked_again_if_the_drive_answered_recently(share: float, looks: int) -> None:
    bus, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(10)
    bus.sleep(share * PAUSE_NS / 1e9)
    begun = len(bus.frames)
    drive.set_frequency(20)
    asked = [is_write(request) for request, _ in bus.frames[begun:]]
    assert asked[: looks + 1] == [False] * looks + [True]


REFUSALS = [
    ("invt-che", 0x11),
    ("invt-che", 0x06),
    ("delixi-native", 0xFF),
    ("yd1000", 0x04),
    ("innovert-ibd", 0x06),
    ("erman-er-g-220", 0x02),
]


@table(("model", "code"), REFUSALS)
def test_a_stop_is_sent_if_the_identity_check_gets_an_exception_reply(model: str, code: int) -> None:
    line, drive, sim = one(MAKE[model](1))
    sim.motor.energised = True

    line.refuses = lambda request: 0 if is_write(request) or writes(line) else code
    begun = line.seconds
    drive.stop()
    stop = first(line, 0, STOPS[model])
    assert stop is not None
    assert line.seconds - begun < 60
    assert STOPS[model](writes(line)[0])  # the stop is the first write


@table("model", MAKE)
def test_the_first_stop_does_not_wait_for_late_replies(monkeypatch: pytest.MonkeyPatch, model: str) -> None:
    line, drive, _ = one(MAKE[model](1))
    insisted: list[bool] = []
    carry_out = line.carry_out

    def watched(exchange: Any, **times: Any) -> Any:
        if not writes(line):
            insisted.append(bool(exchange.c.insists))
        return carry_out(exchange, **times)

    monkeypatch.setattr(line, "carry_out", watched)
    drive.stop()
    assert len(insisted) >= 2
    assert all(insisted)


@table("model", MAKE)
def test_a_stop_is_sent_after_one_unanswered_identity_check(model: str) -> None:
    line, drive, _ = one(MAKE[model](1))
    line.loses = lambda request: not writes(line)
    drive.stop()
    assert first(line, 0, STOPS[model]) == 1


@pytest.mark.parametrize("codes", [(3,), (3, 4)])
def test_a_stop_is_sent_unless_the_same_wrong_identity_is_read_twice(codes: tuple[int, ...]) -> None:
    line, drive, _ = one(InvtCHE(1))
    odd = [build_reply(Framing.RTU, Message(1, 3, data=bytes([0, code]))) for code in codes]
    line.answers = lambda request: odd.pop(0) if odd else None
    drive.stop()
    assert odd == []
    assert STOPS["invt-che"](writes(line)[0])


def test_a_stop_is_sent_after_a_missing_reply_despite_a_wrong_identity() -> None:
    """The drive's next reply may belong to an earlier request."""
    line, drive, sim = one(InvtCHE(1))
    sim["device"] = 0x010A
    line.bus.peer(drive).c.history.ended[10] = 1
    drive.stop()
    assert line.frames[0][1] == "01 06 10 00 00 05 4D 09"  # the stop is sent first, without an identity check


def test_the_error_of_a_withheld_stop_names_the_hard_wired_stop() -> None:
    line, drive, sim = one(InvtCHE(1))
    sim["device"] = 0x010A
    with pytest.raises(
        WriteForbidden,
        match=r"no stop was sent .* two checks found another drive .*010AH.* Use the hard-wired stop",
    ):
        drive.stop()
    assert line.written == []
    sim["device"] = 0x0101
    drive.stop()  # the identity is checked again
    assert line.written != []


# the declared drive, and the drive that answers at its address with the same framing and baud rate
OTHERS: Sequence[tuple[Drive, Drive]] = (
    (InvtCHE(1, maximum_frequency=50), YD1000(1)),
    (InnovertIBD(1, confirmed=0), InvtCHE(1)),
    (YD1000(1), InvtCHE(1)),
    (DelixiModbus(1, framing="rtu", format="8E1"), YD1000(1, format="8E1")),
)


@table("pair", OTHERS)
def test_the_error_of_an_unsent_stop_names_the_actual_family(pair: tuple[Drive, Drive]) -> None:
    declared, there = pair
    sim = simulated(there)
    line = SimulatedBus(sim)
    drive = line.attach(declared)
    with pytest.raises(WriteForbidden, match=f"multidrop stop PORT {there.model} 1"):
        drive.stop()
    assert line.written == []
    line.bus.detach(drive)
    line.attach(type(there)(1, format=there.settings.format)).stop()
    assert line.written != []


UNEXPECTED_COUNTS = [  # (family, register that `identify` reads, a raw count that the right drive may hold)
    ("delixi-modbus", "baudrate_setting", 4),
    ("delixi-modbus", "address_setting", 7),
    ("delixi-modbus", "fault", 99),
    ("delixi-native", "baudrate_setting", 4),
    ("delixi-native", "address_setting", 7),
    ("innovert-ibd", "baudrate_setting", 3),
    ("innovert-ibd", "address_setting", 7),
    ("invt-che", "device", 0x0103),
    ("invt-che", "device", 0x0001),
    ("yd1000", "address_setting", 7),
    ("yd1000", "maximum_frequency", 800),
]


def shows(line: SimulatedBus, drive: Drive, name: str, count: int) -> None:
    """Let each read of this register return `count`, whatever the simulated drive holds."""
    register = drive.register(name)
    data = count.to_bytes(4 if drive.framing is Framing.DELIXI else 2, "big")
    start = register.address if drive.framing is Framing.DELIXI else 0
    reply = build_reply(drive.framing, Message(1, register.table.read, start, data=data))
    line.answers = lambda request: reply if request.start == register.address else None


@table(("model", "name", "count"), UNEXPECTED_COUNTS)
@table("how", ["stop", "stop_all", "write"])
def test_an_unexpected_register_value_prevents_writes_but_not_stops(
    model: str, name: str, count: int, how: str
) -> None:
    line, drive, _ = one(MAKE[model](1))
    shows(line, drive, name, count)
    with pytest.raises(WriteForbidden):
        drive.set_frequency(20)
    assert line.written == []
    shows_only_zeros = model == "delixi-modbus"  # the only sign of standstill is an output frequency of 0
    if how == "stop":
        with pytest.raises(Unconfirmed, match="look at the motor") if shows_only_zeros else nullcontext():
            drive.stop()
    elif how == "stop_all":
        line.bus.detach(drive)
        line.bus.attach(drive)
        (stopped,) = line.bus.stop_all().values()
        assert stopped.seen is (Seen.SENT if shows_only_zeros else Seen.STOPPED)
    else:
        drive.write(drive.control, drive.control.decode(drive.control.broadcast[0]))
    assert STOPS[model](writes(line)[0])


@table("model", MAKE)
def test_a_stop_is_sent_to_a_drive_that_refuses_identity_reads(model: str) -> None:
    """Reads with function 04 are answered: only the ERMAN's identity check uses them."""
    line, drive, _ = one(MAKE[model](1))

    if drive.framing is Framing.RTU:
        line.refuses = lambda request: 0 if is_write(request) or request.function == 4 else 2
    with suppress(BusError):
        drive.stop(seconds=1)
    assert STOPS[model](writes(line)[0])


def test_a_stop_does_not_wait_for_repeated_identity_checks_of_another_drive() -> None:
    """The stop of an identified drive does not wait for the first check of another drive either."""
    others = [YD1000(1), InvtCHE(2, maximum_frequency=50), InvtCHE(3, maximum_frequency=50)]
    line = SimulatedBus(*(simulated(drive) for drive in others))
    line.attach(InvtCHE(1, maximum_frequency=50))
    for drive in others[1:]:
        line.attach(drive)
    line.bus.check_identity(others[2])
    begun = len(line.frames)
    found = line.bus.stop_all()
    addresses = [request.address for request, _ in line.frames[begun:]]
    assert [request.address for request in writes(line, begun)][:2] == [3, 2]
    assert addresses[0] == 3
    before = first(line, begun, lambda each: each.address == 2)
    assert before is not None
    assert addresses[:before].count(1) == 1
    assert found["invt-che@1"].seen is Seen.FAILED
    assert all(write.address != 1 for write in writes(line, begun))


@pytest.mark.parametrize("suspicions", [1, 2])
def test_a_stop_by_register_write_is_refused_after_two_wrong_identities(suspicions: int) -> None:
    line, drive, _ = one(InvtCHE(1))
    odd = build_reply(Framing.RTU, Message(1, 3, data=b"\x01\x0a"))  # a Goodrive300L
    line.answers = lambda request: odd if len(line.frames) <= suspicions else None
    if suspicions == 1:
        drive.write(drive.control, CHEControl.STOP)
    else:
        with pytest.raises(WriteForbidden, match="no stop was sent"):
            drive.write(drive.control, CHEControl.STOP)
    assert len(line.written) == 2 - suspicions


def count_silences(line: SimulatedBus) -> None:
    """Count missing replies, as the core does."""
    carry_out = line.carry_out

    def counted(exchange: Exchange, **times: Any) -> Completion:
        completion = carry_out(exchange, **times)
        if completion.result == Failure.NO_REPLY:
            exchange.c.drive.history.ended[Status.NO_REPLY] += 1
        return completion

    line.carry_out = counted  # type: ignore[method-assign]


def answers_as(line: SimulatedBus, counts: dict[int, int]) -> None:
    """Answer reads with these raw counts by address, and refuse all other reads."""

    def answer(request: Message) -> bytes | None:
        if is_write(request):
            return None
        if request.start not in counts:
            return build_reply(Framing.RTU, Message(1, request.function, exception=2))
        return build_reply(
            Framing.RTU, Message(1, request.function, data=counts[request.start].to_bytes(2, "big"))
        )

    line.answers = answer


def test_registers_of_other_families_are_read_only_before_the_first_write() -> None:
    """An INNOVERT IBD does not answer reads of registers that it lacks. Each such read delays polling."""
    line, drive, _ = one(InnovertIBD(1, confirmed=1))
    count_silences(line)
    drive.set_frequency(20)
    foreign = [request for request, _ in line.frames if request.start == GOODRIVE_DEVICE]
    assert len(foreign) == 2  # the second read allows for a reply lost by chance
    line.frames.clear()
    drive.start()
    drive.set_frequency(30)
    assert GOODRIVE_DEVICE not in {request.start for request, _ in line.frames}


def test_a_wrong_family_is_recognised_although_the_first_reply_is_lost() -> None:
    line, drive, _ = one(InnovertIBD(1, confirmed=1))
    count_silences(line)
    answers_as(line, {GOODRIVE_DEVICE: GOODRIVE, 0x2100: 3, 0x0000: 0})
    line.loses = lambda request: len(line.frames) == 1
    with pytest.raises(WriteForbidden, match="the drive answers as an INVT Goodrive does"):
        drive.set_frequency(20)
    assert line.written == []


def test_a_wrong_family_is_recognised_after_an_unanswered_read() -> None:
    line, drive, _ = one(InnovertIBD(1, confirmed=1))
    count_silences(line)
    line.loses = lambda request: True
    with pytest.raises(NoReply):
        drive.read("terminals")
    line.loses = lambda request: False
    answers_as(line, {0x3000: 3, 0x8000: 0, 0x1000: 0})
    with pytest.raises(WriteForbidden, match="the drive answers as a Powtran PI130"):
        drive.set_frequency(20)
    assert line.written == []


def test_a_waiting_write_is_not_sent_after_the_port_is_reopened(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The drive may have been replaced, so its family must be checked again first."""
    line, drive, sim = one(InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)
    carry_out = line.carry_out

    def late(exchange: Exchange, **times: Any) -> Completion:
        is_start = exchange.request.start == 0x1000
        return line._completion(int(Failure.LATE_ANSWER_DUE)) if is_start else carry_out(exchange, **times)

    def sleep(seconds: float) -> None:
        line.queue = object()
        monkeypatch.setattr(line, "carry_out", carry_out)

    monkeypatch.setattr(line, "carry_out", late)
    monkeypatch.setattr(clock, "sleep", sleep)
    with pytest.raises(PortLost, match="reopened while the write waited"):
        drive.start()
    assert not sim.motor.energised
