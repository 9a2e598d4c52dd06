"""Profile: a drive state machine that several makes share. A family declares the profile's registers."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum, IntFlag
from itertools import chain
from typing import Any, ClassVar, cast

from multidrop.drive import Condition, Direction, Drive, State
from multidrop.drive.declaration_check import DeclarationError
from multidrop.drive.number_format import NumberFormat
from multidrop.drive.register import Access, Carrier, Option, Register
from multidrop.drive.verbs import Script, insist, read, until, verb, write
from multidrop.errors import ANOTHER_FAMILY, Advice, DriveException, NotVerified, Unconfirmed, WriteForbidden

_BY_PROFILE = "set by the profile; leave it out"


@dataclass(frozen=True)
class Role:
    """What a profile requires of a register that it uses, such as `control`.

    The profile sets `values` and `harmless` of the family's register. `needed` is False if a family may omit
    the register.
    """

    access: tuple[Access, ...]
    values: type[IntEnum | IntFlag] | None = None
    harmless: tuple[int, ...] | None = None
    never_together: tuple[int, ...] = ()
    moves: bool | None = None
    units: tuple[str, ...] = ()  # allowed units; empty: any
    extra: tuple[str, ...] = ()  # names of bits, different in each make, that a family may add
    # control words, such as "stop", that a family must list if it has raw counts of its own
    renumbered: tuple[str, ...] = ()
    needed: bool = True

    @property
    def is_word(self) -> bool:
        """True if the register holds named values or flags, not a quantity."""
        return self.values is not None


READING = Role((Access.READING,))
OPTIONAL = Role((Access.READING,), needed=False)
PROOFS = ("station", "signature")  # registers that only serve to identify the family
COMMON: Mapping[str, Role] = {  # registers of all profiles, besides `control` and `status`
    "reference": Role((Access.SETTING, Access.COMMAND), moves=False, units=("Hz", "%")),
    "output_frequency": READING,
    "fault": OPTIONAL,
    "reference_in_force": Role((Access.READING,), units=("Hz", "%"), needed=False),
    **dict.fromkeys(PROOFS, OPTIONAL),
}


def own_errors(
    name: str, register: Register[Any], roles: Mapping[str, Role], taken: Collection[str]
) -> Iterator[str]:
    """Yield the errors in one register of a family; `taken` are the reserved names."""
    if name in roles:
        yield from role_errors(name, roles[name], register)
    elif name in taken:
        yield f"{name}: reserved name: every profile has an attribute with this name; rename the register"
    elif register.harmless:
        yield f"{name}: remove harmless: only control has harmless counts, and the profile states them"
    if name == "reference" and (register.span or register.coding.raw_span)[0] < 0:
        yield f"{name}: a reference below 0 may turn the motor the other way: its span must begin at 0"
    if name == "reference" and ((register.step or 0) < 0 or register.offset):
        yield f"{name}: a greater count must mean more: its step must be above 0, and it has no offset"
    if name == "output_frequency" and (register.part or register.offset or register.scale_register):
        yield f"{name}: it is 0 only at rest, so it cannot have a part, offset or scale_register"
    if name == "fault":
        yield from code_errors(register)


def code_errors(register: Register[Any]) -> Iterator[str]:
    """Yield an error unless this register is a code, such as a fault's: only count 0 has value 0."""
    if register.step not in (1, None) or register.offset or register.scale_register:
        yield f"{register.name}: it is a code, so it cannot have a step, offset or scale_register"


def errors_together(roles: Mapping[str, Role], found: Mapping[str, Any]) -> Iterator[str]:
    """Yield an error for each role that is missing or does not fit another role."""
    for name, role in roles.items():
        if role.needed and not isinstance(found[name], Register):
            yield f"{name}: this profile needs a register of this name, which is not declared"
    reference, shown = found.get("reference"), found.get("reference_in_force")
    if reference is not None and shown is not None and reference.unit != shown.unit:
        yield f"reference_in_force: its unit is not that of reference, {reference.unit!r}"
    signature = found.get("signature")
    if signature is not None and signature.values is None:
        yield "signature: it needs names for the values that identify the family"


def role_errors(name: str, role: Role, register: Register[Any]) -> Iterator[str]:
    """Yield an error for each attribute of a profile's register that the family must omit or change."""
    if register.access not in role.access:
        wanted = " or a ".join(access.value for access in role.access)
        yield f"{name}: in this profile it is a {wanted}, not a {register.access.value}"
    for fact in ("harmless", "never_together", "moves", "never"):
        if getattr(register, fact) not in (None, (), ""):
            yield f"{name}: {fact} is {_BY_PROFILE}"
    if role.is_word:
        yield from _word_errors(name, role, register)
    elif role.units and register.unit not in role.units:
        units = " or ".join(repr(unit) for unit in role.units)
        yield f"{name}: its unit is {register.unit!r}; this profile takes {units}"
    if role.units and register.step is None:
        yield f"{name}: its step must be stated, because the profile computes with it"
    if register.broadcast and role.harmless is not None and not {*register.broadcast} <= {*role.harmless}:
        yield f"{name}: broadcast has counts that are not harmless in this profile"


def _word_errors(name: str, role: Role, register: Register[Any]) -> Iterator[str]:
    is_plain = register.number_format is NumberFormat.U16 and register.step == 1 and not register.unit
    if not is_plain or register.table.carrier is not Carrier.WORD:
        yield f"{name}: it is one word of bits, so it cannot have a unit or a step"
    for fact in ("offset", "part", "invalid", "scale_register"):
        if getattr(register, fact, None):
            yield f"{name}: it is a whole word, so it cannot have {fact}"
    if register.values is None:
        return
    known = ", ".join(role.extra)
    if role.renumbered:
        yield from _renumbering_errors(name, role, register.values)
    elif not role.extra:
        yield f"{name}: values is {_BY_PROFILE}"
    elif unknown := [member.name for member in register.values if member.name.lower() not in role.extra]:
        yield f"{name}: bits may only add {known}, not {', '.join(unknown)}"
    else:
        yield from _extra_errors(name, role, register.values)


def _extra_errors(name: str, role: Role, extra: type[Any]) -> Iterator[str]:
    assert role.values is not None
    taken = {int(member): member.name for member in role.values}
    for member in extra:
        if int(member).bit_count() != 1:
            yield f"{name}: {member.name} is not one bit"
        elif int(member) in taken:
            yield f"{name}: bit {int(member).bit_length() - 1} is {taken[int(member)]} in this profile"


def _renumbering_errors(name: str, role: Role, values: type[Any]) -> Iterator[str]:
    """Yield the errors in a family's own raw counts of control words such as `stop`."""
    assert role.values is not None
    known = [str(member.name).lower() for member in role.values]
    names = [name.lower() for name in values.__members__]
    if not issubclass(values, IntEnum):
        yield f"{name}: its words are whole numbers, so write values and not bits"
    elif unknown := [one for one in names if one not in known]:
        yield f"{name}: {', '.join(unknown)} is not a word of this profile; it has {', '.join(known)}"
    elif missing := [one for one in role.renumbered if one not in names]:
        yield f"{name}: the number of {', '.join(missing)} is missing"
    elif len(values) < len(names):
        yield f"{name}: two of its words have the same number"
    elif {"jog_forward", "jog_reverse"} & {*names} and "stop_jog" not in names:
        yield f"{name}: a jog needs a number for stop_jog; add it, or remove the jogs"


def completed(role: Role, register: Register[Any]) -> Register[Any]:
    """Return the family's register, completed with the attributes that the profile sets."""
    facts: dict[str, Any] = {"moves": role.moves}
    harmless = role.harmless
    if role.renumbered and register.values is not None:
        numbers = {name.upper(): int(member) for name, member in register.values.__members__.items()}
        facts["values"] = _enumeration(IntEnum, register.name, numbers)
        safe = [member.name for member in cast(Any, role.values) if member in (harmless or ())]
        harmless = tuple(numbers[name] for name in safe if name in numbers)
    elif role.values is not None:
        facts["values"] = _with_extra(role.values, register.values)
    if harmless is not None:
        facts["harmless"] = harmless
        facts["never_together"] = role.never_together
    return replace(register, **facts)


def _with_extra(values: type[IntEnum | IntFlag], extra: type[Any] | None) -> type[Any]:
    if extra is None:
        return values
    members = {str(member.name): int(member) for one in (values, extra) for member in one}
    return _enumeration(IntFlag, values.__name__, {name.upper(): bits for name, bits in members.items()})


def _enumeration(kind: Any, name: str, members: dict[str, int]) -> type[Any]:
    return cast(type[Any], kind(name, members))


# seconds allowed for a stop by default, because profiles have no register for the deceleration time
STOP_TIME = 60.0
UNUSED = (0, 0xFFFF)  # values of an unused register, or of a gateway whose drive is absent
RESET_TIME = 2.0  # seconds within which the status must no longer show a fault after its reset


class Profile(Drive):
    """Base class of the profiles. A family is a subclass of a profile that declares the profile's registers.

    The verbs use registers with fixed names, called roles. The family declares a register's address, table,
    unit, step, memory and place in the manual. The profile declares its bits, and which of its counts are
    harmless. Every profile has these:

    - `control` (a command), `status` (a reading), `reference` (a setting, or a command if it cannot be
      read), in Hz, or in % of the option `maximum_frequency`; `output_frequency` (a reading);
    - `fault` (an optional reading): the fault code, shown by name if it has names;
    - `reference_in_force` (an optional reading): the setpoint that the drive shows;
    - `station` (an optional reading): the drive's own address;
    - `signature` (an optional reading of named values): the value of every drive of the family has a name.

    The verbs guarantee the same as those of the built-in families. A stop is always sent, repeated until it
    is confirmed, and observed until the drive is at rest. A start or a reset is written once. A start is
    refused in a fault, in local control, without a setpoint in force, and while the status is impossible in
    this profile. A reset is refused while the motor turns, never has a bit that runs it, and comes after a
    stop. `identify` only reads. A stop is refused only if the status is impossible in this profile and
    neither 0 nor FFFFH, and another check fails too. A wrong `station` or `signature` alone does not prove
    another family: these are settings, and may not be in force yet.
    """

    roles: ClassVar[Mapping[str, Role]] = {}
    stop_word: ClassVar[int]
    coast_word: ClassVar[int | None] = None
    reset_word: ClassVar[int]
    reset_role: ClassVar[str] = "control"
    # bits of the status of which at least one is set: in a fault, and while the motor has voltage
    trip_bits: ClassVar[int]
    running_bits: ClassVar[int]
    # for a start, at least one bit of each entry must be set in the status; else its text says why not
    needed_bits: ClassVar[tuple[tuple[int, str], ...]] = ()

    setpoint_name = "reference"
    options = {
        "maximum_frequency": Option("Hz", (1, 3000), "the frequency that is 100 % of the reference"),
        "stop_time": Option("s", (1, 3600), "longest time that a stop may take; 60 without it"),
    }

    control: ClassVar[Register[Any]]
    status: ClassVar[Register[Any]]
    reference: ClassVar[Register[float]]
    output_frequency: ClassVar[Register[float]]

    def __init_subclass__(cls) -> None:
        """Complete the registers that are listed in `roles`. Raises DeclarationError with all mistakes."""
        own = {name: register for name, register in vars(cls).items() if isinstance(register, Register)}
        if own and (wrong := cls.role_mistakes(own)):
            raise DeclarationError(cls.__name__, wrong)
        for name, register in own.items():
            if name in cls.roles:
                whole = completed(cls.roles[name], register)
                whole.__set_name__(cls, name)
                setattr(cls, name, whole)
        cls.options = {**Profile.options, **cls.options}
        super().__init_subclass__()

    @classmethod
    def role_mistakes(cls, own: Mapping[str, Register[Any]]) -> list[str]:
        """Return a sentence for each mistake in a family's registers, also in those of the profile."""
        taken = {*dir(Profile), *Profile.__annotations__} - {*dir(Drive)}
        found = {name: own.get(name, getattr(cls, name, None)) for name in cls.roles}
        singly = (own_errors(name, one, cls.roles, taken) for name, one in own.items())
        return [*chain.from_iterable(singly), *errors_together(cls.roles, found)]

    @classmethod
    def readings(cls) -> tuple[Register[Any], ...]:
        """Return the registers that are polled by default: all readings except proofs of the identity."""
        return tuple(one for one in super().readings() if one.name not in PROOFS)

    @property
    def identity_is_weak(self) -> bool:
        """True if the family has neither a register `signature` nor a section [[identify]].

        Without them, only the status and the drive's own address are checked, which may match by chance.
        """
        return "signature" not in self.registers and not self.identity_proofs

    # ---- overridden by profiles ----

    def _impossible(self, status: int) -> str:
        """Return why a drive of this profile cannot have this status; "" if it can."""
        return ""

    def _turns(self, status: int) -> bool:
        """Return True if the status shows that the motor has voltage."""
        return bool(status & self.running_bits)

    def _not_ready(self, status: int) -> str:
        """Return why the drive cannot be started from the line; "" if it can be."""
        return next((why for bits, why in self.needed_bits if not status & bits), "")

    def _cannot_reset(self, status: int) -> str:
        """Return why a reset would have no effect or do harm; "" if it may be sent."""
        return ""

    def _direction(self, status: int) -> Direction | None:
        """Return the direction that the status shows; None if it does not show one."""
        return None

    def _reverses(self, direction: Direction | None, status: int) -> bool:
        """Return True for a start or jog in reverse. With None, a turning motor keeps its direction."""
        if direction is None:
            return self._turns(status) and self._direction(status) is Direction.REVERSE
        return direction is Direction.REVERSE

    def _start_word(self, direction: Direction | None, status: int) -> int:
        raise NotImplementedError

    def _prepare(self, status: int) -> Script[None]:
        """Override this if other writes must precede the start word. They must not move the motor."""
        yield from ()

    def _condition(self, status: int) -> Condition:
        """Return the condition of a drive without a fault, from its status."""
        return Condition.RUNNING if self._turns(status) else Condition.STOPPED

    # ---- state ----

    def _status(self) -> Script[int]:
        return int((yield from read(self.status)))

    def _fault(self) -> Script[str]:
        """Return the fault as text; "" if the family has no register for it."""
        register = self.registers.get("fault")
        return "" if register is None else register.format((yield from read(register)))

    def _tripped(self, status: int) -> Script[bool]:
        """Return True if the drive has a fault; by default, the status shows this."""
        return bool(status & self.trip_bits)
        yield

    def _is_at_rest(self) -> Script[bool]:
        """Return True if neither the status nor the output frequency shows that the motor turns."""
        status = yield from self._status()
        if self._turns(status) and not (yield from self._tripped(status)):
            return False
        return (yield from read(self.output_frequency)) == 0

    def _setpoint_in_force(self) -> Script[None]:
        """Raise WriteForbidden unless the drive shows the setpoint that was written, and it is not 0."""
        yield from super()._setpoint_in_force()
        shown = self.registers.get("reference_in_force")
        if shown is None:
            return
        held = yield from read(shown)
        if held == 0:
            problem = f"the setpoint of {self.name} is 0:"
        elif held != self.commanded and not self.reference.readable:
            problem = f"{self.name} follows {shown.format(held)} instead of the written setpoint:"
        else:
            return
        way = Advice.call("set_frequency")
        raise WriteForbidden(f"{problem} call set_frequency before start", advice=way)

    # ---- verbs ----

    @verb
    def identify(self) -> Script[None]:
        """Check that the status, and the registers that identify the family, have the expected values.

        `station` is the drive's address; `signature` and the proofs of [[identify]] are those of the family.
        """
        wrong: list[str] = []
        status = yield from self._status()
        if impossible := self._impossible(status):
            wrong.append(f"its status is {status:04X}H, and {impossible}")
        station = self.registers.get("station")
        if station is not None and (address := int((yield from read(station)))) != self.address:
            wrong.append(f"it reports address {address}")
        signature = self.registers.get("signature")
        if signature is not None:
            assert signature.values is not None
            held = yield from read(signature)
            if not isinstance(held, signature.values):
                names = ", ".join(value.name for value in signature.values)
                wrong.append(f"{signature.name} is {held:g}, not one of {names}")
        for proof in self.identity_proofs:
            register = self.register(proof.register)
            value = yield from read(register)
            if not proof.holds(value):
                wrong.append(f"{register.name} is {register.format(value)}")
        if wrong:
            kind = self.title or type(self).__name__
            rule = ANOTHER_FAMILY if impossible and status not in UNUSED and len(wrong) > 1 else ""
            raise WriteForbidden(f"{self.name} is not recognised as {kind}: {'; '.join(wrong)}", rule=rule)

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start at the setpoint in force.

        Without a direction, a turning motor keeps its direction, and a resting motor turns forward.
        """
        status = yield from self._status()
        yield from self._check_start(status)
        word = self._start_word(direction, status)
        yield from self._setpoint_in_force()
        if not self._turns(status):
            yield from self._prepare(status)
        yield from write(self.control, self._word(word))
        yield from self._started(direction)

    def _check_start(self, status: int) -> Script[None]:
        """Raise WriteForbidden in a fault, in local control, or if the status prevents a start."""
        if (yield from self._tripped(status)):
            raise self._reset_first((yield from self._fault()))
        if impossible := self._impossible(status):
            raise WriteForbidden(
                f"{self.name} cannot be started: its status is {status:04X}H, and {impossible}"
            )
        if why := self._not_ready(status):
            raise WriteForbidden(f"{self.name} is not started: the drive {why}; {self.remote}")

    def _jog_word(self, direction: Direction | None, forward: int, reverse: int) -> Script[Any]:
        """Return the control word of a jog. Raises WriteForbidden as `start` does, and if the motor turns."""
        status = yield from self._status()
        yield from self._check_start(status)
        if self._turns(status):  # the manuals do not define a jog while the motor turns
            raise self._stop_first(f"{self.name} already turns, and a jog must start from rest")
        return self._word(reverse if self._reverses(direction, status) else forward)

    def _word(self, count: int, role: str = "control") -> Any:
        """Return the named value of a raw count; `role` is the name of the register."""
        values = self.register(role).values
        assert values is not None
        return values(count)

    @verb
    def stop(self) -> Script[None]:
        """Stop along the ramp; wait until the status shows a stop and the output frequency is 0."""
        yield from self._stop_by(self.stop_word)

    @verb
    def coast(self) -> Script[None]:
        """Remove the voltage and let the motor coast."""
        if self.coast_word is None:
            raise self._unsupported("coast command")
        yield from self._stop_by(self.coast_word)

    def _stop_by(self, word: int) -> Script[None]:
        yield from self._send_stop(word)
        yield from self._watch_stop()

    def _send_stop(self, word: int) -> Script[None]:
        try:
            yield from insist(self.control, self._word(word))
        except DriveException:  # some drives refuse this word in a fault, when they are already at rest
            if not (yield from self._is_at_rest()):
                raise

    def _watch_stop(self) -> Script[None]:
        yield from self._stopped(self._is_at_rest, self.option.get("stop_time", STOP_TIME))

    @verb
    def reset_fault(self) -> Script[None]:
        """Reset a fault after a stop; never starts the motor. The reset is sent once, then verified."""
        status = yield from self._status()
        if not (yield from self._tripped(status)):
            if not (yield from self._is_at_rest()):
                raise WriteForbidden(f"{self.name} runs: it has no fault to reset")
            return
        if why := self._cannot_reset(status):
            raise WriteForbidden(f"{self.name} is not reset: the drive {why}")
        yield from insist(self.control, self._word(self.stop_word))  # ends a run that was commanded earlier
        yield from self._pulse()
        if not (yield from until(self._is_reset, limit=RESET_TIME)):
            fault = (yield from self._fault()) or "it shows a fault"
            raise NotVerified(self.name, "the fault reset", f"the fault remains: {fault}")

    def _pulse(self) -> Script[None]:
        """Write the reset word once, then clear its bit, so that it cannot reset a later fault."""
        register: Register[Any] = self.register(self.reset_role)
        try:
            yield from write(register, self._word(self.reset_word, self.reset_role))
        except (Unconfirmed, DriveException):
            yield from self._take_reset_back()
            raise
        yield from self._take_reset_back()

    def _take_reset_back(self) -> Script[None]:
        yield from insist(self.control, self._word(self.stop_word))

    def _is_reset(self) -> Script[bool]:
        return not (yield from self._tripped((yield from self._status())))

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the setpoint in Hz, or converted to a percentage of `maximum_frequency`."""
        most = self.option.get("maximum_frequency")
        if self.reference.unit == "%" and most is None:
            raise WriteForbidden(
                f"{self.name} takes its setpoint in percent: declare maximum_frequency = HZ, which is 100 %",
                advice=Advice.declare("maximum_frequency", "HZ"),
            )
        if hz < 0 or (most is not None and hz > most):
            span = "below 0 Hz" if most is None or hz < 0 else f"above {most:g} Hz, its maximum_frequency"
            raise ValueError(f"{hz:g} Hz is {span}: nothing is written to {self.name}")
        value = hz / most * 100 if self.reference.unit == "%" and most is not None else hz
        yield from self._write_setpoint(self.reference, value)

    @verb
    def state(self) -> Script[State]:
        """Return the condition, the direction if it is shown, and the fault by name."""
        status = yield from self._status()
        direction = self._direction(status)
        if (yield from self._tripped(status)):
            return State(Condition.FAULT, fault=(yield from self._fault()) or "it shows a fault")
        condition = self._condition(status)
        if condition is Condition.STOPPED and (yield from read(self.output_frequency)) != 0:
            return State(Condition.DECELERATING, direction)
        if condition is Condition.STOPPED:
            return State(condition, note=self._not_ready(status))
        return State(condition, direction)
