"""Two clients and their drives on one pair: each receives all others, and simultaneous frames collide."""

from __future__ import annotations

import os
import random
import selectors
import threading
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import zip_longest
from time import sleep

from multidrop.core import set_settings

SLOT = 2e-3  # s; frames within one slot collide

Collision = Callable[[random.Random, Sequence[bytes]], bytes]


def interleaved(chance: random.Random, said: Sequence[bytes]) -> bytes:
    """Return the characters of both in alternation."""
    columns = zip_longest(*chance.sample(said, len(said)))
    return bytes(character for column in columns for character in column if character is not None)


def overlaid(chance: random.Random, said: Sequence[bytes]) -> bytes:
    """Return both at once: a 0 wins, because it starts a character and the bias is weak."""
    shorter, longer = sorted(said, key=len)
    at = chance.randint(0, len(longer) - len(shorter))
    middle = bytes(one & other for one, other in zip(shorter, longer[at:], strict=False))
    return longer[:at] + middle + longer[at + len(middle) :]


def cut_off(chance: random.Random, said: Sequence[bytes]) -> bytes:
    """Return the first until the other is louder."""
    first, second = chance.sample(said, 2)
    at = chance.randint(0, len(first))
    return first[:at] + second[chance.randint(0, at) if at else 0 :]


def one_after_another(chance: random.Random, said: Sequence[bytes]) -> bytes:
    """Return both whole, without a silence between them."""
    return b"".join(chance.sample(said, len(said)))


COLLISIONS: Sequence[Collision] = (interleaved, overlaid, cut_off, one_after_another)


class SharedPair:
    """A pair with the clients' ports `ours` and `theirs`; `sent` is what our client sent, before any
    collision.

    If `holds(said)` returns True for our client's bytes, a collision destroys them, and our client receives
    `says`.
    """

    def __init__(self, drives: str, baudrate: int, seed: int) -> None:
        self._chance = random.Random(seed)
        self._drives = os.open(drives, os.O_RDWR | os.O_NOCTTY)
        set_settings(self._drives, baudrate, "8N1")
        (self._our_side, self._our_port), (self._their_side, self._their_port) = os.openpty(), os.openpty()
        self._stop, self._wakeup = os.pipe()
        self.ours, self.theirs = os.ttyname(self._our_port), os.ttyname(self._their_port)
        for fd in (self._our_port, self._their_port):
            tty.setraw(fd)
        for fd in self._sides:
            os.set_blocking(fd, False)
        self._spoke = self._our_side  # the last client that spoke
        self.sent = b""
        self.collisions = 0
        self.holds: Callable[[bytes], bool] = lambda said: False
        self.says = b""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def _sides(self) -> tuple[int, int, int]:
        return self._our_side, self._their_side, self._drives

    def close(self) -> None:
        os.write(self._wakeup, b"!")
        self._thread.join()
        for fd in (*self._sides, self._our_port, self._their_port, self._stop, self._wakeup):
            os.close(fd)

    def _run(self) -> None:
        with selectors.DefaultSelector() as ready:
            for fd in (*self._sides, self._stop):
                ready.register(fd, selectors.EVENT_READ)
            while self._stop not in {key.fd for key, _ in ready.select()}:
                sleep(SLOT)
                self._exchange({fd: said for fd in self._sides if (said := _read(fd))})

    def _exchange(self, said: dict[int, bytes]) -> None:
        """Deliver this slot's frames to all others, with their collision."""
        ours = said.get(self._our_side)
        if ours:
            self.sent += ours
            if self.holds(ours):
                del said[self._our_side]
                said[self._their_side] = self.says
        self.collisions += len(said) > 1
        self._spoke = next((side for side in self._sides[:2] if side in said), self._spoke)
        for listener in sorted(self._sides, key=lambda side: side == self._spoke):
            if listener == self._spoke and self._drives in said:
                sleep(SLOT)  # ptys are slow: else the sender acts before the other client hears the reply
            others = [each for speaker, each in said.items() if speaker != listener]
            received = self._mixed(others)
            if received:
                with suppress(BlockingIOError):
                    os.write(listener, received)

    def _mixed(self, said: Sequence[bytes]) -> bytes:
        if len(said) < 2:
            return b"".join(said)
        return self._chance.choice(COLLISIONS)(self._chance, said)


def _read(fd: int) -> bytes:
    try:
        return os.read(fd, 4096)
    except BlockingIOError:
        return b""


@contextmanager
def shared(drives: str, baudrate: int, seed: int) -> Iterator[SharedPair]:
    pair = SharedPair(drives, baudrate, seed)
    try:
        yield pair
    finally:
        pair.close()
