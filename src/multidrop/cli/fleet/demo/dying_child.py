"""Runs a program that the kernel kills as soon as its parent is gone: dying_child.py PARENT PROGRAM WORDS.

It is run as a file, by an interpreter that imports nothing else: it becomes the program within milliseconds.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1  # prctl(2)


def become(parent: int, words: list[str]) -> None:
    """Become the program; where the parent has gone already, end."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() == parent:
        os.execv(words[0], words)


if __name__ == "__main__":
    become(int(sys.argv[1]), sys.argv[2:])
