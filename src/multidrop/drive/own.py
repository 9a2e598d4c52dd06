"""A drive's own registers and texts: at the same address another family has something else."""

from __future__ import annotations

from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.text import Text


def check_drive(drive: Drive) -> None:
    """Raise TypeError for what is no drive."""
    if not isinstance(drive, Drive):
        raise TypeError(f"{drive!r} is no drive: it is what attach returns")


def check_own(drive: Drive, register: Register[Any]) -> None:
    """Raise ValueError for another family's register: the same address means something else there.

    Raises TypeError for what is no register, such as a name.
    """
    check_drive(drive)
    if not isinstance(register, Register):
        hint = "use its attribute, or drive.register(NAME)"
        raise TypeError(f"{register!r} is no register of {drive.name}: {hint}")
    if drive.registers.get(register.name) is not register:
        family = drive.title or type(drive).__name__
        raise ValueError(f"this {register.name} is no register of {drive.name}, which is a {family}")


def check_readable(drive: Drive, register: Register[Any]) -> None:
    """Raise ValueError for a register that is written alone."""
    if not register.readable:
        raise ValueError(f"{register.name} of {drive.name} cannot be read: it is a {register.access.value}")


def check_own_text(drive: Drive, text: Text) -> None:
    """Raise ValueError for another family's text, TypeError for what is none."""
    check_drive(drive)
    if not isinstance(text, Text):
        raise TypeError(f"{text!r} is no text of {drive.name}: use its attribute, or drive.texts[NAME]")
    if drive.texts.get(text.name) is not text:
        family = drive.title or type(drive).__name__
        raise ValueError(f"this {text.name} is no text of {drive.name}, which is a {family}")
