"""LineFacts: what a family needs of a line, and the settings of one drive there."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

from multidrop.core import MODBUS, Framing
from multidrop.drive.network import speaks_tcp
from multidrop.drive.timing import Settings

LONGEST_SILENCE = 1.0  # s
SERIAL_ADDRESSES = range(1, 248)  # 0 is a broadcast there


class LineFacts:
    """The facts of the line that a family's manual states, and the settings of one drive."""

    title: ClassVar[str] = ""

    framings: ClassVar[tuple[Framing, ...]] = (Framing.RTU,)
    formats: ClassVar[Mapping[Framing, tuple[str, ...]]] = {}  # the first is the default
    baudrates: ClassVar[tuple[int, ...]] = (9600, 1200, 2400, 4800, 19200, 38400, 57600, 115200)
    addresses: ClassVar[range] = range(1, 248)
    line_terminals: ClassVar[str] = ""  # the drive's two terminals for the line
    most_devices: ClassVar[int] = 0  # on a line with such a drive; 0: not stated

    silence: ClassVar[float] = 0.0  # s, before and after a frame; t3.5 is the least for RTU
    silence_characters: ClassVar[float] = 0.0  # the same, in characters
    response_delay: float = 0.005  # s, typical, from the request's end to the reply's begin
    response_delay_characters: ClassVar[float] = 0.0  # the same, in characters, where that is more
    response_timeout: ClassVar[float] = 0.3  # s, after which no reply is expected
    answering_time: ClassVar[float] = 0.0  # s that the document gives the drive for a reply; 0: not stated
    turnaround_delay: ClassVar[float] = 0.1  # s, after a broadcast

    least_interval: ClassVar[float] = 0.0  # s, from the end of an exchange to the next request to the drive
    # It answers or refuses each read of its table and is silent to none: a proof goes before its first value.
    answers_every_read: ClassVar[bool] = False

    def __init__(
        self,
        address: int,
        framing: Framing | str | None,
        baudrate: int | None,
        format: str | None,
        silence: float | None,
    ) -> None:
        self.address = self._checked("address", address, self.addresses)
        self.framing = self._framing(framing)
        self._declared_framing = None if framing is None else self.framing
        formats = self.formats_in(self.framing)
        self.settings = Settings(
            self._checked("baud rate", self.baudrates[0] if baudrate is None else baudrate, self.baudrates),
            self._checked("format", formats[0] if format is None else format, formats),
        )
        self.agreed_silence = silence
        self._check_silence()
        self.response_delay = max(
            self.response_delay, self.response_delay_characters * self.settings.character
        )

    @classmethod
    def _checked(cls, what: str, value: Any, allowed: Any) -> Any:
        if value in allowed and not isinstance(value, bool | float):  # True equals 1, and 1.0 does
            return value
        choices = (
            f"{allowed[0]} to {allowed[-1]}"
            if isinstance(allowed, range)
            else ", ".join(str(choice) for choice in allowed)
        )
        raise ValueError(f"{what} {value!r} is not one of {cls.title or cls.__name__}: {choices}")

    @classmethod
    def _framing(cls, framing: Framing | str | None) -> Framing:
        if framing is None:
            return cls.framings[0]
        if isinstance(framing, str):
            framing = {str(known): known for known in Framing}.get(framing.lower(), framing)
        if framing is Framing.TCP and cls.speaks(framing):
            return framing
        if framing not in cls.framings:
            known = ", ".join(str(one) for one in cls.framings)
            hint = f"; write {known}, or leave it out" if len(cls.framings) == 1 else ""
            family = cls.title or cls.__name__
            raise ValueError(f"framing {str(framing)!r} is not one of {family}: {known}{hint}")
        return Framing(framing)

    @classmethod
    def speaks(cls, framing: Framing) -> bool:
        """Return True for the document's framings, and for TCP where one is Modbus: a gateway translates."""
        return framing in cls.framings or (
            framing is Framing.TCP and any(one in MODBUS for one in cls.framings)
        )

    @classmethod
    def formats_in(cls, framing: Framing) -> tuple[str, ...]:
        """Return the formats of a framing; with TCP those of the wire behind the gateway."""
        return cls.formats.get(framing) or cls.formats[cls.framings[0]]

    def take_framing_of(self, port: str) -> None:
        """Take the framing that this port has: TCP on tcp://, and what was declared on any other.

        Raises ValueError where the drive cannot have it.
        """
        is_tcp, declared = speaks_tcp(port), self._declared_framing or self.framings[0]
        if is_tcp and self._declared_framing not in (None, Framing.TCP):
            raise ValueError(
                f"framing {declared} is a serial line's, and {port} speaks Modbus TCP: leave "
                "framing out, or name the port socket:// where the far end passes serial bytes on"
            )
        if is_tcp and not self.speaks(Framing.TCP):
            raise ValueError(
                f"{self.title or type(self).__name__} does not speak Modbus, and {port} carries "
                "nothing else: name the port socket://, and have the far end pass serial bytes on"
            )
        if not is_tcp and declared is Framing.TCP:
            raise ValueError(
                f"framing tcp is that of tcp:// ports, such as tcp://10.0.0.7:502, and {port} is none"
            )
        if not is_tcp and self.address not in SERIAL_ADDRESSES:
            raise ValueError(
                f"address {self.address} is a unit id of Modbus TCP; on {port} it must be "
                f"{SERIAL_ADDRESSES[0]} to {SERIAL_ADDRESSES[-1]}"
            )
        self.framing = Framing.TCP if is_tcp else declared

    def needed_silence(self) -> float:
        """Return the silence in s that this drive needs before a request and after its reply."""
        own = max(self.silence, self.silence_characters * self.settings.character)
        if self.framing is Framing.TCP:  # the gateway keeps it
            return 0.0
        if self.framing is not Framing.RTU:
            return own
        return max(self.settings.t3_5 if self.agreed_silence is None else self.agreed_silence, own)

    def _check_silence(self) -> None:
        """Refuse a silence that may also occur within a frame, or that is no time at all."""
        agreed, least = self.agreed_silence, 1.5 * self.settings.character
        if agreed is None:
            return
        if (
            isinstance(agreed, bool)
            or not isinstance(agreed, (int, float))
            or not 0 <= agreed <= LONGEST_SILENCE
        ):
            raise ValueError(f"silence {agreed!r} is not a time from 0 to {LONGEST_SILENCE:g} s")
        if self.framing is Framing.RTU and self.needed_silence() < least:
            raise ValueError(
                f"silence {agreed * 1e6:g} us is shorter than 1.5 characters at {self.settings}, which may "
                f"pass within a frame: it must be {math.ceil(least * 1e6)} us or more"
            )
