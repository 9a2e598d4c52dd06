"""A gateway part whose every call fails."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NoReturn


@dataclass(frozen=True)
class Settings:
    """The part's settings, which select how the part fails."""

    breaks: str = "always"

    def __post_init__(self) -> None:
        if self.breaks not in ("always", "library", "port"):
            raise ValueError(f"breaks = {self.breaks!r} is no way to break\nnor would another one be")


class BrokenFeed:
    """A feed whose every method raises an exception."""

    def take(self, batch: Any) -> NoReturn:
        raise RuntimeError("no room on the disk")

    async def run(self) -> NoReturn:
        raise RuntimeError("no broker")

    async def close(self) -> NoReturn:
        raise RuntimeError("no end")

    def health(self) -> NoReturn:
        raise RuntimeError("no health")

    def figures(self) -> NoReturn:
        raise RuntimeError("no figures")


def build(settings: Settings, inside: object) -> BrokenFeed:
    if settings.breaks == "library":
        raise ImportError("No module named 'nosuch'", name="nosuch")
    if settings.breaks == "port":
        raise OSError("127.0.0.1:1502 cannot be had")
    return BrokenFeed()
