"""Cleanup for `fleet demo`, run as a file by an interpreter that imports nothing else.

demo_guard.py exec PARENT PROGRAM WORDS   become the program; the kernel kills it when the parent ends
demo_guard.py remove FOLDER               remove the folder when standard input ends
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import sys
import time

PR_SET_PDEATHSIG = 1  # prctl(2)
ATTEMPTS = 100  # retries, because processes that are being killed may still write


def become(parent: int, words: list[str]) -> None:
    """Replace this process by the program; exit instead if the parent has already ended."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() == parent:
        os.execv(words[0], words)


def remove_at_end(folder: str) -> None:
    """Remove the folder when standard input ends."""
    os.read(0, 1)
    for _ in range(ATTEMPTS):
        shutil.rmtree(folder, ignore_errors=True)
        if not os.path.lexists(folder):
            return
        time.sleep(0.1)


if __name__ == "__main__":
    if sys.argv[1] == "exec":
        become(int(sys.argv[2]), sys.argv[3:])
    else:
        remove_at_end(sys.argv[2])
