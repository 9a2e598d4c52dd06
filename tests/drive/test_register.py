"""Registers: exact scaling, limits of written values, and readable names."""

from __future__ import annotations

import json
import math
from enum import IntEnum, IntFlag
from pathlib import Path
from typing import Any, cast

import pytest
from commands import Run as RunCommand
from hypothesis import given, settings
from hypothesis import strategies as st
from lines import ANY_PORT
from simulated_bus import SimulatedBus
from tables import examples, table

from multidrop import Condition
from multidrop.core import Message, NumberFormat
from multidrop.drive import Drive, StateReader, chosen_language
from multidrop.drive.declaration_check import DeclarationError
from multidrop.drive.line_settings import Settings
from multidrop.drive.register import (
    COIL,
    INPUT,
    LANGUAGES,
    Kept,
    Register,
    catalogue,
    command,
    reading,
    setting,
)
from multidrop.drive.text import Text, text
from multidrop.drive.verbs import Script, State, read, verb
from multidrop.errors import WriteForbidden
from multidrop.families import MODELS
from multidrop.families.registry import SHIPPED, shipped_family
from multidrop.scan.scanner import _read
from multidrop.sim import SimulatedDrive, Simulator, Wire


class Run(IntEnum):
    STOP = 1
    GO = 2


class Bits(IntFlag):
    RUN = 1
    FAULT = 8


class Example(Drive):
    """A drive with registers for these tests."""

    current = reading(3, "A", step=0.1)
    unknown = reading(4, "V", step=None)
    temperature = reading(5, "degC", number_format=NumberFormat.I16)
    bits = reading(6, Bits)
    energy = reading(8, "kWh", step=0.01, number_format=NumberFormat.U32)
    frequency = setting(0x2001, "Hz", step=0.01, span=(0, 400), kept=Kept.RAM)
    run = command(0x2000, Run)
    word = command(0x2002, Bits)
    coil = command(1, table=COIL)
    coarse = setting(9, "V", step=5)
    choice = setting(10, span=(0, 2))


@table(("raw", "value"), [(3, 0.3), (7, 0.7), (285, 28.5), (65535, 6553.5)])
def test_decoded_value_is_the_float_nearest_to_raw_count_times_step(raw: int, value: float) -> None:
    assert Example.current.decode(raw) == value


def test_register_has_the_name_of_its_class_attribute() -> None:
    assert Example.current.name == "current"
    assert list(Example.registers)[:2] == ["current", "unknown"]


def test_raw_count_without_a_name_in_the_enumeration_decodes_to_an_int() -> None:
    assert Example.run.decode(2) is Run.GO
    assert Example.run.decode(9) == 9
    assert Example.bits.decode(9) == Bits.RUN | Bits.FAULT


@table(
    ("register", "value", "error"),
    [
        (Example.frequency, 400.01, ValueError),
        (Example.frequency, -0.01, ValueError),
        (Example.frequency, float("nan"), ValueError),
        (Example.frequency, float("inf"), ValueError),
        (Example.frequency, "50", TypeError),
        (Example.frequency, True, TypeError),
        (Example.run, 2, TypeError),
        (Example.word, Bits(2), ValueError),  # bit 1 is reserved
        (Example.temperature, 40000, ValueError),
        (Example.coil, 2, ValueError),
        (Example.coarse, 5 * 65536, ValueError),
        (Example.unknown, 2.5, ValueError),  # the scale is unknown, so only raw counts can be written
        (Example.choice, 1.5, ValueError),
    ],
)
def test_encoding_an_invalid_value_raises_an_error_that_names_the_register(
    register: Register[Any], value: object, error: type[Exception]
) -> None:
    with pytest.raises(error, match=register.name):
        register.encode(value)


@given(st.integers(0, 40000))
def test_every_raw_count_survives_decoding_and_encoding(raw: int) -> None:
    assert Example.frequency.encode(Example.frequency.decode(raw)) == raw


@given(st.floats(0, 400))
def test_encoding_rounds_to_the_nearest_value_that_a_register_can_hold(value: float) -> None:
    assert abs(Example.frequency.decode(Example.frequency.encode(value)) - value) <= 0.00501


@table(
    ("register", "value", "text"),
    [
        (Example.current, 2.5, "2.5 A"),
        (Example.frequency, 50.0, "50.00 Hz"),
        (Example.unknown, 311, "311 (scale not stated)"),
        (Example.bits, Bits.RUN | Bits.FAULT, "RUN|FAULT"),
        (Example.bits, Bits(0), "none"),
        (Example.bits, Bits(0x1100), "bit 8, bit 12"),
        (Example.bits, Bits(0x8009), "RUN|FAULT, bit 15"),
        (Example.run, Run.STOP, "STOP"),
        (Example.coarse, 15.0, "15 V"),
    ],
)
def test_formatted_values_have_their_unit(register: Register[Any], value: object, text: str) -> None:
    assert register.format(value) == text


def test_typed_text_is_parsed_to_a_value() -> None:
    assert Example.frequency.parse("25.5") == 25.5
    assert Example.run.parse("go") is Run.GO
    assert Example.word.parse("run|fault") == Bits.RUN | Bits.FAULT
    with pytest.raises(ValueError, match="number in Hz"):
        Example.frequency.parse("fast")
    with pytest.raises(ValueError, match="it takes stop, go"):
        Example.run.parse("jump")
    with pytest.raises(ValueError, match="one of"):
        Example.run.parse("go|stop")


def test_32_bit_register_has_two_words() -> None:
    assert (Example.energy.words, Example.current.words, Example.coil.words) == (2, 1, 1)


def test_error_for_an_unknown_register_suggests_similar_names() -> None:
    with pytest.raises(ValueError, match="did you mean current"):
        Example.register("curent")


def test_register_address_above_ffffh_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^Far\.frequency: address = 65536 is not an address"):
        type("Far", (Drive,), {"frequency": reading(0x10000, "Hz")})


@table("number", [10**400, -(10**400), 1 << 64])
@table("name", ["current", "energy", "frequency", "choice", "unknown"])
def test_integer_too_large_for_a_float_is_refused(name: str, number: int) -> None:
    with pytest.raises(ValueError, match=rf"^{name} "):
        Example.register(name).encode(number)


@table(
    ("baudrate", "format", "bits"),
    [
        (9600, "8N1", 10),
        (9600, "8E1", 11),
        (9600, "8N2", 11),
        (9600, "7N2", 10),
        (9600, "7E1", 10),
        (9600, "8O2", 12),
    ],
)
def test_duration_of_a_character_includes_all_of_its_bits(baudrate: int, format: str, bits: int) -> None:
    assert Settings(baudrate, format).character == pytest.approx(bits / baudrate)


@table(
    ("baudrate", "format", "seconds"),
    [
        (9600, "8E1", 4.0104e-3),  # 3.5 characters of 11 bits each
        (19200, "8E1", 2.0052e-3),
        (38400, "8N1", 1.75e-3),  # a fixed time above 19200 baud
        (115200, "8N1", 1.75e-3),
    ],
)
def test_t3_5_is_the_modbus_silence_in_seconds(baudrate: int, format: str, seconds: float) -> None:
    assert Settings(baudrate, format).t3_5 == pytest.approx(seconds, rel=1e-4)


@table("format", ["8X1", "9N1", "8N3", "8n1", "", "8N1 "])
def test_invalid_character_format_is_refused(format: str) -> None:
    with pytest.raises(ValueError, match="format"):
        Settings(9600, format)


@table("baudrate", [0, -9600, 10**9])
def test_baud_rate_outside_the_limits_is_refused(baudrate: int) -> None:
    with pytest.raises(ValueError, match="baud rate"):
        Settings(baudrate, "8N1")


RUNS, STANDS = State(Condition.RUNNING), State(Condition.STOPPED)


class Counting(Drive):
    """A drive class that records each computation of its state, by any copy of the drive."""

    looks: list[float] = []
    speed = reading(0x10)
    temperature = reading(0x11)

    @verb
    def state(self) -> Script[State]:
        """Return running if the speed is not 0."""
        speed = yield from read(self.speed)
        self.looks.append(speed)
        return RUNS if speed else STANDS


class Noting(Drive):
    """A drive class whose `state` sets an attribute, so each call must compute the state again."""

    speed = reading(0x10)

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.zeros = 0

    @verb
    def state(self) -> Script[State]:
        """Return `stopped` after two readings of 0 Hz in a row."""
        speed = yield from read(self.speed)
        self.zeros = 0 if speed else self.zeros + 1
        return STANDS if self.zeros > 1 else RUNS


def test_a_state_is_computed_only_once_for_equal_register_values() -> None:
    Counting.looks.clear()
    reader = StateReader(Counting(1))
    for temperature in range(5):
        assert reader.state({"speed": 25.0, "temperature": float(temperature)}) == RUNS
    assert Counting.looks == [25.0]
    assert reader.state({"speed": 0.0}) == STANDS
    assert reader.state({}) is None
    assert reader.state({"speed": 0.0}) == STANDS
    assert reader.state({"speed": 25.0}) == RUNS
    assert Counting.looks[-1] == 25.0


def test_a_state_is_computed_again_for_a_register_value_of_nan() -> None:
    Counting.looks.clear()
    reader = StateReader(Counting(1))
    assert [reader.state({"speed": math.nan}) for _ in range(2)] == [RUNS, RUNS]
    assert len(Counting.looks) == 2


def test_a_state_is_always_recomputed_if_the_method_sets_attributes() -> None:
    reader = StateReader(Noting(1))
    shown = [reader.state({"speed": speed}) for speed in (25.0, 0.0, 0.0, 0.0, 25.0, 0.0, 0.0)]
    assert shown == [RUNS, RUNS, STANDS, STANDS, RUNS, RUNS, STANDS]


# Status words from the manuals. A Delixi with standard Modbus has no status word: only its fault code shows a
# fault.
@table(
    ("model", "values", "condition"),
    [
        ("invt-che", {"status": 4.0}, Condition.FAULT),
        ("invt-che", {"status": 3.0}, Condition.STOPPED),
        ("delixi-native", {"status": 4.0}, Condition.FAULT),
        ("delixi-modbus", {"output_frequency": 25.0}, None),
    ],
)
def test_a_status_word_shows_a_fault(
    model: str, values: dict[str, float], condition: Condition | None
) -> None:
    found = StateReader(MODELS[model](1)).state(values)
    assert (found and found.condition) == condition
    assert found is None or found.fault is None


def test_a_fault_gets_its_name_when_the_fault_code_is_read() -> None:
    reader = StateReader(MODELS["invt-che"](1))
    assert reader.state({"status": 4.0}) == State(Condition.FAULT)
    assert reader.state({"status": 4.0}) == State(Condition.FAULT)
    named = reader.state({"status": 4.0, "fault": 4.0})
    assert named == State(Condition.FAULT, fault="overcurrent while accelerating (OC1)")
    assert reader.state({"status": 4.0}) == State(Condition.FAULT)


METER = """\
from multidrop import Drive, reading, text
from multidrop.drive import INPUT

class Meter(Drive):
    model = "meter"
    most_registers = {INPUT: 10}
    level = reading(3, "m", table=INPUT, invalid=0x7FFF)
    speed = reading(4, "rpm", table=INPUT)
    serial = text(20, 4, table=INPUT, place="section 2")
"""


class Meter(Drive):
    """A drive with a text register that is longer than one request may read."""

    most_registers = {INPUT: 5}
    level = reading(0, table=INPUT)
    serial = text(20, 12, table=INPUT)
    maker = text(40, 3, order="BA")


def test_text_register_is_decoded_in_the_documented_character_order() -> None:
    assert Meter.serial.decode(b"EM3-0042\0\0\0\0 rubbish") == "EM3-0042"
    assert Meter.maker.decode(b"BAB ") == "AB B"
    assert Meter.maker.decode(bytes.fromhex("42 41 00 42 00 00")) == "ABB"
    assert Meter.serial.decode(b"  v1.2   ") == "  v1.2"


@given(st.binary(max_size=24))
def test_strings_from_text_registers_have_no_control_characters(data: bytes) -> None:
    found = Meter.serial.decode(data)
    assert found.isprintable()
    assert Meter.serial.decode(b"\x1b[2J\x07") == "?[2J?"


@settings(max_examples=examples(20))
@given(st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=6))
@pytest.mark.parametrize("declared", [Meter.serial, Meter.maker], ids=str)
def test_text_register_of_a_simulated_drive_is_read_over_the_line(declared: Text, value: str) -> None:
    sim = SimulatedDrive(Meter(1))
    line = SimulatedBus(sim)
    drive = line.attach(Meter(1))
    sim[declared.name] = value
    assert drive.read(declared) == value == sim[declared.name]
    counts = [request.count for request, _ in line.frames]
    assert counts == ([5, 5, 2] if declared is Meter.serial else [3])


class Known(Meter):
    """A drive that is identified by its text register `maker`."""

    limit = setting(1, "m", span=(0, 10), kept=Kept.RAM)

    @verb
    def identify(self) -> Script[None]:
        """Check that the text register `maker` has the text ABB."""
        if (found := (yield from read(self.maker))) != "ABB":
            raise WriteForbidden(f"{self.name} is of {found}")


@pytest.mark.parametrize("maker", ["ABB", "ABC"])
def test_identity_check_of_a_drive_can_read_a_text_register(maker: str) -> None:
    sim = SimulatedDrive(Known(1))
    sim["maker"] = maker
    line = SimulatedBus(sim)
    drive = line.attach(Known(1, name="em-1"))
    if maker == "ABB":
        assert drive.write(drive.limit, 3) == 3
    else:
        with pytest.raises(WriteForbidden, match="em-1 is of ABC"):
            drive.write(drive.limit, 3)
    assert (line.written != []) == (maker == "ABB")


def test_a_scan_reads_text_registers_to_identify_families() -> None:
    sim = SimulatedDrive(Known(1))
    sim["maker"] = "ABB"

    def ask(drive: Drive, request: Message) -> Message:
        reply = sim.answer(request, 0.0)
        assert reply is not None
        return reply

    assert _read(Known(1), Known.maker, ask) == "ABB"


def test_misuse_of_a_text_register_raises_an_error() -> None:
    class Other(Drive):
        """Another family with a text register at the same address."""

        serial = text(20, 12)

    line = SimulatedBus(SimulatedDrive(Meter(1)))
    drive = line.attach(Meter(1, name="em-1"))
    assert [register.name for register in Meter.readings()] == ["level"]
    assert list(Meter.texts) == ["serial", "maker"]
    with pytest.raises(ValueError, match=r"^this serial is not a text of em-1"):
        drive.read(Other.serial)
    with pytest.raises(AttributeError, match=r"serial is a text; read it with drive.read"):
        drive.serial = "x"
    with pytest.raises(ValueError, match="maker can hold 6 characters, not 7"):
        line.sims[0]["maker"] = "1234567"


@table(
    ("details", "sentence"),
    [
        ((1, 0), "length = 0 of a text is not 1 to 125"),
        ((1, 126), "length = 126 of a text is not 1 to 125 registers"),
        ((0xFFFF, 2), "its registers must be within 0 to FFFFH"),
        ((-1, 2), "its registers must be within 0 to FFFFH"),
    ],
)
def test_text_register_longer_than_one_request_is_refused(details: tuple[int, int], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        text(*details)


def test_invalid_text_register_in_a_drive_class_is_refused() -> None:
    with pytest.raises(ValueError, match="a text has order = 'CDAB'; it must be 'AB', 'BA' or 'B'"):
        text(1, 2, order="CDAB")
    with pytest.raises(
        ValueError, match="a text has the table 'coil'; a text must be in holding or input registers"
    ):
        text(1, 2, table=COIL)
    with pytest.raises(DeclarationError, match="bus: reserved name"):
        type("Wrong", (Drive,), {"bus": text(1, 2)})
    with pytest.raises(DeclarationError, match="second: this object is already the text serial"):
        type("Wrong", (Drive,), {"second": Meter.serial})


def test_command_line_prints_text_registers_and_marks_missing_values(run: RunCommand, tmp_path: Path) -> None:
    path = tmp_path / "meter.py"
    path.write_text(METER)
    model = f"{path}:Meter"
    namespace: dict[str, type[Drive]] = {}
    exec(METER, namespace)
    sim = SimulatedDrive(namespace["Meter"](1))
    sim["level"], sim["speed"], sim["serial"] = None, 1440, "EM3-0042"
    with Simulator([Wire([sim], port=ANY_PORT, unpaced=True)]) as simulator:
        port = simulator.wires[0].path
        status, out, _ = run("read", port, model, 1)
        assert (status, out) == (0, "level        no valid value\nspeed  1440  rpm\nserial  EM3-0042\n")
        assert run("read", port, model, 1, "serial")[1] == "serial  EM3-0042\n"
        shown = json.loads(run("read", port, model, 1, "--json")[1])["values"]
    assert shown == {
        "level": {"value": None, "reason": "no valid value"},
        "speed": {"value": 1440.0, "unit": "rpm"},
        "serial": {"value": "EM3-0042"},
    }
    printed = run("models", model)[1]
    assert "0014H  serial  input register  8 characters  section 2" in printed
    assert "no value: 7FFFH" in printed


UNTRANSLATED = {  # the documents do not explain these registers
    "ru": {"automatic_environment", "display_frequency"},
    "zh": {"display_frequency"},
}


@pytest.mark.parametrize("language", LANGUAGES)
def test_title_catalogue_has_each_register_of_the_built_in_families(language: str) -> None:
    families = [*MODELS.values(), *map(shipped_family, SHIPPED)]
    names = {name for family in families for name in family.registers}
    titles = catalogue(language)
    assert names - titles.keys() == UNTRANSLATED[language]
    assert titles.keys() <= names
    assert all(
        title.strip() == title and title.isprintable() and not title.isascii() for title in titles.values()
    )


def test_declared_title_takes_precedence_over_catalogue_and_english_titles() -> None:
    registers = {
        "output_current": reading(1, "A", titles={"ru": "ток"}),
        "outdoor_temperature": reading(2, titles={"zh": "室外温度"}),
    }
    for name, register in registers.items():
        register.__set_name__(object, name)
    current, outdoor = registers.values()
    assert [current.title_in(one) for one in ("ru", "zh", "en", "de")] == [
        "ток",
        "输出电流",
        "output current",
        "output current",
    ]
    assert [outdoor.title_in(one) for one in ("ru", "zh")] == ["outdoor temperature", "室外温度"]
    assert outdoor.title == "outdoor temperature"


@table(
    ("tags", "language"),
    [
        (["ru_RU.UTF-8"], "ru"),
        (["zh-Hant-TW", "en"], "zh"),
        (["de-DE", "ru"], "ru"),
        (["en-GB", "ru"], "en"),
        (["RU"], "ru"),
        (["rus", "C", "", "*"], "en"),
        ([], "en"),
    ],
)
def test_the_first_language_with_register_titles_is_chosen(tags: list[str], language: str) -> None:
    assert chosen_language(tags) == language


def test_a_unit_or_an_enumeration_can_be_a_keyword_argument() -> None:
    assert reading(0x10, unit="kW").unit == "kW"
    assert reading(0x10, values=IntEnum("Mode", "SLOW")).values is not None


def test_a_text_with_one_character_per_register_is_in_the_low_bytes() -> None:
    version = text(250, 5, order="B")
    assert version.decode(bytes.fromhex("0034 002E 0031 0000 0041")) == "4.1"
    assert version.decode(bytes.fromhex("FF34 FF2E FF31 FF38 FF20")) == "4.18"
    assert version.encode("4.1") == bytes.fromhex("0034 002E 0031 0000 0000")
    with pytest.raises(ValueError, match="can hold 5 characters, not 6"):
        version.encode("4.18.1")
    with pytest.raises(ValueError, match="a text has order = 'A'; it must be 'AB', 'BA' or 'B'"):
        Text(1, 1, order="A")


def test_a_register_outside_a_class_or_with_a_wrong_table_has_a_repr() -> None:
    assert repr(reading(5, "A")) == "<Register (no name): reading, holding register 5, A>"
    assert repr(reading(5, table=cast(Any, 3))) == "<Register (no name): reading, 3 5>"
