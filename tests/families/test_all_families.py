"""Every built-in family has consistent declarations, and no verb that its document does not describe."""

from __future__ import annotations

import ast
import math
import random
import re
from collections.abc import Callable
from enum import Flag, IntFlag
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scripts import Wire
from tables import examples, table

import multidrop.drive
import multidrop.families
from multidrop.core import (
    Message,
    NumberFormat,
    build_reply,
    build_request,
    parse_reply,
    parse_request,
    raw_value,
)
from multidrop.drive import Condition, Direction, Drive, State
from multidrop.drive.register import Access, Carrier, Register, reading
from multidrop.drive.request import write_request
from multidrop.drive.verbs import VERBS
from multidrop.errors import Unsupported
from multidrop.families import MODELS, DelixiModbus, DelixiNative
from multidrop.families.invt_che import CHEStatus
from multidrop.planning.blocks import blocks

FAMILIES = list(MODELS.values())

family = pytest.mark.parametrize("family", FAMILIES, ids=lambda each: each.model)


def registers(wanted: Callable[[Register[Any]], object]) -> list[tuple[type[Drive], Register[Any]]]:
    """Return (family, register) for each register that the function `wanted` accepts."""
    return [(family, each) for family in FAMILIES for each in family.registers.values() if wanted(each)]


def label(one: type[Drive] | Register[Any]) -> str:
    return one.name if isinstance(one, Register) else one.model


def test_built_in_families_are_found_by_name() -> None:
    assert list(MODELS) == [
        "erman-er-g-220",
        "invt-che",
        "innovert-ibd",
        "delixi-modbus",
        "delixi-native",
        "yd1000",
    ]
    assert all(name == each.model for name, each in MODELS.items())
    assert len({family.title for family in FAMILIES}) == len(FAMILIES)


@family
def test_every_family_has_a_title_and_names_its_manual(family: type[Drive]) -> None:
    assert family.__doc__
    assert len(family.__doc__) > 500
    assert family.manual
    assert family.title
    assert family.watchdog
    assert family(family.addresses[0]).name == f"{family.model}@{family.addresses[0]}"


@family
@table("given", [True, 1.0, None, "1", 0, 248, -1])
def test_invalid_drive_address_is_refused(family: type[Drive], given: object) -> None:
    with pytest.raises(ValueError, match=rf"^address {given!r} is not supported by "):
        family(given)  # type: ignore[arg-type]


TERMINALS = {  # names of the RS-485 terminals in each manual; the INVT CHE's manual has none
    "erman-er-g-220": "485A and 485B",
    "innovert-ibd": "RS+ and RS-",
    "delixi-modbus": "SG+ and SG-",
    "delixi-native": "SG+ and SG-",
    "yd1000": "A and B",
    "invt-che": "",
}


@family
def test_every_family_names_its_rs485_terminals(family: type[Drive]) -> None:
    assert family.line_terminals == TERMINALS[family.model]


def test_the_error_for_an_unknown_framing_names_a_valid_one() -> None:
    with pytest.raises(
        ValueError, match=r"^framing 'ascii' is not supported by .*, which has delixi; write delixi, or omit"
    ):
        DelixiNative(1, framing="ascii")


@table("family", [DelixiModbus, DelixiNative])
def test_delixi_units_not_in_the_manual_are_marked_as_inferred(family: type[Drive]) -> None:
    of_p05 = [each for each in family.registers.values() if 501 <= each.address <= 510 and each.unit]
    assert len(of_p05) == 7
    assert all("unit is inferred" in each.note for each in of_p05)


@family
def test_framing_of_a_drive_can_be_given_by_its_number(family: type[Drive]) -> None:
    first = family.framings[0]
    assert family(1, framing=int(first)).framing is first  # type: ignore[arg-type]


def test_base_class_drive_cannot_be_used_as_a_family() -> None:
    with pytest.raises(TypeError, match=r"^Drive is the base class: use a family, such as YD1000, or "):
        Drive(1)


@family
@table("name", ["start", "jog"])
@table("given", ["reverse", "forward", True, 25.0, CHEStatus.REVERSE])
def test_a_start_in_an_invalid_direction_raises(family: type[Drive], name: str, given: object) -> None:
    """A wrong direction must not turn the motor, so no frame is sent."""
    drive = family(family.addresses[0], name="pump")
    drive.perform = pytest.fail
    sentence = rf"^{name} of pump takes Direction\.FORWARD or Direction\.REVERSE, not "
    for words, named in (((given,), {}), ((), {"direction": given})):
        with pytest.raises(TypeError, match=sentence):
            getattr(drive, name)(*words, **named)
        with pytest.raises(TypeError, match=sentence):
            getattr(drive, name).script(*words, **named)


@family
@table("given", ["25", None, True, Direction.FORWARD])
def test_setpoint_that_is_not_a_number_raises_type_error(family: type[Drive], given: object) -> None:
    drive = family(family.addresses[0], name="pump")
    drive.perform = pytest.fail
    with pytest.raises(TypeError, match=r"^set_frequency of pump takes a number in Hz, not "):
        drive.set_frequency(given)  # type: ignore[arg-type]


@family
def test_no_register_has_the_same_name_as_a_verb(family: type[Drive]) -> None:
    assert not set(family.registers) & set(VERBS)
    assert not [name for name in family.registers if name in vars(Drive)]


@family
def test_every_verb_has_a_docstring(family: type[Drive]) -> None:
    assert all(getattr(family, name).__doc__ for name in (*VERBS, "identify"))


@family
def test_no_two_registers_of_a_family_have_the_same_address(family: type[Drive]) -> None:
    """A command and a reading that shows its effect may share an address."""
    places = [
        (register.table, register.address + at, register.access is Access.COMMAND)
        for register in family.registers.values()
        for at in range(register.words)
    ]
    assert len(places) == len(set(places))


@family
def test_every_framing_of_a_family_has_character_formats(family: type[Drive]) -> None:
    assert set(family.formats) == set(family.framings)
    for framing in family.framings:
        for format in family.formats[framing]:
            for baudrate in family.baudrates:
                drive = family(1, framing=framing, format=format, baudrate=baudrate)
                assert drive.response_timeout > drive.response_delay


@family
def test_read_limits_name_only_register_tables_of_the_family(family: type[Drive]) -> None:
    tables = {register.table for register in family.registers.values()}
    assert {*family.most_registers, *family.readable_gaps} <= tables


@family
def test_every_register_names_its_section_of_the_manual(family: type[Drive]) -> None:
    for name, register in family.registers.items():
        assert register.place or register.outside, name
        assert getattr(family, name) is register


@table("family, register", registers(lambda each: each.span))
def test_only_values_within_limits_can_be_encoded(family: type[Drive], register: Register[Any]) -> None:
    assert register.span
    low, high = register.span
    step = float(register.scale)
    assert register.decode(register.encode(low)) == low
    assert register.decode(register.encode(high)) == high
    for beyond in (low - step, high + step, math.nan, math.inf):
        with pytest.raises(ValueError, match=register.name):
            register.encode(beyond)


@table("family, register", registers(lambda each: each.span and each.default is not None))
def test_a_factory_value_survives_encoding_and_decoding(family: type[Drive], register: Register[Any]) -> None:
    assert register.decode(register.encode(register.default)) == register.default


@table("family, register", registers(lambda each: each.values))
def test_the_named_values_survive_encoding_and_decoding(family: type[Drive], register: Register[Any]) -> None:
    assert register.values
    for member in register.values:
        assert register.decode(register.encode(member)) is member
        assert register.parse(register.format(member)) == member
    if issubclass(register.values, IntFlag):
        known = sum(member.value for member in register.values)
        bits = 16 if register.words == 1 else 32
        for at in range(bits):
            if not known >> at & 1:
                with pytest.raises(ValueError, match="reserved"):
                    register.encode(register.values(1 << at))
    else:
        with pytest.raises(TypeError, match=register.name):
            register.encode(max(value.value for value in register.values) + 1)


@family
def test_registers_declared_as_never_written_are_not_writable(family: type[Drive]) -> None:
    assert not [register for register in family.registers.values() if register.never and register.writable]


@table("family, register", registers(lambda each: each.broadcast))
def test_every_broadcast_is_a_stop_or_a_setpoint_of_0(family: type[Drive], register: Register[Any]) -> None:
    for raw in register.broadcast:
        assert family.broadcasts
        value = register.decode(raw)
        if isinstance(value, Flag):
            assert {bit.name for bit in value} <= {"COMMAND_VALID", "FREQUENCY_VALID"}
        else:
            assert raw == 0 or value.name == "STOP"


@family
def test_register_of_unknown_scale_is_never_writable(family: type[Drive]) -> None:
    assert not [
        register for register in family.registers.values() if register.step is None and register.writable
    ]


@pytest.mark.slow
@table("family, register", registers(lambda each: not each.values))
def test_raw_counts_of_all_families_survive_decoding(family: type[Drive], register: Register[Any]) -> None:
    low, high = (0, 1) if register.number_format is NumberFormat.BIT else (0, 0xFFFF)
    if register.number_format is NumberFormat.I16:
        low, high = -0x8000, 0x7FFF
    if register.table.carrier is Carrier.LONG:
        high = 0xFFFF_FFFF
    if register.span is not None:
        low, high = (int(Fraction(str(end)) / register.scale) for end in register.span)
    chance = random.Random(register.name)
    some = {chance.randint(low, high) for _ in range(20)}
    for raw in {low, high, max(low, min(0, high)), *some}:
        value = register.decode(raw)
        assert register.encode(value) == raw
        assert register.format(value).startswith(f"{value:.{register.decimals}f}")


@pytest.mark.parametrize(("family", "register"), registers(lambda each: each.writable), ids=label)
@settings(max_examples=examples(10))
@given(data=st.data())
def test_value_of_any_register_survives_a_write_and_a_read(
    family: type[Drive], register: Register[Any], data: st.DataObject
) -> None:
    """A written value is stored as sent, and read back, in every framing."""
    drive = family(family.addresses[0], framing=data.draw(st.sampled_from(family.framings)))
    value = data.draw(_values(register))
    asked = write_request(drive, register, register.encode(value))
    frame = build_request(drive.framing, asked)
    used, taken = parse_request(drive.framing, frame)
    assert taken is not None
    assert (used, taken) == (len(frame), asked)
    if register.table.carrier is Carrier.NUMBER:
        kept = bytes(2) + taken.start.to_bytes(2, "big")
    elif register.table.carrier is Carrier.BIT:
        kept = bytes([taken.data[0] & 1])
    else:
        kept = taken.data
    if register.readable:
        (block,) = blocks(drive, [register])
        answer = Message(drive.address, block.request.function, block.start, data=kept)
        frame = build_reply(drive.framing, answer)
        used, reply = parse_reply(drive.framing, frame, block.request)
        assert reply is not None
        assert (used, reply.data) == (len(frame), kept)
    assert register.decode(raw_value(kept, 0, register.number_format)) == value


def _values(register: Register[Any]) -> st.SearchStrategy[Any]:
    """Return a strategy for values that may be written to the register."""
    if register.values is not None:
        members = [
            value
            for value in register.values
            if not any(value & mask == mask for mask in register.never_together)
        ]
        return st.sampled_from(members)
    low, high = 0, (1 << 16 * register.words) - 1
    if register.number_format is NumberFormat.BIT:
        high = 1
    if register.number_format in (NumberFormat.I16, NumberFormat.I32):
        low, high = -(high + 1) // 2, high // 2
    if register.span is not None:
        low, high = (int(Fraction(str(end)) / register.scale) for end in register.span)
    return st.integers(low, high).map(register.decode)


NUMBERS = registers(lambda each: each.values is None and each.writable)


@pytest.mark.parametrize(("family", "register"), NUMBERS, ids=label)
@settings(max_examples=examples(10))
@given(data=st.data())
def test_formatted_register_values_can_be_parsed(
    family: type[Drive], register: Register[Any], data: st.DataObject
) -> None:
    value = data.draw(_values(register))
    shown = register.format(value).removesuffix(register.unit).strip()
    assert register.encode(register.parse(shown)) == register.encode(value)


def scripts_of(tree: ast.AST) -> set[str]:
    """Return the names of generator functions, which run only when iterated."""
    return {
        node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and node.returns is not None
        and ast.unparse(node.returns).startswith(("Script[", "Generator[", "Iterator["))
    }


def forgotten(tree: ast.AST, scripts: set[str]) -> list[int]:
    """Return the line numbers of calls that ignore the generator which a function in `scripts` returns."""
    calls = [node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)]
    found = []
    for call in calls:
        if isinstance(call, ast.Call):
            name = call.func.attr if isinstance(call.func, ast.Attribute) else ast.unparse(call.func)
            if name in scripts:
                found.append(call.lineno)
    return found


def test_every_call_of_a_script_uses_yield_from() -> None:
    """Without `yield from`, the script's steps are silently not run."""
    rooms = (Path(multidrop.families.__file__).parent, Path(multidrop.drive.__file__).parent)
    trees = {path: ast.parse(path.read_text("utf-8")) for room in rooms for path in room.rglob("*.py")}
    scripts = {"script"}.union(*map(scripts_of, trees.values()))
    assert {"read", "write", "insist", "wait", "until", "_started", "_stopped", "script"} <= scripts
    assert {path.name: lines for path, tree in trees.items() if (lines := forgotten(tree, scripts))} == {}
    carried_out = [
        node
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.YieldFrom)
        and isinstance(node.value.value, ast.Call)
    ]
    assert len(carried_out) > 80
    # Each call would be a mistake without `yield from`, and `forgotten` must then find it.
    for node in carried_out:
        call = node.value.value  # type: ignore[attr-defined]
        assert forgotten(ast.Module([ast.Expr(call)], []), scripts) == [call.lineno]


def test_a_verb_missing_from_a_family_raises_unsupported() -> None:
    class Mute(Drive):
        """A drive without verbs."""

        speed = reading(0, "rpm")

    with pytest.raises(
        ValueError, match=r"^Mute has no argument or option 'rated_frequency'; it takes name, framing, "
    ):
        Mute(1, rated_frequency=50)
    for name in VERBS:
        given = (5.0,) if name == "set_frequency" else ()
        with pytest.raises(Unsupported, match="the document of Mute has no "):
            next(getattr(Mute(1), name).script(*given))


UNDOCUMENTED = {  # verbs that a family's document does not describe, by family
    "erman-er-g-220": {"coast", "jog", "release_control"},
    "invt-che": {"emergency_stop", "release_control"},
    "innovert-ibd": {"coast", "emergency_stop", "release_control"},
    "delixi-modbus": {"coast", "emergency_stop", "release_control", "reset_fault"},
    "delixi-native": {"coast", "emergency_stop", "jog", "release_control"},
    "yd1000": set(),
}


@family
def test_undocumented_verbs_raise_unsupported(family: type[Drive]) -> None:
    wire = Wire(family(1))
    missing = {name for name in VERBS if getattr(family, name) is getattr(Drive, name)}
    assert missing == UNDOCUMENTED[family.model]
    for name in missing:
        with pytest.raises(Unsupported, match=re.escape(f"the document of {family.title} has no ")):
            getattr(wire.drive, name)()
    assert wire.sent == []


def test_a_state_as_text_shows_condition_direction_fault_and_note() -> None:
    said = State(Condition.FAULT, Direction.REVERSE, "OVERCURRENT", "watchdog is off")
    assert str(said) == "fault reverse (OVERCURRENT) - watchdog is off"
    assert str(State(Condition.UNKNOWN)) == "unknown"


@family
def test_assigning_to_a_register_attribute_is_refused(family: type[Drive]) -> None:
    drive = family(1)
    name = next(iter(drive.registers))
    with pytest.raises(
        AttributeError, match=rf"^{name} is a register; write it with drive.write\('{name}', VALUE\)"
    ):
        setattr(drive, name, 1)
    assert drive.register(name) is drive.registers[name]
