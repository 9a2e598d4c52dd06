"""Texts: characters in registers, read on demand."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import Run
from hypothesis import given
from hypothesis import strategies as st
from lines import ANY_PORT
from simulated_bus import SimulatedBus
from tables import table

from multidrop.core import Message
from multidrop.drive import Drive, Script, WriteForbidden, read, verb
from multidrop.drive.declaration_check import DeclarationError
from multidrop.drive.register import COIL, INPUT, Kept, reading, setting
from multidrop.drive.text import Text, text
from multidrop.scan.identify import _read
from multidrop.sim import SimulatedDrive, Simulator, Wire

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
    """A drive with a text that is longer than its limit for one request."""

    most_registers = {INPUT: 5}
    level = reading(0, table=INPUT)
    serial = text(20, 12, table=INPUT)
    maker = text(40, 3, order="BA")


def test_a_text_is_read_as_the_document_prints_it() -> None:
    assert Meter.serial.decode(b"EM3-0042\0\0\0\0 rubbish") == "EM3-0042"
    assert Meter.maker.decode(b"BAB ") == "AB B"
    assert Meter.maker.decode(bytes.fromhex("42 41 00 42 00 00")) == "ABB"
    assert Meter.serial.decode(b"  v1.2   ") == "  v1.2"


@given(st.binary(max_size=24))
def test_decoded_texts_have_no_control_characters(data: bytes) -> None:
    found = Meter.serial.decode(data)
    assert found.isprintable()
    assert Meter.serial.decode(b"\x1b[2J\x07") == "?[2J?"


@given(st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=6))
@pytest.mark.parametrize("declared", [Meter.serial, Meter.maker], ids=str)
def test_a_text_of_a_simulated_drive_is_read_over_the_line(declared: Text, value: str) -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        sim = SimulatedDrive(Meter(1))
        line = SimulatedBus(monkeypatch, sim)
        drive = line.attach(Meter(1))
        sim[declared.name] = value
        assert drive.read(declared) == value == sim[declared.name]
        counts = [request.count for request, _ in line.frames]
        assert counts == ([5, 5, 2] if declared is Meter.serial else [3])


class Known(Meter):
    """A drive that is identified by the text `maker`."""

    limit = setting(1, "m", span=(0, 10), kept=Kept.RAM)

    @verb
    def identify(self) -> Script[None]:
        """Check that the text `maker` is ABB."""
        if (found := (yield from read(self.maker))) != "ABB":
            raise WriteForbidden(f"{self.name} is of {found}")


@pytest.mark.parametrize("maker", ["ABB", "ABC"])
def test_identify_can_read_a_text(monkeypatch: pytest.MonkeyPatch, maker: str) -> None:
    sim = SimulatedDrive(Known(1))
    sim["maker"] = maker
    line = SimulatedBus(monkeypatch, sim)
    drive = line.attach(Known(1, name="em-1"))
    if maker == "ABB":
        assert drive.write(drive.limit, 3) == 3
    else:
        with pytest.raises(WriteForbidden, match="em-1 is of ABC"):
            drive.write(drive.limit, 3)
    assert (line.written != []) == (maker == "ABB")


def test_scan_reads_texts_to_identify_families() -> None:
    sim = SimulatedDrive(Known(1))
    sim["maker"] = "ABB"

    def ask(drive: Drive, request: Message) -> Message:
        reply = sim.answer(request, 0.0)
        assert reply is not None
        return reply

    assert _read(Known(1), Known.maker, ask) == "ABB"


def test_polling_a_text_or_reading_another_family_s_text_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    class Other(Drive):
        """Another family, with a text at the same address."""

        serial = text(20, 12)

    line = SimulatedBus(monkeypatch, SimulatedDrive(Meter(1)))
    drive = line.attach(Meter(1, name="em-1"))
    assert [register.name for register in Meter.readings()] == ["level"]
    assert list(Meter.texts) == ["serial", "maker"]
    with pytest.raises(ValueError, match=r"^this serial is not a text of em-1"):
        drive.read(Other.serial)
    with pytest.raises(AttributeError, match=r"serial is a text, which drive.read"):
        drive.serial = "x"
    with pytest.raises(ValueError, match="maker holds 6 characters, not 7"):
        line.sims[0]["maker"] = "1234567"


@table(
    ("details", "sentence"),
    [
        ((1, 0), "a text of 0 registers"),
        ((1, 126), "a text of 126 registers: one request reads 1 to 125"),
        ((0xFFFF, 2), "its registers are not within 0 to FFFFH"),
        ((-1, 2), "its registers are not within 0 to FFFFH"),
    ],
)
def test_text_longer_than_a_request_is_refused(details: tuple[int, int], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        text(*details)


def test_invalid_texts_are_refused() -> None:
    with pytest.raises(ValueError, match="order = 'CDAB' of a text is not 'AB', 'BA' or 'B'"):
        text(1, 2, order="CDAB")
    with pytest.raises(ValueError, match="a text is in holding or input registers, and 'coil' is neither"):
        text(1, 2, table=COIL)
    with pytest.raises(DeclarationError, match="bus: reserved name"):
        type("Wrong", (Drive,), {"bus": text(1, 2)})
    with pytest.raises(DeclarationError, match="second: this is the text serial already"):
        type("Wrong", (Drive,), {"second": Meter.serial})


def test_command_line_prints_texts_and_missing_values(run: Run, tmp_path: Path) -> None:
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
    told = run("models", model)[1]
    assert "0014H  serial  input register  8 characters  section 2" in told
    assert "no value: 7FFFH" in told
