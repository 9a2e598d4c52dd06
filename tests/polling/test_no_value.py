"""Polled registers without a valid value, parts and scales: their rows and counts."""

from __future__ import annotations

import math

from lines import line, plant, polled, rows_of, until

from multidrop.core import NumberFormat
from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, HOLDING_MULTIPLE, INPUT, reading, setting
from multidrop.planning.blocks import blocks
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.sim import SimulatedDrive, Simulator, Wire

ANSWERED = ("ok", "no valid value")  # a machine that others load may miss an answer


class Meter(Drive):
    """One request reads all registers."""

    most_registers = {INPUT: 40, HOLDING: 40}

    voltage = reading(0, "V", number_format=NumberFormat.F32, order="CDAB", table=INPUT)
    energy = reading(2, "kWh", number_format=NumberFormat.U64, table=INPUT, invalid=2**64 - 1)
    probe = reading(
        6, "degC", step=0.1, offset=-40, number_format=NumberFormat.I16, invalid=0x7FFF, table=INPUT
    )
    tariff = reading(7, part=(0, 3), invalid=0xFFFF, table=INPUT)
    runs = reading(7, part=(8, 8), table=INPUT)
    power = reading(8, "W", number_format=NumberFormat.I16, scale_register="power_scale", table=INPUT)
    power_scale = reading(9, number_format=NumberFormat.I16, table=INPUT)
    count = reading(10, number_format=NumberFormat.BCD16, table=INPUT)


def rows_by_register(sim: SimulatedDrive) -> tuple[dict[str, Row], Poller, list[Row]]:
    """Poll all registers until each is answered; return the last answer of each, and all rows."""
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        drives = polled(Meter(1, name="em"), Meter.readings())
        with Poller(plant(line(simulator.wires[0].path, drives))) as poller:
            rows: list[Row] = []

            def all_there() -> bool:
                rows.extend(rows_of(poller))
                return len({row.register for row in rows if row.status in ANSWERED}) == len(Meter.registers)

            until(all_there)
        rows += rows_of(poller)  # rows until its end
        return {row.register: row for row in rows if row.status in ANSWERED}, poller, rows


def test_all_of_a_meter_is_one_request() -> None:
    (block,) = blocks(Meter(1), Meter.readings())
    assert (block.start, block.count, len(block.registers)) == (0, 11, 8)


def test_parts_of_a_word_are_one_request_where_nothing_else_may_be() -> None:
    class Single(Drive):
        """A device whose registers are read singly."""

        most_registers = {INPUT: 1}
        first = reading(7, part=(0, 3), table=INPUT)
        second = reading(7, part=(4, 7), table=INPUT)
        whole = reading(7, table=INPUT)
        other = reading(8, table=INPUT)

    found = blocks(Single(1), Single.readings())
    assert [(block.start, block.count, len(block.registers)) for block in found] == [(7, 1, 3), (8, 1, 1)]


def test_a_scale_register_comes_with_what_it_scales() -> None:
    (block,) = blocks(Meter(1), [Meter.power])
    assert (block.start, block.count, block.offset(Meter.power)) == (8, 2, 0)


def test_values_of_a_meter_are_polled() -> None:
    sim = SimulatedDrive(Meter(1))
    sim["voltage"], sim["energy"], sim["probe"], sim["tariff"] = 230.5, 2**53, 21.5, 3
    sim["runs"], sim["power_scale"] = 1, -2
    sim["power"], sim["count"] = -12.34, 1234
    last, _, _ = rows_by_register(sim)
    assert {name: row.value for name, row in last.items()} == {
        "voltage": 230.5,
        "energy": 2.0**53,
        "probe": 21.5,
        "tariff": 3,
        "runs": 1,
        "power": -12.34,
        "power_scale": -2,
        "count": 1234,
    }
    assert {row.status for row in last.values()} == {"ok"}


def test_what_is_no_value_is_a_miss_with_its_reason() -> None:
    sim = SimulatedDrive(Meter(1))
    sim["voltage"], sim["energy"], sim["probe"], sim["tariff"] = math.nan, None, None, None
    sim["power_scale"] = -32768
    sim.memory.set_raw(Meter.count, 0x12A4)
    last, poller, rows = rows_by_register(sim)
    lacking = {name for name, row in last.items() if row.status == "no valid value"}
    assert lacking == {"voltage", "energy", "probe", "tariff", "power", "count"}
    assert all(last[name].value is None and last[name].uncertainty_ns is None for name in lacking)
    assert (last["runs"].value, last["power_scale"].value) == (1, -32768)  # FFFFH has bit 8
    (statistics,) = poller.statistics().values()
    counted = sum(row.status == "no valid value" for row in rows)
    assert statistics.misses["no valid value"] == counted > 0
    assert statistics.samples == sum(row.status == "ok" for row in rows)


def test_words_that_are_written_several_at_once_are_read_with_the_others() -> None:
    class Controller(Drive):
        """Function 06 is not known to all of its registers."""

        most_registers = {HOLDING: 10, HOLDING_MULTIPLE: 10}
        level = reading(0, "m")
        target = setting(1, "m", table=HOLDING_MULTIPLE)

    sim = SimulatedDrive(Controller(1))
    sim["level"], sim["target"] = 3, 4
    assert sim.read(3, 0, 2) == [3, 4]
