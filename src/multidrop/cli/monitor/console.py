"""The console of the monitor: the terminal as rich draws on it."""

from __future__ import annotations

from os import get_terminal_size
from typing import Any


def open_console() -> Any:
    """Return the terminal. Raises ValueError when it is too small."""
    from rich.console import Console

    from multidrop.cli.monitor.screen import LEAST_HEIGHT, LEAST_WIDTH

    console = Console()
    if console.is_dumb_terminal:
        width, height = get_terminal_size()
        console = Console(width=width, height=height - 1)  # it scrolls, and its last line stays empty
    if console.width < LEAST_WIDTH or console.height < LEAST_HEIGHT:
        raise ValueError(
            f"the terminal is too small: it has {console.width} x {console.height} characters, "
            f"and the monitor needs {LEAST_WIDTH} x {LEAST_HEIGHT}"
        )
    return console
