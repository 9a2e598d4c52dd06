"""Captures of a tcp:// line: Wireshark and the library decode them as Modbus/TCP."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from lines import PATIENCE, until
from peers import require_program

from multidrop.capture import Capture, CaptureWriter, Decoding, Pairing, SniffedExchange, Tapped
from multidrop.core import FrameSpan, Framing, Kind, Message
from multidrop.families import InnovertIBD
from multidrop.plant.loader import load_plant
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.sim import EncodedDrive, Simulator, Wire, proof

FIELDS = ("mbtcp.trans_id", "mbtcp.unit_id", "modbus.func_code", "modbus.reference_num")
POLLED = ("output_current", "motor_speed")


def test_unit_id_0_of_modbus_tcp_is_not_a_broadcast() -> None:
    request, reply = Message(0, 0x03, 1, 1), Message(0, 0x03, data=b"\0\7")
    spans = {
        framing: [
            FrameSpan(Kind.REQUEST, framing, 1, request, b"?"),
            FrameSpan(Kind.REPLY, framing, 2, reply, b"!"),
        ]
        for framing in (Framing.TCP, Framing.RTU)
    }
    (exchange,) = Pairing().pair(spans[Framing.TCP])
    assert isinstance(exchange, SniffedExchange)
    assert (exchange.request, exchange.reply, exchange.is_broadcast) == (request, reply, False)
    serial = list(Pairing().pair(spans[Framing.RTU]))
    assert [isinstance(each, SniffedExchange) and each.is_broadcast for each in serial] == [True, False]


@pytest.fixture
def captured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path, list[Row]]:
    """Return a plant file, the capture of its poll with one silent drive, and the poll's rows.

    No reply is late, even on a busy machine, because the other drive has a long time-out.
    """
    monkeypatch.setattr(InnovertIBD, "response_timeout", PATIENCE)
    monkeypatch.setattr(InnovertIBD, "answering_time", PATIENCE)
    plant, path = tmp_path / "plant.toml", tmp_path / "a.pcapng"
    wire = Wire([EncodedDrive(InnovertIBD(3))], port="tcp://127.0.0.1:0", unpaced=True)
    with Simulator([wire]):
        plant.write_text(
            f'[[line]]\nname = "net"\nport = "{wire.path}"\n'
            + "".join(
                f'[[line.drive]]\nname = "{name}"\nmodel = "{model}"\naddress = {address}\n'
                f"poll = {list(POLLED)}\n"
                for name, model, address in (("pump", "innovert-ibd", 3), ("gone", "invt-che", 4))
            )
        )
        poller, rows = Poller(load_plant(plant)), []

        def is_enough() -> bool:
            tapped.collect()
            while batch := poller.take():
                rows.extend(batch)
            return len(rows) > 200 and "gone" in {row.drive for row in rows}

        with CaptureWriter(path, list(poller.buses)) as capture:
            with Tapped(poller.buses, capture) as tapped, poller:
                until(is_enough)
            while batch := poller.take():
                rows.extend(batch)
        assert tapped.lost == 0
    return plant, path, rows


@pytest.mark.long
def test_wireshark_decodes_modbus_tcp(captured: tuple[Path, Path, list[Row]]) -> None:
    _, path, rows = captured
    fields = [word for field in FIELDS for word in ("-e", field)]
    command = [require_program("tshark"), "-n", "-r", str(path), "-T", "fields", "-e", "_ws.col.Info"]
    said = subprocess.run([*command, *fields], capture_output=True, text=True, check=True).stdout
    lines = [line.split("\t") for line in said.splitlines()]
    packets = [line for line in lines if line[1]]
    assert len(packets) == len(lines)
    answered = [packet for packet in packets if packet[2] == "3" and packet[0].strip().startswith("Response")]
    asked = [packet for packet in packets if packet[2] == "3" and packet[0].strip().startswith("Query")]
    assert len(answered) == len({row.monotonic_ns for row in rows if row.value is not None})
    assert {each[1] for each in answered} <= {each[1] for each in asked}
    assert {(packet[2], packet[3]) for packet in packets} == {("3", "3"), ("4", "3")}
    assert "Malformed" not in said


@pytest.mark.slow
def test_our_reader_has_the_poll_s_values(captured: tuple[Path, Path, list[Row]]) -> None:
    plant, path, polled = captured
    known = load_plant(plant)
    with Capture(path) as capture:
        decoding = Decoding(capture, known)
        found = [row for batch in decoding for row in batch]
        assert decoding.counts()["unknown_bytes"] == 0
    drive = known.lines[0].drives[0].drive
    assert {row.value for row in found if row.drive == "pump" and row.register == "output_current"} == {
        proof(drive, drive.register("output_current"))
    }
    told = [(row.drive, row.register, row.value, row.status) for row in polled if row.status != NOT_ASKED]
    assert [(row.drive, row.register, row.value, row.status) for row in found][: len(told) - 8] == told[:-8]


NOT_ASKED = "not asked: drive is silent"
