"""Write files so that a crash or a power failure leaves either the old or the whole new content."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

UNFINISHED = ".*.tmp"  # pattern of the files that killed processes leave behind
_UNSUPPORTED = (errno.EINVAL, errno.ENOTSUP)  # errors of network disks that cannot sync folders


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield the path of a new file, which replaces `path` at the end of the block, once it is on the disk.

    If the block or the disk fails, the new file is removed, `path` keeps its content, and the exception
    propagates.
    """
    part = path.with_name(UNFINISHED.replace("*", path.name))
    try:
        part.unlink(missing_ok=True)
        yield part
        sync_to_disk(part)
        part.replace(path)
        sync_to_disk(path.parent)
    except BaseException:
        with suppress(OSError):
            part.unlink()
        raise


def sync_to_disk(path: Path) -> None:
    """Wait until a file's content, or the names in a folder, are on the disk."""
    is_windows, is_folder = sys.platform == "win32", path.is_dir()
    if is_windows and is_folder:  # Windows cannot open folders, and does not need to flush them
        return
    file = os.open(path, os.O_RDWR if is_windows else os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(file)
    except OSError as failure:
        if not is_folder or failure.errno not in _UNSUPPORTED:
            raise
    finally:
        os.close(file)
