"""The drives behind a responder, independent of the library: registers, and the writes that start motors.

All values are typed from the documents. A write that cancels a stop also counts as a write that moves the
motor.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

STANDARD, DELIXI = "standard", "Delixi's own"
COIL_ON = 0xFF00


class DriveRequest(NamedTuple):
    """A request; `value` is the number of registers to read, or the raw count to write."""

    address: int
    function: int
    start: int
    value: int


Judge = Callable[[DriveRequest], bool]


@dataclass(frozen=True)
class Kind:
    """A family: its registers at rest and while the motor turns, and the writes that start or stop it."""

    name: str
    moves: Judge
    stops: Judge
    memory: Mapping[int, int]  # raw counts by address, for all read functions
    turning: Mapping[int, int]  # replaces entries of `memory` while the motor turns
    # name of a register that no verb reads; tests read it to mark a place in the log
    mark: str
    protocol: str = STANDARD
    # keyword arguments with which a drive of this family is made
    makes: Mapping[str, Any] = field(default_factory=dict)
    halts: tuple[str, ...] = ("stop",)
    own_address: int | None = None  # address of the register that holds the drive's own address
    live: int = 3  # function code of the reads to which `turning` applies


def _writes(function: int, start: int, judge: Callable[[int], bool]) -> Judge:
    return lambda each: (each.function, each.start) == (function, start) and judge(each.value)


def _erman_moves(asked: DriveRequest) -> bool:
    """Return True if the write sets START, or clears STOP or EMERGENCY STOP (section 10, commands)."""
    start = (asked.start, asked.value) == (0, COIL_ON)
    return asked.function == 15 or (
        asked.function == 5 and (start or (asked.start in (1, 2) and asked.value == 0))
    )


def _erman_stops(asked: DriveRequest) -> bool:
    off = (asked.start, asked.value) == (0, 0)
    return asked.function == 5 and (off or (asked.start in (1, 2) and asked.value == COIL_ON))


KINDS = {
    each.name: each
    for each in (
        Kind(
            "erman-er-g-220",
            _erman_moves,
            _erman_stops,
            {2: 200, 3: 500, 4: 0, 0x0C: 10, 0x0D: 1},  # functions 03 and 04 have no address in common
            {0x0401: 1, 1: 200, 3: 15},
            "braking_threshold",
            halts=("stop", "emergency_stop"),
            live=4,
        ),
        Kind(
            "invt-che",
            _writes(6, 0x1000, lambda value: value in (1, 2, 3, 4)),
            _writes(6, 0x1000, lambda value: value in (5, 6)),
            {0x1001: 3, 0x2000: 4000, 0x3016: 0x0101},
            {0x1001: 1, 0x3000: 2000},
            "counter",
            makes={"maximum_frequency": 50, "stop_time": 2},
            halts=("stop", "coast"),
        ),
        Kind(
            "innovert-ibd",
            _writes(6, 0x2000, lambda value: bool(value & 2)),
            _writes(6, 0x2000, lambda value: value & 3 == 1),
            {22: 0x1800, 101: 5, 102: 2, 108: 1, 323: 1, 324: 7, 325: 8, 328: 3, 700: 1},
            {22: 0x1900, 3: 15, 4: 600},
            "stored_frequency",
            own_address=702,
        ),
        Kind(
            "delixi-modbus",
            _writes(6, 0x2000, lambda value: bool(value & 2)),
            _writes(6, 0x2000, lambda value: value & 3 == 1),
            {0: 2, 1: 1, 2: 2000, 428: 3},
            {500: 2000},
            "counter",
            makes={"framing": "rtu", "stop_time": 2},
            own_address=430,
        ),
        Kind(
            "delixi-native",
            lambda each: each.function == 2 and each.start in (2, 3),
            lambda each: each.function == 2 and each.start == 1,
            {0: 2, 1: 1, 2: 2000, 428: 3},
            {500: 2000},
            "counter",
            DELIXI,
            makes={"stop_time": 2},
            own_address=430,
        ),
        Kind(
            "yd1000",
            _writes(6, 0x1000, lambda value: bool(value & 0x0500) or not value & 0x8000),
            _writes(6, 0x1000, lambda value: value & 0x8500 == 0x8000),
            {0x0010: 1, 0x0011: 8000, 0x1001: 2000},
            {0x1100: 2000, 0x1201: 0x0400},
            "run_hours",
            makes={"stop_time": 2},
            halts=("stop", "coast", "emergency_stop"),
            own_address=0x0802,
        ),
        Kind(
            "fan",  # a user's own family, declared in the test
            _writes(6, 0x0030, lambda value: value == 1),
            _writes(6, 0x0030, lambda value: value == 0),
            {},
            {0x0010: 900},
            "current",
            makes={"confirmed": 1},  # confirmed by the user: no reply identifies the family
        ),
    )
}


class ResponderDrive:
    """A responder's drive: its registers, and its motor, which turns for `ramp` s after a stop."""

    def __init__(self, kind: Kind, address: int, ramp: float = 0.0) -> None:
        self.kind = kind
        self.address = address
        self.ramp = ramp
        self.runs = False  # True from a run command until a stop
        self._stands_at = 0.0
        self.switch_on()

    @property
    def turns(self) -> bool:
        return self.runs or time.monotonic() < self._stands_at

    def switch_on(self) -> None:
        """Restart as after a power failure: the motor is at rest, and all registers have factory values."""
        self.runs = False
        self._memory = dict(self.kind.memory)
        if self.kind.own_address is not None:
            self._memory[self.kind.own_address] = self.address
        self._coils = {0: 0, 1: 0, 2: 0}  # coils of ERMAN's START, STOP and EMERGENCY STOP

    def turn(self) -> None:
        """Start the motor as if on the panel."""
        self.runs = True
        self._coils[0] = COIL_ON

    def hold(self, address: int, value: int) -> None:
        """Return this value for all further reads of the address."""
        self._memory[address] = value

    def word(self, address: int, function: int) -> int:
        is_live = self.turns and function in (self.kind.live, 7)
        turning = self.kind.turning.get(address) if is_live else None
        return self._memory.get(address, 0) if turning is None else turning

    def state(self) -> int:
        """Return the run state for function 03 of Delixi's own protocol."""
        return 2 if self.turns else 1

    def write(self, asked: DriveRequest) -> None:
        before = self.runs
        if asked.function == 5:
            self._coils[asked.start] = asked.value
            self.runs = bool(self._coils[0]) and not (self._coils[1] or self._coils[2])
        else:
            self._memory[asked.start] = asked.value
            if self.kind.moves(asked):
                self.runs = True
            elif self.kind.stops(asked):
                self.runs = False
        if before and not self.runs:
            self._stands_at = time.monotonic() + self.ramp
