"""Simulated INNOVERT IBD (manual, part 9, appendix 2)."""

from __future__ import annotations

from multidrop.core import Framing
from multidrop.sim.memory import MemoryCell
from multidrop.sim.motor import Phase
from multidrop.sim.motor_drive import MotorDrive

SETPOINT = 0x2001
STORED_SETPOINT, FREQUENCY_SOURCE, RUN_SOURCE = 100, 101, 102  # addresses of Prb.00, .01 and .02
BY_PARAMETER, BY_LINE, RUN_BY_LINE = 0, 5, 2
STOP, RUN, JOG = 1, 2, 3  # values of bits 1 and 0 of 2000H
ALWAYS_SEEN = 1 << 11 | 1 << 12  # bits of PrA.22 that are set in the manual's example
LARGEST = {107: 36000, 108: 36000}  # assumed maxima of Prb.07 and Prb.08; the manual states none
OUTPUTS = {323: 1 << 8, 324: 1 << 9, 325: 1 << 10, 328: 1 << 13}  # Prd.nn: the output's bit in PrA.22
RUNNING, FAULT, ACCELERATING, DECELERATING = 1, 3, 7, 8  # output functions, as set in Prd.23 to .28
BAUDRATES = (4800, 9600, 19200, 38400)
FORMATS = ("8N1", "8E1", "8O1")


class SimulatedIBD(MotorDrive):
    """INNOVERT IBD, set up for RS-485 (Prb.01 = 5, Prb.02 = 2), with outputs programmed as in the example.

    The manual documents no exceptions: a request that fails gets no reply. A value above the maximum is
    stored as the maximum, but the reply repeats the written value. A run command does not end a jog; a stop
    does, and then a new run command runs the motor (table 3).

    Assumptions beyond the manual: unless Prb.02 = 2, a command is confirmed and has no effect. The setpoint
    is 0 if Prb.01 is neither 5 nor 0. The unit of Prb.00 is 0.01 Hz, like that of 2001H.
    """

    functions = (0x03, 0x06)
    needs_silence = True  # according to the manual's table "message in RTU mode"
    codes = {}
    begins = {
        FREQUENCY_SOURCE: BY_LINE,
        RUN_SOURCE: RUN_BY_LINE,
        323: RUNNING,
        324: ACCELERATING,
        325: DECELERATING,
        328: FAULT,
    }

    _jogs = False

    @property
    def most_gap(self) -> float:
        return super().most_gap if self.drive.framing is Framing.ASCII else 10e-3

    def accept(self, cell: MemoryCell, raw: int) -> int:
        register = cell.register
        if register is not None and register.span is not None:
            return min(raw, int(register.encode(register.span[1])))
        return min(raw, LARGEST.get(cell.address, raw))

    def setpoint(self) -> float:
        source = {BY_LINE: SETPOINT, BY_PARAMETER: STORED_SETPOINT}.get(self.word(FREQUENCY_SOURCE))
        return self.word(source) / 100 if source is not None else 0.0

    def _control(self, bits: int) -> None:
        """Carry out a control word.

        The manual is ambiguous about BIT3 and BIT2; here they form one number.
        """
        if bits & 0x10:
            self.motor.reset()
        action = bits & 0x03
        jogs = self._jogs and self.motor.energised
        if self.word(RUN_SOURCE) != RUN_BY_LINE or (jogs and action == RUN):
            return
        self.run_or_stop(action, {0x04: -1, 0x08: 1, 0x0C: -self.motor.direction}.get(bits & 0x0C))
        self._jogs = action == JOG or (jogs and action != STOP)

    def _terminals(self) -> int:
        says = {
            RUNNING: self.motor.energised,
            FAULT: bool(self.motor.fault),
            ACCELERATING: self.motor.phase is Phase.ACCELERATING,
            DECELERATING: self.motor.phase is Phase.DECELERATING,
        }
        bits = (bit for address, bit in OUTPUTS.items() if says.get(self.word(address)))
        return sum(bits, ALWAYS_SEEN)

    def _run_state(self) -> int:
        """Return the value of PA28, the run state, which some sibling models have."""
        if not self.motor.energised:
            return 0
        return 2 if self.motor.frequency < 0 else 1

    def _format(self) -> int:
        first_rtu = 0 if self.drive.framing is Framing.ASCII else len(FORMATS)
        return first_rtu + FORMATS.index(self.drive.settings.format)

    obeys = {"control": _control}
    shows = {
        "terminals": _terminals,
        "run_state": _run_state,
        "baudrate_setting": lambda self: BAUDRATES.index(self.drive.settings.baudrate),
        "format_setting": _format,
        "address_setting": lambda self: self.drive.address,
    }
