"""Locks on files that end with their process."""

from __future__ import annotations


def lock(file: int) -> None:
    """Lock an open file for this process alone. Raises BlockingIOError while another one has it."""
    import fcntl  # which Windows lacks

    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
