"""A temporary folder that goes when the process that made it is gone, even by SIGKILL.

Run as a file, this removes the folder when its standard input ends.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp

ATTEMPTS = 100  # children that are being killed may still write


@contextmanager
def vanishing_folder() -> Iterator[Path]:
    """Make a folder, and remove it with all that is in it."""
    folder = mkdtemp(prefix="multidrop-")
    words = [sys.executable, "-I", "-S", __file__, folder]
    with subprocess.Popen(words, stdin=subprocess.PIPE, start_new_session=True) as remover:
        try:
            yield Path(folder)
        finally:
            assert remover.stdin is not None
            remover.stdin.close()


def remove_at_end(folder: str) -> None:
    """Remove the folder when standard input ends."""
    os.read(0, 1)
    for _ in range(ATTEMPTS):
        shutil.rmtree(folder, ignore_errors=True)
        if not os.path.lexists(folder):
            return
        time.sleep(0.1)


if __name__ == "__main__":
    remove_at_end(sys.argv[1])
