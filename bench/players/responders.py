"""A context manager that runs responders.c, which simulates drives on many lines."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from socket import socket, socketpair

from bench.support.programs import FRAMES, compiled, talking


@contextmanager
def responders(kind: str, count: int, *options: object) -> Iterator[tuple[list[str], list[int]]]:
    """Simulate `count` lines; yield their ports, and the descriptors that a child process must inherit."""
    program = compiled("players/responders.c", *FRAMES)
    if kind == "pty":
        with talking([program, "--ptys", count, *options]) as talker:
            yield talker.said.split(), []
        return
    pairs: list[tuple[socket, socket]] = [socketpair() for _ in range(count)]
    try:
        theirs = [far.fileno() for _, far in pairs]
        ours = [near.fileno() for near, _ in pairs]
        with talking([program, *options, *theirs], pass_fds=theirs):
            yield [str(fd) for fd in ours], ours
    finally:
        for end in (end for pair in pairs for end in pair):
            end.close()
