"""Record into a history until killed: `python history_recorder.py FOLDER RUN`.

Each output line is the number of rows written so far. Row `n` of run `r` has the drive `run-r` and was sent
at `n * 10 ms` of the monotonic clock; each run starts 9 hours after the previous one.
"""

from __future__ import annotations

import sys
import time
from itertools import count
from pathlib import Path

from histories import METADATA, NOON, SECOND, batch

from multidrop.core.columns import Names
from multidrop.history import writer as writer_module
from multidrop.history.writer import HistoryWriter

STEP = SECOND // 100
RUN = 9 * 3600 * SECOND
ROWS = 30  # per batch


def main(folder: Path, run: int) -> None:
    writer_module.WRITING_S = 0.01
    names = Names([f"run-{run}"])
    writer = HistoryWriter(folder, METADATA, rotate=0.25)
    for number in count():
        writer.take(batch(names, 0, range(number * ROWS, (number + 1) * ROWS), NOON + run * RUN, STEP))
        print(writer.state().rows, flush=True)
        time.sleep(0.005)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
