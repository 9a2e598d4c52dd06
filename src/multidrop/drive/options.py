"""Options: properties of a drive that only its owner knows, such as `confirmed` for its make."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from multidrop.printable import is_number


@dataclass(frozen=True)
class Option:
    """A property of a drive that only its owner knows, such as its maximum frequency.

    An option without a unit is a whole number.
    """

    unit: str
    span: tuple[float, float]
    meaning: str


_CONFIRMED = Option("", (0, 1), "1: its name plate says what it is; the class has no `identify`")
_CHECKED = Option("", (0, 1), "1: its name plate says what it is, and `multidrop check` of its file was read")


def checked_options(
    family: str, options: Mapping[str, Option], given: Mapping[str, float]
) -> Mapping[str, float]:
    """Return `given`. Raises ValueError for an unknown option or a value outside the option's limits."""
    for name, value in given.items():
        if name not in options:
            known = ", ".join(options) or "none"
            raise ValueError(f"{family} has no option {name!r}; its options: {known}")
        low, high = options[name].span
        if not is_number(value) or not low <= value <= high:
            raise ValueError(
                f"{name} = {value!r} is outside {low:g} to {high:g} {options[name].unit}".rstrip()
            )
        if not options[name].unit and value != int(value):
            raise ValueError(f"{name} = {value!r} is not a whole number from {low:g} to {high:g}")
    return given


def confirmation(declared_in: str, *, identifies: bool) -> Mapping[str, Option]:
    """Return the option `confirmed` if the class is untested or cannot identify its drives, else {}."""
    if declared_in:
        return {"confirmed": _CHECKED}
    return {} if identifies else {"confirmed": _CONFIRMED}


def doubt(family: str, declared_in: str, *, identifies: bool) -> str:
    """Return why the owner must confirm that a drive is of this class; "" if that is not needed."""
    if declared_in:
        return (
            f"the family file {declared_in} is not confirmed for this drive. Compare the output of "
            f"`multidrop check {declared_in}` with the manual, read the drive's name plate"
        )
    if not identifies:
        return (
            f"its class cannot identify a {family}, and the write may start a motor on a drive of another "
            "maker. Read the drive's name plate"
        )
    return ""
