"""Limits of what is kept: an age, a size, and the files that are beyond them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

AGES = {"s": 1.0, "min": 60.0, "h": 3600.0, "day": 86400.0, "week": 604800.0}  # in s
SIZES = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}  # in bytes


class StoredFile(NamedTuple):
    """A file of rows whose number grows with the time of recording."""

    path: Path
    number: int  # of its last segment
    end: float  # the newest of it, in s since 1970
    size: int  # in bytes


def outlived(
    files: Iterable[StoredFile], now: float, keep: float | None, most: int | None
) -> list[StoredFile]:
    """Return the files to remove: those that are older than `keep` s, and the oldest beyond `most`.

    `now` is in s since 1970, `most` is the number of bytes that may stay. The oldest is the one with the
    lowest number, whatever the clock said. None is no limit.

    An age is the sum of the times from each file's end to the next one's, and to `now`. Of those a time that
    is longer than `keep` is left out: the clock jumped, or nothing was recorded. Neither empties a history.
    """
    in_order = sorted(files, key=lambda file: file.number)
    ages = {} if keep is None else _ages(in_order, now, keep)
    gone = [file for file in in_order if keep is not None and ages[file.number] > keep]
    left = [file for file in in_order if file not in gone]
    total = sum(file.size for file in left)
    for file in left:
        if most is None or total <= most:
            break
        gone.append(file)
        total -= file.size
    return gone


def _ages(files: Iterable[StoredFile], now: float, longest: float) -> dict[int, float]:
    """Return the age in s of each number, without steps that are longer than this, or back in time."""
    ends: dict[int, float] = {}
    for file in files:
        ends[file.number] = min(file.end, ends.get(file.number, file.end))  # a copy may say later
    ages, age, later = {}, 0.0, now
    for number in sorted(ends, reverse=True):
        step = later - ends[number]
        if 0.0 < step <= longest:
            age += step
        ages[number], later = age, min(later, ends[number])
    return ages


def parse_age(text: str) -> float:
    """Return the seconds in an age such as "30 days"; ValueError if it is none."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(?:(s|min|h)|(day|week)s?)", str(text).strip(), re.ASCII)
    seconds = float(match[1]) * AGES[match[2] or match[3]] if match else 0.0
    if not 1.0 <= seconds <= 36525 * AGES["day"]:
        raise ValueError(
            f'{text!r} is not a time from 1 s to 100 years, such as "10 min", "1 h" or "30 days"'
        )
    return seconds


def parse_size(text: str) -> int:
    """Return the bytes in a size such as "20 GB"; ValueError if it is none."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(kB|MB|GB|TB)", str(text).strip(), re.ASCII)
    size = round(float(match[1]) * SIZES[match[2]]) if match else 0
    if not SIZES["kB"] <= size <= 10**18:
        raise ValueError(f'{text!r} is not a size from 1 kB on, such as "500 MB" or "20 GB"')
    return size
