"""Drive: the base of all families: registers, and the verbs that command the motor.

A family is a subclass that declares registers. Its verbs are scripts; a verb of a drive that is attached
to a bus is carried out there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from multidrop.core import Framing
from multidrop.drive.declaration_check import DeclarationError, declaration_errors
from multidrop.drive.fact_check import fact_errors
from multidrop.drive.known_setpoint import KnownSetpoint
from multidrop.drive.manual_facts import ManualFacts
from multidrop.drive.options import Option, checked_options, confirmation, doubt
from multidrop.drive.read_limits import limit_errors
from multidrop.drive.register import Access, Register
from multidrop.drive.scale_check import scale_errors
from multidrop.drive.script import Script, read, until, write
from multidrop.drive.state import Condition, Direction, State
from multidrop.drive.text import Text, text_errors
from multidrop.drive.verbs import MOVING, CalledStop, UnattachedStop, verb, verb_errors
from multidrop.errors import Advice, NotAttached, NotVerified, Unconfirmed, Unsupported, WriteForbidden

START_TIME = 5.0  # s, after which a motor that was started must be seen to run
REVERSAL_TIME = 60.0  # s, for the ramps of a motor that turned the other way, without the option `stop_time`
_SETPOINT_FIRST = Advice("call set_frequency before start", "add --frequency HZ")

_TURNING = (Condition.RUNNING, Condition.ACCELERATING, Condition.DECELERATING)


class Drive(ManualFacts):
    """One drive on a line; its class is the family, with the manual's tables in the manual's order.

    `address` is 1 to 247, or fewer in some families; on a tcp:// port it is a unit id, 0 to 255 where the
    family has all of them. Baud rate, format and framing default to the family's; on a tcp:// port
    the framing is TCP, and baud rate and format are those of the wire behind the gateway. `silence`, in s,
    takes the place of the standard's t3.5 where all drives on the line bear it; what the family's document
    demands is kept all the same. Options are facts that only the owner knows (see `options`); `ram` names
    registers that the owner knows to be kept in RAM although the document does not say so. Raises
    ValueError for anything the family's document does not allow.
    """

    bus: Any = None  # the one that it is attached to

    def __init_subclass__(cls) -> None:
        """Collect the registers. Raises DeclarationError with all that is wrong with the class."""
        super().__init_subclass__()
        found = cls._declared(Register)
        cls.registers = found
        cls.texts = cls._declared(Text)
        wrong = fact_errors(cls) + verb_errors(cls)
        options = cls.options = cls._all_options() if isinstance(cls.options, Mapping) else {}
        wrong += declaration_errors(found, TAKEN_NAMES, options) + text_errors(cls.texts, TAKEN_NAMES)
        if wrong := wrong or scale_errors(cls) or list(limit_errors(cls)):
            raise DeclarationError(cls.__name__, wrong)
        if not cls.formats:
            cls.formats = dict.fromkeys(cls.framings, ("8N1", "8E1", "8O1", "8N2"))

    @classmethod
    def _all_options(cls) -> Mapping[str, Option]:
        """Return the class's options, and `confirmed` where a command needs that: see `check_confirmed`."""
        commands = any(
            register.commands or register.access is Access.COMMAND for register in cls.registers.values()
        )
        verbs = any(getattr(cls, name) is not getattr(Drive, name) for name in MOVING)
        if not (commands or verbs):
            return cls.options
        return {**confirmation(cls.declared_in, identifies=cls._identifies()), **cls.options}

    @classmethod
    def _identifies(cls) -> bool:
        return cls.identify is not Drive.identify

    def check_confirmed(self, what: str) -> None:
        """Raise WriteForbidden for a drive that must be confirmed and is not.

        It must be where its class cannot identify its drives: the same address means different things to
        different makes, and may start their motor. It must be too where a file declares the class, which
        nobody has tested.
        """
        if "confirmed" not in self.options or self.option.get("confirmed"):
            return
        kind = self.title or type(self).__name__
        if why := doubt(kind, self.declared_in, identifies=self._identifies()):
            raise WriteForbidden(
                f"{what} is not sent to {self.name}: {why}, and declare confirmed = 1",
                rule="nobody has confirmed what it is",
                advice=Advice.declare("confirmed", 1),
            )

    def __init__(
        self,
        address: int,
        *,
        name: str | None = None,
        framing: Framing | str | None = None,
        baudrate: int | None = None,
        format: str | None = None,
        silence: float | None = None,
        ram: Iterable[str] = (),
        **options: float,
    ) -> None:
        if type(self) is Drive:
            raise TypeError("Drive is no family: take one, such as YD1000, or a class of yours that derives")
        super().__init__(address, framing, baudrate, format, silence)
        self.name = name or f"{self.model or type(self).__name__}@{address}"
        if not self.name.isprintable():  # a truncated line of a text recording must be recognised
            raise ValueError(f"the name {name!r} is not one line of printable characters")
        self.option = checked_options(self.title or type(self).__name__, self.options, options)
        self.ram = frozenset(self._in_ram(name) for name in ram)
        self._known_setpoint = KnownSetpoint()
        self.perform: Callable[[Script[Any]], Any] = self._perform_nowhere
        self.stops_called: Sequence[int] = (0,)  # its first item counts them
        # A call's permit, which a stop ends that is called after `seen` of them.
        self.begin_call: Callable[[str, int], Any] = lambda verb, seen: None
        self.carry_out_move: Callable[[Script[Any], Any], Any] = self._move_nowhere
        self.begin_stop: Callable[[str, Callable[[], Script[Any]], float | None], CalledStop] = (
            lambda verb, make, seconds: UnattachedStop(self, make)
        )

    def __repr__(self) -> str:
        where = f"on {self.bus.line.port}" if self.bus else "not attached"
        line = f"{self.framing}, {self.settings}"
        return f"<{type(self).__name__} {self.name!r}, address {self.address}, {line}, {where}>"

    @property
    def commanded(self) -> float | None:
        """The setpoint that was written last; None where it is not known that the drive holds it."""
        return self._known_setpoint.value

    @commanded.setter
    def commanded(self, held: float | None) -> None:
        self._known_setpoint.value = held

    def begin_setpoint(self) -> Callable[[], None]:
        """Know no setpoint until a write of it has ended; return what takes that back, as it was not sent."""
        return self._known_setpoint.begin_write()

    def _move_nowhere(self, script: Script[Any], call: Any) -> Any:
        return self.perform(script)

    def _perform_nowhere(self, script: Script[Any]) -> Any:
        raise NotAttached(f"{self.name} is not attached to a bus: use bus.attach(...)")

    # ---- verbs; each family replaces those that its document has ----

    def _unsupported(self, what: str) -> Unsupported:
        return Unsupported(f"{self.name}: the document of {self.title or type(self).__name__} has no {what}")

    def _stopped(self, look: Callable[[], Script[bool]], limit: float) -> Script[None]:
        """Wait until the drive is seen to have stopped; Unconfirmed after `limit` seconds."""
        if not (yield from until(look, limit=limit)):
            raise Unconfirmed(self.name, "the stop", f"after {limit:g} s it is not seen to have stopped")

    def _hold(self, register: Register[float], value: float) -> Script[None]:
        """Write the setpoint; NotVerified when the drive then holds another value."""
        held = yield from write(register, value)
        if held != register.decode(register.encode(value)):
            what = f"{register.name} = {register.format(value)}"
            raise NotVerified(self.name, what, f"the drive holds {register.format(held)}")

    def _setpoint_in_force(self) -> Script[None]:
        """Raise WriteForbidden unless the setpoint is known, not 0, and still the one that was written."""
        register = self.register(self.setpoint_name)
        held = (yield from read(register)) if register.readable else self.commanded
        if held is None:
            why = f"{self.name} cannot say its setpoint:"
        elif held == 0:
            why = f"the setpoint of {self.name} is 0:"
        elif self.commanded is not None and held != self.commanded:
            shown = f"{register.format(held)} and not {register.format(self.commanded)}"
            why = f"{self.name} holds {shown} as it was told: it may have lost its power;"
        else:
            return
        raise WriteForbidden(f"{why} call set_frequency before start", advice=_SETPOINT_FIRST)

    def _stop_first(self, why: str) -> WriteForbidden:
        return WriteForbidden(f"{self.name} {why} call stop() first", advice=Advice.call("stop"))

    def _reset_first(self, fault: str = "") -> WriteForbidden:
        shown = f"a fault, {fault}" if fault else "a fault"
        why = f"{self.name} has {shown}: see to it, then call reset_fault()"
        return WriteForbidden(why, advice=Advice.call("reset_fault"))

    def _started(self, direction: Direction | None = None) -> Script[None]:
        """Wait until the motor is seen to run, and in `direction` if the drive shows one.

        A motor that turned the other way has the time of its ramps for that. Raises NotVerified if the drive
        trips, Unconfirmed if it is not seen to run so.
        """
        if not (yield from until(self._runs, limit=START_TIME)):
            seen = f"after {START_TIME:g} s it is not seen to run; stop it, or it may start later"
            raise Unconfirmed(self.name, "the start", f"{seen}; {self.remote}")
        if direction is None:
            return
        limit = self.option.get("stop_time", REVERSAL_TIME) + START_TIME
        if not (yield from until(lambda: self._turns_in(direction), limit=limit)):
            way = "in reverse" if direction is Direction.REVERSE else "forward"
            seen = f"after {limit:g} s it is not seen to turn {way}; stop it, or it may later"
            raise Unconfirmed(self.name, f"the start {way}", seen)

    def _runs(self) -> Script[bool]:
        state = yield from self._without_trip()
        return state.condition in _TURNING

    def _turns_in(self, direction: Direction) -> Script[bool]:
        """Return True if the motor is seen to turn in this direction, or if the drive shows none."""
        state = yield from self._without_trip()
        if state.direction is None:
            return (yield from self._runs())
        return state.condition in _TURNING and state.direction is direction

    def _without_trip(self) -> Script[State]:
        state = yield from self.state.script()
        if state.condition is Condition.FAULT:
            raise NotVerified(self.name, "the start", f"it tripped: {state.fault or 'it shows a fault'}")
        return state

    @verb
    def identify(self) -> Script[None]:
        """Check by reading that this is a drive of the family; WriteForbidden when it is another.

        A drive that passes is not proven to be one: few families say who they are.
        """
        yield from ()

    def resembles(self) -> Script[bool]:
        """Return True where a drive that `identify` refuses reads like the family: enough for a guess."""
        yield from ()
        return False

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start the motor at the setpoint in force; without a direction, in the one in force."""
        raise self._unsupported("start command")
        yield

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor along its deceleration ramp."""
        raise self._unsupported("stop command")
        yield

    @verb
    def coast(self) -> Script[None]:
        """Take the voltage off and let the motor run out."""
        raise self._unsupported("coast command")
        yield

    @verb
    def emergency_stop(self) -> Script[None]:
        """Stop the motor as the drive's own emergency stop does."""
        raise self._unsupported("emergency stop")
        yield

    @verb
    def jog(self, direction: Direction | None = None) -> Script[None]:
        """Turn slowly until stopped."""
        raise self._unsupported("jog command")
        yield

    @verb
    def reset_fault(self) -> Script[None]:
        """Reset a fault; never starts the motor."""
        raise self._unsupported("fault reset")
        yield

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the frequency setpoint in Hz."""
        raise self._unsupported("frequency setpoint")
        yield

    @verb
    def release_control(self) -> Script[None]:
        """Give the command over the motor back to the drive's panel or terminals; at rest only."""
        raise self._unsupported("way to give the command back")
        yield

    @verb
    def state(self) -> Script[State]:
        """Report condition, direction and fault."""
        raise self._unsupported("state")
        yield


# Names that a register cannot have.
TAKEN_NAMES = frozenset(
    {*dir(Drive), *("address", "framing", "settings", "agreed_silence", "response_delay", "name")}
    | {"option", "ram", "perform"}
)
