"""Bus: a line with its drives; reads, writes, broadcasts, and the verbs of the drives on it."""

from __future__ import annotations

from collections.abc import Iterable
from types import TracebackType
from typing import Any, TypeVar, cast

from multidrop import core
from multidrop.core import Completion, Exchange, Message, Respondent, Result, raw_value
from multidrop.drive import Drive, Read, Script, Step, Wait
from multidrop.errors import BadReply, BusError, DriveRefused, NoReply, Refused, Unconfirmed
from multidrop.line import Line, now_ns, sleep
from multidrop.plan import Block, blocks, write_request
from multidrop.register import Kept, Register

D = TypeVar("D", bound=Drive)
T = TypeVar("T", bound=float)

READ_ATTEMPTS = 3
LEAST_TIMEOUT = 0.02  # s: what a host and its adapter may add to a drive's own delay


def exchange(
    drive: Drive, request: Message, respondent: Respondent, block: core.Block | None = None
) -> Exchange:
    """What the core needs to carry out a request to this drive."""
    settings = drive.settings
    return Exchange(
        drive.framing,
        request,
        respondent,
        baudrate=settings.baudrate,
        format=settings.format,
        character=settings.character,
        # One bit more: the other side may still be sending its second stop bit.
        silence=drive.needed_silence() + settings.bit,
        turnaround=drive.turnaround_delay,
        block=block,
    )


class Bus:
    """A line and the drives on it, which may differ in family, baud rate and format.

    `port` is a device such as /dev/ttyUSB0 or any pyserial URL; `baudrate` and `format` replace the
    families' defaults for drives that are attached without their own. Raises LineError when the
    port cannot be opened. Leaving the `with` block closes the port and sends nothing.
    """

    def __init__(self, port: str, *, baudrate: int | None = None, format: str | None = None) -> None:
        self.baudrate = baudrate
        self.format = format
        self.drives: list[Drive] = []
        self.line = Line(port)
        self._respondents: dict[Drive, Respondent] = {}

    def __enter__(self) -> Bus:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        self.line.close()

    def attach(self, drive: D | type[D], address: int | None = None, **details: Any) -> D:
        """Put a drive on the bus: a family with address, name and so on, or a drive made before.

        Nothing is sent. Raises ValueError for what the family does not allow, or an address taken.
        """
        if isinstance(drive, type):
            if address is None:
                raise TypeError(f"attach({drive.__name__}, address=...): which address does it have?")
            details = {"baudrate": self.baudrate, "format": self.format, **details}
            drive = drive(address, **details)
        for other in self.drives:
            if other.address == drive.address:
                raise ValueError(f"address {drive.address} is taken by {other.name}")
        drive.perform = lambda script: self.perform(drive, script)
        self._respondents[drive] = Respondent(
            least_timeout=min(drive.response_timeout, max(LEAST_TIMEOUT, 4 * drive.response_delay)),
            most_timeout=drive.response_timeout,
        )
        self.drives.append(drive)
        return drive

    # ---- reading ----

    def read(self, drive: Drive, register: Register[T]) -> T:
        """The register's value in engineering units.

        Raises NoReply, BadReply, DriveRefused or LineError; ValueError if it cannot be read.
        """
        return cast(T, self.read_many(drive, [register])[register.name])

    def read_many(self, drive: Drive, registers: Iterable[Register[Any]]) -> dict[str, Any]:
        """Values by register name, in as few exchanges as the family allows; raises as `read` does."""
        registers = list(registers)
        raw: dict[str, Any] = {}
        for block in blocks(drive, registers):
            reply = self._ask(drive, block)
            for register in block.registers:
                raw[register.name] = register.decode(
                    raw_value(reply.data, block.offset(register), register.wire)
                )
        return {register.name: raw[register.name] for register in registers}

    def _ask(self, drive: Drive, block: Block) -> Message:
        for attempt in range(READ_ATTEMPTS):
            try:
                return self._reply(drive, self._carry_out(drive, block.request(drive.address)))
            except (NoReply, BadReply):
                if attempt == READ_ATTEMPTS - 1:
                    raise
        raise AssertionError("unreachable")

    # ---- writing ----

    def write(self, drive: Drive, register: Register[T], value: T) -> T:
        """Write a value and return what the drive then holds, where that can be read, else `value`.

        Sent once. A register kept in EEPROM is not written when it holds the value already.
        Raises ValueError or TypeError for a value that the register does not take, Refused for what
        the library never sends, DriveRefused when the drive says no, and Unconfirmed when its
        answer is lost and the write may have happened.
        """
        raw = self._checked(drive, register, value)
        if register.kept is Kept.EEPROM and register.ram_address is None and register.readable:
            held = self.read(drive, register)
            if held == register.decode(raw):
                return held
        what = f"{register.name} = {register.format(register.decode(raw))}"
        completion = self._carry_out(drive, write_request(drive, register, raw))
        try:
            self._reply(drive, completion)
        except (NoReply, BadReply) as failure:
            raise Unconfirmed(drive.name, what, _why(failure)) from failure
        if not register.readable:
            return value
        try:
            return self.read(drive, register)
        except (NoReply, BadReply) as failure:
            raise Unconfirmed(
                drive.name, what, f"it was confirmed, but not read back: {failure}"
            ) from failure

    def broadcast(self, register: Register[T], value: T) -> None:
        """Write to every drive on the line at once; nobody answers, so look at each one afterwards.

        Refused unless all drives on the line are of one family, share their settings and framing,
        and its document has this broadcast, because the same address means different things to
        different families. Raises Refused.
        """
        kinds = {(type(drive), drive.settings, drive.framing) for drive in self.drives}
        if len(kinds) != 1:
            raise Refused(
                f"{register.name} cannot be broadcast: the drives on this line differ in family or settings, "
                "and the same address means different things to them; write to one after another"
            )
        drive = self.drives[0]
        raw = self._checked(drive, register, value)
        if raw not in register.broadcast:
            raise Refused(f"{drive.title} has no harmless broadcast of {register.name} = {value}")
        self._carry_out(drive, write_request(drive, register, raw, address=0))

    def _checked(self, drive: Drive, register: Register[T], value: T) -> int:
        if register.never:
            raise Refused(f"{register.name} of {drive.name} is never written: {register.never}")
        if not register.writable:
            raise Refused(
                f"{register.name} of {drive.name} cannot be written: it is a {register.access.value}"
            )
        return register.encode(value)

    # ---- verbs ----

    def perform(self, drive: Drive, script: Script[Any]) -> Any:
        """Carry out a verb's steps; the drive's verbs call this."""
        try:
            step = next(script)
            while True:
                try:
                    result = self._step(drive, step)
                except (BusError, ValueError) as failure:
                    step = script.throw(failure)
                else:
                    step = script.send(result)
        except StopIteration as end:
            return end.value

    def _step(self, drive: Drive, step: Step) -> Any:
        if isinstance(step, Wait):
            return sleep(step.seconds)
        if isinstance(step, Read):
            return self.read(drive, step.register)
        return self.write(drive, step.register, step.value)

    # ---- exchanges ----

    def _carry_out(self, drive: Drive, request: Message) -> Completion:
        """One exchange, ahead of any polling; first an answer that may still come late is waited for."""
        made = exchange(drive, request, self.respondent(drive))
        while True:
            late_until_ns = made.respondent.late_until_ns
            completion = self.line.carry_out(made)
            if completion.result != Result.LATE_ANSWER_DUE:
                return completion
            sleep(max(0, late_until_ns - now_ns()) / 1e9)

    def respondent(self, drive: Drive) -> Respondent:
        """What is known of how this drive answers."""
        return self._respondents[drive]

    def _reply(self, drive: Drive, completion: Completion) -> Message:
        if completion.result == Result.NO_REPLY:
            raise NoReply(drive.name)
        if completion.result <= 0:
            raise BadReply(drive.name, str(Result(completion.result)), completion.raw)
        if completion.reply.exception:
            code = completion.reply.exception
            raise DriveRefused(drive.name, code, drive.exception(code))
        return completion.reply


def _why(failure: BusError) -> str:
    return failure.reason if isinstance(failure, BadReply) else "no reply"
