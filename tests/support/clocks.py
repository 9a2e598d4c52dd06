"""Clocks that a test sets."""


class Clock:
    """A clock of monotonic seconds."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now
