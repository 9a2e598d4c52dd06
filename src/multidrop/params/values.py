"""Read parameter sets from a drive or its family's manual, and compare them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from multidrop.core import Framing
from multidrop.drive.family import Drive
from multidrop.drive.parameters import Parameter, parameters_of
from multidrop.errors import DriveException, NoReply, NotAttached, NoValue, Unsupported
from multidrop.planning.blocks import Block, blocks, halves
from multidrop.printable import format_time
from multidrop.transport import clock

ILLEGAL_FUNCTION = 1  # exception code: the drive does not support the function of this read
GROUP_END = 10  # after this many unanswered reads in a row, a parameter group is assumed to end
READ_EXPIRY = 60.0  # time limit, in s, for a read to wait until a polled line is free
ATTEMPTS = 3

Progress = Callable[[int, int], None]  # called with the number of parameters done, and the total


@dataclass(frozen=True)
class ParameterSet:
    """Parameter values as raw counts by code, such as {"P00.03": 5000}.

    `source` is the drive's name or the file's path. `saved` is the time of reading, UTC in ISO 8601.
    `firmware` is the drive's raw version. `model`, `saved` and `firmware` are "" if unknown.
    """

    model: str
    values: Mapping[str, int]
    source: str = ""
    title: str = ""
    firmware: str = ""
    saved: str = ""


class Difference(NamedTuple):
    """A parameter that differs between two sets: both raw counts (None if a set lacks it) and their texts."""

    code: str
    name: str  # name of the declared register, or ""
    first: int | None
    second: int | None
    first_text: str
    second_text: str


def parameter_of(family: Any, code: str) -> Parameter:
    """Return the family's parameter with this code. Raises ValueError if there is none."""
    known = parameters_of(family)
    if code not in known:
        first = next(iter(known))
        raise ValueError(
            f"{family.model or family.__name__} has no parameter {code}; its first parameter is {first}"
        )
    return known[code]


def text_of(family: Any, code: str, raw: int | None) -> str:
    """Return a raw count as text, with the unit if the parameter is declared; "-" for None."""
    if raw is None:
        return "-"
    try:
        return parameters_of(family)[code].text(raw)
    except (KeyError, Unsupported, AttributeError):  # the model or the code is unknown
        return str(raw)


# ---- reading ----


def read(
    drive: Drive, codes: Iterable[str] | None = None, *, progress: Progress | None = None
) -> ParameterSet:
    """Return all parameters of a drive, or those in `codes`, without those that the drive does not have.

    Monitor values in `codes` are left out too. Parameters are read in blocks; a refused block is split.

    Raises Unsupported if the family has no rule for parameter addresses, ValueError for an unknown code, and
    WriteForbidden if the drive is of another family. If a read fails, raises NoReply, BadReply,
    DriveException or LineError.
    """
    family: Any = type(drive)
    if drive.bus is None:
        raise NotAttached(f"{drive.name} is not attached to a bus: use bus.attach(...)")
    known, space = parameters_of(family), family.parameter_space
    wanted = [
        parameter_of(family, code)
        for code in (known if codes is None else codes)
        if not space.is_monitor(code)
    ]
    drive.bus.check_identity(drive)
    reader = _Reader(drive, len(wanted), progress)
    reader.read(wanted)
    order = {code: at for at, code in enumerate(known)}
    values = {code: reader.values[code] for code in sorted(reader.values, key=order.__getitem__)}
    firmware = space.firmware
    return ParameterSet(
        drive.model,
        values,
        source=drive.name,
        title=drive.title,
        firmware=f"{drive.read(firmware):g}" if firmware else "",
        saved=format_time(clock.utc_ns())[:19] + "Z",
    )


@dataclass
class _Reader:
    """Reads a drive's parameters in blocks.

    It finds out which parameters the drive does not have, and how many it returns in one read.
    """

    drive: Drive
    total: int
    progress: Progress | None
    values: dict[str, int] = field(default_factory=dict)
    most: int = 0  # limit of a block's length, learned from refused blocks; 0: no limit is known
    done: int = 0
    silent: int = 0  # number of reads in a row that were not answered
    group: str = ""  # parameter group of the last parameter that was read

    def read(self, wanted: Sequence[Parameter]) -> None:
        found = sorted(blocks(self.drive, wanted), key=lambda block: block.start)
        for block in found:
            self._read(block)

    def _read(self, block: Block) -> bool:
        """Read a block, in halves if it is refused. Return True if the drive has all parameters in it."""
        kept = self._without_group_end(block)
        if kept is None:
            return False
        block = kept
        parts = halves(self.drive, block) if self.most and block.count > self.most else ()
        if parts:
            return self._read_all(parts)
        try:
            raws = self._ask(block)
        except DriveException as refusal:
            if refusal.code == ILLEGAL_FUNCTION or self.drive.is_temporary(refusal.code):
                raise
        except NoReply:
            self._check_answers()  # raises an error unless the drive answers other reads
            self.silent += 1
        else:
            self._note(block.registers, raws)
            return True
        parts = halves(self.drive, block)
        if not parts:
            self._note(block.registers, [None])
            return False
        is_whole = self._read_all(parts)
        if is_whole:  # all parts were answered, so the drive refused only the block's length
            self.most = max(part.count for part in parts)
        return is_whole

    def _read_all(self, parts: Sequence[Block]) -> bool:
        # a list, so that all parts are read even if one is refused
        answered = [self._read(part) for part in parts]
        return all(answered)

    def _without_group_end(self, block: Block) -> Block | None:
        """Return the parameters of the block that are still to be read; None if there are none.

        After GROUP_END unanswered reads in a group, only the group's declared parameters are read.
        """
        kept: list[Parameter] = []
        for parameter in block.registers:
            assert isinstance(parameter, Parameter)
            group = parameter.code[:-2]
            if group != self.group:
                self.group, self.silent = group, 0
            if self.silent < GROUP_END or parameter.is_declared:
                kept.append(parameter)
            else:
                self._count()
        if len(kept) == len(block.registers):
            return block
        return Block.of(self.drive, kept) if kept else None

    def _ask(self, block: Block) -> list[int | None]:
        """Read a block; return its parameters' raw counts."""
        drive, table = self.drive, block.table
        if drive.framing is Framing.DELIXI or table.read is None:
            (parameter,) = block.registers
            assert isinstance(parameter, Parameter)
            plain = parameter.changed(values=None, step=1, offset=0, span=None, invalid=())
            try:
                return [int(drive.read(plain))]
            except NoValue:
                return [None]
        data = drive.link.read_raw(drive, table.read, block.start, block.count, READ_EXPIRY, ATTEMPTS)
        raws = [one.coding.raw_in(data, block.offset(one)) for one in block.registers]
        return [None if raw is None else int(raw) for raw in raws]

    def _note(self, parameters: Sequence[Any], raws: Sequence[int | None]) -> None:
        for parameter, raw in zip(parameters, raws, strict=True):
            self._count()
            if raw is not None:
                self.silent = 0
                self.values[parameter.code] = raw

    def _count(self) -> None:
        self.done += 1
        if self.progress:
            self.progress(self.done, self.total)

    def _check_answers(self) -> None:
        """Raise NoReply if the drive does not answer a read of a register that it has."""
        readable = (one for one in self.drive.registers.values() if one.readable)
        probe = self.drive.echo_probe or next(readable, None)
        if probe is not None:
            self.drive.read(probe)


def rows(family: Any, held: ParameterSet | None = None) -> list[dict[str, Any]]:
    """Return a dict for each parameter of a set: texts to show, and the reason if it is never written.

    Without a set, return the family's declared parameters, with an empty "value" and no "raw".
    """
    known = parameters_of(family)
    if held is None:
        shown: dict[str, int | None] = {code: None for code, one in known.items() if one.is_declared}
    else:
        shown = {code: raw for code, raw in held.values.items() if code in known}
    found = []
    for code, raw in shown.items():
        one = known[code]
        row = {
            "code": code,
            "name": one.name if one.is_declared else "",
            "value": "" if raw is None else one.text(raw),
            "factory": "" if one.default_raw is None else one.text(one.default_raw),
            "not_written": one.never,
        }
        found.append(row if raw is None else row | {"raw": raw})
    return found


# ---- comparing ----


def defaults(drive: Drive | type[Drive]) -> ParameterSet:
    """Return the factory values printed in the family's manual. Raises Unsupported if it prints none."""
    family: Any = drive if isinstance(drive, type) else type(drive)
    raws = {code: one.default_raw for code, one in parameters_of(family).items()}
    known = {code: raw for code, raw in raws.items() if raw is not None}
    if not known:
        raise Unsupported(f"the manual of {family.title} prints no factory values")
    return ParameterSet(family.model, known, source="factory values", title=family.title)


def compare(first: ParameterSet, second: ParameterSet, family: Any = None) -> list[Difference]:
    """Return the parameters that differ between two sets, in the order of `first`.

    With `family`, a drive class, names and units are filled in. Raises ValueError if the models differ.
    """
    check_same_model(first, second)
    known = {} if family is None else parameters_of(family)
    space = None if family is None else family.parameter_space
    found: list[Difference] = []
    for code in dict.fromkeys((*first.values, *second.values)):
        one, other = first.values.get(code), second.values.get(code)
        if one == other or (space and space.is_monitor(code)):
            continue
        name = known[code].name if code in known and known[code].is_declared else ""
        found.append(
            Difference(code, name, one, other, text_of(family, code, one), text_of(family, code, other))
        )
    return found


def check_same_model(first: ParameterSet, second: ParameterSet) -> None:
    """Raise ValueError if both sets state a model and the models differ."""
    if first.model and second.model and first.model != second.model:
        raise ValueError(
            f"{first.source} has parameters of {first.model}, and {second.source} of {second.model}: they "
            "cannot be compared"
        )
