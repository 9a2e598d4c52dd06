"""Known setpoint: what a drive was told last, as far as it is known to hold it."""

from __future__ import annotations

from collections.abc import Callable


class _Write:
    """One write of the setpoint whose end is not known."""

    def __init__(self, before: float | _Write | None) -> None:
        self.before = before


class KnownSetpoint:
    """The setpoint of one drive; None where it is not known that the drive holds what was written."""

    def __init__(self) -> None:
        self._told: float | _Write | None = None

    @property
    def value(self) -> float | None:
        return None if isinstance(self._told, _Write) else self._told

    @value.setter
    def value(self, value: float | None) -> None:
        self._told = value

    def begin_write(self) -> Callable[[], None]:
        """Know none until a write has ended; return what is to be called where it has changed nothing.

        What another thread has written since stays.
        """
        write = _Write(self._told)
        self._told = write

        def take_back() -> None:
            if self._told is write:
                self._told = write.before

        return take_back
