"""Scan a simulated line on simulated time: drives found, drives missed, duration."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import checksums
import pytest
from line_driver import LineDriver
from tables import table
from toy import Toy, Unsure

from multidrop.core import Completion, Exchange, Framing, build_reply, build_request, parse_request
from multidrop.drive import Drive, Script, write
from multidrop.drive.line_settings import Settings
from multidrop.drive.register import Kept, command, setting
from multidrop.drive.verbs import verb
from multidrop.errors import LineError
from multidrop.families import MODELS
from multidrop.families.delixi import DelixiModbus, DelixiNative
from multidrop.families.erman_er_g_220 import ErmanERG220
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.families.yd1000 import YD1000
from multidrop.scan import Crowd, Found, Noise, Progress, Sweep, Untried, plant_text, scan, sweeps
from multidrop.sim import SimulatedDrive, Wire, simulated
from multidrop.sim.drive import Reason, Refusal
from multidrop.sim.families import SimulatedCHE, SimulatedIBD

FAMILIES = list(MODELS.values())
READS = {Framing.RTU: {1, 2, 3, 4}, Framing.ASCII: {1, 2, 3, 4}, Framing.DELIXI: {3, 7}}
ALL_EIGHT = (
    ErmanERG220(1),
    InvtCHE(2, baudrate=19200, format="8E1"),
    InnovertIBD(3),
    InnovertIBD(4, framing="ascii", format="8O1"),
    DelixiModbus(5, baudrate=4800),
    DelixiModbus(6, framing="ascii"),
    DelixiNative(7, baudrate=19200),
    YD1000(8),
)


class Pair(Wire):
    """A line on which a drive receives only bytes in its own character format, as on a real line.

    The number of stop bits does not matter, because a second stop bit looks like silence to the receiver.
    """

    def __init__(self, drives: Sequence[SimulatedDrive]) -> None:
        super().__init__(drives)
        self._all_groups = self._groups
        self.request = b""

    def send(self, frame: bytes, now: float, settings: Settings) -> None:
        self.request = frame
        self._groups = [group for group in self._all_groups if _alike(group.settings, settings)]
        self.receive(frame, now, settings.baudrate)
        self._groups = self._all_groups


def _alike(one: Settings, other: Settings) -> bool:
    return one.baudrate == other.baudrate and one.format[:2] == other.format[:2]


class Line:
    """Carries out exchanges on a wire; simulated time passes only as far as the line's waits require."""

    def __init__(self, wire: Pair) -> None:
        self.wire = wire
        self.driver = LineDriver()
        self.begun = self.driver.now
        self.sent: list[tuple[Framing, bytes]] = []
        self.seen = bytearray()  # received bytes that were not read yet

    @property
    def seconds(self) -> float:
        return (self.driver.now - self.begun) / 1e9

    def carry_out(self, exchange: Exchange, /, *, not_before_ns: int = 0) -> Completion:
        self.pass_until(max(self.driver.now, not_before_ns))
        self.driver.begin(exchange)
        while (want := self.driver.want) != "done":
            if want == "write":
                self.send(self.driver.take(), exchange)
            elif want == "wait":
                self.pass_until(self.driver.wake)
            elif self.seen:
                self.driver.receive(bytes(self.seen))
                self.seen.clear()
            elif self.driver.wake > self.driver.now:
                self.pass_until(min(self.driver.wake, self.next_byte()))
        return self.driver.completion

    def send(self, frame: bytes, exchange: Exchange) -> None:
        self.sent.append((exchange.framing, frame))
        self.wire.send(frame, self.driver.now / 1e9, Settings(*exchange.settings))

    def next_byte(self) -> int:
        wake = self.wire.wake
        return 1 << 62 if wake is None else max(self.driver.now, int(wake * 1e9) + 1)

    def pass_until(self, end: int) -> None:
        while (at := self.next_byte()) <= end:
            self.seen += self.wire.advance(at / 1e9)
        self.driver.now = max(self.driver.now, end)


def found(line: Line, plan: Sequence[Sweep], families: Sequence[type] = FAMILIES) -> list[object]:
    """Return all findings of a scan except progress reports."""
    return [each for each in scan(line.carry_out, plan, families) if not isinstance(each, Progress)]


def drives(findings: Sequence[object]) -> set[tuple[int, str, str, str]]:
    return {
        (finding.address, " or ".join(finding.models), f"{finding.settings}", f"{finding.framing}")
        for finding in findings
        if isinstance(finding, Found)
    }


def declared(*drives: object) -> set[tuple[int, str, str, str]]:
    return {(drive.address, drive.model, f"{drive.settings}", f"{drive.framing}") for drive in drives}


@pytest.fixture(scope="module")
def whole_scan() -> tuple[Line, list[object]]:
    """Scan a line with all eight drives completely; return the line and the findings."""
    line = Line(Pair([simulated(each) for each in ALL_EIGHT]))
    return line, found(line, sweeps(FAMILIES))


@pytest.mark.long
@pytest.mark.story
def test_all_eight_drives_are_found_at_their_settings(whole_scan: tuple[Line, list[object]]) -> None:
    _, findings = whole_scan
    assert drives(findings) == declared(*ALL_EIGHT)
    assert len(findings) == len(ALL_EIGHT)
    assert not any(finding.doubt for finding in findings)


@pytest.mark.slow
@pytest.mark.story
def test_scan_sends_only_reads(whole_scan: tuple[Line, list[object]]) -> None:
    line, _ = whole_scan
    functions = {(framing, parse_request(framing, frame)[1].function) for framing, frame in line.sent}
    assert all(function in READS[framing] for framing, function in functions)
    assert not any(drive.counters.writes for drive in line.wire.drives)


@pytest.mark.slow
def test_drives_at_default_settings_are_found_within_15_s() -> None:
    line = Line(Pair([simulated(each) for each in ALL_EIGHT]))
    soon = [each for each in ALL_EIGHT if each.settings == type(each)(1, framing=each.framing).settings]
    assert len(soon) == 4
    left = declared(*soon)
    for each in scan(line.carry_out, sweeps(FAMILIES), FAMILIES):
        if isinstance(each, Found):
            left -= drives([each])
        if not left:
            break
    assert line.seconds < 15


@pytest.mark.slow
@pytest.mark.parametrize("format", ["8N1", "8E1"])
def test_sweep_of_a_line_without_drives_takes_the_predicted_time(format: str) -> None:
    nobody = Pair([simulated(YD1000(9))])
    line = Line(nobody)
    plan = sweeps(FAMILIES, addresses=range(10, 248), baudrates=[9600], formats=[format])
    assert found(line, plan) == []
    assert line.seconds <= 1.02 * sum(sweep.needed for sweep in plan)


def test_the_duration_of_a_sweep_includes_silences_requests_and_timeouts() -> None:
    (sweep, patient) = sweeps([InvtCHE], addresses=[1, 2], baudrates=[9600], formats=["8N1"])
    character = 10 / 9600
    each = 3.5 * character + 1 / 9600 + 8 * character
    assert sweep.needed == pytest.approx(2 * (each + 0.020 + 2 * InvtCHE.response_delay))
    assert patient.needed == pytest.approx(2 * (each + InvtCHE.response_timeout))


def test_remaining_time_in_progress_reports_falls_to_zero() -> None:
    line = Line(Pair([simulated(InvtCHE(3))]))
    plan = sweeps([InvtCHE], addresses=range(1, 5), baudrates=[9600], formats=["8N1"])
    left = [each.left for each in scan(line.carry_out, plan, [InvtCHE]) if isinstance(each, Progress)]
    assert left == sorted(left, reverse=True)
    assert left[-1] == 0


class Echo(Line):
    """An adapter that echoes each request."""

    def send(self, frame: bytes, exchange: Exchange) -> None:
        super().send(frame, exchange)
        self.seen += frame


@pytest.mark.long
@pytest.mark.parametrize("families", [FAMILIES, [DelixiNative]], ids=["all", "own protocol"])
def test_scan_through_an_echoing_adapter_finds_exactly_the_drives(families: list[type]) -> None:
    there = [each for each in ALL_EIGHT if type(each) in families and each.settings.baudrate in (9600, 19200)]
    line = Echo(Pair([simulated(each) for each in ALL_EIGHT]))
    plan = sweeps(families, addresses=range(1, 12), baudrates=[9600, 19200])
    assert drives(found(line, plan, families)) == declared(*there)


@pytest.mark.long
def test_scan_of_a_line_without_drives_finds_none() -> None:
    quiet = Pair([simulated(InvtCHE(31))])
    for line in (Line(quiet), Echo(quiet)):
        assert found(line, sweeps(FAMILIES, addresses=range(1, 31), baudrates=[9600])) == []


class Junk(Line):
    """A line with stray bytes after every few requests."""

    every = 4

    def send(self, frame: bytes, exchange: Exchange) -> None:
        super().send(frame, exchange)
        if len(self.sent) % self.every == 0:
            self.seen += b"\xf7\x00\x9c"[: 1 + len(self.sent) % 3]


@pytest.mark.long
def test_occasional_noise_is_not_reported_as_a_drive() -> None:
    line = Junk(Pair([simulated(each) for each in ALL_EIGHT]))
    findings = found(line, sweeps(FAMILIES, addresses=range(1, 12), baudrates=[9600, 38400]))
    assert drives(findings) == declared(
        *(each for each in ALL_EIGHT if each.settings.baudrate in (9600, 38400))
    )
    assert not any(isinstance(finding, Crowd) for finding in findings)


def test_constant_noise_is_reported_and_does_not_hide_a_drive() -> None:
    class Always(Junk):
        every = 1

    line = Always(Pair([simulated(InvtCHE(3))]))
    findings = found(line, sweeps([InvtCHE], baudrates=[9600], formats=["8N1"]), [InvtCHE])
    assert drives(findings) == declared(InvtCHE(3))
    noise = [finding for finding in findings if isinstance(finding, Noise)]
    assert noise
    assert noise[0].garbled == 30
    assert not any(isinstance(finding, Crowd) for finding in findings)


class Shared(Pair):
    """A line on which two drives with the same address reply together: a bit is 0 if either drive sends 0."""

    def __init__(self, drives: Sequence[SimulatedDrive], twin: SimulatedDrive) -> None:
        super().__init__(drives)
        self.twin = twin

    def distort(self, reply: bytes) -> bytes:
        framing = self.twin.drive.framing
        _, request = parse_request(framing, self.request)
        answer = self.twin.answer(request, 0.0) if request else None
        if answer is None:
            return reply
        other = build_reply(framing, answer)
        return bytes(one & two for one, two in itertools.zip_longest(reply, other, fillvalue=0xFF))


def test_two_drives_at_one_address_are_reported() -> None:
    one, twin = simulated(InnovertIBD(3)), simulated(InnovertIBD(3))
    one["output_current"], twin["output_current"] = 41.1, 77.7
    line = Line(Shared([simulated(InvtCHE(1)), one, simulated(InnovertIBD(4))], twin))
    findings = found(line, sweeps(FAMILIES, baudrates=[9600], formats=["8N1"]))
    assert drives(findings) == declared(InvtCHE(1), InnovertIBD(4))
    assert [finding for finding in findings if not isinstance(finding, Found)] == [
        Crowd(3, Settings(9600, "8N1"), Framing.RTU)
    ]


class Misaddressed(Pair):
    """A line on which every reply is a valid frame from another address."""

    def distort(self, reply: bytes) -> bytes:
        return checksums.rtu(b"\x63" + reply[1:-2])


def test_valid_frames_from_another_address_are_reported_with_their_bytes() -> None:
    findings = found(Line(Misaddressed([simulated(InvtCHE(1))])), sweeps([InvtCHE], baudrates=[9600]))
    (crowd, *_) = [finding for finding in findings if isinstance(finding, Crowd)]
    assert crowd.reply.startswith("reply from another address (received 63 ")


class Everything(Echo, Junk):
    """A line with echo and stray bytes."""


@pytest.mark.story
@pytest.mark.long
def test_all_eight_drives_are_found_despite_echo_noise_and_a_shared_address() -> None:
    one, twin = simulated(InnovertIBD(9)), simulated(InnovertIBD(9))
    one["output_current"], twin["output_current"] = 41.1, 77.7
    line = Everything(Shared([*map(simulated, ALL_EIGHT), one], twin))
    findings = found(line, sweeps(FAMILIES, addresses=range(1, 13)))
    assert drives(findings) == declared(*ALL_EIGHT)
    assert {finding.address for finding in findings if not isinstance(finding, Found)} == {9}
    assert {type(finding) for finding in findings} == {Found, Crowd}


class OneAfterTheOther(Shared):
    """A line on which the second drive with the same address replies right after the first."""

    def distort(self, reply: bytes) -> bytes:
        _, request = parse_request(self.twin.drive.framing, self.request)
        answer = self.twin.answer(request, 0.0) if request else None
        return reply if answer is None else reply + build_reply(self.twin.drive.framing, answer)


def test_scan_suspects_a_second_drive_after_two_replies_to_one_request() -> None:
    one, twin = simulated(InnovertIBD(3)), simulated(InnovertIBD(3))
    line = Line(OneAfterTheOther([one, simulated(InnovertIBD(4))], twin))
    findings = found(line, sweeps([InnovertIBD], baudrates=[9600], formats=["8N1"]), [InnovertIBD])
    doubts = {finding.address: finding.doubt for finding in findings if isinstance(finding, Found)}
    assert "second drive" in doubts[3]
    assert doubts[4] == ""


@pytest.mark.parametrize("delay", [0.05, 0.15, 0.3])
def test_drive_with_a_long_response_delay_is_found(delay: float) -> None:
    slow = simulated(InvtCHE(3), response_delay=delay)
    line = Line(Pair([slow, simulated(InvtCHE(5))]))
    plan = sweeps([InvtCHE], baudrates=[9600], formats=["8N1"])
    findings = found(line, plan, [InvtCHE])
    assert drives(findings) == declared(InvtCHE(3), InvtCHE(5))
    delays = {finding.address: finding.response_delay for finding in findings if isinstance(finding, Found)}
    assert delays[3] == pytest.approx(delay, abs=5e-3)


class Hesitant(SimulatedCHE):
    """An INVT CHE that replies fast to its first four requests, then slowly, like a busy converter."""

    @property
    def delay(self) -> float:
        return super().delay if self.counters.requests <= 4 else 0.4


def test_drive_is_identified_even_if_it_becomes_slow_during_a_scan() -> None:
    line = Line(Pair([Hesitant(InvtCHE(3))]))
    plan = sweeps([InvtCHE], baudrates=[9600], formats=["8N1"])
    assert drives(found(line, plan, FAMILIES)) == declared(InvtCHE(3))


def test_slow_replies_lengthen_the_timeouts_of_later_sweeps() -> None:
    line = Line(Pair([simulated(InvtCHE(at), response_delay=0.04) for at in (1, 9)]))
    brisk = sweeps([InvtCHE], baudrates=[9600])
    brisk = brisk[: len(brisk) // 2]
    left = [each.left for each in scan(line.carry_out, brisk, [InvtCHE]) if isinstance(each, Progress)]
    quiet = Line(Pair([simulated(InvtCHE(40))]))
    usual = [each.left for each in scan(quiet.carry_out, brisk, [InvtCHE]) if isinstance(each, Progress)]
    assert left[31] > usual[31]


def test_unknown_drive_is_found_without_a_model() -> None:
    line = Line(Pair([SimulatedDrive(Toy(7))]))
    (answering,) = found(line, sweeps(FAMILIES, baudrates=[9600], formats=["8N1"]))
    assert isinstance(answering, Found)
    assert (answering.address, answering.models) == (7, ())


@pytest.mark.slow
def test_scan_finds_a_drive_of_a_user_defined_family() -> None:
    line = Line(Pair([SimulatedDrive(Toy(7, baudrate=19200)), simulated(InvtCHE(2))]))
    families = [*FAMILIES, Unsure]
    findings = found(line, sweeps(families, baudrates=[9600, 19200], formats=["8N1"]), families)
    assert drives(findings) == {(7, "toy", "19200 8N1", "rtu"), (2, "invt-che", "9600 8N1", "rtu")}


class Addressed(Toy):
    """A user's family with a register that holds the drive's address."""

    model = "addressed"
    address_setting = setting(0x20, span=(1, 31), kept=Kept.EEPROM)


class Older(SimulatedDrive):
    """A drive whose older firmware lacks the address register."""

    def read(self, function: int, start: int, count: int) -> list[int]:
        if start == Addressed.address_setting.address:
            raise Refusal(Reason.READ_ADDRESS)
        return super().read(function, start, count)


@pytest.mark.parametrize(
    ("kind", "held", "models"),
    [(SimulatedDrive, 7, ("addressed",)), (SimulatedDrive, 9, ()), (Older, 0, ("addressed",))],
)
def test_drive_does_not_fit_a_family_if_the_address_register_differs(
    kind: type[SimulatedDrive], held: int, models: tuple[str, ...]
) -> None:
    drive = kind(Addressed(7))
    drive["address_setting"] = held
    plan = sweeps([Addressed], baudrates=[9600], formats=["8N1"])
    findings = found(Line(Pair([drive])), plan, [Addressed])
    assert [(finding.address, finding.models) for finding in findings if isinstance(finding, Found)] == [
        (7, models)
    ]


class Meddler(Toy):
    """A user's family whose identification scripts mistakenly write."""

    model = "meddler"

    @verb
    def identify(self) -> Script[None]:
        yield from write(Toy.frequency, 10.0)

    def resembles(self) -> Script[bool]:
        yield from write(Toy.frequency, 10.0)
        return True


def test_scan_does_not_run_an_identify_script_that_writes() -> None:
    drive = SimulatedDrive(Meddler(7))
    plan = sweeps([Meddler], baudrates=[9600], formats=["8N1"])
    findings = found(Line(Pair([drive])), plan, [Meddler])
    assert drives(findings) == {(7, "", "9600 8N1", "rtu")}
    assert not drive.counters.writes


class Commanded(Drive):
    """A user's family that has only registers for writing."""

    model = "commanded"
    speed = command(1, "rpm")


def test_a_family_without_readable_registers_is_skipped() -> None:
    plan = sweeps([InvtCHE, Commanded], baudrates=[9600], formats=["8N1"])
    assert {family for sweep in plan for family in sweep.families} == {InvtCHE}


def test_drive_is_reported_once_if_it_answers_in_two_serial_formats() -> None:
    line = Line(Pair([simulated(InvtCHE(2, format="8N2"))]))
    findings = found(line, sweeps([InvtCHE], baudrates=[9600], formats=["8N1", "8N2"]), [InvtCHE])
    assert len(drives(findings)) == 1


class Stubborn(Line):
    """A port that does not support parity."""

    def carry_out(self, exchange: Exchange, /, *, not_before_ns: int = 0) -> Completion:
        if exchange.settings[1][1] != "N":
            raise LineError("port", "the port does not take the parity that the drive needs")
        return super().carry_out(exchange, not_before_ns=not_before_ns)


def test_settings_that_the_port_does_not_support_are_skipped_and_reported() -> None:
    line = Stubborn(Pair([simulated(InvtCHE(2))]))
    findings = found(line, sweeps([InvtCHE], baudrates=[9600]), [InvtCHE])
    assert drives(findings) == declared(InvtCHE(2))
    untried = {finding.settings.format for finding in findings if isinstance(finding, Untried)}
    assert untried == {"8E1", "8O1", "8E2", "8O2"}


class Vanishing(Line):
    """A port that is lost after some exchanges."""

    def carry_out(self, exchange: Exchange, /, *, not_before_ns: int = 0) -> Completion:
        if len(self.sent) == 20:
            raise LineError("port", "the port was lost (hung up)")
        return super().carry_out(exchange, not_before_ns=not_before_ns)


def test_lost_port_raises_line_error_after_the_findings_so_far() -> None:
    line = Vanishing(Pair([simulated(InvtCHE(2))]))
    findings = scan(line.carry_out, sweeps([InvtCHE], baudrates=[9600], formats=["8N1"]), [InvtCHE])
    assert drives([next(finding for finding in findings if isinstance(finding, Found))]) == declared(
        InvtCHE(2)
    )
    with pytest.raises(LineError, match=r"^port: the port was lost \(hung up\)$"):
        list(findings)


def test_scan_raises_line_error_if_the_port_supports_no_setting() -> None:
    line = Stubborn(Pair([simulated(InvtCHE(2))]))
    with pytest.raises(LineError, match="parity"):
        found(line, sweeps([InvtCHE], baudrates=[9600], formats=["8E1"]))


@table(
    ("asked", "sentence"),
    [
        ({"baudrates": [300]}, "none of these families allows baud rate 300; they allow 1200, 2400, "),
        ({"formats": ["7N1"]}, "none of these families allows format 7N1; they allow 7E1, "),
        ({"addresses": [250]}, "no family allows any of these addresses"),
        (
            {"baudrates": [1200], "formats": ["7E1"], "addresses": [40]},
            "no family allows any of these addresses",
        ),
    ],
)
def test_scan_setting_that_no_family_supports_raises_value_error(
    asked: dict[str, list[object]], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        sweeps(FAMILIES, **asked)


def questions(plan: Sequence[Sweep]) -> Iterator[bytes]:
    for sweep in plan:
        yield build_request(sweep.framing, sweep.request.to(1))


@pytest.mark.slow
def test_every_sweep_reads_a_register_of_its_families() -> None:
    for sweep in sweeps(FAMILIES):
        assert sweep.request.function in READS[sweep.framing]
        for family in sweep.families:
            reads = {register.table.read for register in family.registers.values() if register.readable}
            assert sweep.request.function in reads
    assert len(set(questions(sweeps(FAMILIES)))) < 10


class Bare(SimulatedIBD):
    """An INNOVERT IBD with only the registers below address 200, which the manual's examples show."""

    def read(self, function: int, start: int, count: int) -> list[int]:
        if start >= 200:
            raise Refusal(Reason.READ_ADDRESS)
        return super().read(function, start, count)


@pytest.mark.slow
def test_an_innovert_ibd_with_unreadable_line_settings_is_reported_as_uncertain() -> None:
    bare = InnovertIBD(3), InnovertIBD(4, framing="ascii")
    line = Line(Pair([Bare(each) for each in bare]))
    plan = sweeps(FAMILIES, baudrates=[9600], formats=["8N1", "8E1"])
    findings = found(line, plan)
    assert drives(findings) == declared(*bare)
    assert {finding.doubt for finding in findings} == {
        "only its registers look like this model: check its name plate"
    }
    text = plant_text("/dev/ttyUSB0", findings, MODELS)
    assert text.count("# only its registers look like this model: check its name plate") == 2
    assert text.count("# confirmed = 1  # once its name plate says so") == 2


@pytest.mark.long
def test_wrong_terminal_register_bits_exclude_an_innovert_ibd() -> None:
    for bits in (0x0000, 0x0800, 0x1000, 0x9800, 0xFFFF):
        drive = Bare(InnovertIBD(3))
        drive.read_handlers = {**Bare.read_handlers, "terminals": lambda self, bits=bits: bits}
        line = Line(Pair([drive]))
        assert drives(found(line, sweeps(FAMILIES, baudrates=[9600], formats=["8N1"]))) == {
            (3, "", "9600 8N1", "rtu")
        }


class Anything(SimulatedDrive):
    """A device that answers every read with 0, as some gateways do."""

    def read(self, function: int, start: int, count: int) -> list[int]:
        return [0] * count


@pytest.mark.slow
def test_device_fits_no_family_if_every_read_returns_0() -> None:
    line = Line(Pair([Anything(Toy(7))]))
    (answering,) = found(line, sweeps(FAMILIES, baudrates=[9600]))
    assert isinstance(answering, Found)
    assert (answering.address, answering.models) == (7, ())
